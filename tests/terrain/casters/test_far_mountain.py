"""A mountain 60 km away under a sun 2 degrees high shades its plain as far as computed, in tiles of every zoom and in ``shade``."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from morecantile import tms as matrix_sets
from rasterio.enums import Resampling

from skugga.api.matrices import zoom_range
from skugga.api.products.mask import MASK_LIT, MASK_SHADOW
from skugga.api.raster_view import raster_view
from skugga.terrain.geo.grid import MapView, tile_grid
from skugga.terrain.geo.world import EARTH_RADIUS_M, LONGITUDE_LATITUDE, transformer
from skugga.terrain.ground import overview
from skugga.terrain.scene import Scene
from tests.products import draw_map, shade_array
from tests.render import plan_of

CELL_M, COLS, ROWS = 30.0, 2700, 700
WEST_M, NORTH_M = 460_000.0, 5_210_500.0
PLAIN_M, MOUNTAIN_M = 300.0, 2500.0
RIM_M, HALF_WIDTH_M = WEST_M + 72_000.0, 2500.0
"""Easting of the mountain's western rim, and half its extent from north to south.

The top is flat, so the rim casts the longest shadow.
"""

MIDDLE_NORTHING_M = NORTH_M - ROWS / 2 * CELL_M
FAR_M, ALTITUDE_DEG = 60_000.0, 2.0
"""Distance from the rim, and the sun's altitude at that distance."""

SAMPLE_PATCH_PX = 6
TMS = matrix_sets.get("WebMercatorQuad")


def plateau_heights() -> np.ndarray:
    """Return heights (``ROWS``, ``COLS``) of a plain with a high plateau in the east."""
    x = WEST_M + (np.arange(COLS) + 0.5) * CELL_M
    y = NORTH_M - (np.arange(ROWS) + 0.5) * CELL_M
    top = (x >= RIM_M)[None, :] & (x <= RIM_M + 5000.0)[None, :] & (np.abs(y - MIDDLE_NORTHING_M) <= HALF_WIDTH_M)[:, None]
    return np.where(top, PLAIN_M + MOUNTAIN_M, PLAIN_M).astype(np.float32)


def shadow_length_m() -> float:
    """Return L that solves H = L tan(a) + L^2 / 2R.

    The sun's altitude a falls by L / R over a distance L towards the west.
    """
    length_m = np.linspace(1e3, 90e3, 100_000)
    altitude = np.radians(ALTITUDE_DEG) + (FAR_M - length_m) / EARTH_RADIUS_M
    needed_m = length_m * np.tan(altitude) + length_m**2 / (2.0 * EARTH_RADIUS_M)
    return float(length_m[np.argmax(needed_m > MOUNTAIN_M)])


def expected_shadow_at_positions(margin_m: float) -> dict[tuple[float, float], bool]:
    """Map places on the plain (easting, northing) to whether they lie in the mountain's shadow.

    Places keep a margin from the shadow's outline.
    """
    end_m = shadow_length_m()
    in_shadow = {
        (RIM_M - distance_m, MIDDLE_NORTHING_M): True for distance_m in (10e3, 25e3, 40e3, FAR_M - margin_m, end_m - margin_m)
    }
    beside_shadow = {(RIM_M - 40e3, MIDDLE_NORTHING_M + side * (HALF_WIDTH_M + margin_m)): False for side in (-1, 1)}
    return {**in_shadow, **beside_shadow, (RIM_M - end_m - margin_m, MIDDLE_NORTHING_M): False}


@pytest.fixture(params=["a raster", "a big one with overviews"])
def scene(request, write_raster, make_scene, monkeypatch) -> Scene:
    """Scene of the plateau, from a raster with or without overviews."""
    raster = write_raster(plateau_heights(), "EPSG:32633", WEST_M, NORTH_M, CELL_M, tiled=True)
    if request.param != "a raster":
        monkeypatch.setattr("skugga.terrain.ground.open_raster.MAX_EXACT_MAXIMA_CELLS", 10_000)
        monkeypatch.setattr(overview, "MAX_EXACT_MAXIMA_CELLS", 10_000)
        monkeypatch.setattr(overview, "OVERVIEW_SIDE_CELLS", 64)
        with rasterio.open(raster, "r+") as dataset:
            dataset.build_overviews([2, 4, 8, 16, 32], Resampling.average)
    middle_m = WEST_M + COLS / 2 * CELL_M
    anchor_altitude_deg = ALTITUDE_DEG + np.degrees((middle_m - (RIM_M - FAR_M)) / EARTH_RADIUS_M)
    return make_scene(raster, 90.0, float(anchor_altitude_deg))


def test_shadow_length_allows_for_the_curved_earth():
    # 60 km need 2095 m for the slope and 283 m for the curvature; the mountain's other 122 m add 3.5 km.
    assert shadow_length_m() == pytest.approx(63_500.0, abs=100.0)


def test_tiles_of_every_zoom_show_the_far_shadow(scene, request):
    """Every second zoom is drawn from the raster, and the others from that with overviews."""
    assert scene.bounds_lon_lat is not None
    zooms = zoom_range(TMS, scene.world, scene.bounds_lon_lat, CELL_M)
    assert zooms is not None and zooms.last - zooms.first >= 7
    mismatches: list[object] = []
    plan = None
    first = zooms.first + (request.node.callspec.params["scene"] != "a raster")
    for zoom in range(first, zooms.last + 1, 2):
        grid = tile_grid(TMS, zoom)
        pixel_m = scene.surface(grid).step_m
        for (x, y), dark in expected_shadow_at_positions(500.0 + 3.0 * pixel_m).items():
            lon, lat = transformer(scene.elevation.crs, LONGITUDE_LATITUDE).transform(x, y)
            mercator_point = TMS.xy(lon, lat)
            row, col = (int(v) - SAMPLE_PATCH_PX // 2 for v in (grid.row(mercator_point.y), grid.col(mercator_point.x)))
            view = MapView(grid, float(row), float(col), 1.0, 1.0, SAMPLE_PATCH_PX, SAMPLE_PATCH_PX)
            plan = plan or plan_of(scene, view)  # all tiles of a level share one plan
            middle = slice(SAMPLE_PATCH_PX // 2 - 1, SAMPLE_PATCH_PX // 2 + 1)
            opacity = draw_map(scene, view, plan).opacity[middle, middle]
            if (opacity != (255 if dark else 0)).any():
                mismatches.append((zoom, (RIM_M - x) / 1000.0, (y - MIDDLE_NORTHING_M) / 1000.0, dark, opacity.tolist()))
    assert not mismatches, "\n".join(map(str, mismatches))


def test_shade_cells_show_the_far_shadow(scene):
    for (x, y), dark in expected_shadow_at_positions(500.0 + 3.0 * CELL_M).items():
        view = raster_view(scene, (x - 100.0, y - 100.0, x + 100.0, y + 100.0))
        shadow_mask = shade_array(scene, view, "mask", None)
        assert (shadow_mask == (MASK_SHADOW if dark else MASK_LIT)).all(), (RIM_M - x, y - MIDDLE_NORTHING_M, dark)
