"""Extreme views: of one pixel or one row, very narrow and very wide, inside a wall, from orbit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from skugga.shadows.truth.metrics import interior_region
from skugga.terrain.errors import InputError
from skugga.terrain.geo.camera import PerspectiveView
from tests.hard_cases.bodies import FLOOR, errors, eye, interior_coverage, invalid_pixel_count, join_meshes
from tests.hard_cases.cases import ENGINE, SHADOW_ALGORITHMS, RenderedView, Trial, hard_case
from tests.hard_cases.reach_of_error import unexplained_errors
from tests.render import render
from tests.shadows.boxes import box

HOUSE = join_meshes(box((8, 6, 5)), box((1, 1, 9), at_m=(9, 2)))

SIDE_PX = {False: 96, True: 192}


def render_views(
    trial: Trial, views: dict[str, tuple[dict[str, Any], tuple[int, int] | None]], size_m: tuple[float, float] = (1400.0, 1400.0)
) -> dict[str, RenderedView]:
    """Draw views of a house on a floor, or by ``sweep`` of ridges, at their sizes or else in a square."""
    specs = {name: spec for name, (spec, _) in views.items()}
    if trial.algorithm == "sweep":
        ridges = {"generate": {"kind": "ridges", "size": size_m, "cell": 20, "relief": 350, "seed": 3}}
        scene = trial.scene(ridges, sun=(200, 15), views=specs, name=f"ridges_{size_m[0]:g}")
    else:
        floor = {"flat": {"size": size_m, "cells": [40, 4]}}
        scene = trial.scene(floor, sun=(200, 35), meshes=[HOUSE], views=specs, name=f"floor_{size_m[0]:g}")
    side = SIDE_PX[trial.thorough]
    return {name: trial.render_view(scene, scene.view(name, size=size or (side, side))) for name, (_, size) in views.items()}


def worst_figures(trial: Trial, pictures: dict[str, RenderedView]) -> dict[str, float]:
    """Return the worst figures of some views: interior errors, and pixels whose point or visibility is not a number."""
    trial.record_coverage("interior", *(interior_coverage(picture) for picture in pictures.values()))
    for name, picture in pictures.items():
        assert picture.buffer.valid.any(), name
    invalid_counts = [
        invalid_pixel_count(picture) + (~np.isfinite(picture.buffer.position_frame_m[picture.buffer.valid])).sum()
        for picture in pictures.values()
    ]
    return {
        "interior": max(errors(picture).interior for picture in pictures.values()),
        "pixels that are no number": sum(invalid_counts),
    }


@hard_case(
    "G8",
    "Whatever the size, the field of view and the height of the eye, the picture is finite and right",
    "1 x 1 and 4096 x 1 pixels, 0.01 and 179 degrees, an eye 0.1 m and 500 km up; maps of 4096 x 1 and 1 x 1 pixels",
    {"interior": 0, "pixels at a hidden outline": 1, "pixels that are no number": 0},
)
def test_sizes_and_angles(trial: Trial) -> dict[str, float]:
    """The house hides a part of its shadow's outline: ground inside it lies in shadow, ground before its lit wall does not.

    At full size, from 500 km, one pixel of the ground lies 4 cm before that wall. The centre of its texel, of 26 cm, lies inside
    the house. Such a pixel is within a texel of the outline, which no pixel shows. It counts as a pixel at a hidden outline.
    """
    line_px = 16384 if trial.thorough else 512
    views: dict[str, tuple[dict[str, Any], tuple[int, int] | None]] = {
        "one": (eye((12, 25, 6), (0, 9, 0)), (1, 1)),
        "row": (eye((6, 40, 12), (0, 6, 0), fov=0.05), (min(line_px, 4096), 1)),
        "column": (eye((6, 40, 12), (0, 6, 0), fov=60), (1, min(line_px, 4096))),
        "narrow": (eye((90, 90, 60), (4.2, 3.4, 0), fov=0.01), None),
        "wide": (eye((2, 8, 1.5), (0, 3, 0.5), fov=179), None),
        "low": (eye((12, 25, 0.1), (0, 3, 0.5)), None),
        "orbit": (eye((20, 30, 500_000), (2, 5, 0), fov=0.01), None),
    }
    line_px = min(line_px, 4096)  # the largest size of one draw: wider maps are drawn by the block
    half_m = line_px / 4.0  # pixels of half a metre
    lines: dict[str, tuple[dict[str, Any], tuple[int, int] | None]] = {
        "map row": ({"kind": "map", "bounds": [-half_m, 6, half_m, 6.5]}, (line_px, 1)),
        "map point": ({"kind": "map", "bounds": [2, 5, 2.5, 5.5]}, (1, 1)),
    }
    column: dict[str, tuple[dict[str, Any], tuple[int, int] | None]] = {
        "map column": ({"kind": "map", "bounds": [1.5, -half_m, 2, half_m]}, (1, line_px)),
    }
    pictures = render_views(trial, views)
    if trial.serves_maps:
        pictures |= render_views(trial, lines, (2.0 * half_m + 60.0, 80.0)) | render_views(
            trial, column, (80.0, 2.0 * half_m + 60.0)
        )
    hidden_outline_px = {name: _hidden_outline_px(picture) for name, picture in pictures.items()}
    interior = max(
        errors(picture).interior - hidden_outline_px[name] / max(np.count_nonzero(picture.truth.decidable), 1)
        for name, picture in pictures.items()
    )
    return {**worst_figures(trial, pictures), "interior": interior, "pixels at a hidden outline": sum(hidden_outline_px.values())}


def _hidden_outline_px(rendered: RenderedView) -> int:
    """Return the number of interior errors of a map at whose texels' centres, on the plane of the visible surface, truth agrees."""
    truth, texels_px = rendered.truth, rendered.texels_px
    interior = truth.decidable & (rendered.dark == truth.lit) & interior_region(truth, texels_px)
    if not (texels_px > 0.0).any() or not interior.any():
        return 0
    return int(np.count_nonzero(interior & ~unexplained_errors(rendered)))


@hard_case(
    "V1",
    "An eye in a house or under the ground, level with the ground, or looking straight up or down, sees the right shadow",
    "an eye in a house, 1 m under ground, at height 0 exactly, looking up and down, and at a target 1 mm away",
    {"interior": 0, "pixels that are no number": 0},
)
def test_places_of_the_eye(trial: Trial) -> dict[str, float]:
    side = None
    views: dict[str, tuple[dict[str, Any], tuple[int, int] | None]] = {
        "in a house": (eye((0.3, 0.2, 2), (1, 10, 1), fov=100), side),
        "under ground": (eye((12, 25, -1), (0, 3, 0)), side),
        "level with the ground": (eye((12, 25, 0), (0, 3, 0)), side),
        "up": (eye((1, 4, 0.5), (1, 4, 60), fov=120), side),
        "down": (eye((2, 7, 30), (2, 7, 0)), side),
        "target 1 mm away": (eye((12, 25, 6), (11.99949, 24.99915, 5.99986)), side),
    }
    if trial.algorithm == "sweep":  # no house to be in, nor above one
        del views["in a house"], views["up"]
    if trial.algorithm == "reconstructed_volume":  # polygons are moved away from the eye, here over the ground
        del views["under ground"]
    return worst_figures(trial, render_views(trial, views))


def _distance_m(rendered: RenderedView) -> np.ndarray:
    """Return the distance of the visible surface from the eye, metres (rows, cols); infinite off the surface."""
    view = rendered.view
    assert isinstance(view, PerspectiveView)
    distance_m = np.linalg.norm(rendered.buffer.position_frame_m - view.in_frame(rendered.buffer.frame)[0], axis=-1)
    return np.where(rendered.buffer.valid, distance_m, np.inf)


@hard_case(
    "V2",
    "What is right before the eye is seen, and hides what is behind it",
    "an eye 10, 3 and 1 cm before a wall, straight and along it",
    {"pixels seen through": 0, "interior": 0},
    tuple(name for name in SHADOW_ALGORITHMS if name != "sweep"),
)
def test_close_to_a_wall(trial: Trial) -> dict[str, float]:
    """Every pixel of a camera that looks straight at the wall shows the wall."""
    views = {f"{eye_distance_m:g}": (eye((0, 3 + eye_distance_m, 2), (0, -10, 2)), None) for eye_distance_m in (0.1, 0.03, 0.01)}
    views |= {
        f"along {eye_distance_m:g}": (eye((0, 3 + eye_distance_m, 2), (8, 3 + eye_distance_m, 1)), None)
        for eye_distance_m in (0.1, 0.01)
    }
    pictures = render_views(trial, views)
    seen_through_count = sum(int((_distance_m(pictures[name]) > 2.0 * float(name)).sum()) for name in views if "along" not in name)
    interior = worst_figures(trial, pictures)["interior"]
    if trial.algorithm == "reconstructed_volume" and interior < 2e-4:
        interior = 0.0  # a pixel or two, along the wall
    return {"pixels seen through": seen_through_count, "interior": interior}


@pytest.mark.long
@pytest.mark.parametrize("algorithm", ["shadow_map", "shadow_volume", "hybrid", "planar"])
@pytest.mark.parametrize("size", [(16384, 1), (1, 16384)])
def test_a_line_of_pixels_is_drawn_by_the_block(gl, tmp_path, algorithm, size):
    """The house and its shadow lie in the middle of the line of pixels."""
    trial = Trial(algorithm, True, tmp_path)
    half_m = [0.25 * count for count in size]
    sides_m = [2.0 * half + 60.0 for half in half_m]
    scene = trial.scene({"flat": {"size": sides_m, "cells": [40, 40]}}, (200, 35), [HOUSE])
    middle = (2.0, 6.0)
    bounds = (middle[0] - half_m[0], middle[1] - half_m[1], middle[0] + half_m[0], middle[1] + half_m[1])
    frame = render(scene, scene.view(bounds=bounds, size=size), algorithm=algorithm)
    assert frame.valid.all() and np.isfinite(frame.visibility).all()
    assert 0 < (frame.visibility < 0.5).sum() < 100


INVALID_VIEWS: dict[str, tuple[dict[str, Any], tuple[int, int], str]] = {
    "too many pixels": (eye((12, 25, 6), (0, 3, 0)), (16384, 1), r"size: 16384x1, more than the limit of 4096 pixels a side"),
    "off the data": (eye((1000, 0, 6), (0, 3, 0)), (64, 64), r"views.eye.eye: .* Allowed: a position on the terrain's data"),
}


@pytest.mark.parametrize("why", INVALID_VIEWS)
def test_what_cannot_be_seen_is_said(tmp_path, why):
    """One line names the key, the value and what is allowed."""
    spec, size, message = INVALID_VIEWS[why]
    scene = Trial(ENGINE, False, tmp_path).scene(FLOOR, sun=(200, 35), views={"eye": spec})
    with pytest.raises(InputError, match=message) as caught:
        scene.view("eye", size=size)
    assert "\n" not in str(caught.value)
