"""Warm up a render process before it reports readiness: import modules, compile loops, and draw a picture with a known result."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
from morecantile import tms as matrix_sets
from rasterio.crs import CRS
from rasterio.io import MemoryFile
from rasterio.transform import from_origin

from skugga.selector.select import plan_of_view
from skugga.shadows.registry import FALLBACK_ALGORITHM
from skugga.shadows.render import render_frame
from skugga.terrain.compiling.ahead_of_time import MAPS
from skugga.terrain.compiling.hooks import declare_product
from skugga.terrain.errors import GraphicsError, NoOpenGLError
from skugga.terrain.geo.grid import BLOCK_PX, Grid, MapView, tile_grid
from skugga.terrain.gl import device as gl
from skugga.terrain.gl.egl_devices import NO_OPENGL_RENDERER
from skugga.terrain.level.level import Level, LoadedLevel
from skugga.terrain.scene import Scene, build_scene

WARM_UP_CELL_M, PLAIN_SIDE_CELLS, WALL_HEIGHT_M = 30.0, 64, 300.0
"""Terrain of the test picture: a plain of 64 x 64 cells of 30 m. In its middle a wall, 300 m high, runs from north to south."""

TEST_ZOOM = 12
"""Zoom of the test picture. At the equator its pixels are 38 m wide, so the plain is 50 pixels wide.

The wall's shadow is 520 m long, since the sun stands 30 degrees high."""

TEST_PICTURE_PX = 64
"""Side in pixels of the test picture around the wall's middle. It shows the whole plain."""

TEST_PIXEL_DISTANCE_M = 240.0
"""Distance of the two tested pixels from the wall. One lies inside the shadow, the other on the sunny side."""

log = logging.getLogger("skugga.worker")


def warm_up(
    expect_renderer: str | None = None, needs_opengl: bool = False, report_problem: Callable[[str], None] = log.warning
) -> str:
    """Draw a first picture, check that its shadow is in the right place, and return the renderer's name.

    Imports, compilation and the creation of the OpenGL context are then done before the first request.

    Parameters
    ----------
    expect_renderer
        Text that the renderer's name must contain; ``None`` accepts every renderer.
    needs_opengl
        Whether OpenGL is required. Otherwise a process without OpenGL computes the products that need none.
    report_problem
        Called with the reason if OpenGL is missing and not required.

    Returns
    -------
    str
        OpenGL's name of the renderer, or ``NO_OPENGL_RENDERER``.

    Raises
    ------
    GraphicsError
        OpenGL is missing although it is required or a renderer is expected, the renderer is another one, or the shadow is wrong.
    """
    declare_product(MAPS)
    renderer, algorithm = NO_OPENGL_RENDERER, "auto"
    try:
        renderer, algorithm = gl.device().renderer, FALLBACK_ALGORITHM
    except NoOpenGLError as error:
        if needs_opengl or expect_renderer is not None:
            raise
        report_problem(str(error))
    if expect_renderer is not None and expect_renderer not in renderer:
        raise GraphicsError(f"the OpenGL renderer is '{renderer}', but SKUGGA_EXPECT_RENDERER is '{expect_renderer}'")
    west, east = _visibility_beside_wall(algorithm)
    if not (west > 0.99 and east < 0.01):
        raise GraphicsError(f"'{renderer}' draws wrong shadows: visibility {west:.2f} in front of a wall, {east:.2f} behind it")
    return renderer


def _visibility_beside_wall(algorithm: str) -> tuple[float, float]:
    """Return the visibility of the sun (0 to 1) west and east of the wall, as drawn by ``algorithm``.

    The sun is in the west, so the shadow lies east of the wall.
    """
    heights = np.zeros((PLAIN_SIDE_CELLS, PLAIN_SIDE_CELLS), np.float32)
    heights[:, PLAIN_SIDE_CELLS // 2 - 1 : PLAIN_SIDE_CELLS // 2 + 2] = WALL_HEIGHT_M
    left, top = 499_000.0, 1_000.0  # the wall stands on the central meridian of zone 31, at 3 degrees east
    with MemoryFile(ext=".tif") as memory:
        with memory.open(
            driver="GTiff", width=PLAIN_SIDE_CELLS, height=PLAIN_SIDE_CELLS, count=1, dtype=heights.dtype, crs=CRS.from_epsg(32631),
            transform=from_origin(left, top, WARM_UP_CELL_M, WARM_UP_CELL_M),
        ) as dataset:  # fmt: skip
            dataset.write(heights, 1)
        scene = _wall_scene(memory.name, algorithm)
        grid, center = _grid_and_wall_center(scene, TEST_ZOOM)
        view = _view_around(grid, center)
        frame = render_frame(scene, view, plan_of_view(scene, view, policy="rules"))
        scene.close()
    distance_px = TEST_PIXEL_DISTANCE_M / grid.step
    row, col = center[0] - view.row0, center[1] - view.col0
    row, cols = int(row), (int(np.rint(col - distance_px)), int(np.rint(col + distance_px)))
    return float(frame.visibility[row, cols[0]]), float(frame.visibility[row, cols[1]])


def _wall_scene(source: str, algorithm: str) -> Scene:
    """Return the scene of the test picture, with shadows by ``algorithm``. ``source`` is the raster of heights in metres."""
    level = Level.model_validate(
        {
            "version": 1,
            "terrain": {"source": source, "units": "m"},
            "sun": {"azimuth": 270, "altitude": 30},
            "shadows": {"algorithm": algorithm},
        }
    )
    return build_scene(LoadedLevel(name="warm-up", path=Path("warm-up"), level=level, digest=""))


def _grid_and_wall_center(scene: Scene, zoom: int) -> tuple[Grid, tuple[float, float]]:
    """Return the pixel grid of a zoom, and the row and column of the wall's middle on it."""
    grid = tile_grid(matrix_sets.get("WebMercatorQuad"), zoom)
    x, y = _mercator_m(scene.world.anchor_lon_deg, scene.world.anchor_lat_deg)
    return grid, ((grid.y0 - y) / grid.step, (x - grid.x0) / grid.step)


def _view_around(grid: Grid, center_row_col: tuple[float, float]) -> MapView:
    """Return a view of ``TEST_PICTURE_PX`` pixels a side around ``center_row_col`` (row, column) of a grid.

    The view is shifted so that it lies within one block, since blocks are drawn separately.
    """
    row, col = (
        float(np.clip(int(index) - TEST_PICTURE_PX // 2, first, first + BLOCK_PX - TEST_PICTURE_PX))
        for index in center_row_col
        for first in [index // BLOCK_PX * BLOCK_PX]
    )
    return MapView(grid, row, col, 1.0, 1.0, TEST_PICTURE_PX, TEST_PICTURE_PX)


def _mercator_m(lon_deg: float, lat_deg: float) -> tuple[float, float]:
    """Return the Web Mercator coordinates x and y, in metres, of a longitude and latitude in degrees."""
    point = matrix_sets.get("WebMercatorQuad").xy(lon_deg, lat_deg)
    return point.x, point.y
