"""Time rates of a typical device, for use on a device without a calibration.

They come from one measured device. The ratio of two candidates' times is similar on many devices, but absolute times are not. So
only the policies that also draw candidates and time them use these rates (``skugga.selector.measure``).
"""

from __future__ import annotations

from importlib.resources import files

from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.error_model import ErrorModel, packaged_model
from skugga.selector.gaussian_estimate import SharedVariance
from skugga.terrain.cache import MIB, cached

UNKNOWN_TIME_SPREAD = 0.7
"""Scale of the logistic distribution of the logarithm of a time around that of the typical device.

With this scale about half of the times are off by a factor of more than two.
"""

UNKNOWN_SHARED = SharedVariance(view=0.85, family=0.08)
"""Shares of the variance of these times that candidates have in common. Most of it is one factor of the device."""


@cached("process", MIB)
def typical_device() -> DeviceProfile:
    """Return the profile of the device that measured the selector's benchmark."""
    return DeviceProfile.model_validate_json(
        files("skugga.selector.cost").joinpath("typical_device.json").read_text(encoding="utf-8")
    )


def uncalibrated_model(errors: ErrorModel | None = None) -> ErrorModel:
    """Return the error model for a device without a calibration: its times have a larger uncertainty."""
    model = errors or packaged_model()
    shared = model.shared.model_copy(update={"time": UNKNOWN_SHARED})
    return model.model_copy(update={"time_spread": UNKNOWN_TIME_SPREAD, "shared": shared})
