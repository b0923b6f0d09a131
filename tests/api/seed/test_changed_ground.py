"""Incremental seeding: a changed raster redraws exactly the tiles that its shadows can reach."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from morecantile import tms
from pyproj import Transformer
from shapely import Polygon, box

from skugga.api.seed.task_table import TaskTable
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.api.seed.runs import LOW_SUN, Run, rough_ground, write_ground

CELLS, CELL_M, WEST, NORTH = 300, 30.0, 500e3, 5200e3
ZOOM = 15
"""Blocks of 3.4 km: the raster of 9 km has some 3 x 3 of them."""

CHUNK_CELLS = 64


def tiles_by_block(run: Run) -> dict[tuple[int, int, int], bytes]:
    """Return the index of each task's tiles."""
    with TaskTable(run.work / "tasks.sqlite") as table:
        rows = table._db.execute("SELECT zoom, x, y, tiles FROM tasks WHERE wanted").fetchall()
    return {(zoom, x, y): tiles for zoom, x, y, tiles in rows}


def block_on_raster(zoom: int, x: int, y: int) -> Polygon:
    """Return a block's outline in the raster's CRS."""
    corners = [tms.get("WebMercatorQuad").xy_bounds(4 * x + i, 4 * y + j, zoom) for i, j in ((0, 0), (3, 3))]
    area = box(corners[0].left, corners[1].bottom, corners[1].right, corners[0].top)
    to_raster = Transformer.from_crs(3857, 32633, always_xy=True)
    return Polygon([to_raster.transform(*point) for point in area.exterior.coords])


def swept_shadow(area: Polygon, azimuth_deg: float, length_m: float) -> Polygon:
    """Return the union of an area and everything that it can cast its shadow on."""
    shadow_azimuth_rad = np.radians(azimuth_deg + 180.0)
    step = length_m * np.sin(shadow_azimuth_rad), length_m * np.cos(shadow_azimuth_rad)
    shifted = Polygon([(x + step[0], y + step[1]) for x, y in area.exterior.coords])
    return area.union(shifted).convex_hull


@pytest.fixture
def heights() -> np.ndarray:
    """Heights of rough ground, metres."""
    return rough_ground(CELLS)


CASES = {
    "a lower corner towards the sun": (slice(280, 300), slice(0, 20), lambda part: part - 60.0),
    "a corner away from the sun": (slice(0, 20), slice(280, 300), lambda part: part + 90.0),
    "a tower in the middle": (slice(150, 152), slice(150, 152), lambda part: part * 0 + 850.0),
}
"""Rows, columns, and the change of their heights. Changes stay within the level's range of heights: every tile depends on it."""


@pytest.fixture(scope="module")
def seeded_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the ground, its seeded tiles and the tasks of that run."""
    folder = tmp_path_factory.mktemp("seeded")
    Run(write_ground(folder / "dem.tif", rough_ground(CELLS)), folder / "t.pmtiles", (ZOOM, ZOOM))()
    return folder


@pytest.mark.parametrize("case", CASES)
def test_a_change_redraws_tiles_that_its_shadows_reach(tmp_path: Path, heights: np.ndarray, seeded_folder: Path, case: str):
    rows, cols, change = CASES[case]
    sun = LOW_SUN
    folder = shutil.copytree(seeded_folder, tmp_path / "seeded")
    run = Run(folder / "dem.tif", folder / "t.pmtiles", (ZOOM, ZOOM), suns=(sun,))
    before = tiles_by_block(run)
    changed = heights.copy()
    changed[rows, cols] = np.clip(change(heights[rows, cols]), heights.min() + 30.0, heights.max() - 1.0)
    write_ground(run.level, changed)
    _, drawn_tasks = run()
    fresh_run = Run(run.level, tmp_path / "fresh.pmtiles", (ZOOM, ZOOM), suns=(sun,))
    fresh_run()

    assert run.output.read_bytes() == fresh_run.output.read_bytes(), "all changed tiles were redrawn"
    redrawn_tiles = {(task.zoom, task.x, task.y) for task in drawn_tasks}
    different = {place for place, tiles in tiles_by_block(fresh_run).items() if tiles != before[place]}
    assert different and different <= redrawn_tiles
    # Computed on a plane: a chunk of cells around the change, and the longest shadow of its highest ground over the lowest.
    first, last = (np.array([s.start, s.stop]) for s in (rows, cols))
    top, bottom = first[0] // CHUNK_CELLS * CHUNK_CELLS, -(-first[1] // CHUNK_CELLS) * CHUNK_CELLS
    left, right = last[0] // CHUNK_CELLS * CHUNK_CELLS, -(-last[1] // CHUNK_CELLS) * CHUNK_CELLS
    chunks = box(WEST + left * CELL_M, NORTH - bottom * CELL_M, WEST + right * CELL_M, NORTH - top * CELL_M)
    high_m = max(float(grid[top:bottom, left:right].max()) for grid in (heights, changed))
    length_m = (high_m - float(min(heights.min(), changed.min()))) / np.tan(np.radians(sun.altitude))
    reach = swept_shadow(chunks, sun.azimuth, length_m).buffer(0.06 * length_m + 1.5 * CHUNK_CELLS * CELL_M)
    reachable_tiles = {place for place in before if block_on_raster(*place).intersects(reach)}
    assert redrawn_tiles <= reachable_tiles, "no tile beyond the shadows' reach was redrawn"
    if case != "a tower in the middle":
        assert len(redrawn_tiles) <= len(before) / 2


def test_a_new_maximum_height_redraws_all_tiles(tmp_path: Path, heights: np.ndarray):
    run = Run(write_ground(tmp_path / "dem.tif", heights), tmp_path / "t.pmtiles", (ZOOM - 1, ZOOM - 1))
    run()
    heights[150, 150] = 1500.0
    write_ground(run.level, heights)
    assert len(run()[1]) == len(tiles_by_block(run))


def test_colours_depend_on_the_range_of_heights(tmp_path: Path, heights: np.ndarray):
    run = Run(write_ground(tmp_path / "dem.tif", heights), tmp_path / "t.pmtiles", (ZOOM - 1, ZOOM - 1), layer="color")
    run()
    for height_m in (700.0, 1800.0):  # within the range, and beyond it
        heights[280:, :20] = height_m
        write_ground(run.level, heights)
        _, drawn_tasks = run()
        fresh_run = Run(run.level, tmp_path / "fresh.pmtiles", (ZOOM - 1, ZOOM - 1), layer="color")
        fresh_run()
        assert drawn_tasks and run.output.read_bytes() == fresh_run.output.read_bytes()
    assert len(drawn_tasks) == len(tiles_by_block(run)), "the highest ground scales all colours"


def test_sky_view_depends_on_all_ground(tmp_path: Path, heights: np.ndarray, monkeypatch):
    def half_of_the_sky(scene: Scene, view: MapView, *_: object, **__: object) -> np.ndarray:
        return np.full((view.rows, view.cols), 0.5, np.float32)

    monkeypatch.setattr("skugga.shadows.horizons.level_horizons.sky_view_of_block", half_of_the_sky)
    run = Run(write_ground(tmp_path / "dem.tif", heights), tmp_path / "t.pmtiles", (ZOOM, ZOOM), layer="sky_view", suns=(None,))
    run()
    heights[280:, :20] = 700.0  # within the range of heights
    write_ground(run.level, heights)
    assert len(run()[1]) == len(tiles_by_block(run)) > 4


def test_at_night_a_change_redraws_only_tiles_with_its_texture(tmp_path: Path, heights: np.ndarray):
    """Texture reaches 67 nodes, here 8 pixels apart, since pixels are smaller than cells. Edges and heights reach 12 cells."""
    night = (SunSpec(azimuth=0.0, altitude=-20.0),)
    run = Run(write_ground(tmp_path / "dem.tif", heights), tmp_path / "t.pmtiles", (ZOOM, ZOOM), suns=night)
    run()
    heights[280:, :20] = 600.0
    write_ground(run.level, heights)
    side_m = CHUNK_CELLS * CELL_M
    texture_m = 67 * 8 * tms.get("WebMercatorQuad").matrix(ZOOM).cellSize * np.cos(np.radians(46.9))
    chunk = box(WEST, NORTH - CELLS * CELL_M, WEST + side_m, NORTH - 4 * side_m).buffer(12 * CELL_M + texture_m)
    redrawn_tiles = {(task.zoom, task.x, task.y) for task in run()[1]}
    assert redrawn_tiles == {place for place in tiles_by_block(run) if block_on_raster(*place).intersects(chunk)}
    assert len(redrawn_tiles) < len(tiles_by_block(run)) / 2


def test_a_rewritten_file_with_equal_heights_redraws_nothing(tmp_path: Path, heights: np.ndarray):
    run = Run(write_ground(tmp_path / "dem.tif", heights), tmp_path / "t.pmtiles", (ZOOM - 2, ZOOM - 2))
    run()
    archive = run.output.read_bytes()
    write_ground(run.level, heights)
    result, drawn_tasks = run()
    assert (result.drawn_count, drawn_tasks) == (0, []) and run.output.read_bytes() == archive
    new_folder = tmp_path / "elsewhere"
    new_folder.mkdir()
    run.level = run.level.rename(new_folder / "dem.tif")
    assert run()[1] == [], "a moved raster of equal content redraws nothing either"


@pytest.mark.long
def test_shadow_maps_redraw_more_tiles_than_sweeps(tmp_path: Path, heights: np.ndarray):
    """The last bits of depth maps depend on whole patches of casters, so more ground counts than for a sweep."""
    settings = {"algorithm": "shadow_map", "map_size": 1024}
    run = Run(write_ground(tmp_path / "dem.tif", heights), tmp_path / "t.pmtiles", (ZOOM - 2, ZOOM - 2), settings=settings)
    run()
    heights[270:290, 10:30] = np.clip(heights[270:290, 10:30] + 180.0, None, heights.max() - 1.0)
    write_ground(run.level, heights)
    _, drawn_tasks = run()
    fresh_run = Run(run.level, tmp_path / "fresh.pmtiles", (ZOOM - 2, ZOOM - 2), settings=settings)
    fresh_run()
    assert run.output.read_bytes() == fresh_run.output.read_bytes()
    assert 0 < len(drawn_tasks)


@pytest.mark.long
def test_changed_ground_moves_the_objects_on_it(tmp_path: Path, heights: np.ndarray):
    """A tower on a raised hill casts a longer shadow. A changed file of towers redraws all tiles."""
    write_ground(tmp_path / "dem.tif", heights)
    to_lon_lat = Transformer.from_crs(32633, 4326, always_xy=True)

    def write_tower(height_m: float) -> None:
        x, y = WEST + 20 * CELL_M, NORTH - 280 * CELL_M
        ring = [to_lon_lat.transform(x + dx, y + dy) for dx, dy in ((0, 0), (60, 0), (60, 60), (0, 60), (0, 0))]
        feature = {"type": "Feature", "properties": {"h": height_m}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
        text = json.dumps({"type": "FeatureCollection", "features": [feature]})
        (tmp_path / "towers.geojson").write_text(text, encoding="utf-8")

    write_tower(120.0)
    level = tmp_path / "level.yaml"
    level.write_text("version: 1\nterrain: {source: dem.tif}\nmeshes: [{source: towers.geojson, height: h}]\n", encoding="utf-8")
    run = Run(level, tmp_path / "t.pmtiles", (ZOOM - 2, ZOOM - 2))
    run()

    def redraw_and_compare() -> int:
        _, drawn_tasks = run()
        fresh_run = Run(level, tmp_path / "fresh.pmtiles", (ZOOM - 2, ZOOM - 2))
        fresh_run()
        assert run.output.read_bytes() == fresh_run.output.read_bytes()
        return len(drawn_tasks)

    heights[270:290, 10:30] = np.clip(heights[270:290, 10:30] + 180.0, None, heights.max() - 1.0)
    write_ground(tmp_path / "dem.tif", heights)
    assert 0 < redraw_and_compare()
    write_tower(200.0)
    assert redraw_and_compare() == len(tiles_by_block(run))
