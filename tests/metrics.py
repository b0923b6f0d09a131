"""Metrics for tests only: the visibility of the sun's disc at every pixel, and flicker from frame to frame."""

from __future__ import annotations

import numpy as np

from skugga.shadows.passes import PassLog
from skugga.shadows.truth import truth
from skugga.shadows.truth.truth import TruthSettings
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene


def soft_truth(buffer: GeometryBuffer, scene: Scene, casters: Casters, samples: int = 64) -> np.ndarray:
    """Return the visibility (rows, cols) of the sun's disc at a buffer's points, NaN off the surface: the reference of soft
    filters.
    """
    visibility = truth.fill_visibility(
        buffer, scene, SUN, truth.ALL_CASTER_KINDS, casters, TruthSettings(light_samples=samples), PassLog()
    )
    return np.where(buffer.valid, visibility, np.nan)


def flicker(
    dark: np.ndarray, next_dark: np.ndarray, true_dark: np.ndarray, next_true_dark: np.ndarray, comparable: np.ndarray
) -> float:
    """Return the share of fixed world points whose class changes from one frame to the next although truth's does not.

    Arrays hold the same points in both frames. ``comparable`` marks points that are decidable in both.
    """
    steady = comparable & (true_dark == next_true_dark)
    return float(np.count_nonzero(steady & (dark != next_dark)) / max(np.count_nonzero(steady), 1))
