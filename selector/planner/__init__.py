"""From a choice to a plan: the rules, and the settings of maps and volumes that a target asks for, each with its reason.

May import: picks, serves.
"""
