"""The catalogue of hard cases: the scene, what must hold, and the tolerance.

A case is a function of a ``Trial``. It makes a level, has an algorithm fill the visibility of a view, and returns the figures that
its bounds apply to. ``hard_case`` registers it and makes tests of it, one for each algorithm: a quick one on small pictures, and a
thorough one. An algorithm must refuse what it cannot serve, in the words of its capabilities; the record then holds a refusal. The
table at the end of a run shows every figure.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pytest
import trimesh

from skugga.selector.measure.footprint import texel_footprint_px
from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps.light_space_perspective import light_space_perspectives
from skugga.shadows.maps.post_perspective import post_perspectives
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.registry import ALGORITHM_MODULES, ALGORITHMS
from skugga.shadows.truth.metrics import (
    MIN_COVERED_SHARE,
    ErrorMetrics,
    MetricCoverage,
    error_metrics,
    interior_region,
    metric_coverage,
)
from skugga.shadows.truth.truth import Truth, trace_truth
from skugga.shadows.visibility import fill_steps
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.algorithm_names import REFERENCE_NAMES
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.hard_cases.regressions import FLOOR_PX, RECORD_OPTION, read_records, regressions
from tests.rasters import write_geotiff

SHADOW_ALGORITHMS = tuple(
    module.ALGORITHM.name for module in ALGORITHM_MODULES if module.ALGORITHM.name not in (*REFERENCE_NAMES, "none")
)
"""The algorithms that cast shadows, without the reference."""

MAP_VIEW_ALGORITHMS = tuple(name for name in SHADOW_ALGORITHMS if "map" not in ALGORITHMS[name].refusals)
"""The algorithms of ``SHADOW_ALGORITHMS`` that draw map views."""

FIND_CANDIDATES = {"perspective_shadow_map": post_perspectives, "light_space_perspective_map": light_space_perspectives}
"""The functions that return the candidate matrices of a map, by algorithm."""

PERSPECTIVE_MAP_ALGORITHMS = tuple(FIND_CANDIDATES)
"""The algorithms of ``SHADOW_ALGORITHMS`` whose maps are warped towards the eye. They refuse map views."""

MAP_ALGORITHMS = ("shadow_map", *PERSPECTIVE_MAP_ALGORITHMS)
"""The algorithms of ``SHADOW_ALGORITHMS`` that look up depth maps alone."""

LONG_ALGORITHMS = ("light_space_perspective_map", "reconstructed_volume")
"""Algorithms whose quick runs belong to the long tests.

They share most code with algorithms whose quick runs do not: all but a matrix, or maps and counting.
"""

ENGINE = "engine"
"""Stands for the algorithm in cases that do not depend on it."""

SHADOW_FIGURE_PATTERN = re.compile("interior|missed_shadow|wrong|edge")
"""Figures that judge shadow by pixels or by edges: each must state its coverage of the cast shadow."""

MIN_CAST_SHADOW_PX = 100
"""Below this number of cast shadow pixels a share does not say how much of the shadow is wrong."""

RECORD_PROPERTY = "hard_case"
"""The key under which a test reports its figures."""

MAX_RECENT_TRUTHS = 64
"""Maximum number of truths that are kept for further algorithms: more than any case has."""

_recent_truths: dict[bytes, Truth] = {}
"""The latest truths, oldest first."""

View = MapView | PerspectiveView


@dataclass(frozen=True, eq=False)
class RenderedView:
    """An algorithm's picture of a view under one light: points, their visibility, and truth.

    ``visibility`` (rows, cols) is float32 in [0, 1] with attached shadow, NaN off the surface. It applies to the pixels' own
    points, without samples for smooth edges.
    """

    scene: Scene
    view: View
    plan: Plan
    light: str
    buffer: GeometryBuffer
    casters: Casters
    visibility: np.ndarray
    log: PassLog
    folder: Path

    @property
    def dark(self) -> np.ndarray:
        """Return the class of each pixel: shadow on a surface."""
        return np.nan_to_num(self.visibility, nan=1.0) < 0.5

    @cached_property
    def truth(self) -> Truth:
        """Ray-traced truth of the view, computed once for all algorithms that draw the same points of the same scene."""
        key = self._truth_key()
        if key not in _recent_truths:
            while len(_recent_truths) >= MAX_RECENT_TRUTHS:
                del _recent_truths[next(iter(_recent_truths))]
            _recent_truths[key] = trace_truth(self.buffer, self.scene, self.casters, light=self.light)
        return _recent_truths[key]

    def _truth_key(self) -> bytes:
        """Return a digest of all that truth depends on: the level's files, its bodies and lights now, and the view's points."""
        buffer, digest = self.buffer, sha256(repr((self.view, self.light)).encode())
        for path in sorted(self.folder.iterdir()):
            digest.update(path.name.encode())
            digest.update(path.read_bytes().replace(str(self.folder).encode(), b""))
        scene = self.scene
        state = scene.sun, scene.world.curvature, scene.clock_seconds, scene.lamp_overrides, self.casters.patches
        digest.update(repr(state).encode())
        solids = scene.objects.solids
        for array in (
            buffer.position_frame_m, buffer.valid, buffer.normal_frame, buffer.crease, buffer.surface_kind, buffer.lift_m,
            None if solids is None else solids.vertices_earth_m,
        ):  # fmt: skip
            if array is not None:
                digest.update(np.ascontiguousarray(array))
        return digest.digest()

    @cached_property
    def errors(self) -> ErrorMetrics:
        """All figures of ``skugga.shadows.truth.metrics`` against truth."""
        return error_metrics(self.visibility, self.truth, self.pixel_m, self.texels_px)

    @cached_property
    def pixel_m(self) -> float:
        """The side of a pixel, metres."""
        return describe(self.scene, self.view, pixel_sampling="points").pixel_m

    @cached_property
    def texels_px(self) -> np.ndarray:
        """The larger side of the largest texels on level ground, in pixels (rows, cols); 0 without maps."""
        steps = self.plan.steps_of_light(self.light)
        return np.max([texel_footprint_px(self.scene, step, self.buffer, self.pixel_m) for step in steps or [None]], axis=0)

    @cached_property
    def interior_coverage(self) -> MetricCoverage:
        """The coverage of the cast shadow by ``errors.interior``."""
        return metric_coverage(self.dark, self.truth, interior_region(self.truth, self.texels_px))


@dataclass(frozen=True, eq=False)
class Trial:
    """One run of a case: the algorithm, whether it is thorough, and a temporary folder."""

    algorithm: str
    thorough: bool
    folder: Path
    coverages: dict[str, list[MetricCoverage]] = field(default_factory=dict)

    @property
    def serves_maps(self) -> bool:
        """Return whether the algorithm draws map views; so does the engine without one."""
        return self.algorithm not in PERSPECTIVE_MAP_ALGORITHMS

    def record_coverage(self, figure: str, *coverages: MetricCoverage) -> None:
        """Record the coverage of the cast shadow by a figure in some pictures."""
        self.coverages.setdefault(figure, []).extend(coverages)

    def scene(
        self,
        terrain: Mapping[str, Any] | Path | str,
        sun: tuple[float, float] | str = "none",
        meshes: list[trimesh.Trimesh | Mapping[str, Any]] | None = None,
        name: str = "level",
        **keys: Any,
    ) -> Scene:
        """Build the scene of a level; ``terrain`` is a raster's path or the key's value, ``sun`` (azimuth, altitude) in degrees.

        Meshes may be bodies, whose heights count from the ground at (0, 0) below them.
        """
        specs: list[Any] = []
        for number, mesh in enumerate(meshes or []):
            if isinstance(mesh, trimesh.Trimesh):
                mesh.export(self.folder / f"{name}_{number}.ply")
                specs.append({"source": f"{name}_{number}.ply", "at": [0, 0]})
            else:
                specs.append(dict(mesh))
        level = {
            "version": 1,
            "terrain": {"source": str(terrain)} if isinstance(terrain, Path | str) else dict(terrain),
            "sun": sun if isinstance(sun, str) else {"azimuth": sun[0], "altitude": sun[1]},
            **({"meshes": specs} if specs else {}),
            **keys,
        }
        path = self.folder / f"{name}.yaml"
        path.write_text(json.dumps(level), encoding="utf-8")  # JSON is YAML
        return build_scene(load_level(path))

    def raster(self, heights: np.ndarray, crs: str, x0: float, y0: float, cell: Any, name: str = "dem", **options: Any) -> Path:
        """Write a GeoTIFF of heights whose north-west corner is (x0, y0)."""
        return write_geotiff(self.folder / f"{name}.tif", heights, crs, x0, y0, cell, **options)

    def render_view(self, scene: Scene, view: View | None = None, light: str | None = None, **settings: Any) -> RenderedView:
        """Draw a view (of one block) with this trial's algorithm.

        ``settings`` are those of a level's ``shadows``, besides the algorithm. While the sun shines, the algorithm runs even if
        the plan finds no casters: its output must show that there are none.

        Raises ``UnsupportedError`` if the algorithm cannot serve the view.
        """
        view = view or scene.view()
        level = scene.loaded.level
        if scene.sun_is_up and level.effects == "auto":
            level = level.model_copy(update={"effects": {"cast_shadows": "on", "alpha_test": "on"}})
        plan = make_plan(describe(scene, view, pixel_sampling="points"), level, {"algorithm": self.algorithm, **settings})
        light = light or scene.light_names[0]
        buffer = geometry_buffer(scene, view)
        casters, log = find_casters(scene, buffer), PassLog()
        visibility = fill_steps(plan.steps_of_light(light), buffer, scene, casters, plan.effect_names, log)
        visibility[attached_shadow_mask(buffer, scene, light)] = 0.0
        visibility[~buffer.valid] = np.nan
        return RenderedView(scene, view, plan, light, buffer, casters, visibility, log, self.folder)


Measure = Callable[[Trial], Mapping[str, float]]


@dataclass(frozen=True)
class Case:
    """A hard case: ``bounds`` gives the upper bound of each measured figure."""

    id: str
    title: str
    set_up: str
    bounds: Mapping[str, float]
    measure: Measure = field(repr=False)

    def run(self, algorithm: str, thorough: bool, folder: Path) -> dict[str, Any]:
        """Return the record of a trial: ``figures`` by name, or the reason of a ``refusal``."""
        record: dict[str, Any] = {
            "id": self.id, "title": self.title, "set_up": self.set_up, "bounds": dict(self.bounds), "algorithm": algorithm,
            "thorough": thorough,
        }  # fmt: skip
        trial = Trial(algorithm, thorough, folder)
        try:
            figures = {name: float(value) for name, value in self.measure(trial).items()}
        except UnsupportedError as error:
            reason = next((reason for reason in ALGORITHMS[algorithm].refusals.values() if reason in str(error)), None)  # type: ignore[index]
            if reason is None:
                raise
            return {**record, "refusal": reason}
        assert figures.keys() == self.bounds.keys(), f"{self.id}: figures {list(figures)} for bounds {list(self.bounds)}"
        shadow_figures = {name for name in figures if SHADOW_FIGURE_PATTERN.search(name)}
        assert shadow_figures <= trial.coverages.keys(), (
            f"{self.id}: {shadow_figures} judge shadow, but coverage is recorded for {set(trial.coverages)} only"
        )
        return {
            **record,
            "figures": figures,
            "sights": {name: coverage_summary(trial.coverages[name]) for name in figures if name in shadow_figures},
        }


def coverage_summary(coverages: list[MetricCoverage]) -> dict[str, float]:
    """Summarise coverages: ``wrong_cast`` of the worst picture, ``covered_share`` of all.

    ``wrong_cast_beyond_floor`` is the largest value that remains if ``FLOOR_PX`` wrong pixels of each picture do not count. If no
    picture has much cast shadow, both are those of all pictures together. Without any cast shadow the result is empty.
    """
    counts = zip(
        *((coverage.cast_px, coverage.covered_px, coverage.wrong_px, coverage.union_px) for coverage in coverages), strict=True
    )
    total = MetricCoverage(*(sum(coverage) for coverage in counts)) if coverages else MetricCoverage(0, 0, 0, 0)
    large_pictures = [coverage for coverage in coverages if coverage.cast_px >= MIN_CAST_SHADOW_PX] or [total]
    if not total.cast_px:
        return {}
    beyond_floor = [replace(coverage, wrong_px=max(coverage.wrong_px - FLOOR_PX, 0)).wrong_cast for coverage in large_pictures]
    return {
        "wrong_cast": max(coverage.wrong_cast for coverage in large_pictures),
        "wrong_cast_beyond_floor": max(beyond_floor),
        "sees": total.covered_share,
    }


def untested_figures(record: Mapping[str, Any]) -> list[str]:
    """Return the names of figures whose coverage of the cast shadow is below ``MIN_COVERED_SHARE``."""
    return [name for name, coverage in record.get("sights", {}).items() if coverage and coverage["sees"] < MIN_COVERED_SHARE]


def exceeded_bounds(record: Mapping[str, Any]) -> list[str]:
    """Return the names of a trial's figures that exceed their bounds; NaN does."""
    return [name for name, value in record.get("figures", {}).items() if not value <= record["bounds"][name]]


def failures(record: Mapping[str, Any]) -> str:
    """Describe which figures of a trial's record exceed their bounds; empty if all hold."""
    return "; ".join(f"{name} {record['figures'][name]:.6g} over {record['bounds'][name]:g}" for name in exceeded_bounds(record))


def hard_case(
    id: str,
    title: str,
    set_up: str,
    bounds: Mapping[str, float],
    algorithms: tuple[str, ...] = SHADOW_ALGORITHMS,
    thorough: bool = True,
) -> Callable[[Measure], Callable[..., None]]:
    """Register a case and make tests of its function; the case itself is the test's attribute ``case``.

    Each algorithm has a quick run and a thorough one. All thorough runs take too long for a build. Therefore the long tests contain
    one thorough run of each case, of an algorithm that the case's id decides; all thorough runs have the mark ``thorough``. The
    quick runs of ``LONG_ALGORITHMS`` are long tests, too. With ``thorough`` false only the quick run exists. A run fails if a
    figure exceeds its bound, or ``wrong_cast`` its regression bound
    (``tests.hard_cases.regressions``).
    """

    def register(measure: Measure) -> Callable[..., None]:
        case = Case(id, title, set_up, bounds, measure)
        candidates = [algorithm for algorithm in algorithms if algorithm not in LONG_ALGORITHMS]
        long_algorithm = candidates[crc32(id.encode()) % len(candidates)]
        runs = [
            pytest.param("quick", algorithm, marks=[pytest.mark.long] * (algorithm in LONG_ALGORITHMS)) for algorithm in algorithms
        ]
        if thorough:
            marks = {
                algorithm: [pytest.mark.thorough] + [pytest.mark.long] * (algorithm == long_algorithm) for algorithm in algorithms
            }
            runs += [pytest.param("thorough", algorithm, marks=marks[algorithm]) for algorithm in algorithms]

        @pytest.mark.parametrize(("way", "algorithm"), runs)
        def test(
            algorithm: str,
            way: str,
            gl: Any,
            tmp_path: Path,
            record_property: Callable[[str, object], None],
            pytestconfig: pytest.Config,
        ) -> None:
            record = case.run(algorithm, way == "thorough", tmp_path)
            record_property(RECORD_PROPERTY, json.dumps(record))
            assert not untested_figures(record), f"{id} by {algorithm} does not test {untested_figures(record)}: {record['sights']}"
            assert not failures(record), f"{id} ({title}) by {algorithm}: {failures(record)}"
            if not pytestconfig.getoption(RECORD_OPTION):
                problems = regressions(record, read_records())
                assert not problems, f"{id} ({title}) by {algorithm}: {problems}"

        test.case = case  # type: ignore[attr-defined]
        test.__doc__ = title
        return test

    return register
