"""Shadow volumes: `shadow_volume`; edges, silhouettes, the volumes' triangles, and counting them in the stencil.

May import: algorithm, area_light, attached, passes, work.
"""
