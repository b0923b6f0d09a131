"""Truth along either diagonal: a raster does not say how its quads are cut, and a class that hangs on it is no class."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from shadows.truth.cache import cached_truth, content_key
from shadows.truth.truth import changed_by_diagonal, truth_of
from terrain.casters.rays import RayScene
from terrain.casters.reach import casters_of
from terrain.gbuffer.geometry import GeometryBuffer, map_geometry
from terrain.gbuffer.picture import geometry_of
from terrain.geo.grid import MapView
from terrain.ground.surface import sheet_triangles
from terrain.scene import Scene
from tests.rasters import ENGINEERING

CELL_M = 8.0
SIDE = 24

SADDLE = (12, 11)
"""Row and column of the NW corner of the only quad that is not plane: its SW and NE corners are 3 m high."""


def whole_view(scene: Scene) -> MapView:
    """A pixel a cell: every pixel's centre is a node."""
    side = SIDE * CELL_M
    view = scene.view(bounds=(0, 0, side, side), size=(SIDE, SIDE))
    assert view.on_nodes
    return view


def geometry(scene: Scene, view: MapView) -> GeometryBuffer:
    return map_geometry(scene.surface(view.grid), view, scene.world.frame_near(view.grid.crs, *view.centre))


@pytest.fixture
def scene_of(write_raster, make_scene):
    """``scene_of(heights, azimuth, altitude)``: a level whose nodes, in a view of a pixel a cell, are the raster's cells."""

    def scene(heights: np.ndarray, azimuth: float, altitude: float, name: str = "dem.tif", **keys) -> Scene:
        raster = write_raster(heights.astype(np.float32), ENGINEERING, 0.0, len(heights) * CELL_M, CELL_M, name)
        return make_scene(raster, azimuth, altitude, **keys)

    return scene


@pytest.fixture
def saddle(scene_of) -> Scene:
    """Cut SW to NE the saddle is a ridge across the sun's way; cut NW to SE a valley along it."""
    heights = np.zeros((SIDE, SIDE))
    row, col = SADDLE
    heights[row + 1, col] = heights[row, col + 1] = 3.0
    return scene_of(heights, 135.0, 3.0)


def test_what_hangs_on_the_cut_is_decidable_only_as_drawn(saddle):
    """Behind the ridge 3 m / tan(3 degrees) = 57.2 m are dark, five nodes; through the valley they see the sun."""
    buffer = geometry(saddle, whole_view(saddle))
    casters = casters_of(saddle, buffer)
    drawn = truth_of(buffer, saddle, casters)
    either = truth_of(buffer, saddle, casters, either_diagonal=True)
    behind = np.array([SADDLE]) - np.arange(5)[:, None]
    assert not drawn.lit[*behind.T].any() and drawn.lit[*(behind[-1] - 1)]
    assert drawn.decidable[*behind[:3].T].all()
    assert not either.decidable[*behind.T].any()
    np.testing.assert_array_equal(either.lit, drawn.lit)
    changed = changed_by_diagonal(buffer, saddle, casters, drawn.lit)
    np.testing.assert_array_equal(either.decidable, drawn.decidable & ~changed)
    assert changed[*behind.T].all() and 5 <= changed.sum() < 20
    assert either.boundary > drawn.boundary


@pytest.mark.parametrize(("azimuth", "altitude"), [(113.0, 10.0), (202.0, 30.0), (67.0, 3.0)])
def test_the_other_cut_is_a_mirrored_world_s_own(azimuth, altitude, scene_of):
    """Mirrored east to west, with the sun, quads cut SW to NE are what NW to SE is unmirrored; points off nodes move too."""
    heights = np.random.default_rng(5).uniform(0.0, 12.0, (SIDE, SIDE))
    seen = []
    for turn, name in ((1, "dem.tif"), (-1, "mirrored.tif")):
        scene = scene_of(heights[:, ::turn], turn * azimuth % 360.0, altitude, name)
        buffer = geometry(scene, whole_view(scene).finer(4).shifted(0.1, turn * 0.2))
        casters = casters_of(scene, buffer)
        lit = truth_of(buffer, scene, casters, samples=1).lit
        seen.append((lit, changed_by_diagonal(buffer, scene, casters, lit)))
    (drawn, changed), (mirrored, _) = seen
    assert 0.03 < changed.mean() < 0.5
    assert ((drawn != mirrored[:, ::-1]) == changed).mean() > 0.999


def test_a_plane_has_no_diagonals(scene_of):
    row, col = np.mgrid[:SIDE, :SIDE]
    scene = scene_of(0.75 * row + 0.5 * col, 202.0, 10.0)
    buffer = geometry(scene, whole_view(scene).finer(3))
    casters = casters_of(scene, buffer)
    drawn, either = (truth_of(buffer, scene, casters, samples=1, either_diagonal=either) for either in (False, True))
    assert drawn.there.mean() > 0.9 and drawn.lit.any()
    np.testing.assert_array_equal(drawn.decidable, either.decidable)


def test_where_the_other_cut_has_no_triangle_the_class_hangs_on_it(scene_of):
    """Of a quad without its NW node only one triangle is left as drawn, and none cut the other way."""
    scene = scene_of(np.zeros((SIDE, SIDE)), 202.0, 30.0)
    buffer = geometry(scene, whole_view(scene).finer(4))
    assert buffer.surface is not None and buffer.triangle is not None
    quad = np.array([SADDLE]) + buffer.triangle[..., :2].min(axis=(0, 1), where=buffer.there[..., None], initial=1 << 20)
    position = buffer.surface.position_frame_m.copy()
    position[quad[0, 0], quad[0, 1]] = np.nan
    torn = replace(buffer, surface=replace(buffer.surface, position_frame_m=position))
    changed = changed_by_diagonal(torn, scene, casters_of(scene, torn), buffer.there)
    assert changed[(buffer.triangle == (*quad[0], 1)).all(axis=-1)].all()


def test_a_camera_s_ground_knows_its_triangles(gl, scene_of):
    views = {"low": {"kind": "perspective", "eye": [0, -60, 20], "target": [0, 0, 0], "size": [64, 48]}}
    scene = scene_of(np.random.default_rng(5).uniform(0.0, 12.0, (SIDE, SIDE)), 113.0, 10.0, views=views)
    buffer = geometry_of(scene, scene.view("low"))
    lit = np.zeros(buffer.there.shape, bool)
    assert buffer.there.any() and not changed_by_diagonal(buffer, scene, casters_of(scene, buffer), lit).any()


def test_truth_on_disk_is_told_apart(saddle, tmp_path):
    buffer = geometry(saddle, whole_view(saddle))
    casters = casters_of(saddle, buffer)
    assert content_key(buffer, saddle, casters, 4) != content_key(buffer, saddle, casters, 4, either_diagonal=True)
    for either in (False, True):
        for _ in range(2):  # made, then read
            truth = cached_truth(buffer, saddle, casters, 4, folder=tmp_path, either_diagonal=either)
            assert truth.decidable[SADDLE] != either
    assert len(list(tmp_path.glob("*.npz"))) == 2


@pytest.mark.parametrize("cut", ["SW-NE", "NW-SE"])
def test_triangles_of_either_cut_face_up_and_cover_the_sheet(cut):
    triangles = sheet_triangles(4, 5, cut)
    row, col = np.divmod(triangles, 5)
    x, y = col.astype(float), -row.astype(float)
    area = ((x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])) / 2
    assert (area == 0.5).all() and len(area) == 2 * 3 * 4
    diagonal = {"SW-NE": (1, 5), "NW-SE": (0, 6)}[cut]
    assert sum(set(diagonal) <= set(triangle) for triangle in triangles.tolist()) == 2


def test_rays_meet_the_cut_they_are_asked_for():
    """Over a saddle of 0 and 10 m a level ray 5 m up is stopped by the ridge of one cut and passes the valley of the other."""
    sheet = np.array([[[0.0, 1, 0], [1, 1, 10]], [[0, 0, 10], [1, 0, 0]]])
    start, way = np.array([[-1.0, 2.0, 5.0]]), np.array([1.0, -1.0, 0.0]) / 2**0.5
    assert RayScene([sheet]).blocked(start, way).tolist() == [True]
    assert RayScene([sheet], cut="NW-SE").blocked(start, way).tolist() == [False]
