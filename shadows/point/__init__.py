"""What one point sees of the sun: its horizon in every direction by relief, meshes and trees, and when the sun clears it."""
