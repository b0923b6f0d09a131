"""Turn choices into plans: the fixed rules, and the planner, which assigns an algorithm to each light and kind of casters."""
