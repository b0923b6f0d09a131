"""Measured against truth: probes of candidates, the policies `probe` and `measure`, and the comparison behind the accuracy report.

May import: belief, candidates, choices, cost, expected_loss, formatting, options, planner, predict, ranking,
seen.
"""
