"""Positions: earth-fixed space, local frames, map grids, cameras, the sun, its light space (axes along its rays), vector files."""
