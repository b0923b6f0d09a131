"""Compute a garden's hours of sun on 21 March, before and after a house is built south of it.

The heights are plain arrays in metres, without a file or a coordinate reference system.
"""

import numpy as np

import skugga

CELL_M = 0.5
LAT_DEG = 59.3  # Stockholm

before = np.zeros((120, 160), np.float32)  # 60 x 80 m of level ground, row 0 in the north
after = before.copy()
after[80:100, 60:100] = 7.0  # a house 10 m deep, 20 m wide and 7 m high
garden = np.s_[50:70, 60:100]  # 10 m of ground, 5 m north of the house

hours = {
    name: skugga.sun_hours(heights, CELL_M, "2024-03-21", LAT_DEG)[garden]
    for name, heights in (("before", before), ("after", after))
}
for name, garden_hours in hours.items():
    print(
        f"{name:6}  mean {garden_hours.mean():5.2f} h, least {garden_hours.min():5.2f} h, under 4 h: "
        f"{(garden_hours < 4.0).mean():4.0%}"
    )
