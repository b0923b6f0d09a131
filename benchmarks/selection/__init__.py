"""The selector's choices against the best of what was measured: ``python -m benchmarks.selection``, docs/selection.md."""
