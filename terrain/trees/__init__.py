"""Vegetation as data: where trees stand, in which order they are thinned out, and how their leaves look."""
