"""Comparison of the selector's choices with the best measured ones (docs/reports/selection.md).

python -m benchmarks.selection COMMAND
"""
