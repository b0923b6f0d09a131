"""Ground: read or generate heights, build the surface in a frame, decimate it, drape imagery and compute the sky-view factor."""
