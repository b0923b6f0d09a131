"""Compute the clear-sky beam irradiation of a solar panel, and the share that the horizon occludes.

pvlib gets the horizon profile from Skugga as a series by azimuth.
"""

import numpy as np
import pandas as pd
import pvlib

import skugga

LON, LAT = -84.1550, 36.4050  # under a ridge of the Jacksboro fault, Tennessee
TURBIDITY = 3.0  # Linke's, of clear air inland
TILT_DEG, PANEL_AZIMUTH_DEG = 35.0, 180.0

with skugga.open_level("jacksboro") as level:
    horizon = level.horizon(LON, LAT, height=6.0)
profile = pd.Series(horizon.elevation_deg, horizon.azimuth_deg)
print(f"horizon: mean {profile.mean():.1f} degrees, highest {profile.max():.1f} towards {profile.idxmax():.1f}")

times = pd.date_range("2024-01-01", "2025-01-01", freq="10min", tz="UTC", inclusive="left")
sun = pvlib.solarposition.get_solarposition(times, LAT, LON)
sun = sun[sun.apparent_elevation > 0.0]
air_mass = pvlib.atmosphere.get_absolute_airmass(pvlib.atmosphere.get_relative_airmass(sun.apparent_zenith))
dni = pvlib.clearsky.ineichen(sun.apparent_zenith, air_mass, TURBIDITY)["dni"]
beam = dni * np.maximum(pvlib.irradiance.aoi_projection(TILT_DEG, PANEL_AZIMUTH_DEG, sun.apparent_zenith, sun.azimuth), 0.0)

horizon_deg = np.interp(sun.azimuth, profile.index, profile.to_numpy(), period=360.0)
is_visible = sun.apparent_elevation > horizon_deg
kwh = 10.0 / 60.0 / 1000.0
for month, month_beam in beam.groupby(beam.index.month):
    occluded_share = 1.0 - month_beam[is_visible[month_beam.index]].sum() / month_beam.sum()
    print(
        f"{pd.Timestamp(2024, month, 1):%b}  {month_beam.sum() * kwh:6.1f} kWh/m2, {occluded_share:5.1%} of it behind the horizon"
    )
