"""Real-world rasters: holes and sentinels, rotated and stretched grids, single cells, grids of the whole earth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import rasterio
from affine import Affine

from skugga.shadows.truth.metrics import metric_coverage
from skugga.terrain.errors import SourceError
from skugga.terrain.geo.world import geocentric, geodetic
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.level.parts import SunSpec
from tests.hard_cases.cases import ENGINE, MAP_VIEW_ALGORITHMS, Trial, hard_case
from tests.hard_cases.ground import CORNER_M, UTM, map_positions, share_of_mask, view_from_above
from tests.rasters import ENGINEERING
from tests.render import render

SENTINELS = (np.nan, np.inf, -np.inf, -32768.0, 3.4e38, -9999.0)
"""Values that files use for nodata; the last one is declared in these files."""

CELL_M = 8.0

FORCED_EFFECTS = {"cast_shadows": "on"}
"""Prevents that level ground is left out because it casts nothing."""


@hard_case(
    "G1",
    "Holes show nothing and throw no shadow, level ground beside them is lit",
    "a plateau with holes of every sentinel, islands and a single cell, sun at 45 to 0.5 degrees",
    {"false_shadow": 0.0, "surface lost or made up": 0.0},
)
def test_holes_cast_nothing(trial: Trial) -> dict[str, float]:
    side = 1024 if trial.thorough else 128
    scene = trial.scene(
        trial.raster(plateau_with_holes(side), UTM, *CORNER_M, CELL_M, nodata=-9999.0), (200, 45), effects=FORCED_EFFECTS
    )
    ground_m = scene.elevation.ground_m
    false_shadow = wrong_surface = 0.0
    for azimuth, altitude in ((200, 45), (75, 5), (310, 0.5))[0 if trial.thorough else 1 :]:
        sunlit_scene = scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
        rendered = trial.render_view(
            sunlit_scene, view_from_above(trial, sunlit_scene, side), map_size=2048 if trial.thorough else 512
        )
        valid = rendered.buffer.valid
        assert 0.3 < valid.mean() < 0.95
        false_shadow = max(false_shadow, share_of_mask(rendered.dark, valid))
        wrong_surface = max(wrong_surface, share_of_mask(~np.isfinite(ground_m(*map_positions(rendered))), valid))
        if trial.serves_maps:
            wrong_surface = max(wrong_surface, abs(valid.mean() - np.isfinite(plateau_with_holes(side, np.nan)).mean()))
    return {"false_shadow": false_shadow, "surface lost or made up": wrong_surface}


def plateau_with_holes(side: int, sentinel: float | None = None) -> np.ndarray:
    """Return 100 m everywhere, and holes: one of each sentinel, random single cells, a sea with an island and one with one cell."""
    heights = np.full((side, side), 100.0, np.float32)
    eighth = side // 8

    def dig(window: tuple[slice, slice], number: int) -> None:
        heights[window] = SENTINELS[number] if sentinel is None else sentinel

    for number in range(len(SENTINELS)):
        dig((slice(eighth, 2 * eighth), slice((number + 1) * eighth, (number + 1) * eighth + eighth // 2)), number)
    for row in range(5):
        for col in range(10):
            dig(
                (slice(3 * eighth + 3 * row, 3 * eighth + 3 * row + 1), slice(eighth + 7 * col, eighth + 7 * col + 1)),
                col % len(SENTINELS),
            )
    for left, number in ((0, 3), (4 * eighth, 0)):
        dig((slice(5 * eighth, 8 * eighth), slice(left, left + 3 * eighth)), number)
    heights[6 * eighth : 6 * eighth + eighth // 2, eighth : 2 * eighth] = 100.0
    heights[6 * eighth, 5 * eighth] = 100.0
    return heights


@hard_case(
    "R7",
    "What stands before a hole throws its shadow over it to its length, and what is filled in adds none",
    "a cliff of 60 m above a hole 40 cells wide, sun 2 degrees above and below the line from the far rim to its top",
    {"false_shadow": 0.0, "tip_px": 1.0},
)
def test_shadows_cross_holes(trial: Trial) -> dict[str, float]:
    """A fill by inverse distances is no straight line: its step at the far rim is 1.7 degrees steeper than the line to the top."""
    side = 1024 if trial.thorough else 128
    high, hole = slice(0, side // 4), slice(side // 4, side // 4 + 40)
    heights = np.full((side, side), 100.0, np.float32)
    heights[:, high] = 160.0
    heights[5:-5, hole] = np.nan
    scene = trial.scene(trial.raster(heights, UTM, *CORNER_M, CELL_M), (270, 45))
    crest_m = CORNER_M[0] + (high.stop - 0.5) * CELL_M  # east of the last high cell's centre
    beyond_m = CORNER_M[0] + hole.stop * CELL_M
    rim_deg = np.degrees(np.arctan(60.0 / (beyond_m - crest_m)))
    false_shadow = tip_px = 0.0
    for altitude in (rim_deg + 2.0, rim_deg - 2.0):
        sunlit_scene = scene.with_sun(SunSpec(azimuth=270, altitude=altitude))
        rendered = trial.render_view(sunlit_scene, view_from_above(trial, sunlit_scene, side), map_size=2048)
        x, y = map_positions(rendered)
        middle = np.abs(y - (CORNER_M[1] - side / 2 * CELL_M)) < (side / 2 - 20) * CELL_M
        tip_m = crest_m + 60.0 / np.tan(np.radians(altitude))
        false_shadow = max(false_shadow, share_of_mask(rendered.dark, middle & (x > max(beyond_m, tip_m + CELL_M))))
        if altitude < rim_deg:
            tip_px = abs(x[rendered.dark & middle].max() - tip_m) / CELL_M
    return {"false_shadow": false_shadow, "tip_px": tip_px}


BLOCK_BOUNDS = {"tip_px": 2.0, "side_px": 1.0, "surface lost or made up": 0.0}
"""The tip may miss by a pixel and by a node: where nodes are not cell centres, the top ends at its last node."""


@dataclass(frozen=True)
class RasterOrientation:
    """The orientation of a raster: its cells' size, and its axes, rotated or mirrored; metres per column and per row."""

    per_col_m: tuple[float, float]
    per_row_m: tuple[float, float]

    def transform(self, rows: int, cols: int) -> Affine:
        """Return the geotransform, with the middle of the raster at (0, 0)."""
        (a, d), (b, e) = self.per_col_m, self.per_row_m
        return Affine(a, b, -(a * cols + b * rows) / 2, d, e, -(d * cols + e * rows) / 2)


def rotated_raster(deg: float, width_m: float = CELL_M, height_m: float = CELL_M) -> RasterOrientation:
    """Return a raster rotated counter-clockwise."""
    sin, cos = np.sin(np.radians(deg)), np.cos(np.radians(deg))
    return RasterOrientation((width_m * cos, width_m * sin), (height_m * sin, -height_m * cos))


ROTATED = (rotated_raster(30.0), rotated_raster(-71.0), rotated_raster(180.0))

STRETCHED = (
    rotated_raster(25.0, 3.0, 9.0),
    RasterOrientation((2.0, 0.0), (0.0, -10.0)),
    RasterOrientation((10.0, 0.0), (0.0, -2.0)),
)

MIRRORED = (
    RasterOrientation((CELL_M, 0.0), (0.0, CELL_M)),
    RasterOrientation((-CELL_M, 0.0), (0.0, -CELL_M)),
    RasterOrientation((0.0, CELL_M), (CELL_M, 0.0)),
)


@hard_case(
    "R1",
    "A block's shadow lies where it must, however the raster is turned",
    "a block of 40 m in rasters turned by 30, -71 and 180 degrees, sun along each axis",
    BLOCK_BOUNDS,
)
def test_turned_rasters(trial: Trial) -> dict[str, float]:
    return shadows_of_blocks(trial, ROTATED)


@hard_case(
    "R2",
    "A block's shadow lies where it must, whatever the shape of cells and the order of rows and columns",
    "a block of 40 m in cells of 2 x 10 m, 10 x 2 m and 3 x 9 m turned; rows from south to north, columns from east to west",
    BLOCK_BOUNDS,
)
def test_stretched_and_mirrored_rasters(trial: Trial) -> dict[str, float]:
    return shadows_of_blocks(trial, (*STRETCHED, *MIRRORED))


def shadows_of_blocks(trial: Trial, orientations: tuple[RasterOrientation, ...]) -> dict[str, float]:
    """Return the largest errors over rasters of 480 m a side; a quick run takes every third one."""
    worst: dict[str, float] = {}
    for number, orientation in enumerate(orientations if trial.thorough else orientations[::3]):
        shape = tuple(int(np.rint(480.0 / np.hypot(*step))) for step in (orientation.per_row_m, orientation.per_col_m))
        worst = larger_figures(worst, shadow_of_block(trial, orientation, shape, f"level{number}"))
    return worst


def shadow_of_block(trial: Trial, orientation: RasterOrientation, shape: tuple[int, int], name: str = "level") -> dict[str, float]:
    """Compare a block's shadow along its raster's axes with the edge of the block's top, moved by the shadow's length."""
    (rows, cols), pixels = shape, 256 if trial.thorough else 96
    geotransform, sides_m = orientation.transform(rows, cols), (np.hypot(*orientation.per_row_m), np.hypot(*orientation.per_col_m))
    height_m, altitude = max(rows * sides_m[0], cols * sides_m[1]) / 12, 24.0
    block = np.ix_(*(np.arange(n // 2 - n // 15, n // 2 + n // 15 + 1) for n in shape))
    heights = np.zeros(shape, np.float32)
    heights[block] = height_m
    path = trial.raster(heights, ENGINEERING, 0.0, 0.0, 1.0, name=name, transform=geotransform)
    # Through clear air: with cells of 1 km the camera is so far away that any other air would hide the shadow.
    scene = trial.scene(path, (0, altitude), name=name, weather={"visibility": 1e7})
    # Nodes are the centres of cells, and the top ends at the outermost nodes.
    corners = np.array([geotransform @ (c + 0.5, r + 0.5) for r in block[0].ravel()[[0, -1]] for c in block[1].ravel()[[0, -1]]])
    worst: dict[str, float] = {}
    for axis_m, cells in ((orientation.per_col_m, cols), (orientation.per_row_m, rows)):
        if cells < 8:
            continue
        from_sun = np.array(axis_m) / np.hypot(*axis_m)
        perpendicular = np.array([-from_sun[1], from_sun[0]])
        sunlit_scene = scene.with_sun(
            SunSpec(azimuth=float(np.degrees(np.arctan2(-from_sun[0], -from_sun[1]))) % 360.0, altitude=altitude)
        )
        rendered = trial.render_view(sunlit_scene, view_from_above(trial, sunlit_scene, pixels), map_size=2048)
        at = np.stack(map_positions(rendered), axis=-1)
        steps_m = (np.linalg.norm(np.diff(at, axis=axis), axis=-1).ravel() for axis in (0, 1))
        pixel_m = float(np.fmax.reduce(np.concatenate([*steps_m])))
        foot_m = (corners @ from_sun).max() + np.hypot(*axis_m)
        cast = at[rendered.dark & (at @ from_sun > foot_m)]
        tip_m = (corners @ from_sun).max() + height_m / np.tan(np.radians(altitude))
        side_m = (np.ptp(cast @ perpendicular) / 2 + (cast @ perpendicular).min()) - (corners @ perpendicular).mean()
        col, row = ~geotransform @ at.transpose(2, 0, 1)
        outside_raster = (np.abs(row - rows / 2) > rows / 2 + 1e-6) | (np.abs(col - cols / 2) > cols / 2 + 1e-6)
        worst = larger_figures(worst, {
            "tip_px": abs((cast @ from_sun).max() - tip_m) / pixel_m, "side_px": abs(side_m) / pixel_m,
            "surface lost or made up": share_of_mask(outside_raster, rendered.buffer.valid),
        })  # fmt: skip
    return worst


def larger_figures(first: dict[str, float], second: dict[str, float]) -> dict[str, float]:
    """Return the larger value of each figure."""
    return {name: max(value, first.get(name, value)) for name, value in second.items()}


@hard_case(
    "G7",
    "Cells of any size and grids of any shape throw the same shadows",
    "a block in cells of 0.1 m and of 1 km, in 16 x 16 and (thorough) 8192 x 8192 cells, in strips one cell wide either way",
    BLOCK_BOUNDS,
)
def test_cells_and_grids_of_any_size(trial: Trial) -> dict[str, float]:
    """A camera sees the triangles between cells. A single row has none, so algorithms without maps skip it."""
    worst: dict[str, float] = {}
    grids = [(0.1, (120, 120)), (1000.0, (120, 120)), (10.0, (1, 24))]
    if trial.thorough:
        grids += [(10.0, (16, 16)), (10.0, (24, 1)), (1.0, (8192, 8192))]
    for number, (cell_m, shape) in enumerate(grids):
        if not trial.serves_maps and min(shape) < 2:
            continue
        worst = larger_figures(worst, shadow_of_block(trial, rotated_raster(0.0, cell_m, cell_m), shape, f"level{number}"))
    return worst


@hard_case(
    "R4",
    "The smallest rasters are a lit picture",
    "level ground of 1 x 1, 1 x 5, 2 x 2 cells, and one cell with a height in 64 x 64 without",
    {"false_shadow": 0.0, "surface lost or made up": 0.0},
    algorithms=MAP_VIEW_ALGORITHMS,
    thorough=False,
)
def test_smallest_rasters(trial: Trial) -> dict[str, float]:
    """The rasters are drawn as maps only. A camera sees the triangles between nodes, and a single node has none."""
    single_cell = np.full((64, 64), np.nan, np.float32)
    single_cell[30, 33] = 5.0
    worst: dict[str, float] = {}
    for number, heights in enumerate([*(np.full(shape, 5.0, np.float32) for shape in ((1, 1), (1, 5), (2, 2))), single_cell]):
        name = f"level{number}"
        scene = trial.scene(trial.raster(heights, UTM, *CORNER_M, CELL_M, name=name), (75, 3), name=name, effects=FORCED_EFFECTS)
        pixels = 192 if np.isnan(heights).any() else 32
        rendered = trial.render_view(scene, view_from_above(trial, scene, pixels), map_size=512)
        x, y = map_positions(rendered)
        col, row = np.floor((x - CORNER_M[0]) / CELL_M), np.floor((CORNER_M[1] - y) / CELL_M)
        valid = rendered.buffer.valid
        assert valid.any()
        inside = np.isfinite(heights[np.clip(np.nan_to_num(row), 0, heights.shape[0] - 1).astype(int),
                                     np.clip(np.nan_to_num(col), 0, heights.shape[1] - 1).astype(int)])  # fmt: skip
        worst = larger_figures(
            worst, {"false_shadow": share_of_mask(rendered.dark, valid), "surface lost or made up": share_of_mask(~inside, valid)}
        )
    return worst


@hard_case(
    "R3",
    "Heights are the file's, whatever its numbers are, and no sentinel is one of them",
    "heights of 8 to 64 bits, signed and not, scaled, with declared and undeclared sentinels",
    {"height_m": 1e-3, "holes filled or dug": 0.0},
    algorithms=(ENGINE,),
    thorough=False,
)
def test_numbers_of_every_kind(trial: Trial) -> dict[str, float]:
    height_m = 20.0 + 10.0 * np.add.outer(np.arange(12), np.arange(14) % 3)
    hole = np.zeros(height_m.shape, bool)
    hole[3:6, 4:9], hole[0, 0], hole[-1, -1] = True, True, True
    worst: dict[str, float] = {}
    for number, (kind, sentinel, declared, scale, offset) in enumerate((
        ("uint8", 255, True, 1.0, 0.0), ("uint8", 0, True, 1.0, 10.0), ("uint16", 65535, True, 0.1, -1000.0),
        ("int16", -32768, True, 1.0, 0.0), ("int16", -32768, False, 1.0, 0.0), ("uint16", 65535, False, 1.0, 0.0),
        ("int32", -2147483648, False, 0.01, 0.0), ("uint32", 4294967295, False, 0.01, 0.0),
        ("float32", -3.4028234663852886e38, True, 1.0, 0.0), ("float64", -1.7976931348623157e308, False, 1.0, 0.0),
        ("float64", 1e20, False, 2.0, 5.0), ("float32", np.inf, True, 1.0, 0.0), ("float32", np.nan, True, 1.0, 0.0),
    )):  # fmt: skip
        stored = (
            ((height_m - offset) / scale).round().astype(kind) if kind[0] in "iu" else ((height_m - offset) / scale).astype(kind)
        )
        stored[hole] = sentinel
        path = trial.raster(stored, UTM, *CORNER_M, CELL_M, name=f"dem{number}", nodata=sentinel if declared else None)
        with rasterio.open(path, "r+") as dataset:
            dataset.scales, dataset.offsets = (scale,), (offset,)
        row, col = np.indices(height_m.shape, np.float64)
        read_m, valid = Elevation(str(path)).heights_at(0, row, col)
        wrong_m = float(np.abs(read_m - height_m)[~hole].max())
        worst = larger_figures(worst, {"height_m": wrong_m, "holes filled or dug": float((valid == hole).mean())})
    return worst


@hard_case(
    "R5",
    "On the whole earth it is day where the sun is above the horizon, and night elsewhere",
    "level grids of the globe from -180.5 to 180.5 and from 0 to 360 degrees, round a pole, and in polar stereographic cells",
    {"false_shadow": 0.0, "missed_shadow": 0.0, "surface lost or made up": 0.0},
    algorithms=("shadow_map",),
)
def test_grids_of_the_earth(trial: Trial) -> dict[str, float]:
    """Only ``shadow_map`` serves such a wide view. The sun's altitude at each pixel refers to its own vertical.

    Pixels and facets (1 degree wide) within a degree of the terminator do not count, nor does the picture's rim, where nodes end.
    """
    worst: dict[str, float] = {}
    pixels = 256 if trial.thorough else 96
    grids = (
        ("EPSG:4326", -180.5, 90.5, 1.0, (181, 361)), ("EPSG:3413", -2e6, 2e6, 4e4, (100, 100)),
        ("EPSG:4326", 0.0, 90.0, 1.0, (180, 360)), ("EPSG:4326", -180.0, 90.0, (1.0, 0.05), (200, 360)),
    )  # fmt: skip
    for number, (crs, x0, y0, cell, shape) in enumerate(grids if trial.thorough else grids[:2]):
        name = f"level{number}"
        scene = trial.scene(
            trial.raster(np.zeros(shape, np.float32), crs, x0, y0, cell, name=name), (75, 3), name=name, effects=FORCED_EFFECTS
        )
        rendered = trial.render_view(scene, view_from_above(trial, scene, pixels), map_size=512)
        valid, frame = rendered.buffer.valid, rendered.buffer.frame
        earth_m = frame.origin_earth_m + rendered.buffer.position_frame_m @ frame.frame_from_earth
        lon, lat, height_m = geodetic(earth_m[valid])
        _, up = geocentric(lon, lat)
        altitude = np.full(valid.shape, np.nan)
        altitude[valid] = np.degrees(np.arcsin(np.clip(up @ scene.sun.to_sun_earth, -1.0, 1.0)))
        trial.record_coverage("missed_shadow", metric_coverage(rendered.dark, rendered.truth, np.abs(altitude) > 1.0))
        worst = larger_figures(worst, {
            "false_shadow": share_of_mask(rendered.dark, altitude > 1.0),
            "missed_shadow": share_of_mask(~rendered.dark, altitude < -1.0),
            "surface lost or made up": 1.0 - float(valid[1:-1, 1:-1].mean()),
        })  # fmt: skip
    return worst


UNUSUAL_RASTERS = {
    "autzen_feet_DSM.tif": 0.4, "autzen_feet_DTM.tif": 0.2, "etopo1_1deg_global.tif": 0.9, "eudem_25km_3035.tif": 0.7,
    "nz_elev_1km_oceanholes.tif": 0.15, "slovenia_TM1_564_146_nodata.tif": 0.9, "texas_flat_3arcsec_4326.tif": 0.9,
    "vanderford_64m_epsg3031.tif": 0.05,
}  # fmt: skip
"""Unusual rasters of the world, and the least share of their map that shows data."""


@pytest.mark.parametrize("file", UNUSUAL_RASTERS)
def test_odd_rasters_of_the_world_are_drawn(gl, shared_data, make_scene, file):
    """Hard case R6: the selector plans a map under a low sun. It has light and shadow, and is finite on all ground."""
    scene = make_scene(shared_data / "odd" / file, 75.0, 3.0)
    frame = render(scene, scene.view(size=(96, 96)))
    assert frame.valid.mean() > UNUSUAL_RASTERS[file]
    ground_visibility = frame.visibility[frame.valid]
    assert ((ground_visibility >= 0.0) & (ground_visibility <= 1.0)).all() and np.isnan(frame.visibility[~frame.valid]).all()
    assert 0.001 < (ground_visibility < 0.5).mean() < 0.95
    assert frame.color[frame.valid].any() and not frame.color[~frame.valid].any()


def test_a_raster_of_nothing_is_refused(shared_data, make_scene):
    """Hard case R6: every cell of this raster is nodata."""
    with pytest.raises(SourceError, match="CHM_empty.tif.*no height in any cell"):
        make_scene(shared_data / "odd" / "CHM_empty.tif")
