"""Measured against truth: trials of candidates, the policy `measure`, and the comparison behind the accuracy report.

May import: candidates, choices, formatting, planner, portfolio, ranking.
"""
