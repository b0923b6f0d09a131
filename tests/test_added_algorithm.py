"""A new algorithm needs a single record: a made-up algorithm is validated, planned, refused, drawn, cached, compared, calibrated
and chosen.

Few modules name the existing algorithms.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from skugga.api.report.page.marks import mark_of
from skugga.selector.candidates import candidates, name_of
from skugga.selector.cost import calibration
from skugga.selector.cost.calibration import calibrate
from skugga.selector.cost.calibration_scenes import calibration_views
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.measure.compare import compare
from skugga.selector.measure.probe import probed_plan
from skugga.selector.planner.planner import make_plan
from skugga.selector.predict import predicted_plan
from skugga.selector.select import select
from skugga.shadows.algorithm import AccuracyInputs, Algorithm, CostInputs, ErrorConstants, PlotMarker, SettingsSearch
from skugga.shadows.algorithm_settings import AlgorithmSettings, NamedReason, ResolvedSettings, SettingsRequest
from skugga.shadows.plan import Plan
from skugga.shadows.registry import ALGORITHMS, algorithms_serving, register_algorithm
from skugga.shadows.render import render_frame
from skugga.shadows.truth.truth import lit_mask, ray_scene
from skugga.shadows.work import Work, Workload
from skugga.terrain.cache import Cache, Missing, caches, clear_caches
from skugga.terrain.describe import describe
from skugga.terrain.errors import LevelError, UnsupportedError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.algorithm_names import ALGORITHM_NAMES, served_algorithms
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.scene import Scene, build_scene

ROOT = Path(__file__).resolve().parents[1]

PASSES = ("coarse rays",)
REFUSAL_REASON = "coarse rays are for what is far away, as the sun is"

visibility_caches: dict[str, Cache[np.ndarray]] = {}
"""The cache of the made-up algorithm under its name, which is added when the algorithm is registered."""

ray_counts: list[int] = []
"""Number of rays that each call cast."""


class CoarseRaysSettings(AlgorithmSettings):
    """Settings of one ray for each square of ``square_px`` x ``square_px`` pixels."""

    square_px: int


def compute_visibility(buffer, scene, light, kinds, casters, settings, log):
    """Return visibility by rays from one pixel of each square, which stands for all of the square."""
    (rays_pass,) = log.pass_names(light, kinds, PASSES)
    with log.record_pass(rays_pass):
        visibility = visibility_caches["coarse rays"].get(scene, buffer.view, light, kinds, settings)
        if isinstance(visibility, Missing):
            lit = lit_mask(buffer, scene, light, ray_scene(buffer, scene, casters, kinds))
            side = settings.square_px
            chosen_lit = lit[side // 2 :: side, side // 2 :: side]
            rows, cols = (
                np.minimum(np.arange(size) // side, chosen_size - 1)
                for size, chosen_size in zip(lit.shape, chosen_lit.shape, strict=True)
            )
            visibility = chosen_lit[np.ix_(rows, cols)].astype(np.float32)
            ray_counts.append(chosen_lit.size)
            visibility_caches["coarse rays"].put(scene, buffer.view, light, kinds, settings, value=visibility)
        return visibility.copy()


def resolve(request: SettingsRequest) -> ResolvedSettings:
    """Return the algorithm's settings from a request, and their reasons."""
    map_size = request.effective_shadows.map_size
    side = 4 if map_size == "auto" else max(4096 // map_size, 1)
    return CoarseRaysSettings(square_px=side), [NamedReason(name=f"square_px {side}", reason="fewer rays would be seen")]


def estimate_work(task: Workload, settings: CoarseRaysSettings) -> Work:
    """Return the units of work of a view, by part."""
    return {
        "coarse rays": {
            "blocks": 1.0,
            "rays": task.visible_pixel_count / settings.square_px**2,
            "triangles": task.all_triangle_count,
        }
    }


ACCURATE_CONSTANTS = ErrorConstants(floor=0.004, interior=0.0, spread=0.05, interior_spread=0.05)

ALGORITHM = Algorithm(
    name="coarse_rays",
    description="a ray for each square of pixels",
    plural_name="coarse rays",
    fill_visibility=compute_visibility,
    passes=PASSES,
    refusals={"omni": REFUSAL_REASON, "spot": REFUSAL_REASON},
    settings_types=(CoarseRaysSettings,),
    resolve_settings=resolve,
    cache_names=("tests.coarse_rays",),
    search=SettingsSearch(resolution_variants=({"map_size": 4096}, {"map_size": 512})),
    cost=CostInputs(
        estimate_work,
        calibration_settings=lambda descriptor, light, calibration_extent: [
            CoarseRaysSettings(square_px=side) for side in (1, 4, 16)
        ],
    ),
    accuracy=AccuracyInputs(error_constants={"coarse_rays": ACCURATE_CONSTANTS}),
    marker=PlotMarker("cross", "vermilion"),
)


@pytest.fixture
def register() -> Iterator[Callable[[Algorithm], None]]:
    """Yield a function that registers an algorithm for the duration of a test."""
    algorithms_before, names_before = dict(ALGORITHMS), list(ALGORITHM_NAMES)
    yield register_algorithm
    ALGORITHMS.clear()
    ALGORITHMS.update(algorithms_before)
    ALGORITHM_NAMES[:] = names_before


@pytest.fixture
def coarse_rays(register) -> Iterator[None]:
    """Register the algorithm ``coarse_rays`` for a test."""
    register(ALGORITHM)
    visibility_caches["coarse rays"] = Cache("tests.coarse_rays", "light", 2**26)
    ray_counts.clear()
    yield
    visibility_caches.clear()


LEVEL = {
    "version": 1,
    "terrain": {"generate": {"kind": "ridges", "size": [800, 800], "cell": 20, "relief": 120, "seed": 3}},
    "sun": {"azimuth": 240, "altitude": 25},
    "lights": {"lamp": {"kind": "omni", "position": [0, 0, 60]}},
}


def level_file(tmp_path: Path, **keys) -> Path:
    """Write the level ``LEVEL`` with further keys, and return its path."""
    path = tmp_path / "level.yaml"
    path.write_text(json.dumps(LEVEL | keys), encoding="utf-8")
    return path


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """Return ridges under the sun alone."""
    return build_scene(load_level(level_file(tmp_path, lights={})))


def coarse_rays_plan(scene: Scene, view, **overrides) -> Plan:
    """Return a plan with the algorithm ``coarse_rays``."""
    return make_plan(describe(scene, view), scene.loaded.level, {"algorithm": "coarse_rays", **overrides})


def test_a_level_may_name_a_new_algorithm(coarse_rays, tmp_path):
    loaded = load_level(level_file(tmp_path, shadows={"algorithm": {"relief": "coarse_rays"}}))
    assert loaded.level.shadows.algorithm == {"relief": "coarse_rays"}
    assert load_level(level_file(tmp_path, shadows={"algorithm": "coarse_rays"})).level.shadows.algorithm == "coarse_rays"
    assert served_algorithms()[-1] == "coarse_rays"
    with pytest.raises(LevelError, match="coarse_rays"):  # a light may not have the name of an algorithm
        load_level(level_file(tmp_path, lights={"coarse_rays": LEVEL["lights"]["lamp"]}))


def test_an_unregistered_algorithm_is_refused(tmp_path):
    with pytest.raises(LevelError, match=r"shadows\.algorithm: .*'coarse_rays'.*shadow_map"):
        load_level(level_file(tmp_path, shadows={"algorithm": "coarse_rays"}))


def test_a_plan_has_the_new_settings_and_survives_json(coarse_rays, scene):
    view = scene.view(size=(64, 64))
    plan, coarser = coarse_rays_plan(scene, view), coarse_rays_plan(scene, view, map_size=512)
    assert plan.settings[SUN]["relief"] == CoarseRaysSettings(square_px=4)
    assert coarser.settings[SUN]["relief"] == CoarseRaysSettings(square_px=8)
    assert "sun/relief: coarse rays" in plan.passes
    assert {entry.name: entry.reason for entry in plan.reasons}["square_px 4"] == "fewer rays would be seen"
    assert Plan.model_validate_json(plan.model_dump_json()) == plan
    assert json.loads(plan.model_dump_json())["settings"][SUN]["relief"] == {"square_px": 4}
    by_maps = make_plan(describe(scene, view), scene.loaded.level, {"algorithm": "shadow_map"})
    assert "coarse_rays" in {entry.name for entry in by_maps.rejected}


def test_a_new_algorithm_is_refused_where_unsupported(coarse_rays, tmp_path):
    lamp_scene = build_scene(load_level(level_file(tmp_path)))
    view = lamp_scene.view(size=(64, 64))
    with pytest.raises(
        UnsupportedError, match=f"coarse_rays for relief under lamp.*{REFUSAL_REASON}; algorithms that can: shadow_map"
    ):
        make_plan(describe(lamp_scene, view), lamp_scene.loaded.level, {"algorithm": "coarse_rays"})
    assert "coarse_rays" in algorithms_serving(("map", "sun", "relief", "uneven")) and "coarse_rays" not in algorithms_serving(
        ("map", "omni", "relief")
    )


def test_a_new_algorithm_draws_and_its_cache_is_cleared(gl, coarse_rays, scene):
    render_points = partial(render_frame, pixel_sampling="points")  # antialiasing of edges would cast more rays
    view = scene.view(size=(64, 64))
    fine_visibility = render_points(scene, view, coarse_rays_plan(scene, view, map_size=4096)).visibility
    truth = render_points(scene, view, make_plan(describe(scene, view), scene.loaded.level, {"algorithm": "truth"})).visibility
    assert np.array_equal(fine_visibility, truth, equal_nan=True) and 0.05 < (truth == 0.0).mean() < 0.95
    frame = render_points(scene, view, coarse_rays_plan(scene, view))
    assert [record.name for record in frame.passes] == frame.plan.passes
    differs = frame.visibility[frame.valid] != truth[frame.valid]
    assert 0.0 < differs.mean() < 0.2 and len(ray_counts) == 2
    cached_frame = render_points(scene, view, coarse_rays_plan(scene, view))
    assert np.array_equal(cached_frame.visibility, frame.visibility, equal_nan=True) and len(ray_counts) == 2  # it was cached

    (cache,) = (light_cache for light_cache in caches("light") if light_cache.name in ALGORITHM.cache_names)
    assert len(cache) > 0
    ALGORITHM.clear_caches()
    assert len(cache) == 0
    render_points(scene, view, coarse_rays_plan(scene, view))
    assert len(cache) > 0 and len(ray_counts) == 3
    clear_caches("light")
    assert len(cache) == 0


def test_a_new_algorithm_is_compared(gl, coarse_rays, scene):
    view = scene.view(size=(96, 96))
    names = {name_of(plan) for plan in candidates(scene, view)}
    assert {"coarse_rays-4", "coarse_rays-1", "coarse_rays-8"} <= names
    plans = [coarse_rays_plan(scene, view, map_size=size) for size in (4096, 1024, 256)]
    rows = compare(scene, view, plans=plans).rows
    cast_errors = [row.figures["wrong_cast"] for row in rows]
    assert [row.figures["algorithm"][SUN]["relief"] for row in rows] == ["coarse_rays"] * 3
    assert cast_errors[0] == 0.0 < cast_errors[1] < cast_errors[2]
    assert mark_of("coarse_rays") == ALGORITHM.marker


def test_a_new_algorithm_is_calibrated(gl, coarse_rays, monkeypatch):
    monkeypatch.setattr(calibration, "TIMING_ROUNDS", 2)
    monkeypatch.setattr(
        calibration,
        "calibration_views",
        lambda folder: (
            replace(view, calibration_extent="few") for view in calibration_views(folder) if view.name == "few_balls_small"
        ),
    )
    profile = calibrate()
    assert profile.residuals["coarse_rays"].rows == 3
    assert sum(profile.rates_ns["coarse rays"].values()) > 0.0


def slow_device(**rates: dict[str, float]) -> DeviceProfile:
    """Return a device on which maps and volumes are slow."""
    slow_rates_ns = {
        "shadow_map, map": {"blocks": 90e6}, "silhouettes, map": {"blocks": 90e6}, "counting, map": {"blocks": 90e6},
        "conservative map, map": {"blocks": 90e6}, "mask": {"blocks": 90e6}, "sweep, map": {"blocks": 40e6},
    }  # fmt: skip
    return DeviceProfile(
        renderer="a device", version="1", cpus=2, engine="0", measured=datetime(2026, 1, 1, tzinfo=UTC), took_s=1.0,
        rates_ns={**slow_rates_ns, **rates},
    )  # fmt: skip


RATES = {"coarse rays": {"blocks": 1e6}}


@pytest.fixture
def ridges(scene) -> Descriptor:
    """Descriptor of the scene's map."""
    return describe(scene, scene.view(size=(64, 64)))


def test_a_new_algorithm_is_chosen_by_its_error_model(coarse_rays, register, ridges, scene):
    level = scene.loaded.level
    plan = predicted_plan(ridges, level, {"max_error": 0.02}, slow_device(**RATES))
    assert plan.algorithm[SUN]["relief"] == "coarse_rays" and plan.predicted is not None and plan.predicted.ms == pytest.approx(1.0)
    assert plan.predicted.wrong_cast == pytest.approx(ACCURATE_CONSTANTS.floor)

    worse_constants = replace(
        ACCURATE_CONSTANTS, floor=10.0 * ACCURATE_CONSTANTS.floor
    )  # the planner trusts this wrong error model, and rejects it
    register(replace(ALGORITHM, accuracy=AccuracyInputs(error_constants={"coarse_rays": worse_constants})))
    revised_plan = predicted_plan(ridges, level, {"max_error": 0.02}, slow_device(**RATES))
    assert revised_plan.algorithm[SUN]["relief"] == "sweep"
    rejection_reasons = {entry.name: entry.reason for entry in revised_plan.rejected}
    assert "chance of an error over 2 %" in rejection_reasons["coarse_rays"] or rejection_reasons["coarse_rays"].startswith(
        "expected at best: an error of 4.0 %"
    )


def test_a_probe_detects_a_wrong_error_model(gl, coarse_rays, register, scene):
    """The error model claims a tenth of the real error. The planner trusts it until the probe draws once."""
    view, level = scene.view(size=(64, 64)), scene.loaded.level
    square = {"map_size": 256}  # a ray for each square of 16 pixels
    probe_result = probed_plan(
        scene, view, overrides={"algorithm": "coarse_rays", **square, "max_error": 0.9}, device=slow_device(**RATES)
    )
    real_error = probe_result.plan.predicted.wrong_cast
    assert real_error > 0.05 and not any(measurement.interior_noise for measurement in probe_result.observations[SUN])
    claimed_constants = replace(ACCURATE_CONSTANTS, floor=real_error / 10.0)
    register(
        replace(
            ALGORITHM, resolve_settings=resolve_coarse, accuracy=AccuracyInputs(error_constants={"coarse_rays": claimed_constants})
        )
    )
    overrides = {"max_error": real_error / 3.0}
    predicted = predicted_plan(describe(scene, view), level, overrides, slow_device(**RATES))
    assert predicted.algorithm[SUN]["relief"] == "coarse_rays" and predicted.target.met
    probed = probed_plan(scene, view, overrides=overrides, device=slow_device(**RATES)).plan
    assert probed.policy == "probe" and probed.algorithm[SUN]["relief"] != "coarse_rays" and probed.target.met
    reasons = {entry.name: entry.reason for entry in probed.reasons}
    assert "sun: probed coarse_rays" in reasons and "(expected: " in reasons["sun: probed coarse_rays"]
    assert "instead of coarse_rays" in reasons["sun: probe"]


def resolve_coarse(request: SettingsRequest) -> ResolvedSettings:
    """Return the coarse settings of the probe's test."""
    return CoarseRaysSettings(square_px=16), []


@pytest.mark.parametrize(
    ("record_changes", "rates", "expected_reason"),
    [
        ({"accuracy": AccuracyInputs()}, RATES, "its errors are not measured yet: benchmarks/selection fits them"),
        ({}, {}, "this device has no rates for coarse rays: run skugga calibrate again"),
    ],
)
def test_an_unmeasured_algorithm_is_rejected_with_a_reason(
    coarse_rays, register, ridges, scene, record_changes, rates, expected_reason
):  # fmt: skip
    register(replace(ALGORITHM, **record_changes))
    level, measured = scene.loaded.level, slow_device(**rates)
    plan = predicted_plan(ridges, level, None, measured)
    assert plan.policy == "predict" and plan.algorithm[SUN]["relief"] == "sweep"
    assert {entry.name: entry.reason for entry in plan.rejected}["coarse_rays"] == expected_reason
    requested_plan = select(ridges, level, {"algorithm": "coarse_rays"}, "predict", measured)
    assert (
        requested_plan.algorithm[SUN]["relief"] == "coarse_rays"
        and requested_plan.predicted is None
        and requested_plan.target.met is None
    )
    reason = next(entry.reason for entry in requested_plan.reasons if entry.name == "policy rules")
    assert reason == f"no prediction is possible, so fixed rules choose: coarse_rays: {expected_reason}"


PATH_BY_ALGORITHM = {
    "shadow_map": "shadows/maps/",
    "perspective_shadow_map": "shadows/maps/",
    "light_space_perspective_map": "shadows/maps/",
    "shadow_volume": "shadows/volumes/",
    "hybrid": "shadows/hybrid/",
    "reconstructed_volume": "shadows/reconstruction/",
    "planar": "shadows/planar.py",
    "sweep": "shadows/sweep/",
    "truth": "shadows/truth/",
}

ALLOWED_MODULES = {
    "terrain/level/algorithm_names.py": "the words that a level may use",
    "selector/mixes.py": "algorithms that are tried together",
    "selector/planner/advice_rules.py": "what each rule of advice takes",
}
"""Modules outside an algorithm's own package that name one, and the reason."""


def algorithm_names_by_module(root: Path) -> dict[str, set[str]]:
    """Return modules outside an algorithm's own package with its name as a word -> those names."""
    names_by_module: dict[str, set[str]] = {}
    for package in ("terrain", "shadows", "selector", "api"):
        for path in (root / package).rglob("*.py"):
            name, text = path.relative_to(root).as_posix(), path.read_text(encoding="utf-8")
            if not any(algorithm in text for algorithm in PATH_BY_ALGORITHM):
                continue  # most modules: to parse them takes seconds
            for node in ast.walk(ast.parse(text)):
                if (
                    isinstance(node, ast.Constant)
                    and node.value in PATH_BY_ALGORITHM
                    and not name.startswith(PATH_BY_ALGORITHM[str(node.value)])
                ):
                    names_by_module.setdefault(name, set()).add(str(node.value))
    return names_by_module


def test_algorithms_are_named_in_three_other_modules_only():
    assert set(PATH_BY_ALGORITHM) | {"none"} == set(ALGORITHMS)
    assert set(algorithm_names_by_module(ROOT)) == set(ALLOWED_MODULES)


def test_a_module_that_names_an_algorithm_is_found(tmp_path):
    (tmp_path / "selector").mkdir()
    (tmp_path / "selector" / "chain.py").write_text(
        'def taps(name):\n    return 3 if name == "shadow_map" else 1\n', encoding="utf-8"
    )
    assert algorithm_names_by_module(tmp_path) == {"selector/chain.py": {"shadow_map"}}


def test_caches_of_algorithm_packages_are_listed_in_records(gl):
    """Every cache that a record lists exists, and a record lists every cache of the packages of algorithms."""
    cache_names = {cache.name for cache in caches()}
    listed_names = {name for algorithm in ALGORITHMS.values() for name in algorithm.cache_names}
    assert listed_names <= cache_names
    package_prefixes = tuple(f"shadows.{package}." for package in ("maps", "volumes", "hybrid", "sweep", "truth.truth", "planar"))
    assert {name for name in cache_names if name.startswith(package_prefixes)} - {
        "skugga.shadows.maps.resolve._measure_band_ranges",
        "skugga.shadows.maps.resolve._splits_into_ranges",
    } <= listed_names
