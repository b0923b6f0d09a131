"""Where figures come from: scripts that anybody can run again, ``python -m benchmarks.NAME``."""
