"""Casters thinner than a texel: a map may miss them, a hybrid must not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely
import trimesh

from skugga.shadows.truth.metrics import metric_coverage
from skugga.shadows.truth.truth import Truth
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene
from tests.hard_cases.blocks import block, flat_terrain, points_in_polygons, shadow_polygons
from tests.hard_cases.cases import RenderedView, Trial, hard_case

SUN = (180.0, 60.0)

SLOPES = (0.0, 0.11, 0.25, 0.43, 0.6, 0.75, 0.9, 1.0)
"""Tangents of the angle between a wire and the map's rows."""

WIRE_WIDTHS_TEXELS = (0.1, 0.25, 0.5, 0.75, 1.0, 2.0)

SIDE_M, CELL_M, WIRE_HEIGHT_M = 48.0, 12.0, 2.0
"""The view's side; the side of a wire's part of it; the height of the wires above the ground."""

WIRE_THICKNESS_M = 0.01


def wires(width_m: float) -> list[trimesh.Trimesh]:
    """Return eight wires of one width, each in its own part of the view, at eight slopes as the sun sees them.

    The sun sees distances to the north shortened by the sine of its altitude: angles on the ground are steeper, and widths are
    measured across the wire.
    """
    sine = np.sin(np.radians(SUN[1]))
    result = []
    for number, slope in enumerate(SLOPES):
        row, col = divmod(number, 4)
        at = ((col - 1.5) * CELL_M, (row - 0.5) * CELL_M)
        angle_rad = np.arctan2(slope / sine, 1.0)
        # Map units per metre on the ground, across the wire.
        map_units_per_metre = 1.0 / np.hypot(np.cos(angle_rad) / sine, np.sin(angle_rad)) if slope else sine
        result.append(
            block((0.75 * CELL_M, width_m / map_units_per_metre, WIRE_THICKNESS_M), at, WIRE_HEIGHT_M, float(np.degrees(angle_rad)))
        )
    return result


def view_from_above(scene: Scene, px: int) -> MapView:
    """Return a map of the whole level with ``px`` x ``px`` pixels."""
    half = SIDE_M / 2.0
    view = scene.view(bounds=(-half, -half, half, half), size=(px, px))
    assert isinstance(view, MapView)
    return view


def true_shadow(rendered: RenderedView, hulls: list[shapely.Polygon]) -> np.ndarray:
    """Return which pixels of the ground lie in the wires' shadow, by their centres, bool (rows, cols)."""
    ground, result = rendered.buffer.valid & (rendered.buffer.surface_kind == RELIEF), np.zeros(rendered.dark.shape, bool)
    points = (
        rendered.buffer.position_frame_m[ground] @ rendered.buffer.frame.frame_from_earth + rendered.buffer.frame.origin_earth_m
    )
    result[ground] = points_in_polygons(points[:, 0], points[:, 1], hulls)
    return result


def far_from_outlines(rendered: RenderedView, mask: np.ndarray, hulls: list[shapely.Polygon], distance_m: float) -> np.ndarray:
    """Return those pixels of ``mask`` whose centres lie farther than a distance from any outline, bool (rows, cols)."""
    result = mask.copy()
    points = rendered.buffer.position_frame_m[mask] @ rendered.buffer.frame.frame_from_earth + rendered.buffer.frame.origin_earth_m
    outline = shapely.union_all(hulls).boundary
    result[mask] = shapely.distance(outline, shapely.points(points[:, :2])) > distance_m
    return result


@hard_case(
    "H21", "The conservative hybrid loses no wire, and is what volumes are",
    "wires 0.1 to 2 texels wide at 8 slopes, eight pixels a texel (quick: four)",
    {"missed_shadow": 0.0, "false_shadow": 0.0, "pixels that differ": 0.0}, algorithms=("shadow_volume", "hybrid"),
)  # fmt: skip
def test_wires(trial: Trial) -> dict[str, float]:
    """Truth is the wires' outlines at the pixels' centres, except within a step of the rasteriser's grid, 1/256 pixel.

    The pixels that differ are those between both algorithms. The mask that is not conservative must miss thin wires, or the case
    would show nothing: more than half of a wire of a tenth of a texel.
    """
    px, texels = (512, 64) if trial.thorough else (256, 64)
    counterparts = {"shadow_volume": "hybrid", "hybrid": "shadow_volume"}
    results = []
    for width in WIRE_WIDTHS_TEXELS if trial.thorough else (0.1, 0.5, 2.0):
        bodies = wires(width * SIDE_M / (texels - 3))
        anchor = block((0.02, 0.02, 0.02), (SIDE_M, SIDE_M))  # a body outside the picture that puts hanging bodies at their height
        scene = trial.scene(flat_terrain(), sun=SUN, meshes=[trimesh.util.concatenate([*bodies, anchor])])
        view, options = view_from_above(scene, px), {"map_size": texels, "fit": "tight"}
        rendered = trial.render_view(scene, view, **options)
        other = replace(trial, algorithm=counterparts[trial.algorithm]).render_view(scene, view, **options)
        hulls = shadow_polygons(bodies, SUN)
        is_shadow, ground = true_shadow(rendered, hulls), rendered.buffer.valid & (rendered.buffer.surface_kind == RELIEF)
        assert is_shadow.sum() > 100, f"{is_shadow.sum()} pixels of shadow, {width} texels wide"
        is_wrong = far_from_outlines(rendered, ground & (rendered.dark != is_shadow), hulls, SIDE_M / px / 256.0)
        differ = (rendered.dark != other.dark) & ground
        truth = Truth(ground & ~is_shadow, np.zeros_like(is_shadow), ground, ground)
        trial.record_coverage(
            "missed_shadow",
            metric_coverage(rendered.dark, truth, far_from_outlines(rendered, ground & is_shadow, hulls, SIDE_M / px / 256.0)),
        )
        results.append(
            (
                (is_wrong & is_shadow).sum() / is_shadow.sum(),
                (is_wrong & ~is_shadow).sum() / (ground & ~is_shadow).sum(),
                differ.sum() / ground.sum(),
            )
        )
        if trial.algorithm == "hybrid" and width < 0.2:
            original = trial.render_view(scene, view, mask="original", **options)
            missed = (is_shadow & ~original.dark).sum() / is_shadow.sum()
            assert missed > 0.5, f"the original mask misses {missed:.0%}"
    missed, false, differ = np.max(results, axis=0)
    return {"missed_shadow": missed, "false_shadow": false, "pixels that differ": differ}
