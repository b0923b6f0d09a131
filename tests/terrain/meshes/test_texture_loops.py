"""Sampling of textures: exact texels head-on, means from afar, sharp lines at grazing angles, known normals and highlights."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from skugga.terrain.meshes.surface import (
    WRAP_CLAMP,
    WRAP_MIRROR,
    WRAP_REPEAT,
    Material,
    Surface,
    color_texture,
    concatenate_surfaces,
    make_atlas,
    normal_texture,
)
from skugga.terrain.meshes.texture_loops import (
    DIELECTRIC_REFLECTANCE,
    blinn_phong,
    toksvig_exponent,
    write_gloss_rows,
    write_normal_rows,
    write_texture_rows,
)
from skugga.terrain.meshes.texture_types import VisibleTriangles
from skugga.terrain.srgb import linear_of_srgb
from tests.model_files import checker, normal_map

REPEAT = WRAP_REPEAT, WRAP_REPEAT
COUNT = 16
WALL = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
"""A wall of a square metre that faces south, (0, -1, 0), its texture upright on it."""

WALL_UV = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])


def view_of_wall(points: np.ndarray, eye: np.ndarray, tangent: float, uv: np.ndarray = WALL_UV) -> VisibleTriangles:
    """Return the triangles of the wall that pixels show at points (rows, cols, 3)."""
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    number = np.where(points[..., 0] >= points[..., 2], np.int32(0), np.int32(1))
    return VisibleTriangles(
        number, points, WALL, triangles, uv.astype(np.float32)[triangles], np.ones((2, 3, 3), np.float32), np.zeros(2, np.int32),
        eye, tangent,
    )  # fmt: skip


def wall_points(count: int = COUNT) -> np.ndarray:
    """Return the centres (count, count, 3) of squares on the wall, from the upper left one."""
    middle = (np.arange(count) + 0.5) / count
    return np.stack(np.broadcast_arrays(middle, 0.0, 1.0 - middle[:, None]), axis=-1).copy()


def textured(visible: VisibleTriangles, image: Image.Image, wrap=REPEAT, **keys) -> np.ndarray:
    """Return the albedo of the wall's pixels with a picture on it."""
    albedo = np.full((*visible.number.shape, 3), np.nan, np.float32)
    material = Material(texture=color_texture(image, wrap), **keys)
    write_texture_rows(0, len(albedo), visible, make_atlas([material]), albedo)
    return albedo


def random_picture() -> Image.Image:
    return Image.fromarray(np.random.default_rng(3).integers(0, 256, (COUNT, COUNT, 3)).astype(np.uint8))


def test_texture_head_on_shows_its_texels():
    """An eye far away, whose pixels are as wide as the texels."""
    distance_m = 1e6
    eye = np.array([0.5, -distance_m, 0.5])
    albedo = textured(view_of_wall(wall_points(), eye, 1.0 / COUNT / distance_m), random_picture(), factor=(1.0, 0.5, 0.25))
    expected = linear_of_srgb(np.asarray(random_picture()) / 255.0) * (1.0, 0.5, 0.25)
    np.testing.assert_allclose(albedo, expected, atol=2e-4)


def test_texture_from_afar_shows_its_mean():
    eye = np.array([0.5, -100.0, 0.5])
    albedo = textured(view_of_wall(wall_points(2), eye, 0.02), random_picture())
    mean = linear_of_srgb(np.asarray(random_picture()) / 255.0).mean(axis=(0, 1))
    np.testing.assert_allclose(albedo, np.broadcast_to(mean, albedo.shape), atol=4e-3)


@pytest.mark.parametrize("pixels_per_texel", [1.0, 2.0, 3.0, 5.0, 8.0])
def test_checker_fades_to_grey_where_pixels_are_wider_than_its_squares(pixels_per_texel):
    """At half a pixel for a square, no pixel may be black or white: nothing shimmers."""
    eye = np.array([0.5, -100.0, 0.5])
    albedo = textured(view_of_wall(wall_points(97), eye, pixels_per_texel / 64.0 / 100.0), checker(1))
    contrast = np.ptp(albedo)
    assert albedo.mean() == pytest.approx(0.5, abs=0.03)
    assert contrast < (1.01 if pixels_per_texel < 2.0 else 0.05)


def test_lines_along_the_line_of_sight_stay_sharp_at_grazing_angles():
    """Seen at 4 degrees, a pixel is 14 times as long as wide. Stripes in that direction stay, those across it turn grey."""
    eye = np.array([0.5 - 100.0, -7.0, 0.5])  # looks along the wall, from the west
    row, col = np.indices((64, 64)) // 4 % 2
    along, across = (Image.fromarray(np.repeat((stripes * 255).astype(np.uint8)[..., None], 3, axis=2)) for stripes in (row, col))
    visible = view_of_wall(wall_points(64), eye, 1.0 / 64.0 / 100.0)
    sharp, blurred = textured(visible, along)[..., 0], textured(visible, across)[..., 0]
    assert np.ptp(sharp) > 0.95 and np.ptp(blurred) < 0.3


def test_coordinates_outside_of_the_texture_wrap():
    eye, uv = np.array([0.5, -1e6, 0.5]), WALL_UV * 2.0
    picture = Image.fromarray(np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8))
    visible = view_of_wall(wall_points(4), eye, 0.25 / 1e6, uv)
    for wrap, indices in ((WRAP_REPEAT, [0, 1, 0, 1]), (WRAP_CLAMP, [0, 1, 1, 1]), (WRAP_MIRROR, [0, 1, 1, 0])):
        expected = np.asarray(picture)[np.ix_(indices, indices)] / 255.0
        np.testing.assert_allclose(textured(visible, picture, (wrap, wrap)), expected, atol=1e-4)


def mapped_normal(x: float, y: float, uv: np.ndarray = WALL_UV, normal=(0.0, -1.0, 0.0), scale: float = 1.0) -> np.ndarray:
    """Return the shading normal (3,) of the wall with an even normal map."""
    visible = view_of_wall(wall_points(4), np.array([0.5, -1e6, 0.5]), 0.25 / 1e6, uv)
    out = np.broadcast_to(np.array(normal, np.float32), (4, 4, 3)).copy()
    material = Material(normal_map=normal_texture(normal_map(x, y), REPEAT), normal_scale=scale)
    write_normal_rows(0, 4, visible, make_atlas([material]), out)
    assert np.ptp(out, axis=(0, 1)).max() < 1e-6
    return out[0, 0]


def test_normal_map_tilts_the_normal_by_its_vector():
    """Red tilts to the right, green upwards; 8 bits keep angles to a quarter of a degree."""
    np.testing.assert_allclose(mapped_normal(0.0, 0.0), [0.0, -1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(mapped_normal(0.6, 0.0), [0.6, -0.8, 0.0], atol=5e-3)
    np.testing.assert_allclose(mapped_normal(0.0, 0.6), [0.0, -0.8, 0.6], atol=5e-3)
    tan = 0.5 * 0.6 / 0.8
    np.testing.assert_allclose(mapped_normal(0.0, 0.6, scale=0.5), np.array([0.0, -1.0, tan]) / np.hypot(1.0, tan), atol=5e-3)


def test_known_normal_map_gives_the_known_cosine_to_the_sun():
    sun = np.array([0.0, -np.cos(np.radians(30.0)), np.sin(np.radians(30.0))])
    tilt = np.radians(20.0)
    cosine = mapped_normal(0.0, np.sin(tilt)) @ sun
    assert cosine == pytest.approx(np.cos(np.radians(30.0 - 20.0)), abs=3e-3)


def test_mirrored_textures_keep_their_relief():
    """A texture that runs from right to left tilts to the left."""
    mirrored = WALL_UV * (-1.0, 1.0) + (1.0, 0.0)
    np.testing.assert_allclose(mapped_normal(0.6, 0.3, mirrored)[[0, 2]], [-0.6, 0.3], atol=6e-3)


def test_back_sides_have_the_opposite_normal():
    front, back = mapped_normal(0.3, 0.4), mapped_normal(0.3, 0.4, normal=(0.0, 1.0, 0.0))
    np.testing.assert_allclose(back, -front, atol=1e-6)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 10.0, 100.0, 2000.0])
def test_highlight_reflects_all_light_at_normal_incidence(exponent):
    angle = (np.arange(20_000) + 0.5) * 0.5 * np.pi / 20_000
    lobe = np.array([blinn_phong(exponent, np.cos(0.5 * a)) for a in angle]) / np.pi
    total = (lobe * np.cos(angle) * 2.0 * np.pi * np.sin(angle)).sum() * 0.5 * np.pi / 20_000
    assert total == pytest.approx(1.0, abs=2e-3)


def gloss_of_wall(to_sun: np.ndarray, eye: np.ndarray, **keys) -> np.ndarray:
    """Return the gloss (4,) in the middle of the wall."""
    visible = view_of_wall(np.array([[[0.5, 0.0, 0.5]]]), eye, 1e-3)
    gloss, normal = np.zeros((1, 1, 4), np.float32), np.array([[[0.0, -1.0, 0.0]]], np.float32)
    write_gloss_rows(0, 1, visible, make_atlas([Material(is_glossy=True, **keys)]), normal, to_sun, gloss)
    return gloss[0, 0]


def test_highlight_is_where_the_eye_sees_the_mirrored_sun():
    to_sun = np.array([0.6, -0.8, 0.0])
    mirrored, beside = np.array([0.5 - 6.0, -8.0, 0.5]), np.array([0.5 + 6.0, -8.0, 0.5])
    smooth = gloss_of_wall(to_sun, mirrored, roughness=0.3)
    exponent = 2.0 / 0.3**4 - 2.0
    fresnel = DIELECTRIC_REFLECTANCE + (1.0 - DIELECTRIC_REFLECTANCE) * 0.2**5
    assert smooth[0] == pytest.approx(fresnel * blinn_phong(exponent, 1.0) * 0.8, rel=1e-3)
    assert smooth[3] == pytest.approx(fresnel, rel=1e-3)
    assert gloss_of_wall(to_sun, beside, roughness=0.3)[0] < 1e-6 * smooth[0]
    assert gloss_of_wall(-to_sun, mirrored, roughness=0.3).max() == 0.0


def test_rough_metal_scatters_as_lamberts_law_says():
    gloss = gloss_of_wall(np.array([0.0, -1.0, 0.0]), np.array([0.5, -9.0, 0.5]), factor=(0.8, 0.5, 0.2), metallic=1.0)
    np.testing.assert_allclose(gloss, [0.8, 0.5, 0.2, 1.0], rtol=1e-5)


def test_highlights_widen_where_normals_spread_within_a_pixel():
    assert toksvig_exponent(100.0, 1.0) == 100.0
    assert toksvig_exponent(100.0, 0.99) == pytest.approx(99.0 / (0.99 + 1.0))
    assert toksvig_exponent(0.0, 0.5) == 0.0


def test_copies_share_their_textures():
    material = Material(texture=color_texture(checker(8), REPEAT))
    surface = Surface(np.zeros((2, 3, 2), np.float32), np.ones((2, 3, 3), np.float32), np.zeros(2, np.int32), (material,))
    joined = concatenate_surfaces([surface, None, surface], [2, 3, 2])
    assert joined.materials == (material,) and joined.material.tolist() == [0, 0, -1, -1, -1, 0, 0]
    assert concatenate_surfaces([None, None], [2, 3]) is None
