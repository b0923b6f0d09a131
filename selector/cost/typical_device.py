"""A typical device for use without a calibration: rates of one measured device, assumed right within a factor.

Only the policies that measure afterwards use it (``skugga.selector.measure``). The ratio of two candidates' times is similar on
many devices, but their absolute times are not.
"""

from __future__ import annotations

from importlib.resources import files

from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.error_model import ErrorModel, packaged_model
from skugga.selector.gaussian_estimate import SharedVariance
from skugga.terrain.cache import MIB, cached

UNKNOWN_TIME_SPREAD = 0.7
"""Scale of the logistic distribution of times around those of the typical device: half of them are off by a factor of two."""

UNKNOWN_SHARED = SharedVariance(view=0.85, family=0.08)
"""Most of this uncertainty is one factor of the device."""


@cached("process", MIB)
def typical_device() -> DeviceProfile:
    """Return the profile of the device that measured the selector's benchmark."""
    return DeviceProfile.model_validate_json(
        files("skugga.selector.cost").joinpath("typical_device.json").read_text(encoding="utf-8")
    )


def uncalibrated_model(errors: ErrorModel | None = None) -> ErrorModel:
    """Return the error model with uncertain times."""
    model = errors or packaged_model()
    shared = model.shared.model_copy(update={"time": UNKNOWN_SHARED})
    return model.model_copy(update={"time_spread": UNKNOWN_TIME_SPREAD, "shared": shared})
