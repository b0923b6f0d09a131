"""The device that is assumed where the real one is not calibrated: rates that were measured once, held to be right within a factor.

Only what is measured afterwards goes by them (``skugga.selector.measure``): how the times of two candidates compare is much the
same on many devices, how long they take is not.
"""

from __future__ import annotations

from importlib.resources import files

from skugga.selector.belief import SharedVariance
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.error_model import ErrorModel, packaged_model
from skugga.terrain.cache import MIB, cached

UNKNOWN_TIME_SPREAD = 0.7
"""The scale of the logistic distribution of times about those of the usual device: half of them are off by a factor of two."""

UNKNOWN_SHARED = SharedVariance(view=0.85, family=0.08)
"""Most of that is one factor of the device's."""


@cached("process", MIB)
def usual_device() -> DeviceProfile:
    """The device that measured the benchmark of the selector."""
    return DeviceProfile.model_validate_json(
        files("skugga.selector.cost").joinpath("usual_device.json").read_text(encoding="utf-8")
    )


def uncalibrated_model(errors: ErrorModel | None = None) -> ErrorModel:
    """The error model with times about which little is known."""
    model = errors or packaged_model()
    shared = model.shared.model_copy(update={"time": UNKNOWN_SHARED})
    return model.model_copy(update={"time_spread": UNKNOWN_TIME_SPREAD, "shared": shared})
