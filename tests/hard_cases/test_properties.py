"""Random terrain, place, sun and eye: values are finite and within [0, 1], and errors within the algorithm's bounds.

``COUNTEREXAMPLES`` names the counter-examples that were found; they run with the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from pyproj import Transformer

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps.perspective_shadow_map import perspective_maps
from skugga.shadows.maps.settings import PerspectiveMapSettings
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import FIND_CANDIDATES, SHADOW_ALGORITHMS, RenderedView, Trial, View, hard_case
from tests.hard_cases.reach_of_error import unexplained_coverage, unexplained_errors
from tests.rasters import ENGINEERING

PX = 64
"""Side of the pictures."""

GROUNDS = ("cliff", "spikes", "plateaus", "plane", "islands", "rough", "saw")

PLACES: dict[str, tuple[str, float, float, float]] = {
    "site": (ENGINEERING, 0.0, 0.0, 1.0),
    "far site": (ENGINEERING, 500_000.0, 6_650_000.0, 1.0),
    "zone's middle": ("EPSG:32633", 500_000.0, 6_400_000.0, 1.0),
    "zone's edge": ("EPSG:32632", 170_000.0, 6_400_000.0, 1.0),
    "southern": ("EPSG:32755", 560_000.0, 5_200_000.0, 1.0),
    "antimeridian": ("EPSG:32760", 829_000.0, 8_100_000.0, 1.0),
    "degrees": ("EPSG:4326", 15.0, 60.0, 1 / 111_320),
    "degrees past 180": ("EPSG:4326", 180.0, -17.0, 1 / 111_320),
    "north pole": ("EPSG:3413", 0.0, 0.0, 1.0),
    "south pole": ("EPSG:3031", 0.0, 0.0, 1.0),
    "mercator": ("EPSG:3857", 1_300_000.0, 11_000_000.0, 1.0),
    "feet": ("EPSG:2994", 2_100_000.0, 900_000.0, 1 / 0.3048),
}
"""Places of the ground's middle: CRS, x, y, and the number of its units per metre."""

ORTHOGONAL, CONDITION = 1e-12, 1e7
"""Bounds on a rotation's distance from an orthogonal matrix, and on the condition number of an equilibrated projection:
float32 has no digit left at 1e7.
"""


@dataclass(frozen=True)
class Eye:
    """The position and direction of a camera, as shares of the ground's sides, and its height in cells."""

    at: tuple[float, float]
    target: tuple[float, float]
    above_cells: float
    fov_deg: float


@dataclass(frozen=True)
class Situation:
    """A random scene: the ground (its relief in cells), the place, the sun, the eye (``None``: a map), and its houses."""

    ground: str
    cells: int
    cell_m: float
    relief_cells: float
    seed: int
    place: str
    azimuth_deg: float
    altitude_deg: float
    eye: Eye | None
    houses: bool


def _evenly_distributed(low: float, high: float, steps: int = 1000) -> st.SearchStrategy[float]:
    """Return a strategy of evenly distributed numbers: floats would come mostly from the range's ends."""
    return st.integers(0, steps).map(lambda step: round(low + (high - low) * step / steps, 4))


_SHARE = _evenly_distributed(0.1, 0.9)
EYES = st.builds(
    Eye, st.tuples(_SHARE, _SHARE), st.tuples(_SHARE, _SHARE),
    st.one_of(_evenly_distributed(0.01, 3.0), _evenly_distributed(3.0, 300.0)),
    st.one_of(_evenly_distributed(20.0, 70.0), _evenly_distributed(0.5, 150.0)),
).filter(lambda eye: max(abs(a - b) for a, b in zip(eye.at, eye.target, strict=True)) > 0.01)  # fmt: skip
SITUATIONS = st.builds(
    Situation,
    ground=st.sampled_from(GROUNDS),
    cells=st.integers(12, 40),
    cell_m=_evenly_distributed(-1.0, 3.0).map(lambda power: round(10.0**power, 3)),
    relief_cells=_evenly_distributed(-2.0, 1.5).map(lambda power: round(10.0**power, 4)),
    seed=st.integers(0, 2**16),
    place=st.sampled_from(sorted(PLACES)),
    azimuth_deg=st.one_of(_evenly_distributed(0.0, 360.0), st.sampled_from([0.0, 45.0, 90.0, 135.0, 180.0, 270.0])),
    altitude_deg=st.one_of(_evenly_distributed(-2.0, 90.0), _evenly_distributed(0.01, 10.0), st.sampled_from([0.0, 45.0, 90.0])),
    eye=st.one_of(st.none(), EYES),
    houses=st.booleans(),
)


def heights_of(situation: Situation) -> np.ndarray:
    """Return heights in metres (cells, cells) float32, NaN without data."""
    rng = np.random.default_rng(situation.seed)
    n, relief = situation.cells, min(situation.relief_cells * situation.cell_m, 8000.0)
    row, col = np.mgrid[:n, :n]
    base = np.zeros((n, n))
    if situation.ground == "cliff":
        base = np.where(col + row * rng.uniform(-1, 1) > n / 2, relief, 0.0)
    elif situation.ground == "spikes":
        base[tuple(rng.integers(2, n - 2, (2, 3)))] = relief
    elif situation.ground == "plateaus":
        base = relief * np.round(rng.random((n // 4 + 2, n // 4 + 2)) * 2)[row // 4, col // 4] / 2
    elif situation.ground == "plane":
        base = relief * (rng.uniform(-1, 1) * row + rng.uniform(-1, 1) * col) / n
    elif situation.ground == "rough":
        base = relief * rng.random((n, n))
    elif situation.ground == "saw":
        base = relief * ((row + col) % 2)
    else:
        base = relief * rng.random((n, n))
        base[rng.random((n, n)) < 0.3] = np.nan
        for east, north in (
            [(0.5, 0.5)] if situation.eye is None else [situation.eye.at, situation.eye.target]
        ):  # ground to stand on and to look at
            base[np.hypot(row - (1 - north) * n, col - east * n) < 2.0] = relief / 2
    return base.astype(np.float32)


def scene_of(situation: Situation, folder: Path) -> Scene:
    """Return the scene of a situation; its only camera is ``eye``."""
    trial = Trial("", False, folder)
    crs, x, y, units = PLACES[situation.place]
    side = situation.cell_m * units
    raster = trial.raster(
        heights_of(situation), crs, x - situation.cells * side / 2, y + situation.cells * side / 2, side, nodata=float("nan")
    )
    meshes: list[Any] = []
    if situation.houses:
        box = trimesh.creation.box(extents=(2.2, 1.4, 1.7))
        box.apply_scale(situation.cell_m)
        box.export(folder / "house.ply")
        meshes.append({"source": "house.ply", "at": _place(situation, (0.5, 0.5)), "turn": 20})
    views: dict[str, Any] = {}
    if situation.eye is not None:
        above_m = situation.eye.above_cells * situation.cell_m
        views["views"] = {"eye": {
            "kind": "perspective", "fov": situation.eye.fov_deg, "size": [PX, PX * 3 // 4],
            "eye": [*_place(situation, situation.eye.at), above_m], "target": [*_place(situation, situation.eye.target), 0.0],
        }}  # fmt: skip
    return trial.scene(raster, (situation.azimuth_deg, situation.altitude_deg), meshes, **views)


def view_of(situation: Situation, scene: Scene) -> View:
    """Return the camera, or a map of the whole ground.

    Across the antimeridian the map is in degrees, since UTM zones end there. Its pixels are at least 1e-9 of its coordinates, which
    such a view must be able to resolve.
    """
    if situation.eye is not None:
        return scene.view("eye")
    if situation.place != "degrees past 180":
        return scene.view(size=(PX, PX))
    px = min(PX, int(situation.cells * situation.cell_m * PLACES[situation.place][3] / (1e-9 * 181.0)))
    return scene.view(size=(px, px), crs="EPSG:4326")


def _place(situation: Situation, share: tuple[float, float]) -> list[float]:
    """Return metres from the middle, or degrees, of a place given as shares of the ground's sides."""
    crs, x, y, units = PLACES[situation.place]
    distance_m = [(s - 0.5) * situation.cells * situation.cell_m for s in share]
    if crs == ENGINEERING:
        return distance_m
    return list(
        Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(x + distance_m[0] * units, y + distance_m[1] * units)
    )


def matrix_errors(rendered: RenderedView) -> tuple[float, float]:
    """Return the largest error of the rotations of a view and its light, and the largest condition number of its projections.

    A projection applies to the cube round the visible points: the origin's distance does not count.
    """
    buffer, scene = rendered.buffer, rendered.scene
    assert scene.light_space is not None
    rotations = [scene.light_space.light_from_earth, buffer.frame.frame_from_earth]
    projections = []
    if isinstance(rendered.view, PerspectiveView):
        rotations.append(rendered.view.earth_from_camera)
        points = buffer.position_frame_m[buffer.valid]
        if len(points):
            middle, half = (points.max(axis=0) + points.min(axis=0)) / 2.0, max(float(np.ptp(points, axis=0).max()) / 2.0, 1e-3)
            cube = np.block([[half * np.eye(3), middle[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
            steps = [step for step in rendered.plan.steps if isinstance(step.settings, PerspectiveMapSettings)]
            receivers = buffer.valid & ~attached_shadow_mask(buffer, scene)
            if steps and receivers.any():
                settings, find_candidates = steps[0].settings, FIND_CANDIDATES[steps[0].algorithm]
                for perspective_map in perspective_maps(buffer, receivers, scene, SUN, settings, None, find_candidates):
                    projections.append(np.reshape(perspective_map.depth_map.uniforms["clip_rows"], (4, 4)) @ cube)
    assert all(np.isfinite(matrix).all() for matrix in (*rotations, *projections)), "a matrix is not finite"
    skew = max(float(np.abs(matrix.T @ matrix - np.eye(3)).max()) for matrix in rotations)
    return skew, max(
        (float(np.linalg.cond(matrix / np.abs(matrix).max(axis=1, keepdims=True))) for matrix in projections), default=1.0
    )


COUNTEREXAMPLES = {
    "a sun on the horizon over the teeth of a saw: level faces of volumes have no slope": Situation(
        "saw", 8, 1.0, 1.0, 293, "zone's edge", 270.0, 0.0, None, True
    ),
    "a cliff's edge in line with the sun": Situation("cliff", 8, 1.0, 1.0, 0, "antimeridian", 0.0, 0.0, None, False),
    "plateaus at the pole, the sun on the horizon": Situation("plateaus", 17, 1.0, 1.0, 17, "north pole", 0.0, -1e-300, None, True),
    "nodes of a map count past 2^31": Situation("saw", 8, 0.1, 3.4, 2477, "mercator", 233.28, 2.7173, None, False),
    "a house across the antimeridian under the zenith": Situation(
        "cliff", 23, 1.419, 0.0208, 91, "degrees past 180", 45.0, 90.0, None, True
    ),
    "one pixel of ground": Situation(
        "rough", 17, 1.38, 0.0145, 2517, "site", 0.0, 1.5884, Eye((0.1808, 0.2024), (0.268, 0.2264), 140.511, 125.6315), True
    ),
    "grazed triangles that begin before what is seen of them": Situation(
        "plateaus", 36, 0.108, 0.2037, 40766, "zone's middle", 45.0, 0.0899,
        Eye((0.1064, 0.24), (0.2736, 0.5248), 21.711, 9.9185), False,
    ),
    "shadows that lie as deep as a face may be off": Situation(
        "rough", 20, 3.767, 0.0265, 217, "degrees", 43.56, 0.0, Eye((0.3232, 0.432), (0.1728, 0.1968), 0.2821, 24.55), True
    ),
    "a ring of triangles that folds over, as the sun sees it: a texel's centre falls into several": Situation(
        "saw", 18, 75.858, 3.3113, 49838, "feet", 270.0, 45.0, None, True
    ),
    "the eye in the shadow of ground some of whose nodes are not there": Situation(
        "saw", 39, 1.294, 0.5998, 27653, "degrees past 180", 0.0, 1.6584, Eye((0.1, 0.5064), (0.4672, 0.28), 0.01, 33.35), True
    ),
    "a map of more pixels than degrees can tell apart": Situation(
        "cliff", 12, 0.1, 0.01, 0, "degrees past 180", 270.0, 30.0, None, True
    ),
}  # fmt: skip
"""Former failures, by cause."""

ALGORITHMS = tuple(name for name in SHADOW_ALGORITHMS if name != "planar")
EXAMPLES, THOROUGH_EXAMPLES = 10, 100

_BOUNDS = {"rotation_skew": ORTHOGONAL, "condition": CONDITION, "wrong beyond its reach": 0.0}


MIN_SUN_DEG = {"reconstructed_volume": 1.0}
"""Least altitude of the sun, degrees. Under lower suns rebuilt surfaces have single wrong pixels (docs/algorithms.md)."""


def is_served(trial: Trial, situation: Situation) -> bool:
    """Return whether a situation is within the limits that are documented for an algorithm."""
    return situation.altitude_deg >= MIN_SUN_DEG.get(trial.algorithm, -90.0)


def outcome(trial: Trial, situation: Situation) -> dict[str, float]:
    """Return the figures of a situation; all 0 where the algorithm refuses it."""
    with TemporaryDirectory() as folder:
        scene = scene_of(situation, Path(folder))
        try:
            rendered = trial.render_view(scene, view_of(situation, scene))
        except UnsupportedError:
            return dict.fromkeys(_BOUNDS, 0.0)
    valid = rendered.visibility[rendered.buffer.valid]
    assert ((valid >= 0.0) & (valid <= 1.0)).all(), "a visibility that is none"
    skew, condition = matrix_errors(rendered)
    trial.record_coverage("wrong beyond its reach", unexplained_coverage(rendered))
    return {"rotation_skew": skew, "condition": condition, "wrong beyond its reach": float(unexplained_errors(rendered).mean())}


def within_bounds(figures: dict[str, float]) -> bool:
    """Return whether all figures are within their bounds."""
    return all(figures[name] <= bound for name, bound in _BOUNDS.items())


def _worse(worst: dict[str, float], figures: dict[str, float]) -> None:
    """Update the largest value of each figure in ``worst``."""
    for name, value in figures.items():
        worst[name] = max(worst.get(name, 0.0), value)


@hard_case(
    "X1", "Whatever the ground, the place, the sun and the eye: finite, and wrong only as far as the algorithm's error reaches",
    "grounds, places, suns and eyes drawn at random", _BOUNDS,
    algorithms=ALGORITHMS,
)  # fmt: skip
def test_random_situations(trial: Trial) -> dict[str, float]:
    """Every run tests the same random situations. ``tests.hard_cases.hunt`` draws others."""
    worst: dict[str, float] = {}

    @settings(
        max_examples=THOROUGH_EXAMPLES if trial.thorough else EXAMPLES, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(SITUATIONS)
    def look(it: Situation) -> None:
        assume(is_served(trial, it))
        found = outcome(trial, it)
        assert within_bounds(found), found
        _worse(worst, found)

    look()
    return worst


@hard_case(
    "X2", "The same for situations that once broke something", "; ".join(COUNTEREXAMPLES), _BOUNDS,
    algorithms=ALGORITHMS, thorough=False,
)  # fmt: skip
def test_found_situations(trial: Trial) -> dict[str, float]:
    worst: dict[str, float] = {}
    for situation in COUNTEREXAMPLES.values():
        _worse(worst, outcome(trial, situation))
    return worst
