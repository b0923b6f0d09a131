"""First and last direct sun of a winter's day along a valley, and the occluder before the first sun."""

import numpy as np

import skugga

VALLEY_START, VALLEY_END = (-84.235, 36.355), (-84.115, 36.430)  # up a valley of the Jacksboro fault, Tennessee

print("   lon     lat   ground   first    last   direct sun   before the first sun")
with skugga.open_level("jacksboro") as level:
    for fraction in np.linspace(0.0, 1.0, 7):
        lon, lat = (start + fraction * (end - start) for start, end in zip(VALLEY_START, VALLEY_END, strict=True))
        report = level.point(lon, lat, date="2024-12-21", clock="America/New_York", height=1.6)
        day = report.day
        if not day.sunlit:
            print(f"{lon:8.4f} {lat:.4f} {report.elevation_m:5.0f} m   {day.remark}")
            continue
        occluder = day.sunlit[0].after
        occluder_text = "the level horizon" if occluder is None else f"{occluder.kind}, {occluder.distance_m / 1000.0:.1f} km away"
        print(
            f"{lon:8.4f} {lat:.4f} {report.elevation_m:5.0f} m   {day.first_sun:%H:%M}   {day.last_sun:%H:%M}"
            f"   {day.direct_h:4.1f} of {day.daylight_h:.1f} h   {occluder_text}"
        )
