"""Compute how much of the sky the ground sees, in each of the definitions that tools call sky view factor or openness."""

import numpy as np

import skugga

KINDS = ("solid_angle", "cosine", "tilted", "openness", "negative_openness")

with skugga.open_level("jacksboro") as level:
    height_m = level.compute("height")
    print(f"{'kind':18} {'least':>6} {'mean':>6} {'most':>6}   height of the least")
    for kind in KINDS:
        values = level.sky_view(kind, azimuths=36)
        lowest = np.unravel_index(np.nanargmin(values), values.shape)
        print(f"{kind:18} {np.nanmin(values):6.2f} {np.nanmean(values):6.2f} {np.nanmax(values):6.2f}   {height_m[lowest]:.0f} m")
