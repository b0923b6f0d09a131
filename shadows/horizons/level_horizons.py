"""Horizons and sky view factors of the blocks of a level's map."""

from __future__ import annotations

import numpy as np

from skugga.shadows.horizons.azimuths import SkyViewKind, evenly_spaced_azimuths_deg
from skugga.shadows.horizons.block_ground import block_grid, horizon_blocks
from skugga.shadows.horizons.scan import horizon_angles_deg
from skugga.shadows.horizons.sky_view import sky_view_factor
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene

__all__ = ["horizon_blocks", "horizons_of_block", "sky_view_of_block"]


def sky_view_of_block(scene: Scene, view: MapView, kind: SkyViewKind, azimuths: int, transmissivity: float = 0.0) -> np.ndarray:
    """Return the sky view factor at the cells of a block, float32 (rows, cols); NaN without ground.

    ``kind`` and ``azimuths`` are those of ``skugga.shadows.horizons.sky_view``. ``transmissivity`` is the share of light, 0 to 1,
    that comes through the crowns of trees.
    """
    return sky_view_factor(block_grid(scene, view), kind, azimuths)


def horizons_of_block(scene: Scene, view: MapView, azimuths: int) -> np.ndarray:
    """Return the horizon angles at the cells of a block towards evenly spaced azimuths, float32 (rows, cols, azimuths), degrees.

    They are -90 where no ground lies, and NaN at cells without ground.
    """
    angles = horizon_angles_deg(block_grid(scene, view), evenly_spaced_azimuths_deg(azimuths))
    return np.moveaxis(angles, 0, -1)
