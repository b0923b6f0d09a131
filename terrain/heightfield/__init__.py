"""Heightfields (heights at the nodes of a grid) for the loops that follow rays over them: curvature, maxima of tiles, slopes."""
