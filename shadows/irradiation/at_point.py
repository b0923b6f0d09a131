"""The irradiation of a plane at a point over a period, and what ground, buildings and trees take from it.

Light is computed in stages: under an open sky, behind the ground, behind ground and solids, and behind leaves as well. The loss by
a cause is the difference of two stages, so received light and losses add up to the light under an open sky. The loss of skylight by
trees is what would be gained without them. A cause that hides the sky reflects light in its place, which is a negative loss.
Trees also take from the light that the ground around reflects (``skugga.shadows.irradiation.planes.reflecting_share``).
Direct light that several casters hide is lost to the one that reaches highest, as in the report of a point
(``skugga.shadows.point.horizon``).

Leaves hide the sky up to the highest leaf in each azimuth, without gaps. Rays towards the sun go on through gaps of leaves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from skugga.shadows.irradiation.light import Part, SkyLight, reflected_light
from skugga.shadows.irradiation.planes import LEVEL_PLANE, TiltedPlane, reflecting_share
from skugga.shadows.irradiation.suns import SunIntervals
from skugga.shadows.point.horizon import GROUND, LEAVES, SOLIDS, PointHorizon, Surroundings, horizon_profile, sun_occluder_groups

Cause = Literal["relief", "solids", "forest"]
"""What takes light: the ground, buildings and models, or trees."""

CAUSES: tuple[Cause, ...] = get_args(Cause)

PARTS: tuple[Part, ...] = ("beam", "circumsolar", "sky", "horizon_band", "reflected")
"""The parts of light, which add up to ``total``."""

LostLight = Literal["beam", "sky", "reflected"]
"""Light that is lost: from the sun's direction, from the rest of the sky, and from the ground around."""

_PARTS_OF_LOSS: dict[LostLight, slice] = {"beam": slice(0, 2), "sky": slice(2, 4), "reflected": slice(4, 5)}
"""Indices in ``PARTS`` of the parts of lost light."""

SKY_AZIMUTHS = 360
"""Azimuths of the horizon over which the light of the sky is summed."""

_GROUPS = GROUND, SOLIDS, LEAVES


@dataclass(frozen=True, eq=False)
class PointIrradiation:
    """The irradiation of a plane at a point in m periods, such as months, kWh/m2.

    Attributes
    ----------
    plane
        The plane.
    received
        (m,) by part, ``total`` among them.
    open_sky
        (m,) by part: what the plane would receive under an open sky, without terrain and objects.
    lost
        (m,) by kind of light and cause. Lost reflected light is negative where a cause reflects more light in place of the sky than
        it takes.
    sky_view, open_sky_view
        Sky view factor of the plane, and that under an open sky.
    sky_view_of_relief
        Sky view factor behind the ground alone.
    has_sun
        bool (m,): whether the sun rises in each period.
    """

    plane: TiltedPlane
    received: dict[Part, np.ndarray]
    open_sky: dict[Part, np.ndarray]
    lost: dict[LostLight, dict[Cause, np.ndarray]]
    sky_view: float
    open_sky_view: float
    sky_view_of_relief: float
    has_sun: np.ndarray


def irradiation_at_point(
    surroundings: Surroundings,
    plane: TiltedPlane,
    suns: SunIntervals,
    light: SkyLight,
    period_of_sun: np.ndarray,
    period_count: int,
    albedo: float,
) -> PointIrradiation:
    """Return the irradiation of a plane at a place, summed by period.

    Parameters
    ----------
    surroundings
        The place and the casters around it.
    plane
        The plane that receives light.
    suns, light
        The n suns at the place, and their light at one height, (1, n).
    period_of_sun
        int (n,): the period of each sun, below ``period_count``.
    period_count
        The number m of periods.
    albedo
        Albedo of the ground around, 0 to 1.

    Raises
    ------
    SkuggaError
        A mesh or a tree layer of the level cannot be read.
    """
    group = sun_occluder_groups(surroundings, suns.azimuth_deg, suns.altitude_deg)
    azimuth_deg = np.arange(SKY_AZIMUTHS) * (360.0 / SKY_AZIMUTHS)
    horizons_deg = _horizons_by_stage(horizon_profile(surroundings, azimuth_deg))
    sky_views, level_sky_views = (
        [any_plane.sky_view(azimuth_deg, horizon_deg) for horizon_deg in horizons_deg] for any_plane in (plane, LEVEL_PLANE)
    )
    sums = []
    for stage, horizon_deg in enumerate(horizons_deg):
        is_lit = ~np.isin(group, _GROUPS[:stage])
        band = plane.horizon_band(azimuth_deg, horizon_deg)
        without_trees = min(stage, LEAVES)  # the stage before the leaves
        reflecting = reflecting_share(sky_views[stage], level_sky_views[stage], level_sky_views[without_trees])
        factors = sky_views[stage], band, reflecting
        energy_kwh = _light_on_plane(plane, suns, light, is_lit, factors, albedo) * suns.hours / 1000.0
        sums.append(np.stack([np.bincount(period_of_sun, values, period_count) for values in energy_kwh]))
    by_cause = {cause: sums[stage] - sums[stage + 1] for stage, cause in enumerate(CAUSES)}
    lost = {
        kind: {cause: values[parts].sum(axis=0) for cause, values in by_cause.items()} for kind, parts in _PARTS_OF_LOSS.items()
    }
    has_sun = np.bincount(period_of_sun, minlength=period_count) > 0
    return PointIrradiation(plane, _by_part(sums[-1]), _by_part(sums[0]), lost, sky_views[-1], sky_views[0], sky_views[1], has_sun)


def _horizons_by_stage(horizon: PointHorizon) -> list[np.ndarray]:
    """Return horizon angles (n,): level ones, and those by the ground, with solids, and with leaves as well."""
    stages = [np.zeros_like(horizon.relief_deg)]
    for angles_deg in (horizon.relief_deg, horizon.solids_deg, horizon.forest_deg):
        stages.append(np.maximum(stages[-1], angles_deg))
    return stages


def _light_on_plane(
    plane: TiltedPlane, suns: SunIntervals, light: SkyLight, is_lit: np.ndarray, factors: tuple[float, float, float], albedo: float
) -> np.ndarray:
    """Return the light of n suns on a plane, W/m2 (parts, n) in the order of ``PARTS``.

    ``is_lit`` (n,) tells whether the suns are seen. ``factors`` are those of the sky, of the band at its horizon, and of the light
    that open level ground reflects. A band that is darker than the sky takes no more than the sky gives, as in pvlib.
    """
    cosine = plane.cosine_towards(suns.azimuth_deg, suns.altitude_deg) * is_lit
    sky_view, band, reflecting = factors
    beam, circumsolar, sky = light.beam[0] * cosine, light.circumsolar[0] * cosine, light.isotropic[0] * sky_view
    horizon_band = np.maximum(light.horizon_band[0] * band, -(sky + circumsolar))
    return np.stack([beam, circumsolar, sky, horizon_band, reflected_light(light, albedo)[0] * reflecting])


def _by_part(sums: np.ndarray) -> dict[Part, np.ndarray]:
    """Return sums (parts, m) by part, and their total."""
    return {**dict(zip(PARTS, sums, strict=True)), "total": sums.sum(axis=0)}
