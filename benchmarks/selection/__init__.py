"""Comparison of the selector's choices with the best measured ones: ``python -m benchmarks.selection``, docs/selection.md."""
