"""The same points of a raster, asked through every interface: pictures, rasters, points, hours of sun, arrays and rays.

The grounds have cells that are the pixels of a zoom of web tiles, so that pixels of tiles and of maps lie on the cells' centres. At
the next zoom they lie between the centres, and beyond the outermost ones.
"""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import httpx
import numpy as np
import pytest
import rasterio
from morecantile import tms as matrix_sets
from PIL import Image
from pyproj import CRS

import skugga
from skugga.api.point.report import point_surroundings, reported_sun
from skugga.api.point.values import PointQuery
from skugga.api.products.mask import MASK_LIT
from skugga.shadows.truth.truth import Truth, trace_truth
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import TILE_PX, MapView, tile_grid
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING, write_geotiff

CELLS = 192
MERCATOR = CRS.from_epsg(3857)
WEB_TILES = matrix_sets.get("WebMercatorQuad")

TRUTH_SAMPLES = 16
"""Sub-samples of a pixel. A pixel on which they disagree lies on the edge of a shadow."""

DATA_GROUNDS = {
    "bigtujunga": ("mountain/bigtujunga_30m_utm11.tif", 200, 400, -118.2, 34.3, 12),
    "sierra": ("mountain/sierra_30m_albers.tif", 500, 400, -118.6, 37.0, 12),
    "zion": ("mountain/zion_srtm_4326.tif", 100, 120, -113.0, 37.2, 11),
    "essen": ("urban/essen_dom1_32_356_5699_1_nw_2020.tif", 300, 300, 6.9, 51.4, 17),
    "gothenburg": ("urban/goteborg_1m/DSM.tif", 10, 20, 12.0, 57.7, 17),
    "quebec": ("forest/quebec_DSM.tif", 40, 40, -71.2, 46.8, 17),
    "kootenay": ("forest/kootenay_CHM_025m.tif", 100, 100, -117.0, 49.0, 19),
}
"""Windows of real rasters: file, first row and column, then the longitude, latitude and zoom to which they are moved."""

MADE_GROUNDS = {"hills": (8.4, 47.5, 12), "towers": (8.4, 47.5, 17), "holes": (8.4, 47.5, 12)}
"""Longitude, latitude and zoom of made grounds."""

SUNS = {
    "high": (date(2024, 6, 21), False, 50.0),
    "morning": (date(2024, 3, 21), True, 30.0),
    "winter": (date(2024, 10, 21), False, 15.0),
    "low evening": (date(2024, 3, 21), False, 6.0),
    "low morning": (date(2024, 12, 21), True, 3.0),
}
"""Date, whether it is morning, and the approximate altitude of the sun in degrees."""


def made_heights(name: str) -> np.ndarray:
    """Return heights (CELLS, CELLS), float32."""
    row, col = np.mgrid[:CELLS, :CELLS].astype(np.float32)
    hills = 900 + 350 * np.sin(col / 14) * np.cos(row / 23) + 4 * np.sin(col * row / 97)
    if name == "hills":
        return hills
    if name == "holes":
        hills[60:90, 100:150] = np.nan
        hills[0:20, 0:30] = np.nan
        return hills
    rng = np.random.default_rng(7)
    heights = (0.02 * row).astype(np.float32)
    for top, left in rng.integers(-4, CELLS, (60, 2)):  # some of them stand on the border
        heights[max(top, 0) : top + rng.integers(3, 14), max(left, 0) : left + rng.integers(3, 14)] += rng.uniform(2.0, 12.0)
    return heights


@dataclass(frozen=True, eq=False)
class Ground:
    """A raster on the pixels of a zoom, and the same heights in a flat world.

    Attributes
    ----------
    name
        The level's name.
    height_m
        (CELLS, CELLS) float32, metres; NaN without ground.
    path, flat_path
        The raster in EPSG:3857, and the one in an engineering CRS.
    zoom, first_col, first_row
        The zoom, and the raster's first pixel on its tile matrix.
    cell_m
        The side of a cell in the flat world, metres.
    """

    name: str
    height_m: np.ndarray
    path: Path
    flat_path: Path
    zoom: int
    first_col: int
    first_row: int
    cell_m: float

    def view(self, halvings: int) -> MapView:
        """Return the view of the raster's pixels at a zoom: its own (0), or the next (1)."""
        count = CELLS * 2**halvings
        grid = tile_grid(WEB_TILES, self.zoom + halvings)
        return MapView(grid, float(self.first_row * 2**halvings), float(self.first_col * 2**halvings), 1.0, 1.0, count, count)


def make_ground(folder: Path, name: str, data: Path | None) -> Ground:
    """Write a ground's rasters. Skip the test without the data."""
    if name in MADE_GROUNDS:
        height_m, (lon, lat, zoom) = made_heights(name), MADE_GROUNDS[name]
    else:
        file, top, left, lon, lat, zoom = DATA_GROUNDS[name]
        if data is None or not (data / file).is_file():
            pytest.skip(f"no sample raster {file}")
        with rasterio.open(data / file) as dataset:
            height_m = dataset.read(1, window=((top, top + CELLS), (left, left + CELLS)), masked=True)
        height_m = np.nan_to_num(height_m.astype(np.float32).filled(0.0))
    tile = WEB_TILES.tile(lon, lat, zoom)
    first_col, first_row = tile.x * TILE_PX - CELLS // 2, tile.y * TILE_PX - CELLS // 3  # across the border of four tiles
    cell, grid = WEB_TILES.matrix(zoom).cellSize, tile_grid(WEB_TILES, zoom)
    west, north = float(grid.x(first_col - 0.5)), float(grid.y(first_row - 0.5))
    options = {"nodata": float("nan")}
    path = write_geotiff(folder / f"{name}.tif", height_m, "EPSG:3857", west, north, cell, **options)
    cell_m = 2.0 ** np.round(np.log2(cell * np.cos(np.radians(lat))))  # nodes of maps in a flat world, too
    flat_path = write_geotiff(folder / f"{name}_flat.tif", height_m, ENGINEERING, 1000.0, 5000.0, cell_m, **options)
    level = {"version": 1, "terrain": {"source": path.name}, "sun": {"azimuth": 200, "altitude": 30}}
    (folder / f"{name}.yaml").write_text(json.dumps(level), encoding="utf-8")
    return Ground(name, height_m, path, flat_path, zoom, first_col, first_row, cell_m)


def sun_time(level: skugga.OpenLevel, name: str) -> datetime:
    """Return the whole minute of a sun of ``SUNS``, found by halving a half day of solar time."""
    day, is_morning, altitude_deg = SUNS[name]
    noon = datetime(day.year, day.month, day.day, 12, tzinfo=UTC) - timedelta(hours=level._scene.world.anchor_lon_deg / 15.0)
    dark, light = noon + timedelta(hours=-12 if is_morning else 12), noon
    while abs(light - dark) > timedelta(seconds=30):
        middle = dark + (light - dark) / 2
        sun = level._scene.with_sun(SunSpec(time=middle)).sun
        assert sun is not None
        dark, light = (dark, middle) if sun.altitude_deg > altitude_deg else (middle, light)
    return light.replace(second=0, microsecond=0)


def traced(scene: Scene, view: MapView) -> Truth:
    """Return ray-traced truth at the pixels of a view."""
    buffer = geometry_buffer(scene, view)
    return trace_truth(buffer, scene, find_casters(scene, buffer), TRUTH_SAMPLES)


def filled_heights(scene: Scene, view: MapView) -> np.ndarray:
    """Return the heights of a view's nodes, float32 (rows, cols) metres, with holes filled as for casting. The world is flat."""
    buffer = geometry_buffer(scene, view)
    assert buffer.surface is not None
    window = buffer.surface.with_rim
    top, left = int(view.row0) - window.row0, int(view.col0) - window.col0
    return window.height_m[top : top + view.rows, left : left + view.cols].astype(np.float32)


def chosen_pixels(side: int, count: int, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of pixels of a square picture: three fifths anywhere, and a tenth along each side."""
    row, col = np.random.default_rng(seed).integers(0, side, (2, count))
    tenth = count // 10
    for part, (axis, value) in enumerate(((row, 0), (row, side - 1), (col, 0), (col, side - 1))):
        axis[part * tenth : (part + 1) * tenth] = value
    return row, col


def lit_at_points(scene: Scene, view: MapView, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Return whether the points at pixels' centres are lit, as reports of points say: bool (n,)."""
    crs = scene.elevation.crs
    x, y = view.grid.x(view.col0 + col), view.grid.y(view.row0 + row)
    return np.array([_lit_at(scene, PointQuery(lon=float(a), lat=float(b)), crs) for a, b in zip(x, y, strict=True)])


def _lit_at(scene: Scene, query: PointQuery, crs: CRS) -> bool:
    """Return whether the sun is visible at the point and time of a query, whose coordinates are those of ``crs``."""
    moment = reported_sun(point_surroundings(scene, query, crs))
    assert moment is not None
    return moment.lit


def lit_mask(mask: np.ndarray) -> np.ndarray:
    """Return the lit pixels of a product ``mask``."""
    return mask == MASK_LIT


def picture(answer: httpx.Response) -> np.ndarray:
    """Return the pixels of an answer."""
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)))


def served_pictures(client: httpx.Client, ground: Ground, halvings: int, moment: datetime) -> dict[str, np.ndarray]:
    """Return the mask of a ground as tiles, as a map and by WMS, at its own zoom (0) or the next (1)."""
    view, zoom = ground.view(halvings), ground.zoom + halvings
    top, left, time = int(view.row0), int(view.col0), moment.isoformat()
    mosaic = np.zeros((view.rows, view.cols), np.uint8)
    for y in range(top // TILE_PX, (top + view.rows - 1) // TILE_PX + 1):
        for x in range(left // TILE_PX, (left + view.cols - 1) // TILE_PX + 1):
            address = f"/levels/{ground.name}/tiles/WebMercatorQuad/{zoom}/{x}/{y}.png"
            tile = picture(client.get(address, params={"layer": "mask", "time": time}))
            rows, cols = np.arange(TILE_PX) + y * TILE_PX - top, np.arange(TILE_PX) + x * TILE_PX - left
            down, right = (rows >= 0) & (rows < view.rows), (cols >= 0) & (cols < view.cols)
            mosaic[np.ix_(rows[down], cols[right])] = tile[np.ix_(down, right)]
    bbox = ",".join(repr(value) for value in view.bounds)
    query = {"bbox": bbox, "crs": "EPSG:3857", "width": view.cols, "height": view.rows, "layer": "mask", "time": time}
    wms = {
        "SERVICE": "WMS", "VERSION": "1.3.0", "REQUEST": "GetMap", "LAYERS": f"{ground.name}:mask", "STYLES": "",
        "CRS": "EPSG:3857", "BBOX": bbox, "WIDTH": view.cols, "HEIGHT": view.rows, "FORMAT": "image/png", "TIME": time,
    }  # fmt: skip
    return {
        "tiles": mosaic,
        "map": picture(client.get(f"/levels/{ground.name}/map.png", params=query)),
        "WMS": picture(client.get("/wms", params=wms)),
    }
