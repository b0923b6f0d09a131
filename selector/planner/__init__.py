"""Turn choices into plans: the rules, and the algorithm for each light and kind of casters, each with its reason."""
