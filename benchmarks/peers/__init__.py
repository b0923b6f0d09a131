"""Other tools on the same work: ``python -m benchmarks.peers`` writes docs/peers.md."""
