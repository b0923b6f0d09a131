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

    ``kind`` and ``azimuths`` are those of ``skugga.shadows.horizons.sky_view``. Buildings count, and cells on them are those of
    their roofs. Trees hide the sky above the ground and above roofs, also overhead. ``transmissivity`` is the share of light, 0 to
    1, that comes through their crowns; openness, an angle, takes crowns as opaque.
    """
    from skugga.shadows.horizons.object_ground import has_objects, is_under_crown, object_grids

    if not has_objects(scene):
        return sky_view_factor(block_grid(scene, view), kind, azimuths)
    solid, wooded = object_grids(scene, view)
    if wooded is None or kind == "negative_openness":
        return sky_view_factor(solid, kind, azimuths)
    below_crowns = sky_view_factor(wooded, kind, azimuths)
    below_crowns[is_under_crown(solid, wooded) & np.isfinite(below_crowns)] = 0.0
    if kind == "openness" or transmissivity == 0.0:
        return below_crowns
    share = np.float32(transmissivity)
    return share * sky_view_factor(solid, kind, azimuths) + (1 - share) * below_crowns


def horizons_of_block(scene: Scene, view: MapView, azimuths: int) -> np.ndarray:
    """Return the horizon angles at the cells of a block towards evenly spaced azimuths, float32 (rows, cols, azimuths), degrees.

    They are -90 where no ground lies, NaN at cells without ground, and 90 under the crown of a tree. Buildings and trees count.
    """
    from skugga.shadows.horizons.object_ground import has_objects, is_under_crown, object_grids

    azimuth_deg = evenly_spaced_azimuths_deg(azimuths)
    if not has_objects(scene):
        return np.moveaxis(horizon_angles_deg(block_grid(scene, view), azimuth_deg), 0, -1)
    solid, wooded = object_grids(scene, view)
    angles = horizon_angles_deg(solid if wooded is None else wooded, azimuth_deg)
    if wooded is not None:
        angles[:, is_under_crown(solid, wooded)] = 90.0
    return np.moveaxis(angles, 0, -1)
