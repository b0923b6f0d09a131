"""The sun at one point: its horizon profile by relief, meshes and trees, and the times of direct sun."""
