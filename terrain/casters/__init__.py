"""Find what can cast a shadow on a point: the reach towards the sun, ground, meshes and trees within it, and rays through them."""
