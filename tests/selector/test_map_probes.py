"""Map probes: classes of maps by pixel size and sun altitude, and the store of probes on disk."""

from __future__ import annotations

import os
from math import atan, degrees, hypot

import pytest

from skugga.selector import probe_store
from skugga.selector.map_probes import BLOCK_ERROR_SD, BLOCK_TIME_SD, MapClass, MapProbes, ProbedClass, map_class
from skugga.selector.probe_store import load_probes, probes_folder, save_probes
from tests.api.workers.fake_probes import observation as make_observation


def make_probes(scale: int, sun: int, *choices: str) -> MapProbes:
    """Return probes of one class of scale and sun, with observations of these choices."""
    return MapProbes(classes=(ProbedClass(scale=scale, sun=sun, seen={"sun": tuple(map(make_observation, choices))}),))


@pytest.mark.parametrize(
    ("pixel_m", "altitude_deg", "expected"),
    [
        (8.0, 45.0, (3, 0)), (11.0, 45.0, (3, 0)), (12.0, 45.0, (4, 0)), (0.25, 26.565, (-2, -1)), (1.0, 0.01, (0, -5)),
        (1.0, 90.0, (0, 2)), (1.0, degrees(atan(2.0**0.49)), (0, 0)), (1.0, degrees(atan(2.0**0.51)), (0, 1)),
    ],
)  # fmt: skip
def test_map_class_by_pixel_size_and_sun_altitude(pixel_m, altitude_deg, expected):
    assert map_class(pixel_m, altitude_deg) == expected


@pytest.mark.parametrize("altitude_deg", [None, 0.0, -3.0])
def test_map_class_is_none_without_sun(altitude_deg):
    assert map_class(8.0, altitude_deg) is None


@pytest.mark.parametrize("sun", range(-5, 3))
def test_map_class_contains_its_middle(sun):
    assert map_class(1.0, MapClass(0, sun).sun_altitude_deg) == (0, sun)


def test_map_probes_add_noise_for_other_blocks():
    probes = make_probes(3, -1, "sweep").merged_with(make_probes(4, -1, "shadow_map 512"))
    observations = probes.observations_of_class(MapClass(4, -1))
    assert observations is not None and [observation.choice for observation in observations["sun"]] == ["shadow_map 512"]
    observation, original = observations["sun"][0], make_observation()
    assert (observation.error, observation.ms) == (original.error, original.ms)
    assert observation.error_noise == hypot(original.error_noise, BLOCK_ERROR_SD) > observation.ms_noise
    assert observation.ms_noise == hypot(original.ms_noise, BLOCK_TIME_SD) > original.ms_noise
    assert all(probes.observations_of_class(other) is None for other in (MapClass(5, -1), MapClass(3, 0), None))


def test_map_probes_merge_replaces_the_same_class():
    merged = make_probes(4, 0, "b").merged_with(make_probes(3, 0, "a")).merged_with(make_probes(4, 0, "c"))
    assert merged == make_probes(3, 0, "a").merged_with(make_probes(4, 0, "c")) and merged != make_probes(3, 0, "a").merged_with(
        make_probes(4, 0, "b")
    )
    assert [probed_class.scale for probed_class in merged.classes] == [3, 4]


def test_save_probes_merges_with_the_stored_file(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    path = save_probes("device", "1", "level", make_probes(3, 0, "a"))
    assert path.parent == probes_folder("device", "1") != probes_folder("device", "2")
    assert save_probes("device", "1", "level", make_probes(4, 0, "b")) == path
    assert load_probes(path) == make_probes(3, 0, "a").merged_with(make_probes(4, 0, "b"))


@pytest.mark.parametrize("text", ["", "{", "[]", '{"classes": [{"scale": 1}]}', '{"other": 1}', "\xff"])
def test_load_probes_ignores_a_broken_file(tmp_path, text):
    path = tmp_path / "level.json"
    assert load_probes(path) == MapProbes()
    path.write_bytes(text.encode("latin1"))
    assert load_probes(path) == MapProbes()


def test_save_probes_evicts_the_oldest_files(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(probe_store, "MAX_FILES", 2)
    for number in range(4):
        os.utime(save_probes("device", "1", f"level{number}", make_probes(number, 0, "a")), (number, number))
    assert sorted(path.stem for path in probes_folder("device", "1").iterdir()) == ["level2", "level3"]
