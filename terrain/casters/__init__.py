"""What can shade a point: how far towards the sun to look, which ground, meshes and trees cast there, and rays through them."""
