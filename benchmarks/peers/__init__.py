"""Comparison of Skugga's cast shadows with those of other tools: ``python -m benchmarks.peers`` writes docs/reports/peers.md."""
