"""Gaussian hills, and their irradiation by quadrature: analytic normals, shadows and horizons, without a grid.

The ground is a sum of Gaussian hills on a round earth. Its heights are those above the plane that touches the level at the middle
of the hills, which also defines the suns' directions. Along a line towards an azimuth, a hill is a Gaussian of the distance. So the
steepest rise of the ground along the line, the tangent of the horizon angle, is found by samples and a parabola.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.irradiation.light import Part, SkyLight, reflected_light
from skugga.shadows.irradiation.sky import HORIZON_BAND_DEG
from skugga.shadows.irradiation.suns import SunIntervals

STEPS_PER_SIGMA = 20.0
"""Samples along a line per standard deviation of the narrowest hill. The parabola leaves errors of its fourth power."""

HORIZON_AZIMUTHS = 360
"""Azimuths of horizons for the light of the sky."""


@dataclass(frozen=True, eq=False)
class GaussianHills:
    """Hills on a square of ground.

    Attributes
    ----------
    east_m, north_m
        (k,), positions of the tops from the middle of the square, metres.
    height_m
        (k,), heights of the tops, metres.
    sigma_m
        (k,), standard deviations, metres.
    half_side_m
        Half of the side of the square, metres. The ground ends there.
    curvature_per_m
        Curvature of the earth.
    """

    east_m: np.ndarray
    north_m: np.ndarray
    height_m: np.ndarray
    sigma_m: np.ndarray
    half_side_m: float
    curvature_per_m: float = 0.0

    def heights_m(self, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
        """Return heights above the level at positions, in their shape."""
        total = np.zeros(np.broadcast_shapes(np.shape(east_m), np.shape(north_m)))
        for x, y, height, sigma in zip(self.east_m, self.north_m, self.height_m, self.sigma_m, strict=True):
            total += height * np.exp(-((east_m - x) ** 2 + (north_m - y) ** 2) / (2.0 * sigma**2))
        return total

    def slopes(self, east_m: np.ndarray, north_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rises (n,) to the east and to the north at positions (n,), against the plane at the middle."""
        east, north = -self.curvature_per_m * east_m, -self.curvature_per_m * north_m
        for x, y, height, sigma in zip(self.east_m, self.north_m, self.height_m, self.sigma_m, strict=True):
            value = height * np.exp(-((east_m - x) ** 2 + (north_m - y) ** 2) / (2.0 * sigma**2)) / sigma**2
            east, north = east + value * (x - east_m), north + value * (y - north_m)
        return east, north

    @property
    def top_m(self) -> float:
        """An upper bound of all heights: that of a top, if the slopes of other hills raise it by a tenth at most."""
        return 1.1 * float(self.height_m.max())

    def horizon_tangents(
        self, east_m: np.ndarray, north_m: np.ndarray, azimuth_deg: float, least_tangent: float = 0.0
    ) -> np.ndarray:
        """Return the tangents (n,) of the horizon angles of positions (n,) towards an azimuth, against the plane at the middle.

        They are exact above ``least_tangent``; ground beyond the distance at which none can rise above it is left out. Where no
        ground lies towards the azimuth it is -infinity.
        """
        sine, cosine = np.sin(np.radians(azimuth_deg)), np.cos(np.radians(azimuth_deg))
        step = float(self.sigma_m.min()) / STEPS_PER_SIGMA
        reach_m = min(2.0 * np.sqrt(2.0) * self.half_side_m, self.top_m / max(least_tangent, 1e-9) + 2.0 * step)
        distance = step * np.arange(0.25, np.ceil(reach_m / step))[:, None]
        height = np.zeros((len(distance), len(east_m)))
        for x, y, top, sigma in zip(self.east_m, self.north_m, self.height_m, self.sigma_m, strict=True):
            along = (x - east_m) * sine + (y - north_m) * cosine
            aside = (x - east_m) * cosine - (y - north_m) * sine
            height += (top * np.exp(-(aside**2) / (2.0 * sigma**2))) * np.exp(-((distance - along) ** 2) / (2.0 * sigma**2))
        start_m = self.heights_m(east_m, north_m)
        # the level falls from the plane by the square of the distance from the middle
        fall = self.curvature_per_m * (0.5 * distance + (east_m * sine + north_m * cosine))
        rise = (height - start_m) / distance - fall
        is_outside = np.abs(east_m + distance * sine) > self.half_side_m
        is_outside |= np.abs(north_m + distance * cosine) > self.half_side_m
        rise[is_outside] = -np.inf
        at = np.clip(rise.argmax(axis=0), 1, len(distance) - 2)
        before, top_rise, after = (rise[at + side, np.arange(len(east_m))] for side in (-1, 0, 1))
        with np.errstate(invalid="ignore", divide="ignore"):
            refined = top_rise - (after - before) ** 2 / (8.0 * (before - 2.0 * top_rise + after))
        is_peak = np.isfinite(refined) & (top_rise > before) & (top_rise > after)
        return np.where(is_peak, refined, rise.max(axis=0))


def four_hills(sigma_m: float, curvature_per_m: float = 0.0) -> GaussianHills:
    """Return four hills of one standard deviation on a square whose rim lies four of them beyond the tops.

    Their heights are 0.5 to 1.2 standard deviations, so slopes reach 36 degrees, and hills shade each other.
    """
    return GaussianHills(
        sigma_m * np.array([-1.4, 1.5, -1.2, 1.3]), sigma_m * np.array([1.3, 1.1, -1.5, -1.4]),
        sigma_m * np.array([1.2, 0.8, 0.5, 1.0]), np.full(4, sigma_m), 5.5 * sigma_m, curvature_per_m,
    )  # fmt: skip


def hills_irradiation(
    hills: GaussianHills,
    east_m: np.ndarray,
    north_m: np.ndarray,
    suns: SunIntervals,
    light_heights_m: np.ndarray,
    light: SkyLight,
    albedo: float,
    azimuths: int = HORIZON_AZIMUTHS,
) -> dict[Part, np.ndarray]:
    """Return the irradiation of positions (n,) by part and in total, (n,) each, kWh/m2, on the ground's own slope.

    ``light`` is that of the suns at heights (k,). ``albedo`` is that of the ground around. ``azimuths`` is the number of azimuths
    of horizons for the light of the sky.
    """
    beam, circumsolar = sun_irradiation(hills, east_m, north_m, suns, light_heights_m, np.stack([light.beam, light.circumsolar]))
    sky_view, band = hills_sky(hills, east_m, north_m, azimuths)
    height = hills.heights_m(east_m, north_m)
    sums = [
        np.interp(height, light_heights_m, power @ suns.hours / 1000.0)
        for power in (light.isotropic, light.horizon_band, reflected_light(light, albedo))
    ]
    parts: dict[Part, np.ndarray] = {
        "beam": beam, "circumsolar": circumsolar,
        "sky": sky_view * sums[0], "horizon_band": band * sums[1], "reflected": (1.0 - sky_view) * sums[2],
    }  # fmt: skip
    return parts | {"total": np.sum(list(parts.values()), axis=0)}


def sun_irradiation(
    hills: GaussianHills,
    east_m: np.ndarray,
    north_m: np.ndarray,
    suns: SunIntervals,
    light_heights_m: np.ndarray,
    power: np.ndarray,
) -> np.ndarray:
    """Return the irradiation (parts, n) of positions (n,) from the suns' directions, kWh/m2.

    ``power`` (parts, k, suns) is the light of each part at heights (k,) on planes that face the suns, W/m2.
    """
    east, north = hills.slopes(east_m, north_m)
    height = hills.heights_m(east_m, north_m)
    total = np.zeros((len(power), len(east_m)))
    for number in range(len(suns)):
        azimuth, altitude = np.radians(suns.azimuth_deg[number]), np.radians(suns.altitude_deg[number])
        cosine = np.sin(altitude) - np.cos(altitude) * (east * np.sin(azimuth) + north * np.cos(azimuth))
        faces = np.flatnonzero(cosine > 0.0)
        sun_tangent = float(np.tan(altitude))
        tangent = hills.horizon_tangents(east_m[faces], north_m[faces], float(suns.azimuth_deg[number]), sun_tangent)
        lit = faces[sun_tangent > tangent]
        for part, of_heights in zip(total, power[:, :, number], strict=True):
            part[lit] += cosine[lit] * suns.hours[number] / 1000.0 * np.interp(height[lit], light_heights_m, of_heights)
    return total / np.sqrt(1.0 + east**2 + north**2)


def hills_sky(hills: GaussianHills, east_m: np.ndarray, north_m: np.ndarray, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the sky view factors of the ground's own planes, and the factors of the horizon's band, (n,) each, of positions (n,).

    They are those of ``skugga.shadows.irradiation.sky``, of exact horizons.
    """
    east, north = hills.slopes(east_m, north_m)
    sky, band = np.zeros(len(east_m)), np.zeros(len(east_m))
    for azimuth_deg in (np.arange(azimuths) + 0.5) * 360.0 / azimuths:
        own = east * np.sin(np.radians(azimuth_deg)) + north * np.cos(np.radians(azimuth_deg))
        tangent = np.maximum(hills.horizon_tangents(east_m, north_m, float(azimuth_deg)), 0.0)
        horizon = np.arctan(np.maximum(tangent, own))
        # J. Dozier and J. Frew 1990, equation 7b, over the normal's upward component
        sky += np.cos(horizon) ** 2 - own * (np.pi / 2.0 - horizon - np.sin(horizon) * np.cos(horizon))
        band += np.maximum(-own, 0.0) * (1.0 - np.minimum(tangent / np.tan(np.radians(HORIZON_BAND_DEG)), 1.0))
    up = 1.0 / np.sqrt(1.0 + east**2 + north**2)
    return sky / azimuths * up, band * np.pi / azimuths * up
