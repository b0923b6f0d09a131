"""The selector's choices against the best measured choices: ``python -m benchmarks.selection``, docs/selection.md."""
