"""Shadow volumes: `shadow_volume`; edges, silhouettes, the volumes' triangles, and counting them in the stencil."""
