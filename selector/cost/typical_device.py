"""Time rates of a typical device, for use on a device without a calibration.

They come from one measured device. The ratio of two candidates' times is similar on many devices, but absolute times are not.
Where these matter, ``skugga.selector.cost.device_estimate`` scales them by a benchmark. Policies that draw candidates correct them.
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

UNKNOWN_SHARED_VARIANCE = SharedVariance(view=0.85, family=0.08)
"""Shares of the variance of these times that candidates have in common. Most of it is one factor of the device."""

ESTIMATED_TIME_SPREAD = 0.35
"""The same scale for estimated rates, whose factor a benchmark has measured: half of the times are off by a factor of 1.5."""

ESTIMATED_SHARED_VARIANCE = SharedVariance(view=0.3, family=0.3)
"""The same shares for estimated rates: what the factor leaves is common to a view's pixels or to a family's passes."""


@cached("process", MIB)
def typical_device() -> DeviceProfile:
    """Return the profile of the device that measured the selector's benchmark."""
    return DeviceProfile.model_validate_json(
        files("skugga.selector.cost").joinpath("typical_device.json").read_text(encoding="utf-8")
    )


def model_for_device(device: DeviceProfile | None, errors: ErrorModel | None = None) -> ErrorModel:
    """Return the error model for the times of a device.

    Without a calibration its times have a larger uncertainty: by ``ESTIMATED_TIME_SPREAD`` for estimated rates, and by
    ``UNKNOWN_TIME_SPREAD`` for those of the typical device (``None``).
    """
    model = errors or packaged_model()
    if device is not None and not device.is_estimate:
        return model
    spread, time = (
        (UNKNOWN_TIME_SPREAD, UNKNOWN_SHARED_VARIANCE) if device is None else (ESTIMATED_TIME_SPREAD, ESTIMATED_SHARED_VARIANCE)
    )
    return model.model_copy(update={"time_spread": spread, "shared": model.shared.model_copy(update={"time": time})})
