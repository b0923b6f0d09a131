"""``skugga select --all-scales``: the command probes tiles of all scales, and services plan by the saved probes."""

from __future__ import annotations

import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from skugga.api import map_probing
from skugga.api.cli.main import main
from skugga.api.http.state.served_levels import ServedLevels
from skugga.api.map_probing import map_block, probe_blocks, probed_scales
from skugga.api.workers.jobs import ZoomTiles
from skugga.api.workers.map_plans import select_view_plan, unprobed_class
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.worker_state import representative_block
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.typical_device import typical_device
from skugga.selector.map_probes import MapClass, map_class
from skugga.selector.probe_store import load_probes, probes_folder
from skugga.terrain.gl.device import device
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene


@pytest.fixture(scope="module")
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the probes that the tests save."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def written_rows(hills_level: Path, cache_folder: Path) -> list[dict]:
    """Return the rows of ``select --all-scales --write``."""
    arguments = ["skugga", "select", str(hills_level), "--all-scales", "--budget", "1s", "--write", "--json"]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        patch.setenv("XDG_CACHE_HOME", str(cache_folder))
        patch.setattr(map_probing, "probed_scales", lambda scene: range(3, 5))
        patch.setattr(sys, "argv", arguments)
        with pytest.raises(SystemExit) as exit_info:
            main()
    assert exit_info.value.code == 0 and err.getvalue().startswith("Saved to "), err.getvalue()
    return list(json.loads(out.getvalue()))


@pytest.fixture
def probe_rows(gl, written_rows: list[dict], cache_folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """Return the rows of ``select --all-scales --write`` whose probes are in the user's cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache_folder))
    return written_rows


def saved_probe_files() -> list[Path]:
    """Return the files with stored probes of this device."""
    return list(probes_folder(device().renderer, device().version).glob("*.json"))


def test_a_service_plans_by_the_saved_probes(probe_rows: list[dict], hills_level: Path):
    served_level = ServedLevels([hills_level]).cached_levels()[0]
    (path,) = saved_probe_files()
    assert path.stem == served_level.version, "the command and the service compute the same version of the level"
    probes = load_probes(path)
    assert [2.0**entry.scale for entry in probes.classes] == [row["pixel_m"] for row in probe_rows]

    scene, profile = build_scene(load_level(hills_level)), typical_device()
    measurements, unprobed_measurements = (
        PlanMeasurements(profile, {served_level.version: probes.model_dump_json()}),
        PlanMeasurements(profile),
    )
    for row in probe_rows:
        view = map_block(scene, row["pixel_m"])

        def reasons(overrides: dict, plan_measurements: PlanMeasurements = measurements, view=view) -> dict[str, str]:
            plan = select_view_plan(scene, view, "map", overrides, served_level.key, plan_measurements)
            return {entry.name: entry.reason for entry in plan.reasons}

        assert reasons({})["sun: probe"].startswith("maps like this one were probed: ")
        assert "sun: probe" in reasons({"max_error": 0.01})
        assert "sun: probe" not in reasons({"map_size": 512}), "the probe did not draw with this map size"
        assert "sun: probe" not in reasons({}, unprobed_measurements)
        assert unprobed_class(scene, view, {}, served_level.key, measurements) is None
        missing_class = unprobed_class(scene, view, {}, served_level.key, unprobed_measurements)
        assert missing_class == map_class(row["pixel_m"], scene.sun.altitude_deg)
        assert unprobed_class(scene, view, {}, served_level.key, PlanMeasurements()) is None, (
            "without a device profile there are no predictions that a probe could correct"
        )
    assert missing_class is not None
    higher = scene.with_sun(SunSpec(azimuth=180.0, altitude=MapClass(0, missing_class.sun + 2).sun_altitude_deg))
    assert unprobed_class(higher, view, {}, served_level.key, measurements) == MapClass(missing_class.scale, missing_class.sun + 2)


def test_tiles_of_all_zooms_have_a_probed_scale(hills_level: Path):
    served_level = ServedLevels([hills_level]).cached_levels()[0]
    scene = build_scene(load_level(hills_level))
    for name, zooms in served_level.zooms.items():
        for zoom in range(zooms.first, zooms.last + 1):
            tile = representative_block(scene, ZoomTiles(matrix_set=name, zoom=zoom))
            tile_class = map_class(map_pixel_m(scene.world, tile), 45.0)
            assert tile_class is not None and tile_class.scale in probed_scales(scene), (name, zoom)


def test_coarse_scales_probe_one_block_and_fine_ones_three(gl, hills_level: Path):
    scene = build_scene(load_level(hills_level))
    scales = probed_scales(scene)
    coarse_m, fine_m = 2.0 ** scales[-1], 2.0 ** scales[0]
    assert len(map_probing.probe_centers(scene, coarse_m)) == 1
    places = map_probing.probe_centers(scene, fine_m)
    assert len(places) == 3 and places[0] == (0.5, 0.5)
    coarse_probes = probe_blocks(scene, coarse_m, typical_device(), budget_s=0.2)
    fine_probes = probe_blocks(scene, fine_m, typical_device(), budget_s=0.2)
    assert len(fine_probes.observations["sun"]) >= 3 > 0 < len(coarse_probes.observations["sun"])
    assert fine_probes.plan.view == "map"


def test_a_probe_of_a_slow_choice_changes_the_plan(probe_rows: list[dict], hills_level: Path):
    """Plan the same level on a device whose probe measured the preferred choice as very slow."""
    served_level = ServedLevels([hills_level]).cached_levels()[0]
    scene, profile = build_scene(load_level(hills_level)), typical_device()
    view = map_block(scene, probe_rows[0]["pixel_m"])
    probes = load_probes(saved_probe_files()[0])
    first = probes.classes[0]
    (choice_name,) = {observation.choice for observation in first.seen["sun"][:1]}
    slow_observations = tuple(
        observation.model_copy(update={"ms": 1e5}) if observation.choice == choice_name else observation
        for observation in first.seen["sun"]
    )
    slower_probes = probes.merged_with(type(probes)(classes=(first.model_copy(update={"seen": {"sun": slow_observations}}),)))

    def probe_outcome(plan_measurements: PlanMeasurements) -> str:
        plan = select_view_plan(scene, view, "map", {}, served_level.key, plan_measurements)
        return next(observation.reason for observation in plan.reasons if observation.name == "sun: probe").rsplit("; ", 1)[1]

    assert probe_outcome(_measurements(profile, served_level.version, probes)) == f"the choice remains {choice_name}"
    assert probe_outcome(_measurements(profile, served_level.version, slower_probes)).endswith(f" instead of {choice_name}")


def _measurements(profile: DeviceProfile, version: str, probes) -> PlanMeasurements:
    """Return measurements for plans: a calibration, and the probes of the level version ``version``."""
    return PlanMeasurements(profile, {version: probes.model_dump_json()})


@pytest.mark.parametrize(
    ("options", "wrong_option"),
    [
        (["--view", "main"], "--view"), (["--policy", "predict"], "--policy"), (["--map-size", "512"], "--map-size"),
        (["--altitude", "-5", "--azimuth", "180"], "altitude"), (["--all-views"], "--all-views"),
        (["--budget", "soon"], "--budget"),
    ],
)  # fmt: skip
def test_conflicting_options_are_refused(gl, run, hills_level: Path, options: list[str], wrong_option: str):
    status, out, err = run("select", str(hills_level), "--all-scales", *options)
    assert status != 0 and out == "" and err.startswith(f"skugga: {wrong_option}: ") and len(err.strip().splitlines()) == 1
