"""Climate: the ground's colour by height and latitude, for styles whose own colours are those of central Europe's climate.

Latitude and height alone decide, so that a place has the same colour in every map, tile and zoom.

- **Ice** lies above the snow line. The snow line is at sea level in Antarctica and highest in the dry subtropics.
- **Vegetation** thins out in the subtropics, where air sinks and dries, and towards the poles, where it is cold.

The model ignores rain from mountains and coasts: Florida and the Sahara get the same share of desert colours, at most
``MAX_DESERT_SHARE``.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.color_ramp import ColorRamp
from skugga.terrain.interpolation import smoothstep

SNOW_LINE_BY_LATITUDE = (
    (-90.0, -700.0), (-64.0, -400.0), (-60.0, 150.0), (-55.0, 700.0), (-48.0, 1250.0), (-44.0, 1900.0), (-38.0, 2800.0),
    (-33.0, 4300.0), (-27.0, 5700.0), (-20.0, 5800.0), (-10.0, 5000.0), (0.0, 4800.0), (10.0, 4900.0), (20.0, 5500.0),
    (30.0, 5500.0), (36.0, 4700.0), (41.0, 3800.0), (46.0, 3050.0), (55.0, 2300.0), (61.0, 1750.0), (68.0, 1250.0),
    (74.0, 700.0), (79.0, 350.0), (83.0, 50.0), (87.0, -400.0), (90.0, -400.0),
)  # fmt: skip
"""Latitudes in degrees, and the height in metres above which more snow falls than melts.

Rounded from the lower ends of glaciers in the Alps, Scandinavia, Svalbard, the Himalaya, the Andes, New Zealand and Antarctica.
"""

ICE_BLEND_HALF_RANGE_M = 250.0
"""Half the range of heights, centred on the snow line, over which ground blends into ice."""

MAX_DESERT_SHARE, ARID_LATITUDES_DEG = 0.75, ((13.0, 21.0), (28.0, 36.0))
"""Share of the desert's colours in the middle of the dry belt, and the latitudes over which that share rises and falls."""

TUNDRA_LATITUDES_DEG = (60.0, 70.0), (-52.0, -60.0)
"""Latitudes over which meadows blend into tundra: of the northern hemisphere, and of the southern one, which is colder."""

SEA_FLOOR_BLEND_RANGE_M = -500.0, -440.0
"""Heights between which the sea floor, which has no climate, blends into land. The Dead Sea's shore is the lowest land."""

ARID_RAMP: ColorRamp = (
    (0.0, "#d8c8a2"), (500.0, "#dbcdab"), (1100.0, "#ded1b3"), (1700.0, "#dfd4ba"), (2400.0, "#e0d6c2"), (3100.0, "#e3dccf"),
    (3800.0, "#e9e6e1"), (4600.0, "#f6f6f6"), (6000.0, "#fdfdfe"),
)  # fmt: skip
TUNDRA_RAMP: ColorRamp = (
    (0.0, "#bcbda6"), (400.0, "#c5c3ae"), (1000.0, "#cec9b7"), (1700.0, "#d6cfc1"), (2400.0, "#dcd6cb"), (3100.0, "#e2ddd6"),
    (3800.0, "#e9e6e1"), (4600.0, "#f6f6f6"), (6000.0, "#fdfdfe"),
)  # fmt: skip
ICE_RAMP: ColorRamp = ((0.0, "#ebf1f5"), (2500.0, "#f1f5f8"), (4600.0, "#f7f9fa"), (6000.0, "#fdfdfe"))

TINT_LATITUDE_ROWS = 181
"""Rows of a tint table, at even steps of the latitude's sine from -1 to 1: 0.6 degrees at the equator, 1.3 at 60 degrees."""


def climate_srgb(style_ramp: ColorRamp, heights_m: np.ndarray) -> np.ndarray:
    """Return the ground's sRGB colours (``TINT_LATITUDE_ROWS``, n, 3) in [0, 1] by latitude and height.

    Heights (n,) are in metres. ``style_ramp`` is the style's own colour ramp, for land that is neither ice, desert nor tundra.
    """
    latitude = np.degrees(np.arcsin(np.linspace(-1.0, 1.0, TINT_LATITUDE_ROWS)))[:, None]
    on_land, ground = (
        smoothstep((heights_m - SEA_FLOOR_BLEND_RANGE_M[0]) / np.ptp(SEA_FLOOR_BLEND_RANGE_M)),
        ramp_srgb(style_ramp, heights_m)[None],
    )
    for ramp, share in (
        (ARID_RAMP, _arid_share(latitude)),
        (TUNDRA_RAMP, _tundra_share(latitude)),
        (ICE_RAMP, _ice_share(latitude, heights_m)),
    ):
        ground = ground + (on_land * share)[..., None] * (ramp_srgb(ramp, heights_m) - ground)
    return ground


def ramp_srgb(ramp: ColorRamp, heights_m: np.ndarray) -> np.ndarray:
    """Return the sRGB colours (n, 3) in [0, 1] of a colour ramp at heights (n,) in metres."""
    colors = np.array([[int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5)] for _, text in ramp])
    return np.stack([np.interp(heights_m, [height for height, _ in ramp], colors[:, k]) for k in range(3)], axis=-1)


def snow_line_m(latitude_deg: np.ndarray) -> np.ndarray:
    """Return the height of the snow line in metres at latitudes in degrees."""
    return np.asarray(
        np.interp(
            latitude_deg, [latitude for latitude, _ in SNOW_LINE_BY_LATITUDE], [height for _, height in SNOW_LINE_BY_LATITUDE]
        )
    )


def _ice_share(latitude_deg: np.ndarray, heights_m: np.ndarray) -> np.ndarray:
    """Return the share of ice colours at latitudes in degrees and heights in metres."""
    return smoothstep(0.5 + 0.5 * (heights_m - snow_line_m(latitude_deg)) / ICE_BLEND_HALF_RANGE_M)


def _arid_share(latitude_deg: np.ndarray) -> np.ndarray:
    """Return the share of desert colours at latitudes in degrees."""
    (rise_start, rise_end), (fall_start_deg, fade_end) = ARID_LATITUDES_DEG
    abs_latitude = np.abs(latitude_deg)
    return (
        MAX_DESERT_SHARE
        * smoothstep((abs_latitude - rise_start) / (rise_end - rise_start))
        * smoothstep((fade_end - abs_latitude) / (fade_end - fall_start_deg))
    )


def _tundra_share(latitude_deg: np.ndarray) -> np.ndarray:
    """Return the share of tundra colours at latitudes in degrees."""
    shares = [smoothstep((latitude_deg - begin_deg) / (end_deg - begin_deg)) for begin_deg, end_deg in TUNDRA_LATITUDES_DEG]
    return np.maximum(*shares)
