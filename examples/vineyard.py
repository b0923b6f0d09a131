"""Compute what slopes of a valley receive from April to October against level ground: where a vineyard would ripen."""

import numpy as np

import skugga

SEASON = {"date": "2023-04-01", "to": "2023-10-31", "days": "mean"}
FACINGS = ("north", "east", "south", "west")

with skugga.open_level("jacksboro") as level:
    slopes, plain = (level.irradiation(**SEASON, plane=plane) for plane in ("ground", "level"))
    height_m = level.compute("height")
    beam = level.irradiation(**SEASON, part="beam")
down, right = np.gradient(height_m)
facing = ((np.degrees(np.arctan2(-right, down)) + 45.0) % 360.0 // 90.0).astype(int)
steep = np.hypot(down, right) > np.nanpercentile(np.hypot(down, right), 75)
print(f"level ground {np.nanmean(plain):.0f} kWh/m2 from April to October")
for number, name in enumerate(FACINGS):
    of_facing = steep & (facing == number)
    gain = np.nanmean(slopes[of_facing]) / np.nanmean(plain[of_facing]) - 1.0
    print(
        f"steep, facing {name:5}  {np.nanmean(slopes[of_facing]):5.0f} kWh/m2, {gain:+.1%}; beam {np.nanmean(beam[of_facing]):5.0f}"
    )
