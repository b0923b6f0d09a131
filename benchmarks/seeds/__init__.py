"""Replications of the experiments in the texts that Skugga is based on.

``python -m benchmarks.seeds`` writes docs/reports/seeds.md.
"""
