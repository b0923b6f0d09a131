"""Algorithm `shadow_volume`: edges and silhouettes of casters, the volumes' triangles, and counting them in the stencil."""
