"""Estimates of devices: the typical device's rates, scaled by the times of a benchmark."""

from __future__ import annotations

from datetime import timedelta

import pytest

from skugga.api import device_calibration
from skugga.selector.cost import calibration, device_estimate
from skugga.selector.cost.calibration import CalibrationJob
from skugga.selector.cost.cost_model import counts_to_ms
from skugga.selector.cost.device_estimate import estimated_profile, is_current, is_software_rasteriser
from skugga.selector.cost.device_profile import load_profile, profile_digest, profile_path, save_profile
from skugga.selector.cost.error_model import packaged_model
from skugga.selector.cost.typical_device import model_for_device, typical_device
from skugga.selector.predict import ESTIMATED_TIMES_REASON, predicted_plan
from skugga.terrain.gl import device as gl_module
from skugga.terrain.level.level import Shadows
from tests.selector.test_predict import make_descriptor, make_request, name_of

RENDERER, VERSION = "llvmpipe (LLVM 15.0.6, 256 bits)", "4.5 Mesa 22"


@pytest.fixture(autouse=True)
def _no_profile(tmp_path, monkeypatch) -> None:
    """Hide the machine's calibration and its cached estimate."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    estimated_profile.cache.clear()


@pytest.fixture
def twice_as_slow(monkeypatch) -> None:
    """Let the benchmark find that this device takes twice the time of the typical one."""
    monkeypatch.setattr(device_estimate, "_time_ratio", lambda: 2.0)


def test_estimated_profile_has_scaled_rates(twice_as_slow):
    profile = estimated_profile(RENDERER, VERSION)
    assert profile.is_estimate and (profile.renderer, profile.version) == (RENDERER, VERSION)
    assert profile.rates_ns == {
        part: {name: 2.0 * rate for name, rate in rates.items()} for part, rates in typical_device().rates_ns.items()
    }
    assert load_profile(RENDERER, VERSION) == profile


def test_estimated_profile_leaves_an_unusable_file(twice_as_slow):
    """A calibration of a newer version of Skugga is not lost."""
    path = profile_path(RENDERER, VERSION)
    path.parent.mkdir(parents=True)
    path.write_text('{"schema_version": 99}', encoding="utf-8")
    assert estimated_profile(RENDERER, VERSION).is_estimate and path.read_text(encoding="utf-8") == '{"schema_version": 99}'


def test_a_failed_benchmark_leaves_the_times_of_the_typical_device(monkeypatch, caplog):
    """A full disk must not end a render process."""

    def fail() -> float:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(device_estimate, "_time_ratio", fail)
    profile = estimated_profile(RENDERER, VERSION)
    assert profile.rates_ns == typical_device().rates_ns and profile.is_estimate and load_profile(RENDERER, VERSION) is None
    assert "No space left on device" in caplog.text


def test_estimate_of_other_typical_rates_is_replaced(twice_as_slow):
    """A new release has other rates, which an estimate by the earlier ones does not fit."""
    estimate = estimated_profile(RENDERER, VERSION)
    old_rates_ns = {part: dict.fromkeys(rates, 1.0) for part, rates in estimate.rates_ns.items()}
    old = estimate.model_copy(update={"rates_ns": old_rates_ns})
    save_profile(old)
    estimated_profile.cache.clear()
    assert not is_current(old) and is_current(estimate) and is_current(old.model_copy(update={"is_estimate": False}))
    assert estimated_profile(RENDERER, VERSION).rates_ns == load_profile(RENDERER, VERSION).rates_ns == estimate.rates_ns


def test_a_stored_calibration_is_preferred_to_an_estimate(twice_as_slow):
    """Another process may have calibrated the device during the benchmark."""
    calibration = typical_device().model_copy(update={"renderer": RENDERER, "version": VERSION})
    save_profile(calibration)
    assert estimated_profile(RENDERER, VERSION) == load_profile(RENDERER, VERSION) == calibration


def test_equal_estimates_have_one_digest(twice_as_slow):
    estimate = estimated_profile(RENDERER, VERSION)
    later = estimate.model_copy(update={"measured": estimate.measured + timedelta(days=1), "took_s": 9.0})
    assert profile_digest(later) == profile_digest(estimate) != ""
    calibration = estimate.model_copy(update={"is_estimate": False})
    assert profile_digest(calibration) != profile_digest(calibration.model_copy(update={"took_s": 9.0}))


def test_time_ratio_is_the_median_of_the_steps(gl, monkeypatch):
    """Every step takes three times as long as on the typical device, except for the sweeps, which take a hundred times as long."""
    algorithms = []

    def run(job: CalibrationJob) -> None:
        algorithms.append(job.step.algorithm)
        factor = 100.0 if job.step.algorithm == "sweep" else 3.0
        rates_ns = typical_device().rates_ns
        job.min_ms.update({part: factor * counts_to_ms(rates_ns[part], counts) for part, counts in job.work.items()})

    monkeypatch.setattr(calibration, "run_job", run)
    assert device_estimate._time_ratio() == pytest.approx(3.0)
    assert {"shadow_map", "shadow_volume", "sweep"} <= set(algorithms) and "truth" not in algorithms


@pytest.mark.parametrize(
    ("renderer", "is_software"),
    [(RENDERER, True), ("softpipe", True), ("Google SwiftShader", True), ("NVIDIA GeForce RTX 4090/PCIe/SSE2", False)],
)
def test_only_software_rasterisers_are_estimated(monkeypatch, twice_as_slow, renderer, is_software):
    monkeypatch.setattr(gl_module, "renderer_and_version", lambda: (renderer, VERSION))
    assert is_software_rasteriser(renderer) == is_software
    profile = device_calibration.calibration()
    assert (profile is not None) == is_software and (load_profile(renderer, VERSION) is not None) == is_software


def test_estimated_times_are_less_certain_than_measured_ones(twice_as_slow):
    estimate = estimated_profile(RENDERER, VERSION)
    spreads = [model_for_device(device).time_spread for device in (typical_device(), estimate, None)]
    assert spreads == sorted(set(spreads)) and spreads[0] == packaged_model().time_spread


def test_plans_without_a_limit_of_time_need_no_benchmark(gl, monkeypatch):
    """The first picture on a new machine waits for nothing. Times that are limited or shown are scaled by a benchmark."""
    monkeypatch.setattr(device_estimate, "_time_ratio", lambda: 2.0)
    shadows, rates_ns = Shadows(), typical_device().rates_ns
    profile = device_calibration.calibration_for(shadows, {})
    assert profile is not None and profile.is_estimate and profile.rates_ns == rates_ns
    assert not profile_path(gl.renderer, gl.version).exists()
    for timed in (
        device_calibration.calibration_for(shadows, {"max_ms": 40.0}),
        device_calibration.calibration_for(Shadows(max_ms=40.0), {}),
        device_calibration.calibration_for(shadows, {}, shows_times=True),
        device_calibration.calibration(),
    ):
        assert timed is not None and timed.rates_ns["planar"]["pixels"] == 2.0 * rates_ns["planar"]["pixels"]
    assert device_calibration.calibration_for(shadows, {}) == load_profile(gl.renderer, gl.version)


@pytest.mark.parametrize("max_error", [0.1, 0.03, 0.01, 0.001])
def test_choice_for_an_error_does_not_depend_on_the_factor(monkeypatch, max_error):
    """A machine's speed changes what a choice takes, and not which one is taken: pictures are the same on all of them."""
    descriptor, names = make_descriptor(), set()
    for factor in (0.01, 1.0, 50.0):
        monkeypatch.setattr(device_estimate, "_time_ratio", lambda factor=factor: factor)
        estimated_profile.cache.clear()
        plan = predicted_plan(descriptor, make_request(descriptor, max_error=max_error), None, estimated_profile("llvmpipe", "1"))
        names.add(name_of(plan))
        assert any(reason.reason == ESTIMATED_TIMES_REASON for reason in plan.reasons)
    assert len(names) == 1
