"""Vegetation as data: positions and sizes of trees, their thinning order, and the pictures of their foliage."""
