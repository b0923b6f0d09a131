"""Positions: earth-fixed space and local frames, map grids, cameras, the sun and its light space, vector files."""
