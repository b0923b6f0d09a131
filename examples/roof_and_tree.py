"""Compute the year of a solar panel on a roof, and what the ridge, the houses and a neighbour's tree take of it, kWh/m2."""

import skugga

LON, LAT = -84.15771, 36.22715  # on a shed in the made-up village, 5 m above its ground, north of a tree
HEIGHT_M, TILT_DEG, AZIMUTH_DEG = 5.0, 30.0, 180.0

with skugga.open_level("jacksboro_wooded") as level:
    report = level.point_irradiation(LON, LAT, year=2023, tilt=TILT_DEG, azimuth=AZIMUTH_DEG, height=HEIGHT_M)
assert report.months is not None and report.all_months is not None
print(f"panel {HEIGHT_M:g} m above the ground, sky view {report.sky_view:.2f}")
for name, sums in [*((month.month, month) for month in report.months), ("year", report.all_months)]:
    lost = [sums.lost(cause) for cause in ("relief", "solids", "forest")]
    print(
        f"{name:7}  {sums.total:7.1f} of {sums.open_sky:7.1f}, lost to the ridge {lost[0]:5.1f}, to houses {lost[1]:5.1f}, "
        f"to trees {lost[2]:5.1f}"
    )
