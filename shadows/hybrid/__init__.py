"""The hybrid: `hybrid`, a small map that decides where it provably can, and volumes where it cannot.

May import: algorithm, attached, layer_collector, maps, passes, volumes, work.
"""
