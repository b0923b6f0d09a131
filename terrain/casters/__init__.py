"""Find the geometry that can cast a shadow on a point, and trace rays through it.

The reach is the distance towards the sun within which ground can still cast a shadow. The geometry is ground, meshes and trees.
"""
