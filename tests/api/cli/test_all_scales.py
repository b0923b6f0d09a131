"""``skugga select --all-scales``: the command probes tiles of all scales, and services plan by the saved probes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from skugga.api import map_probing
from skugga.api.http.state.served_levels import ServedLevels
from skugga.api.map_probing import map_block, probe_blocks, probed_scales
from skugga.api.workers.jobs import Tiles
from skugga.api.workers.map_plans import plan_in_service, unprobed_class
from skugga.api.workers.plan_basis import PlanBasis
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


@pytest.fixture
def probed(gl, run, hills_level: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """Return the rows that the command prints for a level whose probes it has saved."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(map_probing, "probed_scales", lambda scene: range(3, 5))
    status, out, err = run("select", str(hills_level), "--all-scales", "--budget", "1s", "--write", "--json")
    assert status == 0 and err.startswith("Saved to "), err
    return list(json.loads(out))


def own_probes() -> list[Path]:
    return list(probes_folder(device().renderer, device().version).glob("*.json"))


def test_a_service_plans_by_the_saved_probes(probed: list[dict], hills_level: Path):
    served = ServedLevels([hills_level]).known()[0]
    (path,) = own_probes()
    assert path.stem == served.version, "the command and the service know the level by the same version"
    probes = load_probes(path)
    assert [2.0**each.scale for each in probes.classes] == [row["pixel_m"] for row in probed]

    scene, profile = build_scene(load_level(hills_level)), typical_device()
    basis, without = PlanBasis(profile, {served.version: probes.model_dump_json()}), PlanBasis(profile)
    for row in probed:
        view = map_block(scene, row["pixel_m"])

        def reasons(overrides: dict, by: PlanBasis = basis, view=view) -> dict[str, str]:
            plan = plan_in_service(scene, view, "map", overrides, served.key, by)
            return {each.name: each.reason for each in plan.reasons}

        assert reasons({})["sun: probe"].startswith("maps like this one were probed: ")
        assert "sun: probe" in reasons({"max_error": 0.01})
        assert "sun: probe" not in reasons({"map_size": 512}), "other settings than those that were drawn"
        assert "sun: probe" not in reasons({}, without)
        assert unprobed_class(scene, view, {}, served.key, basis) is None
        wanted = unprobed_class(scene, view, {}, served.key, without)
        assert wanted == map_class(row["pixel_m"], scene.sun.altitude_deg)
        assert unprobed_class(scene, view, {}, served.key, PlanBasis()) is None, "nothing is predicted, so nothing is corrected"
    assert wanted is not None
    higher = scene.with_sun(SunSpec(azimuth=180.0, altitude=MapClass(0, wanted.sun + 2).sun_altitude_deg))
    assert unprobed_class(higher, view, {}, served.key, basis) == MapClass(wanted.scale, wanted.sun + 2)


def test_tiles_of_all_zooms_have_a_probed_scale(hills_level: Path):
    served = ServedLevels([hills_level]).known()[0]
    scene = build_scene(load_level(hills_level))
    for name, zooms in served.zooms.items():
        for zoom in range(zooms.first, zooms.last + 1):
            tile = representative_block(scene, Tiles(matrix_set=name, zoom=zoom))
            found = map_class(map_pixel_m(scene.world, tile), 45.0)
            assert found is not None and found.scale in probed_scales(scene), (name, zoom)


def test_coarse_scales_probe_one_block_and_fine_ones_three(gl, hills_level: Path):
    scene = build_scene(load_level(hills_level))
    scales = probed_scales(scene)
    coarse_m, fine_m = 2.0 ** scales[-1], 2.0 ** scales[0]
    assert len(map_probing.probe_centers(scene, coarse_m)) == 1
    places = map_probing.probe_centers(scene, fine_m)
    assert len(places) == 3 and places[0] == (0.5, 0.5)
    alone = probe_blocks(scene, coarse_m, typical_device(), budget_s=1.0)
    several = probe_blocks(scene, fine_m, typical_device(), budget_s=1.0)
    assert len(several.seen["sun"]) >= 3 > 0 < len(alone.seen["sun"])
    assert several.plan.view == "map"


def test_a_probe_that_saw_a_slow_choice_changes_it(probed: list[dict], hills_level: Path):
    """Plan the same level on a device whose probe measured the preferred choice as very slow."""
    served = ServedLevels([hills_level]).known()[0]
    scene, profile = build_scene(load_level(hills_level)), typical_device()
    view = map_block(scene, probed[0]["pixel_m"])
    probes = load_probes(own_probes()[0])
    first = probes.classes[0]
    (name,) = {each.choice for each in first.seen["sun"][:1]}
    slow = tuple(each.model_copy(update={"ms": 1e5}) if each.choice == name else each for each in first.seen["sun"])
    slower = probes.merged_with(type(probes)(classes=(first.model_copy(update={"seen": {"sun": slow}}),)))

    def verdict(by: PlanBasis) -> str:
        plan = plan_in_service(scene, view, "map", {}, served.key, by)
        return next(each.reason for each in plan.reasons if each.name == "sun: probe").rsplit("; ", 1)[1]

    assert verdict(_basis(profile, served.version, probes)) == f"the choice remains {name}"
    assert verdict(_basis(profile, served.version, slower)).endswith(f" instead of {name}")


def _basis(profile: DeviceProfile, version: str, probes) -> PlanBasis:
    return PlanBasis(profile, {version: probes.model_dump_json()})


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--view", "main"], "--view"), (["--policy", "predict"], "--policy"), (["--map-size", "512"], "--map-size"),
        (["--altitude", "-5", "--azimuth", "180"], "altitude"), (["--all-views"], "--all-views"),
        (["--budget", "soon"], "--budget"),
    ],
)  # fmt: skip
def test_conflicting_options_are_refused(gl, run, hills_level: Path, options: list[str], named: str):
    status, out, err = run("select", str(hills_level), "--all-scales", *options)
    assert status != 0 and out == "" and err.startswith(f"skugga: {named}: ") and len(err.strip().splitlines()) == 1
