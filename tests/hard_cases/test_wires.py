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
from tests.hard_cases.blocks import block, flat, shade, shaded
from tests.hard_cases.cases import Seen, Trial, hard_case

SUN = (180.0, 60.0)

SLOPES = (0.0, 0.11, 0.25, 0.43, 0.6, 0.75, 0.9, 1.0)
"""Tangents of the angle between a wire and the map's rows."""

WIDTHS_TEXELS = (0.1, 0.25, 0.5, 0.75, 1.0, 2.0)

SIDE_M, CELL_M, HIGH_M = 48.0, 12.0, 2.0
"""The view's side; the side of a wire's part of it; the height of the wires above the ground."""

THIN_M = 0.01


def wires(width_m: float) -> list[trimesh.Trimesh]:
    """Return eight wires of one width, each in its own part of the view, at eight slopes as the sun sees them.

    The sun sees distances to the north shortened by the sine of its altitude: angles on the ground are steeper, and widths are
    measured across the wire.
    """
    sine = np.sin(np.radians(SUN[1]))
    out = []
    for number, slope in enumerate(SLOPES):
        row, col = divmod(number, 4)
        at = ((col - 1.5) * CELL_M, (row - 0.5) * CELL_M)
        turn = np.arctan2(slope / sine, 1.0)
        # Map units per metre on the ground, across the wire.
        across = 1.0 / np.hypot(np.cos(turn) / sine, np.sin(turn)) if slope else sine
        out.append(block((0.75 * CELL_M, width_m / across, THIN_M), at, HIGH_M, float(np.degrees(turn))))
    return out


def over(scene: Scene, px: int) -> MapView:
    half = SIDE_M / 2.0
    view = scene.view(bounds=(-half, -half, half, half), size=(px, px))
    assert isinstance(view, MapView)
    return view


def truly_dark(seen: Seen, hulls: list[shapely.Polygon]) -> np.ndarray:
    """Return which pixels of the ground lie in the wires' shadow, by their centres, bool (rows, cols)."""
    ground, out = seen.buffer.valid & (seen.buffer.kind == RELIEF), np.zeros(seen.dark.shape, bool)
    points = seen.buffer.position_frame_m[ground] @ seen.buffer.frame.frame_from_earth + seen.buffer.frame.origin_earth_m
    out[ground] = shaded(points[:, 0], points[:, 1], hulls)
    return out


def beyond(seen: Seen, wrong: np.ndarray, hulls: list[shapely.Polygon], distance_m: float) -> np.ndarray:
    """Return those pixels of ``wrong`` whose centres lie farther than a distance from any outline, bool (rows, cols)."""
    out = wrong.copy()
    points = seen.buffer.position_frame_m[wrong] @ seen.buffer.frame.frame_from_earth + seen.buffer.frame.origin_earth_m
    outline = shapely.union_all(hulls).boundary
    out[wrong] = shapely.distance(outline, shapely.points(points[:, :2])) > distance_m
    return out


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
    others = {"shadow_volume": "hybrid", "hybrid": "shadow_volume"}
    found = []
    for width in WIDTHS_TEXELS if trial.thorough else (0.1, 0.5, 2.0):
        bodies = wires(width * SIDE_M / (texels - 3))
        anchor = block((0.02, 0.02, 0.02), (SIDE_M, SIDE_M))  # a body outside the picture that puts hanging bodies at their height
        scene = trial.scene(flat(), sun=SUN, meshes=[trimesh.util.concatenate([*bodies, anchor])])
        view, asked = over(scene, px), {"map_size": texels, "fit": "tight"}
        seen = trial.see(scene, view, **asked)
        other = replace(trial, algorithm=others[trial.algorithm]).see(scene, view, **asked)
        hulls = shade(bodies, SUN)
        real, ground = truly_dark(seen, hulls), seen.buffer.valid & (seen.buffer.kind == RELIEF)
        assert real.sum() > 100, f"{real.sum()} pixels of shadow, {width} texels wide"
        wrong = beyond(seen, ground & (seen.dark != real), hulls, SIDE_M / px / 256.0)
        differ = (seen.dark != other.dark) & ground
        truth = Truth(ground & ~real, np.zeros_like(real), ground, ground)
        trial.saw("missed_shadow", metric_coverage(seen.dark, truth, beyond(seen, ground & real, hulls, SIDE_M / px / 256.0)))
        found.append(
            ((wrong & real).sum() / real.sum(), (wrong & ~real).sum() / (ground & ~real).sum(), differ.sum() / ground.sum())
        )
        if trial.algorithm == "hybrid" and width < 0.2:
            original = trial.see(scene, view, mask="original", **asked)
            missed = (real & ~original.dark).sum() / real.sum()
            assert missed > 0.5, f"the original mask misses {missed:.0%}"
    missed, false, differ = np.max(found, axis=0)
    return {"missed_shadow": missed, "false_shadow": false, "pixels that differ": differ}
