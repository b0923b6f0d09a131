"""Plan -> Frame: the shadow algorithms, each filling the visibility of one light for the points of a geometry buffer."""
