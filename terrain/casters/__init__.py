"""What can shade a point: how far towards the sun to look, which ground, meshes and trees cast there, and rays through them.

May import: gbuffer, geo, ground, level, scene, scene_objects, trees.
"""
