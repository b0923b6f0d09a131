"""Calibration: rates fitted to measured times, and device profiles on disk."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.cost import calibration
from skugga.selector.cost.calibration import calibrate, fitted_rates
from skugga.selector.cost.calibration_scenes import calibration_levels, calibration_views
from skugga.selector.cost.cost_model import counts_to_ms
from skugga.selector.cost.device_profile import DeviceProfile, load_profile, missing_profile_reason, profile_path, save_profile

RENDERER, VERSION = "llvmpipe (LLVM 15.0.6, 256 bits)", "4.5 Mesa 22"


@pytest.fixture(autouse=True)
def _no_calibration(tmp_path, monkeypatch) -> None:
    """Hide the machine's calibration."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def profile() -> DeviceProfile:
    """A calibration with the rates of ``planar`` alone."""
    return DeviceProfile(
        renderer=RENDERER, version=VERSION, cpus=2, engine="0.1", measured=datetime(2025, 1, 1, tzinfo=UTC), took_s=60.0,
        rates_ns={"planar": {"blocks": 1e6, "pixels": 12.5}}, residuals={"planar": {"rows": 4, "median": 0.05, "p90": 0.1}},
    )  # fmt: skip


@given(st.lists(st.floats(0.5, 500.0), min_size=3, max_size=3), st.integers(0, 99))
def test_fitted_rates_recover_the_rates_that_made_the_times(rates, seed):
    names = ("blocks", "pixels", "texels")
    counts = np.random.default_rng(seed).uniform(1.0, 1e5, (12, 3))
    truth = dict(zip(names, rates, strict=True))
    rows = [
        (dict(zip(names, work_counts, strict=True)), "planar", counts_to_ms(truth, dict(zip(names, work_counts, strict=True))))
        for work_counts in counts
    ]
    assert fitted_rates(rows)["planar"] == pytest.approx(truth, rel=1e-6)


def test_fitted_rates_minimise_relative_errors_and_stay_positive():
    rows = [({"blocks": 1.0, "pixels": 10.0 * n}, "planar", ms) for n, ms in ((1, 5.0), (10, 4.0), (100, 3.0))]
    rates = fitted_rates(rows)["planar"]
    assert rates["pixels"] == 0.0
    # the constant c that minimises the sum of (c/ms - 1)^2 is sum(1/ms) / sum(1/ms^2)
    inverse = np.array([1 / 5.0, 1 / 4.0, 1 / 3.0])
    assert rates["blocks"] * 1e-6 == pytest.approx(inverse.sum() / (inverse**2).sum())


def test_load_profile_requires_same_device_and_driver(profile):
    assert load_profile(RENDERER, VERSION) is None and "not calibrated" in missing_profile_reason(RENDERER, VERSION)
    path = save_profile(profile)
    assert path == profile_path(RENDERER, VERSION) and path.name.startswith("llvmpipe-llvm-15-0-6-256-bits-")
    assert load_profile(RENDERER, VERSION) == profile and missing_profile_reason(RENDERER, VERSION) is None
    assert load_profile(RENDERER, "4.5 Mesa 23") is None and load_profile("another", VERSION) is None
    assert [file.name for file in path.parent.iterdir()] == [path.name]  # no partial file is left


def test_save_profile_is_atomic(profile, monkeypatch):
    path = save_profile(profile)
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        save_profile(profile.model_copy(update={"took_s": 1.0}))
    assert [file.name for file in path.parent.iterdir()] == [path.name] and load_profile(RENDERER, VERSION) == profile


@pytest.mark.parametrize(
    ("change", "reason_part"),
    [
        ({"rates_ns": {"planar": {"pixels": -1.0}}}, "rates_ns.planar.pixels"),
        ({"rates_ns": {"planar": {"pixels": float("nan")}}}, "rates_ns.planar.pixels"),
        ({"rates_ns": {"planar": {"pixels": float("inf")}}}, "rates_ns.planar.pixels"),
        ({"rates_ns": {"planar": {"pixels": None}}}, "rates_ns.planar.pixels"),
        ({"rates_ns": {"planar": {}}}, "rates_ns.planar"),
        ({"rates_ns": {}}, "rates_ns"),
        ({"rates_ns": None}, "rates_ns"),
        ({"cpus": 0}, "cpus"),
        ({"more": 1}, "more"),
        ({"schema_version": 99}, "another version"),
        ({"renderer": "another"}, "another device"),
    ],
)
def test_load_profile_ignores_invalid_values_with_a_reason(profile, change, reason_part):
    path = save_profile(profile)
    path.write_text(json.dumps(json.loads(path.read_text()) | change), encoding="utf-8")
    assert load_profile(RENDERER, VERSION) is None
    reason = missing_profile_reason(RENDERER, VERSION)
    assert reason_part in reason and str(path) in reason and "skugga calibrate" in reason and "\n" not in reason


@pytest.mark.parametrize("text", [b"", b"{", b"[]", b"null", b"\xff\xfe", b'{"schema_version": 1}'])
def test_load_profile_ignores_a_broken_file(profile, text):
    save_profile(profile).write_bytes(text)
    assert load_profile(RENDERER, VERSION) is None and "skugga calibrate" in missing_profile_reason(RENDERER, VERSION)


def test_load_profile_ignores_a_folder_at_its_path():
    profile_path(RENDERER, VERSION).mkdir(parents=True)
    assert load_profile(RENDERER, VERSION) is None and "cannot be read" in missing_profile_reason(RENDERER, VERSION)
    profile_path(RENDERER, VERSION).rmdir()


def test_calibrate_profiles_the_device_that_draws(gl, monkeypatch):
    """Calibrate on one small level. The profile names the device, and its rates explain the times of every algorithm that ran."""

    def yield_smallest_view(folder):
        yield replace(next(view for view in calibration_views(folder) if view.name == "few_balls_small"), calibration_extent="few")

    monkeypatch.setattr(calibration, "calibration_views", yield_smallest_view)
    monkeypatch.setattr(calibration, "TIMING_ROUNDS", 2)
    progress = []
    device_profile = calibrate(lambda done, total: progress.append((done, total)))
    assert [done for done, _ in progress] == list(range(1, progress[-1][1] + 1)) and len({total for _, total in progress}) == 1
    assert (device_profile.renderer, device_profile.version) == (gl.renderer, gl.version)
    names = {
        "shadow_map", "perspective_shadow_map", "light_space_perspective_map", "shadow_volume", "hybrid", "reconstructed_volume",
        "planar",
    }  # fmt: skip
    assert names <= device_profile.residuals.keys()
    assert device_profile.residuals["shadow_map"].rows >= 2
    assert device_profile.rates_ns["shadow_map, perspective"]["look-ups, filter 3"] >= 0.0
    assert any(part.startswith("light_space_perspective_map, ") for part in device_profile.rates_ns)
    assert load_profile(device_profile.renderer, device_profile.version) is None  # the caller saves the profile
    save_profile(device_profile)
    assert load_profile(device_profile.renderer, device_profile.version) == device_profile


def test_calibration_levels_cover_views_lights_and_casters(tmp_path):
    names, views, lights, kinds = zip(
        *((name, view, light, kinds) for name, _, view, _, light, kinds, _ in calibration_levels(tmp_path)), strict=True
    )
    assert len(set(names)) == len(names)
    assert set(views) == {"main", "map"} and set(lights) == {"sun", "lamp"}
    assert {kind for caster_kinds in kinds for kind in caster_kinds} == {"relief", "meshes", "forest"}
