"""Sky colours by altitude and azimuth of the sun, and the dither noise that prevents banding."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from skugga.terrain import sky
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.shading import encode_srgb
from skugga.terrain.sky import (
    HORIZON_COLOR,
    ZENITH_COLOR,
    gradient_noise,
    horizon_colors,
    horizontal_sun_direction,
    sky_color,
    sky_colors,
    sky_of,
    sky_pixel_colors,
    sun_disc_of,
    transmittances,
)
from skugga.terrain.srgb import srgb_of_linear

UP = np.array([0.0, 0.0, 1.0])


def scene_of(altitude_deg: float | None, cloud_cover: float = 0.0, visibility: float | None = None):
    """Return the parts of a scene that the sky needs, in a flat world with the sun in the east."""
    sun = None
    if altitude_deg is not None:
        altitude = np.radians(altitude_deg)
        sun = SimpleNamespace(altitude_deg=altitude_deg, to_sun_earth=np.array([np.cos(altitude), 0.0, np.sin(altitude)]))
    level = SimpleNamespace(weather=SimpleNamespace(cloud_cover=cloud_cover, visibility=visibility))
    return SimpleNamespace(sun=sun, loaded=SimpleNamespace(level=level), world=SimpleNamespace(is_flat=True))


def color_at(scene, altitude_deg: float, azimuth_deg: float) -> np.ndarray:
    """Return the linear colour (3,) of the sky. ``azimuth_deg`` is relative to the sun."""
    out = np.empty(3)
    sky_color(sky_of(scene), np.sin(np.radians(altitude_deg)), np.cos(np.radians(azimuth_deg)), out)
    return out


def camera(rows: int = 120, cols: int = 160) -> PerspectiveView:
    """Return a view to the north that shows only sky."""
    return look_at(np.zeros(3), np.array([0.0, 1.0, 0.6]), UP, 30.0, rows, cols)


def picture(scene, view: PerspectiveView) -> np.ndarray:
    """Return the sky in a view (rows, cols, 3)."""
    row, col = (axis.ravel() for axis in np.mgrid[0 : view.rows, 0 : view.cols])
    return sky_pixel_colors(scene, view, row, col).reshape(view.rows, view.cols, 3)


def test_sky_far_from_a_high_sun_has_day_colours():
    assert color_at(scene_of(60.0), 0.0, 180.0) == pytest.approx(HORIZON_COLOR, abs=0.01)
    assert color_at(scene_of(30.0), 90.0, 0.0) == pytest.approx(ZENITH_COLOR, abs=0.04)


@pytest.mark.parametrize("altitude_deg", [0.0, 2.0, 5.0])
def test_horizon_is_warm_only_below_a_low_sun(altitude_deg):
    below, opposite = (color_at(scene_of(altitude_deg), 0.0, azimuth) for azimuth in (0.0, 180.0))
    assert below[0] > 1.2 * below[1] > 1.4 * below[2]
    assert opposite[2] > 0.75 * opposite[0] and below[0] / below[2] > 2.0 * opposite[0] / opposite[2]


def test_horizon_is_redder_below_a_lower_sun():
    redness = [np.divide(*color_at(scene_of(altitude), 0.0, 0.0)[[0, 2]]) for altitude in (40.0, 15.0, 10.0, 6.0, 3.0, 1.5)]
    assert (np.diff(redness) > 0).all()


def test_sky_above_a_low_sun_is_bluer():
    horizon_color, upper_color = (color_at(scene_of(3.0), altitude, 60.0) for altitude in (0.0, 20.0))
    ratio = upper_color / horizon_color
    assert ratio[0] < ratio[1] < ratio[2]


def test_sky_is_at_most_white_and_dark_at_night():
    for altitude in (-30.0, -6.0, -1.0, 0.0, 4.0, 12.0, 45.0, 90.0):
        colors = [color_at(scene_of(altitude), up, azimuth) for up in (0.0, 2.0, 10.0, 45.0, 90.0) for azimuth in range(0, 181, 15)]
        assert np.min(colors) >= 0.0 and np.max(colors) <= 1.0
    assert horizon_colors(scene_of(-30.0)).max() < 0.02 and horizon_colors(scene_of(None)).max() < 0.02


def test_overcast_sky_has_no_sun():
    colors = np.array([color_at(scene_of(4.0, 1.0), 4.0, azimuth) for azimuth in range(0, 181, 15)])
    assert np.ptp(colors, axis=0).max() < 1e-9


def test_sky_is_brightest_around_the_sun():
    separations_deg = np.array([0.0, 1.0, 3.0, 8.0, 20.0, 45.0])
    brightness = [color_at(scene_of(20.0), 20.0 + separation_deg, 0.0).sum() for separation_deg in separations_deg]
    assert (np.diff(brightness) < 0).all()


def test_gradient_noise_is_uniform_within_half_a_step():
    noise = np.array([[gradient_noise(x - 79.5, y - 59.5) for x in range(160)] for y in range(120)])
    assert -0.5 <= noise.min() and noise.max() < 0.5
    count, _ = np.histogram(noise, bins=8, range=(-0.5, 0.5))
    assert count == pytest.approx(noise.size / 8, rel=0.03)


@pytest.mark.parametrize("altitude_deg", [50.0, 4.0, -6.0])
def test_dithered_sky_has_no_bands(altitude_deg):
    """Means over 8 x 8 pixels differ from the sky colour by a small fraction of an 8-bit step.

    Rounded codes differ by up to half a step across a whole band. Single pixels differ by at most a step, and at night by a bin of
    the encoder.
    """
    scene, rows, cols = scene_of(altitude_deg), 120, 160
    view = camera(rows, cols)
    encoded = encode_srgb(picture(scene, view)).astype(float)
    row, col = np.mgrid[0:rows, 0:cols]
    ray = np.stack([(col + view.col0) / view.focal_px, (row + view.row0) / view.focal_px, np.ones(row.shape)], axis=-1)
    ray = ray @ view.earth_from_camera.T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    exact = np.empty((rows, cols, 3))
    its_sky = sky_of(scene)
    for i, j in zip(row.ravel(), col.ravel(), strict=True):
        sky_color(its_sky, ray[i, j, 2], ray[i, j, 0] / np.hypot(*ray[i, j, :2]), exact[i, j])
    codes = 255.0 * srgb_of_linear(exact)
    assert np.abs(encoded - codes).max() < 1.3

    def banding(picture: np.ndarray) -> float:
        means = (picture - codes).reshape(rows // 8, 8, cols // 8, 8, 3).mean(axis=(1, 3))
        return float(np.abs(means).max())

    assert banding(encoded) < 0.2 and banding(np.rint(codes)) > 0.3


def test_sky_is_equal_in_parts_and_repeated_pictures():
    scene = scene_of(8.0)
    full_picture = picture(scene, camera())
    np.testing.assert_array_equal(full_picture, picture(scene, camera()))
    np.testing.assert_array_equal(full_picture[31:71, 17:100], picture(scene, camera().part(31, 17, 40, 83)))


def view_of_sun(altitude_deg: float, fov_deg: float = 4.0, offset: float = 0.01, rows: int = 121) -> PerspectiveView:
    """Return a square view that shows the sun of ``scene_of`` a little off its middle."""
    altitude = np.radians(altitude_deg)
    forward = np.array([np.cos(altitude), offset, np.sin(altitude) + 0.6 * offset])
    return look_at(np.zeros(3), forward, UP, fov_deg, rows, rows)


def pixel_rays(view: PerspectiveView) -> np.ndarray:
    """Return the unit vectors (rows, cols, 3) of a view's pixels."""
    row, col = np.mgrid[0 : view.rows, 0 : view.cols]
    ray = np.stack([(col + view.col0) / view.focal_px, (row + view.row0) / view.focal_px, np.ones(row.shape)], axis=-1)
    ray = ray @ view.earth_from_camera.T
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)


@pytest.mark.parametrize(("altitude_deg", "fov_deg"), [(4.0, 4.0), (9.0, 20.0), (4.0, 60.0)])
def test_sun_disc_stands_in_the_suns_direction(altitude_deg, fov_deg, monkeypatch):
    """The mean direction of the covered pixels is the sun's within a tenth of a pixel, and their solid angle is the disc's."""
    scene, view = scene_of(altitude_deg), view_of_sun(altitude_deg, fov_deg, 0.02)
    with_disc = picture(scene, view).astype(float)
    monkeypatch.setattr(sky, "sun_disc_of", lambda *arguments: sun_disc_of(*arguments)._replace(disc_share=1e-12))
    glow = picture(scene, view).astype(float)
    color = sun_disc_of(scene, view, UP, 0.0).color
    coverage = ((with_disc - glow) / (color - glow))[..., 2]
    rays = pixel_rays(view)
    forward = view.earth_from_camera[:, 2]
    weight = coverage * (rays @ forward) ** 3 * view.pixel_tangent**2
    mean = (weight[..., None] * rays).sum(axis=(0, 1))
    mean /= np.linalg.norm(mean)
    assert np.linalg.norm(mean - scene.sun.to_sun_earth) < 0.1 * view.pixel_tangent
    assert weight.sum() == pytest.approx(2.0 * np.pi * (1.0 - np.cos(np.radians(0.265))), rel=0.03)


@pytest.mark.parametrize("altitude_deg", [1.5, 5.0, 20.0, 60.0])
def test_sun_glow_falls_off_without_a_ring(altitude_deg):
    """Away from the disc, no channel gets brighter by more than the dither."""
    view = view_of_sun(altitude_deg, 16.0, 0.0, 321)
    colors = picture(scene_of(altitude_deg), view)
    angle = np.arccos(np.clip(pixel_rays(view) @ scene_of(altitude_deg).sun.to_sun_earth, -1.0, 1.0))
    rings = np.digitize(np.degrees(angle), np.arange(0.0, 8.0, 0.1))
    sides = np.arange(321) > 160  # above the sun, where the sky also gets darker with the altitude
    means = np.array([colors[(rings == ring) & ~sides[:, None]].sum(axis=1).mean() for ring in range(1, 80)])
    assert np.diff(means).max() < 0.002
    assert means[0] > means[10]


def test_sun_disc_is_hidden_by_fog_clouds_and_the_horizon(monkeypatch):
    def changes(altitude_deg: float, **weather: float) -> np.ndarray:
        """Return what the disc and its glow add to the sky (rows, cols)."""
        scene, view = scene_of(altitude_deg, **weather), view_of_sun(altitude_deg, offset=0.0)
        with_disc = picture(scene, view)
        with monkeypatch.context() as patch:
            patch.setattr(sky, "sun_disc_of", lambda *arguments: sun_disc_of(*arguments)._replace(disc_share=0.0))
            return (with_disc - picture(scene, view)).max(axis=2)

    assert changes(10.0).max() > 0.15
    assert changes(10.0, visibility=200.0).max() < 0.01 and changes(10.0, cloud_cover=1.0).max() == 0.0
    setting = changes(0.0)
    assert setting[:60].max() > 0.3 > 0.15 > setting[62:].max()
    assert changes(-0.3).max() == 0.0


def test_horizontal_sun_direction_has_unit_length():
    assert horizontal_sun_direction(np.array([0.6, 0.0, 0.8]), UP) == pytest.approx([1.0, 0.0, 0.0])
    assert horizontal_sun_direction(UP, UP) == pytest.approx([0.0, 0.0, 0.0])


@pytest.mark.parametrize("altitude_deg", [-4.0, 0.5, 12.0, 50.0])
def test_sky_colors_of_rows_equal_those_of_single_directions(altitude_deg):
    its_sky, rng = sky_of(scene_of(altitude_deg)), np.random.default_rng(3)
    sine, cosine = np.concatenate([rng.uniform(-0.2, 1.0, 300), [0.0, 1.0, -1.0]]), rng.uniform(-1.0, 1.0, 303)
    row_colors, single_colors = np.empty((3, 303)), np.empty((303, 3))
    sky_colors(its_sky, sine, cosine, row_colors)
    for n in range(303):
        sky_color(its_sky, sine[n], cosine[n], single_colors[n])
    np.testing.assert_allclose(row_colors.T, single_colors, rtol=1e-9)


def test_transmittances_fall_off_exponentially():
    length = np.concatenate([np.linspace(0.0, 60.0, 500), [1e-12, 1e4, -5.0]])
    out = np.empty(len(length))
    for per_length in (1e-9, 0.02, 1.0):
        transmittances(per_length, length, out)
        np.testing.assert_allclose(out, np.exp(-per_length * np.maximum(length, 0.0)), rtol=0.0, atol=1e-12)
