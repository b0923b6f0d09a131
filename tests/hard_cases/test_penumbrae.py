"""Penumbrae of the sun's disc and of a lamp's ball, against the closed form of a straight edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.area_light import ball_points, disc_points
from skugga.shadows.maps.settings import PerspectiveMapSettings, ShadowMapSettings
from skugga.shadows.maps.sun_disc import DISC_EDGE_STEPS, DISC_SAMPLES
from skugga.shadows.plan import Step
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from tests.hard_cases.bodies import eye, with_ground_pebble
from tests.hard_cases.cases import RenderedView, Trial, hard_case
from tests.hard_cases.ground import close_view
from tests.hard_cases.reach_of_error import GRID_TEXELS, STENCIL_PX
from tests.rasters import ENGINEERING
from tests.shadows.boxes import box
from tests.shadows.test_area_light import disc_share_beyond_chord

SUN_TANGENT = float(np.tan(np.radians(SUN_RADIUS_DEG)))

CHORDS = np.linspace(-1.0, 1.0, 2001)

STEEPEST = 2.0 / np.pi
"""The largest change of the disc's visible share per radius by which the chord moves: the derivative of the share at 0."""

MAX_CELLS_ACROSS_DISC = 16
"""Cells of a map's texels across the sun's disc, ``ACROSS`` of ``shaders/sun_disc.frag.glsl``."""

DISC_HALF_MEAN_DISTANCE = float(np.trapezoid(disc_share_beyond_chord(CHORDS) * (1.0 - disc_share_beyond_chord(CHORDS)), CHORDS))
"""Integral of v (1 - v) over the chord's position in radii, where v is the visible share: half the mean distance of two points."""


@dataclass(frozen=True)
class PointsError:
    """Errors of points that stand for a disc, the worst of all directions of the chord.

    ``share`` is the largest error of the visible share, ``width`` the relative error of the penumbra's width.
    """

    share: float
    width: float


def error_of_points(points: np.ndarray) -> PointsError:
    """Return the errors of points (n, 2 or 3) within the unit disc or ball, each of the same weight.

    The chord may have any direction.
    """
    n, dimensions = points.shape
    angles = np.linspace(0.0, np.pi, 61)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    if dimensions == 3:
        up = np.linspace(-1.0, 1.0, 21)
        flat = np.sqrt(1.0 - up**2)
        directions = np.concatenate([np.column_stack([flat[:, None] * d, up]) for d in directions])
    share = width = 0.0
    for direction in directions:
        at = np.sort(points @ direction)
        below, above = np.arange(n) / n, np.arange(1, n + 1) / n
        exact = 1.0 - disc_share_beyond_chord(at)  # the disc's share before the chord through each point
        share = max(share, float(np.maximum(np.abs(exact - below), np.abs(exact - above)).max()))
        half_mean_distance = float((np.diff(at) * above[:-1] * (1.0 - above[:-1])).sum())
        width = max(width, abs(half_mean_distance / DISC_HALF_MEAN_DISTANCE - 1.0))
    return PointsError(share, width)


def allowance(step: Step, radius_m: float, texel_m: float, pixel_m: float, point_error_texels: float) -> PointsError:
    """Return the errors that an algorithm's samples of a light explain.

    ``radius_m`` is half the penumbra's width on the ground, ``texel_m`` a texel's side and ``pixel_m`` a pixel's side there. Edges
    are off by up to ``point_error_texels`` texels of a map, or ``STENCIL_PX`` pixels without one. The sun's map merges texels to
    ``MAX_CELLS_ACROSS_DISC`` cells across the disc, whose edges are off by half a cell. It rounds them to ``DISC_EDGE_STEPS``
    steps.
    """
    settings = step.settings
    if isinstance(settings, ShadowMapSettings):
        points = disc_points(DISC_SAMPLES)
        cell_m = np.ceil(2.0 * (radius_m + texel_m) / (MAX_CELLS_ACROSS_DISC * texel_m)) * texel_m
        off_m = 0.5 * cell_m + GRID_TEXELS * texel_m + radius_m / DISC_EDGE_STEPS
    else:
        count = settings.light_points  # type: ignore[union-attr]
        points = disc_points(count) if step.light == "sun" else ball_points(count)
        is_map = isinstance(settings, PerspectiveMapSettings) or hasattr(settings, "map_size")
        off_m = point_error_texels * texel_m if is_map else STENCIL_PX * pixel_m
    return _with_displaced_edges(error_of_points(points), off_m / radius_m, pixel_m / radius_m)


def _with_displaced_edges(error: PointsError, off: float, pixel: float) -> PointsError:
    """Add the effect of edges that are ``off`` radii off, and of pixels whose sides are ``pixel`` radii.

    The share changes by ``STEEPEST`` times the displacement at most. The mean distance of two points changes by twice the
    displacement at most, half of which counts. A sum over pixels differs from the integral of v (1 - v), which rises by 1/4 and
    falls by as much, by half a pixel times 1/2 at most.
    """
    return PointsError(error.share + STEEPEST * off, error.width + (off + 0.25 * pixel) / DISC_HALF_MEAN_DISTANCE)


def penumbra_figures(rendered: RenderedView, chord: np.ndarray, in_question: np.ndarray, allowed: PointsError) -> dict[str, float]:
    """Return the errors of the visible share and of the penumbra's width, as shares of what is allowed.

    ``chord`` (rows, cols) is the place of the edge on the light's disc in radii, positive where the centre is hidden, of the pixels
    ``in_question`` (rows, cols).
    """
    expected, shown = disc_share_beyond_chord(chord[in_question]), rendered.visibility[in_question].astype(np.float64)
    assert expected.min() == 0.0 and expected.max() == 1.0, "from full light to full shadow"
    width = float((shown * (1.0 - shown)).sum() / (expected * (1.0 - expected)).sum()) - 1.0
    return {
        "share of light": float(np.abs(shown - expected).max()) / allowed.share,
        "width": abs(width) / allowed.width,
    }  # fmt: skip


def positions(rendered: RenderedView) -> np.ndarray:
    """Return the points (rows, cols, 3) of a flat world in metres east, north and up."""
    return (rendered.buffer.position_frame_m + rendered.buffer.frame.origin_earth_m).astype(np.float64)


def edge_chords(points: np.ndarray, edge_m: np.ndarray, along: np.ndarray, to_light: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Return the place (rows, cols) of a straight edge on a light's disc, in radii: positive where the centre is hidden.

    The edge passes through ``edge_m`` (3,) along the unit vector ``along`` (3,). ``to_light`` (..., 3) are the unit vectors from
    the points to the disc's centre, and ``tangent`` that of its angular radius. The plane through point and edge cuts the disc
    along a chord. Its distance from the centre is s n / |n - (n s) s|, for the plane's upward normal n and the direction s to the
    centre.
    """
    normal = np.cross(along, edge_m - points)
    normal *= np.sign(normal[..., 2:])
    height = (normal * to_light).sum(axis=-1)
    across = np.linalg.norm(normal - height[..., None] * to_light, axis=-1)
    return -height / across / tangent


RIDGE_M = 30.0

CELL_M = 4.0

CELLS = 48


@hard_case(
    "L2",
    "Behind a straight edge the half-shadow of the sun's disc is as wide, and as dark in each place, as in closed form",
    "a ridge of 30 m on a plain, the sun behind it and square to it at 35 degrees (long: at 20 and 50 too), the filter `sun`; as a "
    "share of what the samples of the disc, the texels and the pixels explain",
    {"share of light": 1.0, "width": 1.0},
)
def test_half_shadow_of_the_sun(trial: Trial) -> dict[str, float]:
    """A point sees the part of the disc above the plane through it and the ridge: the part of a circle beyond a chord.

    The penumbra's half width across the light is the tangent of the disc's angular radius times the distance from the ridge. It is
    that over the sine of the altitude on the ground. The width is the sum of v (1 - v) over the pixels, where v is the visible
    share, relative to the same sum in closed form. It grows in proportion to the penumbra.
    """
    return _worst_half_shadow(trial, [(35.0, 0.0)] + ([(50.0, 0.0), (20.0, 0.0)] if trial.thorough else []))


@hard_case(
    "L4",
    "The same behind an edge that runs aslant to the sun, which cuts the disc along a chord that is not level",
    "the same ridge, the sun 30 degrees aslant (long: 45 degrees, too)",
    {"share of light": 1.0, "width": 1.0},
)
def test_half_shadow_of_an_edge_aslant(trial: Trial) -> dict[str, float]:
    """Points of the disc need an azimuth and an altitude each.

    Of points that differ in altitude alone, penumbrae are too wide by 1 / cos(t) for a chord that is tilted by t. For a sun at the
    altitude a, turned by d from the edge's square, tan t = tan d sin a: 5 % at 30 degrees and 15 % at 45.
    """
    return _worst_half_shadow(trial, [(35.0, 30.0)] + ([(35.0, -45.0)] if trial.thorough else []))


def _worst_half_shadow(trial: Trial, suns: list[tuple[float, float]]) -> dict[str, float]:
    """Return the worst figures of suns: altitude, and the azimuth's turn from the ridge's square, degrees.

    A camera sees the penumbra, since a map's nodes need not lie on the ridge.
    """
    heights = np.zeros((CELLS, CELLS), np.float32)
    heights[CELLS // 2 + 4] = RIDGE_M
    side_m = CELLS * CELL_M
    raster = trial.raster(heights, ENGINEERING, -side_m / 2.0, side_m / 2.0, CELL_M)
    ridge_y = side_m / 2.0 - (CELLS // 2 + 4 + 0.5) * CELL_M
    result = {"share of light": 0.0, "width": 0.0}
    for altitude, aslant in suns:
        reach_m = RIDGE_M / np.tan(np.radians(altitude)) * np.cos(np.radians(aslant))
        radius_m = RIDGE_M / np.sin(np.radians(altitude)) * SUN_TANGENT / np.sin(np.radians(altitude))
        pixels = 96 if trial.thorough else 64
        at = 0.0, ridge_y + reach_m
        camera = eye((*at, 2.0 * radius_m / np.tan(np.radians(20.0))), (at[0], at[1] + 0.2 * radius_m, 0.0), fov=40.0)
        scene = trial.scene(raster, (180.0 + aslant, altitude), views={"main": camera})
        assert scene.sun is not None
        rendered = trial.render_view(scene, scene.view("main", size=(pixels, pixels)), filter="sun", map_size=256)
        (step,) = rendered.plan.steps_of_light("sun")
        chord = edge_chords(
            positions(rendered), np.array([0.0, ridge_y, RIDGE_M]), np.array([1.0, 0.0, 0.0]), scene.sun.to_sun_earth, SUN_TANGENT
        )
        texel_m = float(np.max(rendered.texels_px)) * rendered.pixel_m
        allowed = allowance(step, radius_m, texel_m, rendered.pixel_m, 0.5 * 2.0**0.5 + GRID_TEXELS)
        figures = penumbra_figures(rendered, chord, rendered.buffer.valid, allowed)
        result = {name: max(result[name], figures[name]) for name in result}
    return result


PLATE_M, LAMP_M = 6.0, 12.0
"""Heights of the plate and of the lamp above the ground."""

HALF_PLATE_M = 3.0


@hard_case(
    "L3",
    "A lamp's ball throws a half-shadow as wide, and as dark in each place, as in closed form, and alike on both sides",
    "a plate of 6 m half-way up to a spot of 0.5 m radius (long: 0.2 and 1 m too); as a share of what the samples of the ball, the "
    "texels and the pixels explain",
    {"share of light": 1.0, "width": 1.0, "asymmetry": 1.0},
)
def test_half_shadow_of_a_lamp(trial: Trial) -> dict[str, float]:
    """A point at the distance d sees a ball of radius R as a disc whose angular radius has the sine R / d, and the plane through
    the point and the plate's edge cuts a chord from it.

    The plate is 0.2 mm thick. The two sides mirror each other. What either side may be off, both may be in opposite ways:
    ``asymmetry`` is a share of twice what is allowed for the share of light.
    """
    plate = with_ground_pebble(box((2.0 * HALF_PLATE_M, 60.0, 2e-4), PLATE_M - 1e-4))
    result = {"share of light": 0.0, "width": 0.0, "asymmetry": 0.0}
    for ball_m in (0.5, 0.2, 1.0) if trial.thorough else (0.5,):
        lamp = {"kind": "spot", "position": [0, 0, LAMP_M], "target": [0, 0, 0], "cutoff": 42, "radius": ball_m}
        scene = trial.scene({"flat": {"size": [100, 100], "cells": [10, 10]}}, meshes=[plate], lights={"lamp": lamp})
        edge_at = HALF_PLATE_M * LAMP_M / (LAMP_M - PLATE_M)
        extent_m = 2.6 * ball_m * edge_at / HALF_PLATE_M
        shown, allowed = {}, PointsError(0.0, 0.0)
        for side in (-1.0, 1.0):
            view = close_view(trial, scene, (side * edge_at, 0.0), 0.0, extent_m, 96 if trial.thorough else 64)
            rendered = trial.render_view(scene, view, light="lamp", filter="sun", map_size=1024 if trial.thorough else 768)
            (step,) = rendered.plan.steps_of_light("lamp")
            points = positions(rendered)
            to_lamp = np.array([0.0, 0.0, LAMP_M]) - points
            distance_m = np.linalg.norm(to_lamp, axis=-1)
            tangent = np.tan(np.arcsin(ball_m / distance_m))
            edge = np.array([side * HALF_PLATE_M, 0.0, PLATE_M])
            chord = edge_chords(points, edge, np.array([0.0, 1.0, 0.0]), to_lamp / distance_m[..., None], tangent)
            in_question = rendered.buffer.valid & (rendered.buffer.surface_kind == RELIEF)
            slope = np.abs(np.gradient(chord, axis=1) / np.gradient(points[..., 0], axis=1))
            radius_m = 1.0 / float(slope[in_question & (np.abs(chord) < 1.0)].max())
            texel_m = float(np.max(rendered.texels_px)) * rendered.pixel_m
            allowed = allowance(step, radius_m, texel_m, rendered.pixel_m, 1.0 + GRID_TEXELS)
            figures = penumbra_figures(rendered, chord, in_question, allowed)
            result |= {name: max(result[name], figure) for name, figure in figures.items()}
            shown[side] = np.where(in_question, rendered.visibility, np.nan)
        apart = np.nanmax(np.abs(shown[1.0] - shown[-1.0][:, ::-1]))
        result["asymmetry"] = max(result["asymmetry"], float(apart) / (2.0 * allowed.share))
    return result
