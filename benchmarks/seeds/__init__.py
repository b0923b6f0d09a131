"""The experiments of the texts that Skugga began with, made again: ``python -m benchmarks.seeds`` writes docs/seeds.md."""
