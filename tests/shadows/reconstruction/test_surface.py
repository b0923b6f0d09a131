"""Surfaces rebuilt from depth maps: planes and creases by arithmetic, and closed polygons behind them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from skugga.shadows.reconstruction.polygons import MAX_SQUARE_TEXELS, volume_polygons
from skugga.shadows.reconstruction.surface import EMPTY_DEPTH, NO_VERTEX, DepthScale, Surface, rebuild_surface

TEXEL = 0.0008
SCALE = DepthScale((TEXEL, TEXEL), 1e-9, 2.0**-24, (1.0, 0.0), 3.0)
"""A sun's map of 1250 texels in depth, whose errors are small beside its texels."""

MAX_PLANE_OFFSET = 0.1 * TEXEL
"""Upper bound of the offset on planes of up to 45 degrees: the rasteriser's grid, and what squares may deviate."""

ROWS, COLS = 70, 90
ROW, COL = np.mgrid[:ROWS, :COLS] + 0.5


def plane(across: float, along: float, depth: float = 0.5) -> np.ndarray:
    """Return the depths of a plane, whose slopes are in texels a texel, through the middle of the map."""
    return (depth + TEXEL * (across * (COL - COLS / 2) + along * (ROW - ROWS / 2))).astype(np.float32)


def with_boxes(depths: np.ndarray) -> np.ndarray:
    """Return depths with a box, a bar one texel wide, and single texels in front of them."""
    out = depths.copy()
    out[20:40, 30:60] = 0.2
    out[50, 10:80] = 0.3
    out[::9, ::7] -= 0.15
    return out


def with_holes(depths: np.ndarray) -> np.ndarray:
    """Return depths with empty texels, some of them at the map's rim."""
    out = with_boxes(depths)
    out[10:30, 50:] = EMPTY_DEPTH
    out[60:, ::3] = EMPTY_DEPTH
    return out


def noise(depths: np.ndarray) -> np.ndarray:
    """Return depths without any structure."""
    return np.random.default_rng(4).random(depths.shape).astype(np.float32)


def depths_at(surface: Surface, row: int, col: int) -> np.ndarray:
    """Return the depths (4,) of a texel's corners."""
    return surface.vertices[surface.corners[row, col], 2]


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (1.0, 0.0), (-0.5, 0.8), (6.0, -9.0)])
def test_surface_of_a_plane_lies_close_behind_it(slopes):
    surface = rebuild_surface(plane(*slopes), SCALE)
    across, along = slopes
    true_depth = 0.5 + TEXEL * (across * (surface.vertices[:, 0] - COLS / 2) + along * (surface.vertices[:, 1] - ROWS / 2))
    behind = surface.vertices[:, 2] - true_depth
    assert behind.min() > 0.0
    assert behind.max() < MAX_PLANE_OFFSET * max(1.0, abs(across) + abs(along))
    assert surface.linked_right[:, :-1].all() and surface.linked_up[:-1].all()


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9])
@pytest.mark.parametrize("slope", [0.3, 1.0, 2.5])
def test_surface_of_a_crease_does_not_shade_it(slope, share):
    """A wall meets a floor, wherever the crease lies between centres; a sampled ray to any point of them stays free."""

    def true_depth(col: np.ndarray) -> np.ndarray:
        return 0.5 - TEXEL * slope * np.maximum(col - (COLS // 2 + share), 0.0)

    depths = np.broadcast_to(true_depth(COL), COL.shape).astype(np.float32)
    surface = rebuild_surface(depths, SCALE)
    cols = np.linspace(1.0, COLS - 1.0, 40 * (COLS - 2) + 1)
    texels = np.minimum(cols.astype(int), COLS - 2)
    left, right = (surface.vertices[surface.corners[5, texels, corner], 2] for corner in (0, 1))
    rebuilt = left + (right - left) * (cols - texels)
    assert (rebuilt >= true_depth(cols)).all()
    assert (rebuilt - true_depth(cols)).max() <= (MAX_PLANE_OFFSET + TEXEL) * max(slope, 1.0)


def test_surface_is_torn_at_a_box_and_keeps_both_depths():
    surface = rebuild_surface(with_boxes(plane(0.5, 0.5)), SCALE)
    assert not surface.linked_right[25, 29] and not surface.linked_right[25, 59]
    np.testing.assert_allclose(depths_at(surface, 25, 30), 0.2, atol=0.2 * TEXEL)
    ground = 0.5 + TEXEL * 0.5 * (np.array([29.0, 30.0, 29.0, 30.0]) - COLS / 2 + np.array([25.0, 25.0, 26.0, 26.0]) - ROWS / 2)
    np.testing.assert_allclose(depths_at(surface, 25, 29), ground, atol=0.2 * TEXEL)


def test_surface_has_no_vertices_at_empty_texels():
    depths = with_holes(plane(0.0, 0.0))
    surface = rebuild_surface(depths, SCALE)
    assert ((surface.corners[..., 0] == NO_VERTEX) == (depths == EMPTY_DEPTH)).all()
    assert not len(rebuild_surface(np.ones((5, 6), np.float32), SCALE).vertices)


def test_steep_side_behind_a_ridge_belongs_to_it():
    """A roof's far side is so steep to the light that its slope alone would tear it off."""
    depths = (0.3 + TEXEL * np.maximum(-0.5 * (COL - 40.3), 8.0 * (COL - 40.3))).astype(np.float32)
    assert rebuild_surface(depths, SCALE).linked_right[:, 35:50].all()
    depths[:, :40] -= np.float32(0.1)  # now something floats in front of it
    assert not rebuild_surface(depths, SCALE).linked_right[:, 39].any()


@pytest.mark.parametrize("is_lamp", [False, True], ids=["sun", "lamp"])
@pytest.mark.parametrize("max_square", [1, 4, MAX_SQUARE_TEXELS])
@pytest.mark.parametrize("change", [np.copy, with_boxes, with_holes, noise])
def test_volumes_are_closed(change: Callable[[np.ndarray], np.ndarray], max_square, is_lamp):
    """Each polygon's edge is used as often in one direction as in the other."""
    surface = rebuild_surface(change(plane(0.4, -0.7)), SCALE)
    vertices, far_rays, faces = volume_polygons(surface, SCALE, is_lamp, max_square)
    assert faces.min() >= 0 and faces.max() < len(vertices) + len(far_rays)
    edges = Counter(map(tuple, np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()))
    assert all(count == edges[b, a] for (a, b), count in edges.items())


def test_squares_save_polygons_and_keep_the_surface():
    surface = rebuild_surface(with_boxes(plane(0.4, -0.7)), SCALE)
    (vertices, _, faces), (all_vertices, _, all_faces) = (volume_polygons(surface, SCALE, False, side) for side in (64, 1))
    assert len(faces) < 0.6 * len(all_faces) and len(vertices) < len(all_vertices)
    plain = rebuild_surface(plane(0.4, -0.7), SCALE)
    assert len(volume_polygons(plain, SCALE, False)[2]) < 0.15 * len(volume_polygons(plain, SCALE, False, 1)[2])
    caps = faces[(faces < len(vertices)).all(axis=1)]
    a, b, c = vertices[caps].transpose(1, 0, 2)
    area = np.cross(b - a, c - a)[:, 2].sum() / 2.0
    assert area == pytest.approx(ROWS * COLS)  # sides are upright: what is left covers the map once
