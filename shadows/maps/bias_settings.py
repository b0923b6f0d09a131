"""Resolve the bias of depth maps, its factor and the culling, and tell the faults that a requested bias shows."""

from __future__ import annotations

from typing import Any

from skugga.shadows.algorithm_settings import NamedReason
from skugga.shadows.maps.settings import SLOPE_BIAS_LIMIT
from skugga.terrain.level.level import Shadows


def bias_fault_reasons(shadows: Shadows, prefix: str = "") -> list[NamedReason]:
    """Return what is wrong in pictures with a requested bias or its factor; nothing for the right ones.

    ``prefix`` begins the names of the reasons.
    """
    reasons = []
    if shadows.bias == "slope_clamped":
        reason = (
            f"to compare with: it is a share of the map's depth, at most {SLOPE_BIAS_LIMIT:g}, and knows no texels, so coarse maps "
            "show acne and deep ones peter-panning"
        )
        reasons.append(NamedReason(name=f"{prefix}bias slope_clamped", reason=reason))
    if bias_scale_of(shadows) != 1.0:
        fault = "acne on slopes"
        if bias_scale_of(shadows) > 1.0:
            fault = (
                "acne on slopes, too" if shadows.bias in ("auto", "receiver_plane") else "shadows that begin late (peter-panning)"
            )
        reason = f"to show the fault: a factor of 1 is right, this one shows {fault}"
        reasons.append(NamedReason(name=f"{prefix}bias_scale {shadows.bias_scale}", reason=reason))
    return reasons


def bias_scale_of(shadows: Shadows) -> float:
    """Return the factor of the bias, with the automatic value replaced."""
    return 1.0 if shadows.bias_scale == "auto" else shadows.bias_scale


def bias_and_culling(shadows: Shadows) -> dict[str, Any]:
    """Return the bias, its factor and the culling as fields of map settings, with automatic values replaced."""
    return {
        "bias": "receiver_plane" if shadows.bias == "auto" else shadows.bias,
        "bias_scale": bias_scale_of(shadows),
        "culling": "none" if shadows.culling == "auto" else shadows.culling,
    }
