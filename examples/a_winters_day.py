# %% [markdown]
# # A winter's day in the ridges
#
# Where does shadow fall, for how long, and from which ridge? This notebook only needs `import skugga` and arrays. The heights are
# the SRTM sample of matplotlib, bundled as the level `jacksboro`. `skugga.open_level("dem.tif")` opens your own raster.

# %%
import matplotlib.pyplot as plt
import numpy as np

import skugga

plt.rcParams.update({"figure.dpi": 75, "savefig.dpi": 75})
level = skugga.open_level("jacksboro")
west, north = level.transform * (0, 0)
east, south = level.transform * (level.shape[1], level.shape[0])
print(f"{level.shape[1]} x {level.shape[0]} cells, {level.crs.name}, {west:.2f} to {east:.2f} E, {south:.2f} to {north:.2f} N")

# %% [markdown]
# ## Pictures
#
# `render` draws a view of the level: coloured relief with cast shadows.

# %%
picture = level.render(time="2024-12-21T16:15:00-05:00", size=(500, 427))
plt.figure(figsize=(6.8, 6.1), layout="constrained")
plt.imshow(picture)
plt.axis("off")
plt.title("21 December, 16:15: the sun stands 11 degrees high in the south-west")
plt.show()

# %% [markdown]
# ## Masks
#
# `shade` computes a mask on the raster's own cells: 0 is shadow, 255 is lit, 128 is nodata. Five times of the day:

# %%
fig, axes = plt.subplots(1, 5, figsize=(12, 2.4), layout="constrained")
for ax, hour in zip(axes, ("08:00", "09:00", "12:30", "16:00", "17:00"), strict=True):
    mask = level.shade("mask", time=f"2024-12-21T{hour}:00-05:00")
    ax.imshow(mask, cmap="gray", vmin=0, vmax=255)
    ax.set(title=f"{hour}, {(mask == 0).mean():.0%} dark", xticks=[], yticks=[])
plt.show()

# %% [markdown]
# ## Hours
#
# Counting masks would take hundreds of them. `sun_hours` finds the times at which each cell enters and leaves the sun.

# %%
hours = level.sun_hours("2024-12-21")
plt.figure(figsize=(6.6, 5.2), layout="constrained")
plt.imshow(hours, extent=(west, east, south, north), cmap="magma", aspect=1.0 / np.cos(np.radians((south + north) / 2.0)))
plt.colorbar(label="hours of sun on 21 December")
plt.show()
print(f"median {np.median(hours):.1f} h; {(hours < 4.0).mean():.1%} of the ground has less than 4 h")

# %% [markdown]
# ## At a point
#
# In a valley below the ridge: when does the sun appear and disappear, and what occludes it?

# %%
lon, lat = -84.1550, 36.4050
day = level.point(lon, lat, date="2024-12-21", clock="America/New_York", height=1.6).day
print(f"up {day.sunrise:%H:%M} to {day.sunset:%H:%M}, seen {day.first_sun:%H:%M} to {day.last_sun:%H:%M}: {day.direct_h:.1f} h")
for spell in day.sunlit:
    print(f"before {spell.begin:%H:%M}: {spell.after.kind}, {spell.after.distance_m:.0f} m away, {spell.after.height_m:.0f} m high")

# %%
horizon = level.horizon(lon, lat, height=1.6)
azimuth_rad = np.radians(horizon.azimuth_deg)
ax = plt.figure(figsize=(5, 5), layout="constrained").add_subplot(projection="polar")
ax.set(theta_zero_location="N", theta_direction=-1, rlim=(90.0, 0.0), title="The sky from there")
ax.fill_between(azimuth_rad, 0.0, horizon.elevation_deg, color="0.3", label="ground")
ax.legend(loc="lower left")
plt.show()

# %% [markdown]
# ## On a map
#
# With ipyleaflet, `Map(center=(lat, lon), zoom=11).add(level)` shows the level's tiles with cast shadows in a notebook.

# %%
level.close()
