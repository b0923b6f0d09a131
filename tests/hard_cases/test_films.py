"""Films: a frame is the picture of its time, and no direction of the compass has better films than another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np
import pyproj
import trimesh
from scipy.ndimage import maximum_filter, minimum_filter

from benchmarks.symmetry import SYMMETRIES, Symmetry, invert_grid, transform_azimuth
from skugga.selector.film import FilmFrame, FrameMoment, film_frames, frame_moments
from skugga.selector.film_request import FilmRequest, FilmSpan
from skugga.selector.select import select
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.level.camera_file import CameraPathSpec
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.hard_cases.bodies import FLOOR, eye
from tests.hard_cases.cases import MAP_VIEW_ALGORITHMS, PERSPECTIVE_MAP_ALGORITHMS, SHADOW_ALGORITHMS, Trial, hard_case
from tests.hard_cases.ground import UTM
from tests.hard_cases.sites import CELL_M, CELLS, HOUSE_POSITIONS_M, hills
from tests.hard_cases.test_every_side import MAX_DIFFERING_SHARE
from tests.rasters import ENGINEERING

EVERY_ALGORITHM = (*SHADOW_ALGORITHMS, "truth", "none")

NOON = datetime.fromisoformat("2024-06-21T12:00:00+00:00")


def settings(trial: Trial) -> dict[str, Any]:
    """Return the settings of a film by the trial's algorithm, all of them named: nothing is left for a plan to choose."""
    return {"algorithm": trial.algorithm, "map_size": 1024 if trial.thorough else 256, "cascades": 1}


# -- frames and stills


def largest_difference_from_stills(scene: Scene, request: FilmRequest) -> float:
    """Return the largest share of pixels in which a frame differs from the single picture of its time.

    The still has a scene of its own, which shares no cache of objects with the film's, and a plan of its own.
    """
    frames, worst = list(film_frames(scene, request, frame_moments(scene, request))), 0.0
    assert len({frame.color.tobytes() for frame in frames}) == len(frames), "every frame shows something else"
    for frame in frames:
        still = _still(scene, request, frame)
        worst = max(worst, float((frame.color != still).any(axis=-1).mean()))
    return worst


def _still(scene: Scene, request: FilmRequest, frame: FilmFrame) -> np.ndarray:
    """Return the picture of a frame's time, drawn alone."""
    moment = frame.moment
    sun = None if moment.time is None else SunSpec(time=moment.time)
    alone = build_scene(scene.loaded).with_sun(sun).at_second(moment.second)
    descriptor = describe(alone, moment.view, request.view_name)
    return render_frame(alone, moment.view, select(descriptor, scene.loaded.level, dict(request.overrides))).color


MIDDLE_M = 500_000.0, 6_400_000.0
"""The middle of the hills in ``UTM``."""


def _lon_lat(east_m: float, north_m: float) -> list[float]:
    """Return the longitude and latitude of a place, metres from the middle of the hills."""
    to_degrees = pyproj.Transformer.from_crs(UTM, "EPSG:4326", always_xy=True)
    return list(to_degrees.transform(MIDDLE_M[0] + east_m, MIDDLE_M[1] + north_m))


@hard_case(
    "F1",
    "Under a sun that moves, each frame is the single picture of its time, to the bit, by every algorithm",
    "hills with houses in UTM, from noon on by steps of 40 minutes, from a camera, and as a map by algorithms that have maps",
    {"pixels that differ": 0.0},
    algorithms=EVERY_ALGORITHM,
)
def test_films_of_a_moving_sun(trial: Trial) -> dict[str, float]:
    houses: dict[str, Any] = {}
    if trial.algorithm != "sweep":
        trimesh.creation.box(extents=(21.0, 13.0, 24.0)).export(trial.folder / "house.ply")
        houses = {"meshes": [{"source": "house.ply", "at": [_lon_lat(x, y) for x, y in HOUSE_POSITIONS_M], "turn": 17.3}]}
    half_m = CELLS * CELL_M / 2.0
    raster = trial.raster(hills(), UTM, MIDDLE_M[0] - half_m, MIDDLE_M[1] + half_m, CELL_M)
    camera = {"eye": [*_lon_lat(150.0, 110.0), 70], "target": [*_lon_lat(0.0, 0.0), 0], "fov": 45, "size": [128, 96]}
    scene = trial.scene(raster, (180.0, 40.0), views={"eye": {"kind": "perspective", **camera}}, **houses)
    span = FilmSpan(12 if trial.thorough else 3, 2400.0, NOON)
    size = (256, 192) if trial.thorough else (96, 72)
    names = ["eye", "map"] if trial.serves_maps else ["eye"]
    differ = [
        largest_difference_from_stills(scene, FilmRequest(span, name, size=size, overrides=settings(trial))) for name in names
    ]
    return {"pixels that differ": max(differ)}


@hard_case(
    "F2",
    "With a body, a lamp and a camera that move, each frame is the single picture of its time, to the bit, by every algorithm",
    "a house that turns and a lamp that passes over it, from a camera that flies round them, in steps of half a second",
    {"pixels that differ": 0.0},
    algorithms=EVERY_ALGORITHM,
)
def test_films_of_moving_bodies(trial: Trial) -> dict[str, float]:
    trimesh.creation.box(extents=(8.0, 6.0, 5.0)).export(trial.folder / "house.ply")
    lamp_path = [{"seconds": 0, "position": [-14, -12, 18]}, {"seconds": 10, "position": [14, -10, 18]}]
    lamp = {"kind": "spot", "target": [0, 0, 0], "cutoff": 40, "motion": {"path": lamp_path}}
    scene = trial.scene(
        FLOOR, (200.0, 35.0), meshes=[{"source": "house.ply", "at": [0, 0], "motion": {"spin": 30}}], lights={"lamp": lamp}
    )
    path = CameraPathSpec.model_validate({
        "size": (192, 160) if trial.thorough else (96, 80),
        "keys": [
            {"at": "0s", "eye": [-24, -30, 15], "target": [0, 0, 2]},
            {"at": "2s", "eye": [24, -30, 12], "target": [0, 0, 2], "fov": 40},
            {"at": "5s", "eye": [30, 20, 20], "target": [0, 0, 2], "fov": 45},
        ],
    })  # fmt: skip
    request = FilmRequest(FilmSpan(10 if trial.thorough else 3, 0.5), path=path, overrides=settings(trial))
    return {"pixels that differ": largest_difference_from_stills(scene, request)}


# -- symmetries


@dataclass(frozen=True, eq=False)
class SunPathMoment(FrameMoment):
    """A frame under a sun given by its angles, as in a flat world, where there are no dates."""

    sun: SunSpec

    def scene(self, scene: Scene) -> Scene:
        return scene.with_sun(self.sun).at_second(self.second)


SAMPLES_PER_PIXEL = 5
"""A pixel on an edge is the mean of its own point and four samples."""

TOWERS_M = [(0.0, 0.0), *((x, y) for x in (-44.0, 44.0) for y in (-44.0, 44.0))]
"""Middles of the towers: unchanged by all symmetries of the square."""

FLOOR_CELLS = 80

TOWER_CELLS, TOWER_HEIGHT_M = 8, 20.0


def symmetric_scene(trial: Trial) -> Scene:
    """Return five square towers on a floor, 160 m a side; a raster for the sweep."""
    cell_m = 2.0
    half_m = FLOOR_CELLS * cell_m / 2.0
    # The ground's materials and small details are no part of the scene's symmetry.
    effects = {"ground_materials": "off", "ground_detail": "off"}
    keys = {"views": {"above": eye((0.0, 0.0, 240.0), (0.0, 0.0, 0.0), fov=38.0)}, "effects": effects}
    if trial.algorithm != "sweep":
        side_m = TOWER_CELLS * cell_m
        trimesh.creation.box(extents=(side_m, side_m, TOWER_HEIGHT_M)).export(trial.folder / "tower.ply")
        floor = {"flat": {"size": [2.0 * half_m, 2.0 * half_m], "cells": [FLOOR_CELLS, FLOOR_CELLS]}}
        meshes = [{"source": "tower.ply", "at": [list(at) for at in TOWERS_M]}]
        return trial.scene(floor, (200.0, 35.0), meshes=meshes, **keys)  # type: ignore[arg-type]
    heights = np.zeros((FLOOR_CELLS, FLOOR_CELLS), np.float32)
    for x, y in TOWERS_M:
        row, col = (round((half_m + offset) / cell_m) - TOWER_CELLS // 2 for offset in (-y, x))
        heights[row : row + TOWER_CELLS, col : col + TOWER_CELLS] = TOWER_HEIGHT_M
    raster = trial.raster(heights, ENGINEERING, -half_m, half_m, cell_m)
    return trial.scene(raster, (200.0, 35.0), **keys)


def sun_path_film(trial: Trial, scene: Scene, symmetry: Symmetry, pixels: int, frames: int) -> Iterator[np.ndarray]:
    """Yield the frames (pixels, pixels, 3) of a film under a sun path transformed by a symmetry, transformed back."""
    name = "map" if trial.serves_maps else "above"
    overrides = settings(trial) | {"map_size": 4096 if trial.thorough else 2304}
    request = FilmRequest(FilmSpan(frames, 60.0), name, size=(pixels, pixels), overrides=overrides)
    view = scene.view(name, size=(pixels, pixels))
    moments = [
        SunPathMoment(
            number, 60.0 * number, None, 60.0 * number, view,
            SunSpec(azimuth=transform_azimuth(113.0 + 11.0 * number, symmetry), altitude=24.0 + 3.0 * number),
        )
        for number in range(frames)
    ]  # fmt: skip
    for frame in film_frames(scene, request, moments):
        yield invert_grid(frame.color, symmetry) if not symmetry[2] else _invert_color(frame.color, symmetry)


def _invert_color(color: np.ndarray, symmetry: Symmetry) -> np.ndarray:
    """Invert a symmetry that swaps rows and columns for a picture (n, n, 3)."""
    return np.stack([invert_grid(color[..., channel], symmetry) for channel in range(color.shape[-1])], axis=-1)


def film_differences(trial: Trial) -> dict[str, float]:
    """Return the largest share of a frame's pixels that differ from the transformed film: of all, and inside plain areas.

    A pixel differs if a colour does by more than 1 of 255, which rounding explains. It is inside a plain area if the colours of its
    neighbourhood of 3 x 3 pixels are alike to ``MAX_PLAIN_RANGE`` in both films. There it differs if it does by more than that: a
    faint edge within the neighbourhood explains no more.
    """
    scene = symmetric_scene(trial)
    pixels, frames = (160, 6) if trial.thorough else (112, 2)
    first = list(sun_path_film(trial, scene, SYMMETRIES[0], pixels, frames))
    assert len({frame.tobytes() for frame in first}) == frames
    result = {"pixels that differ": 0.0, "inside plain areas": 0.0}
    for symmetry in SYMMETRIES[1:] if trial.thorough else (SYMMETRIES[1], SYMMETRIES[6]):
        for frame, other in zip(first, sun_path_film(trial, scene, symmetry, pixels, frames), strict=True):
            brightness = frame.astype(int).sum(axis=-1)
            assert np.ptp(brightness) > 60, "light and shadow"
            apart = np.abs(frame.astype(int) - other.astype(int)).max(axis=-1)
            plain = _is_plain(frame) & _is_plain(other)
            assert plain.mean() > 0.5 and np.ptp(brightness[plain]) > 60, "also inside plain areas"
            result["pixels that differ"] = max(result["pixels that differ"], float((apart > 1).mean()))
            result["inside plain areas"] = max(result["inside plain areas"], float(((apart > MAX_PLAIN_RANGE) & plain).mean()))
    return result


MAX_PLAIN_RANGE = 8
"""Range of the colours, of 255, of neighbours without an edge between them."""


def _is_plain(color: np.ndarray) -> np.ndarray:
    """Return the pixels (rows, cols) of a picture whose neighbourhoods are of one colour."""
    return (maximum_filter(color, (3, 3, 1)) - minimum_filter(color, (3, 3, 1)) <= MAX_PLAIN_RANGE).all(axis=-1)


SYMMETRIC_SET_UP = "five towers at the middle and the corners of a square, eight ways"


@hard_case(
    "Y9",
    "A film of a symmetric scene under a mirrored or turned sun path has the mirrored or turned frames",
    SYMMETRIC_SET_UP,
    {"pixels that differ": SAMPLES_PER_PIXEL * MAX_DIFFERING_SHARE["city"], "inside plain areas": 0.0},
    algorithms=MAP_VIEW_ALGORITHMS,
)
def test_films_from_every_side(trial: Trial) -> dict[str, float]:
    """``MAX_DIFFERING_SHARE`` of the points of a city may differ (Y1), and a pixel has ``SAMPLES_PER_PIXEL`` points. As there, a
    pixel is more than twenty texels wide.

    An edge that is off by less than a texel in either film stays within a pixel, so inside plain areas nothing may differ.
    """
    return film_differences(trial)


@hard_case(
    "Y10",
    "The same by a perspective map, whose texels follow the camera: nothing differs but on edges",
    SYMMETRIC_SET_UP + ", from above",
    {"inside plain areas": 0.0},
    algorithms=PERSPECTIVE_MAP_ALGORITHMS,
)
def test_perspective_films_from_every_side(trial: Trial) -> dict[str, float]:
    """The map's lattice has no fixed place, and all samples along an edge that is parallel to the rows may change at once.

    So a share of the pixels is no bound. As for Y9, two edges that are each off by less than a twentieth of a pixel lie in the same
    pixel or in neighbours.
    """
    return {"inside plain areas": film_differences(trial)["inside plain areas"]}
