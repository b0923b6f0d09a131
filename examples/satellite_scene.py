"""Compute the shadow mask and the cosine of incidence of a satellite scene, for topographic correction.

The bundled SRTM raster stands in for your own DEM. The sun's angles come from the scene's metadata.
"""

import numpy as np

import skugga

SUN_AZIMUTH_DEG, SUN_ALTITUDE_DEG = 159.4, 27.3  # typical of December scenes at mid latitudes

with skugga.open_level("jacksboro") as level:
    scene_grid = {"azimuth": SUN_AZIMUTH_DEG, "altitude": SUN_ALTITUDE_DEG, "crs": "EPSG:32616", "resolution": 30.0}
    mask = level.shade("mask", **scene_grid)  # uint8: 0 shadow, 255 lit, 128 off the data
    cos_i = level.shade("cosi", **scene_grid)  # float32, NaN off the data

ground = mask != 128
lit = mask == 255
print(f"{mask.shape[1]} x {mask.shape[0]} cells of 30 m, {(mask[ground] == 0).mean():.2%} of the ground in shadow")

# C correction (Teillet et al. 1982) of a band whose reflectance follows cos i: here a synthetic one.
zenith = np.deg2rad(90.0 - SUN_ALTITUDE_DEG)
band = 0.25 * (0.2 + 0.8 * cos_i) + np.random.default_rng(1).normal(0.0, 0.004, cos_i.shape)
slope, offset = np.polyfit(cos_i[lit], band[lit], 1)
c = offset / slope
corrected = band * (np.cos(zenith) + c) / (cos_i + c)
for name, band_values in (("as seen", band), ("corrected", corrected)):
    print(f"{name:9}  correlation with cos i: {np.corrcoef(band_values[lit], cos_i[lit])[0, 1]:+.2f}")
