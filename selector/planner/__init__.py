"""From a choice to a plan: the rules, and what runs for each light and kind of casters, each with its reason."""
