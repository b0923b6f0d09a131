"""Scripts that measure the figures in the documentation. Anybody can run them again: ``python -m benchmarks.NAME``."""
