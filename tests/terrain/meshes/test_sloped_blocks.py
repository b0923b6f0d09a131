"""Roofs by straight skeletons, and eaves: heights, areas and volumes by hand, closed meshes, bounds, and true shadows."""

from __future__ import annotations

import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import py_straight_skeleton.algorithm
import pyogrio
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from skugga.selector.planner.planner import make_plan
from skugga.shadows.passes import PassLog
from skugga.shadows.truth.truth import trace_truth
from skugga.shadows.visibility import fill_steps
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.errors import LevelError
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import load_level
from skugga.terrain.meshes import extrusion, skeleton_roofs
from skugga.terrain.meshes.body import Body
from skugga.terrain.meshes.facade_layout import BAY_COUNT, GABLE_HALF_WIDTH, LENGTH, TOP
from skugga.terrain.meshes.facades import TILES
from skugga.terrain.meshes.roofs import MAX_RISE_SHARE, ROOF_SLOPE
from skugga.terrain.meshes.sloped_blocks import EAVES_THICKNESS_M, SlopedBlockResult, sloped_block
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff
from tests.terrain.meshes.test_buildings import town_blocks

HEIGHT_M, WING_M, EAVES_M = 7.0, 4.0, 0.5

L_SHAPE = shapely.Polygon([(0, 0), (12, 0), (12, WING_M), (WING_M, WING_M), (WING_M, 10), (0, 10)])
"""Wings of one width. Their axes measure 10 m and 8 m from the corner to the ends."""

L_AXES_M = 10.0 + 8.0

MAX_WRONG_SHARES = {"shadow_map": 0.001, "shadow_volume": 0.0, "hybrid": 0.0}
"""Maximum share of a view's decidable pixels outside of attached shadow that an algorithm may get wrong."""

COURT = shapely.Polygon(shapely.box(0, 0, 12, 12).exterior.coords, [shapely.box(4, 4, 8, 8).exterior.coords])
"""Four wings of ``WING_M``, with axes of 8 m."""


def build(outline: shapely.Polygon, form: str, eaves_m: float = 0.0, height_m: float = HEIGHT_M) -> SlopedBlockResult:
    """Return the block over a footprint on level ground."""
    xy, ends = corners_of(outline)
    return sloped_block(np.insert(xy, 2, 0.0, axis=1), np.array([0.0, 0.0, 1.0]), ends, height_m, form, eaves_m)


def corners_of(outline: shapely.Polygon) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (n, 2) of a footprint, and the end index of each ring."""
    oriented = shapely.orient_polygons(outline)
    rings = [np.array(ring.coords)[:-1] for ring in (oriented.exterior, *oriented.interiors)]
    return np.concatenate(rings), np.cumsum([len(ring) for ring in rings])


def body_of(outline: shapely.Polygon, form: str, eaves_m: float = 0.0, height_m: float = HEIGHT_M) -> Body:
    """Return the mesh of the block over a footprint, with its floor at height 0."""
    block = build(outline, form, eaves_m, height_m).block
    assert block is not None
    xy = corners_of(outline)[0][block.order]
    vertices = [
        np.insert(xy, 2, height_m - block.wall_drop_m, axis=1), np.insert(xy, 2, 0.0, axis=1),
        np.column_stack([block.point_weights @ xy, height_m - block.point_drops_m]),
    ]  # fmt: skip
    albedo = np.where(block.is_roof[:, None], 1.0, 0.0)
    return Body(np.concatenate(vertices), block.triangles, albedo, crease_deg=block.crease_deg)


def double_area_vectors(body: Body) -> np.ndarray:
    """Return the outward normals (m, 3) of triangles, twice as long as their areas."""
    a, b, c = np.moveaxis(body.vertices_m[body.triangles], 1, 0)
    return np.cross(b - a, c - a)


def slope_triangles(body: Body) -> np.ndarray:
    """Return the mask (m,) of triangles that face upwards."""
    return double_area_vectors(body)[:, 2] > 1e-9


def wall_area_m2(body: Body, is_roof: bool) -> float:
    """Return the area of upright triangles on the roof (fascias), or of walls and gables."""
    normal = double_area_vectors(body)
    is_upright = (np.abs(normal[:, 2]) < 1e-9) & ((body.albedo[:, 0] > 0.5) == is_roof)
    return float(0.5 * np.linalg.norm(normal[is_upright], axis=1).sum())


@pytest.mark.parametrize("turn", [0.0, 33.0, 90.0])
def test_wings_of_one_width_have_ridges_at_the_height(turn):
    outline, rise = affinity.rotate(L_SHAPE, turn), ROOF_SLOPE * WING_M / 2.0
    for form in ("hipped", "pitched"):
        body = body_of(outline, form)
        assert body.is_closed
        assert np.unique(body.vertices_m[:, 2].round(6)) == pytest.approx([0.0, HEIGHT_M - rise, HEIGHT_M])
    hipped = body_of(affinity.rotate(L_SHAPE, turn, origin=(0, 0)), "hipped")
    ridge = np.array(affinity.rotate(shapely.MultiPoint([(10, 2), (2, 2), (2, 8)]), turn, origin=(0, 0)).geoms)
    expected = np.array([(point.x, point.y) for point in ridge])
    found = hipped.vertices_m[hipped.vertices_m[:, 2] > HEIGHT_M - 1e-6, :2]
    assert np.sort(found, axis=0) == pytest.approx(np.sort(expected, axis=0), abs=1e-6)


def test_narrow_wing_has_a_lower_ridge():
    outline = shapely.Polygon([(0, 0), (16, 0), (16, 4), (8, 4), (8, 14), (0, 14)])
    rise, narrow_rise = ROOF_SLOPE * 4.0, ROOF_SLOPE * 2.0
    pitched = body_of(outline, "pitched", height_m=9.0)
    levels = np.unique(pitched.vertices_m[:, 2].round(6))
    assert levels == pytest.approx([0.0, 9.0 - rise, 9.0 - rise + narrow_rise, 9.0])
    low = body_of(outline, "hipped", height_m=4.0)
    assert low.vertices_m[:, 2].max() == pytest.approx(4.0)
    assert np.unique(low.vertices_m[:, 2].round(6))[1] == pytest.approx(4.0 * (1.0 - MAX_RISE_SHARE))


@pytest.mark.parametrize("eaves_m", [0.0, EAVES_M])
def test_volumes_are_those_of_prisms_and_pyramids(eaves_m):
    """A wing's prism has half the volume of its rise. A hip takes a twelfth of width times width times rise from it."""
    rise = ROOF_SLOPE * WING_M / 2.0
    prism, hip = WING_M * rise / 2.0, WING_M * WING_M * rise / 12.0

    def slab(outline: shapely.Polygon) -> float:
        """Return the volume of the eaves: of a slab of their thickness between the walls and the edge."""
        return EAVES_THICKNESS_M * (outline.buffer(eaves_m, join_style="mitre").area - outline.area)

    for outline, form, roof in (
        (L_SHAPE, "pitched", prism * L_AXES_M), (L_SHAPE, "hipped", prism * L_AXES_M - 2.0 * hip), (COURT, "hipped", prism * 32.0),
        (COURT, "pitched", prism * 32.0), (shapely.box(0, 0, 10, 4), "pitched", prism * 10.0),
        (shapely.box(0, 0, 10, 4), "hipped", prism * 10.0 - 2.0 * hip),
    ):  # fmt: skip
        body = body_of(outline, form, eaves_m)
        assert body.is_closed
        assert body.volume_m3 == pytest.approx(outline.area * (HEIGHT_M - rise) + roof + slab(outline), rel=1e-6), (outline, form)


@pytest.mark.parametrize("eaves_m", [0.0, EAVES_M])
def test_planes_have_the_area_of_the_outline_over_the_cosine(eaves_m):
    for outline, form in ((L_SHAPE, "hipped"), (L_SHAPE, "pitched"), (COURT, "hipped"), (affinity.rotate(L_SHAPE, 20), "pitched")):
        body = body_of(outline, form, eaves_m)
        area = 0.5 * np.linalg.norm(double_area_vectors(body)[slope_triangles(body)], axis=1).sum()
        covered = outline.buffer(eaves_m, join_style="mitre").area
        assert area == pytest.approx(covered * np.hypot(1.0, ROOF_SLOPE), rel=1e-5)
        assert (body.albedo[slope_triangles(body)] == 1.0).all()


def test_eaves_hang_over_the_walls_by_their_width():
    rise, edge = ROOF_SLOPE * WING_M / 2.0, shapely.box(-EAVES_M, -EAVES_M, 12 + EAVES_M, 10 + EAVES_M)
    for form in ("hipped", "pitched"):
        body = body_of(L_SHAPE, form, EAVES_M)
        assert shapely.MultiPoint(body.vertices_m[:, :2]).bounds == pytest.approx(edge.bounds, abs=1e-6)
        plane_at_walls = HEIGHT_M - rise
        levels = np.unique(body.vertices_m[:, 2].round(6))
        drop = ROOF_SLOPE * EAVES_M
        assert {round(plane_at_walls - EAVES_THICKNESS_M, 6), round(plane_at_walls - drop, 6)} <= set(levels.tolist())
        assert levels[1] == pytest.approx(plane_at_walls - drop - EAVES_THICKNESS_M)
        fascia = EAVES_THICKNESS_M * L_SHAPE.buffer(EAVES_M, join_style="mitre").length
        assert wall_area_m2(body, is_roof=True) == pytest.approx(fascia, rel=1e-6)
        gables = 2 * WING_M * rise / 2.0 if form == "pitched" else 0.0
        walls = L_SHAPE.length * (plane_at_walls - EAVES_THICKNESS_M) + gables
        assert wall_area_m2(body, is_roof=False) == pytest.approx(walls, rel=1e-6)


def test_eaves_are_bounded_by_walls_and_left_out_of_narrow_courtyards():
    low = body_of(shapely.box(0, 0, 10, 4), "hipped", 2.0, height_m=3.0)
    wall = 3.0 * (1.0 - MAX_RISE_SHARE)
    assert np.unique(low.vertices_m[:, 2].round(9))[1] >= 0.5 * wall - 1e-9
    assert low.vertices_m[:, 0].min() == pytest.approx(-(0.5 * wall - EAVES_THICKNESS_M) / (3.0 * MAX_RISE_SHARE / 2.0), abs=1e-6)
    for yard, lacks_eaves in ((0.9, True), (1.1, False)):
        outline = shapely.Polygon(shapely.box(0, 0, 12, 12).exterior.coords, [shapely.box(5, 5, 5 + yard, 7).exterior.coords])
        result = build(outline, "hipped", EAVES_M)
        assert result.block is not None and result.lacks_eaves == lacks_eaves
    spike = shapely.Polygon([(0, 0), (20, 0), (20, 4)])
    assert build(spike, "hipped", EAVES_M).lacks_eaves


@st.composite
def simple_polygons(draw):
    """Draw outlines that are star-shaped about the origin, with corners at any angles."""
    count = draw(st.integers(3, 12))
    radii = draw(st.lists(st.floats(3.0, 15.0), min_size=count, max_size=count))
    gaps = np.array(draw(st.lists(st.floats(0.2, 1.0), min_size=count, max_size=count)))
    angle = 2.0 * np.pi * np.cumsum(gaps) / gaps.sum()
    outline = shapely.Polygon(np.column_stack([radii * np.cos(angle), radii * np.sin(angle)]))
    return [outline] if outline.is_valid and outline.area > 1.0 else []


@settings(max_examples=150, deadline=None)
@given(st.one_of(town_blocks(), simple_polygons()), st.sampled_from(["hipped", "pitched"]), st.sampled_from([0.0, 0.3, EAVES_M]))
def test_any_outline_gets_a_closed_roof(polygons, form, eaves_m):
    for outline in polygons:
        result = build(outline, form, eaves_m)
        assert result.block is not None, outline.wkt
        body = body_of(outline, form, eaves_m)
        assert body.is_closed, outline.wkt
        top = body.vertices_m[:, 2].max()
        assert HEIGHT_M - 1e-6 <= top <= HEIGHT_M + (0.3 if form == "pitched" and eaves_m else 1e-6)
        normal = double_area_vectors(body)
        covered = 0.5 * normal[slope_triangles(body), 2].sum()
        if result.lacks_eaves or not eaves_m:
            assert covered == pytest.approx(outline.area, rel=1e-6)
            assert body.volume_m3 > outline.area * HEIGHT_M * (1.0 - MAX_RISE_SHARE)
        else:
            assert covered > outline.area
        if form == "hipped" and not eaves_m and result.block.point_weights.shape[1] > 4:
            cosine = normal[slope_triangles(body), 2] / np.linalg.norm(normal[slope_triangles(body)], axis=1)
            area = 0.5 * np.linalg.norm(normal[slope_triangles(body)], axis=1)
            assert np.average(np.abs(cosine - np.average(cosine, weights=area)), weights=area) < 5e-3  # one slope


def make_scene(folder, outlines, height_m=HEIGHT_M, **mesh: object) -> Scene:
    """Return a scene of buildings on flat ground of 200 m, with views of the corner of the first one."""
    write_geotiff(folder / "floor.tif", np.zeros((50, 50), np.float32), ENGINEERING, -100.0, 100.0, 4.0)
    pyogrio.raw.write(
        folder / "houses.gpkg", shapely.to_wkb(np.array(outlines, object)), [np.full(len(outlines), float(height_m))], ["height"],
        geometry_type="Polygon", crs=ENGINEERING,
    )  # fmt: skip
    eye = partial(dict, kind="perspective", size=[200, 160])
    level = {
        "version": 1, "terrain": {"source": "floor.tif"}, "sun": {"azimuth": 150, "altitude": 9},
        "meshes": [{"source": "houses.gpkg", "height": "height", **mesh}],
        "views": {
            "valley": eye(eye=[26, 22, 16], target=[5, 5, 4], fov=40), "street": eye(eye=[16, -14, 2], target=[6, 2, 4], fov=60),
            "map": {"kind": "map", "bounds": [-1.0, -1.0, 13.0, 13.0], "size": [160, 160]},
        },
    }  # fmt: skip
    (folder / "level.yaml").write_text(json.dumps(level))
    return build_scene(load_level(folder / "level.yaml"))


@pytest.mark.parametrize("mesh", [{"roof": "hipped"}, {"roof": "pitched", "eaves_m": EAVES_M}], ids=["hipped", "eaves"])
def test_shadows_in_the_valley_and_below_eaves_equal_truth(tmp_path, mesh):
    scene = make_scene(tmp_path, [L_SHAPE], **mesh)
    algorithms_by_view = {"valley": ("shadow_map", "shadow_volume", "hybrid"), "map": ("shadow_map",)}
    if "eaves_m" in mesh:
        algorithms_by_view["street"] = ("shadow_map", "shadow_volume")
    for name, algorithms in algorithms_by_view.items():
        view = scene.view(name)
        buffer = geometry_buffer(scene, view)
        casters = find_casters(scene, buffer)
        truth = trace_truth(buffer, scene, casters)
        checked = truth.decidable & ~truth.attached_shadow_mask
        shadow_on_house = checked & ~truth.lit & (buffer.surface_kind == MESHES)
        assert np.count_nonzero(shadow_on_house) > 60
        for algorithm in algorithms:
            plan = make_plan(describe(scene, view, pixel_sampling="points"), scene.loaded.level, {"algorithm": algorithm})
            visibility = fill_steps(plan.steps_of_light("sun"), buffer, scene, casters, plan.effect_names, PassLog())
            is_wrong = (visibility < 0.5) == truth.lit
            assert is_wrong[checked].mean() <= MAX_WRONG_SHARES[algorithm], (name, algorithm)


def test_a_failing_library_gives_one_warning_and_flat_roofs(tmp_path, monkeypatch):
    def fail(*args: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(py_straight_skeleton.algorithm.StraightSkeletonAlgorithm, "compute_skeleton", fail)
    others = [affinity.translate(L_SHAPE, 20, 0), shapely.box(0, 20, 10, 28)]
    placement = make_scene(tmp_path, [L_SHAPE, *others], roof="hipped").objects.placement
    assert placement is not None
    (warning,) = placement.warnings
    assert "footprints with flat roofs in place of sloped ones: 2 (" in warning
    flat, _, house = (placed.body for placed in placement.visible_bodies)
    assert flat.is_closed and flat.volume_m3 == pytest.approx(L_SHAPE.area * (HEIGHT_M + 0.5)) and len(house.triangles) > 12


def test_a_file_has_a_bound_on_its_skeletons(tmp_path, monkeypatch):
    """Three outlines of six corners are 108 squared corners; the rectangle needs no skeleton."""
    monkeypatch.setattr(extrusion, "MAX_SKELETON_WORK", 100)
    outlines = [L_SHAPE, affinity.translate(L_SHAPE, 20, 0), affinity.translate(L_SHAPE, 40, 0), shapely.box(0, 20, 10, 28)]
    placement = make_scene(tmp_path, outlines, roof="hipped", eaves_m=0.5).objects.placement
    assert placement is not None
    (warning,) = placement.warnings
    assert "flat roofs in place of sloped ones: 1 (" in warning and "beyond 100 squared corners of a file" in warning
    flat_m3 = L_SHAPE.area * (HEIGHT_M + 0.5)
    is_flat = [placed.body.volume_m3 == pytest.approx(flat_m3) for placed in placement.visible_bodies]
    assert is_flat == [False, False, True, False]


def test_the_library_cannot_run_without_end(monkeypatch):
    monkeypatch.setattr(skeleton_roofs, "MAX_STEPS_PER_CORNER", 0.5)
    assert build(L_SHAPE, "hipped").lacks_roof


def test_round_outlines_have_a_bound_on_their_corners():
    for corners, lacks_roof in ((100, False), (101, True)):
        assert build(regular_polygon(corners), "hipped").lacks_roof == lacks_roof
    cone = body_of(shapely.Point(0, 0).buffer(10.0, quad_segs=8), "hipped")
    assert cone.is_closed and np.count_nonzero(cone.vertices_m[:, 2] > HEIGHT_M - 1e-6) == 1


def test_auto_keeps_flat_roofs_over_other_outlines():
    assert build(L_SHAPE, "auto", EAVES_M) == SlopedBlockResult(None)
    assert build(L_SHAPE, "flat") == SlopedBlockResult(None)
    house = build(shapely.box(0, 0, 12, 8), "auto", EAVES_M).block
    assert house is not None and house.point_drops_m.max() > house.wall_drop_m


def test_facades_have_walls_below_the_eaves(tmp_path):
    outline = affinity.scale(L_SHAPE, 2, 2, origin=(0, 0))
    scene = make_scene(tmp_path, [outline], roof="pitched", eaves_m=EAVES_M)
    facades, placement = scene.objects.facades, scene.objects.placement
    assert facades is not None and placement is not None
    (body,) = placement.visible_bodies
    assert facades.layout[:6, LENGTH] == pytest.approx([24.0, 8.0, 16.0, 12.0, 8.0, 20.0])
    wall_m = HEIGHT_M - ROOF_SLOPE * WING_M - EAVES_THICKNESS_M
    assert facades.layout[:6, TOP] == pytest.approx(wall_m, abs=1e-4)
    assert body.footprint is not None and body.footprint.eaves_m == pytest.approx(wall_m)
    is_gable = facades.layout[:6, GABLE_HALF_WIDTH] > 0.0
    assert is_gable.tolist() == [False, True, False, False, True, False]


def test_threads_get_the_same_roofs():
    """The library's counters are shared by threads, which take turns after each few instructions here."""
    outlines = [affinity.rotate(L_SHAPE, 11.0 * turn) for turn in range(40)]
    expected = [body_of(outline, "hipped").vertices_m for outline in outlines]
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as executor:
            found = list(executor.map(lambda outline: body_of(outline, "hipped").vertices_m, outlines))
    finally:
        sys.setswitchinterval(interval_s)
    for vertices, others in zip(expected, found, strict=True):
        np.testing.assert_array_equal(vertices, others)


def regular_polygon(corners: int, radius_m: float = 10.0) -> shapely.Polygon:
    """Return a regular polygon around the origin."""
    angle = 2.0 * np.pi * np.arange(corners) / corners
    return shapely.Polygon(np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle)]))


@pytest.mark.parametrize("eaves_m", [0.0, EAVES_M])
def test_low_roofs_are_sharp_where_walls_are(eaves_m):
    """Planes of 14 degrees meet at a smaller angle than the smoothed facets of round walls."""
    hall = affinity.scale(L_SHAPE, 5, 5, origin=(0, 0))
    for outline, is_sharp in ((hall, True), (regular_polygon(8), True), (regular_polygon(24), False)):
        body = body_of(outline, "hipped", eaves_m, height_m=5.0)
        normal = double_area_vectors(body)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        deviation = np.abs(body.corner_normals() - normal[:, None]).max(axis=(1, 2))
        is_slope = slope_triangles(body)
        is_wall = (np.abs(normal[:, 2]) < 1e-9) & (body.albedo[:, 0] < 0.5)
        for part in (is_slope, is_wall):
            assert (deviation[part] < 1e-5).all() == is_sharp and (deviation[part] > 1e-3).all() != is_sharp


def test_eaves_do_not_count_to_the_area_of_a_shed(tmp_path):
    for eaves_m in (0.0, EAVES_M):
        scene = make_scene(tmp_path, [shapely.box(0, 0, 13, 3)], 4.0, roof="pitched", eaves_m=eaves_m)
        assert scene.objects.facades is not None
        assert scene.objects.facades.layout[:4, BAY_COUNT].max() <= 1.0


def test_courses_of_tiles_begin_at_the_eaves_on_all_triangles(tmp_path):
    """The bar's long side has a plane with five corners below the higher roof of the stem, so that a triangle misses the eaves."""
    bar_and_stem = shapely.Polygon([(0, 0), (24, 0), (24, 4), (16, 4), (16, 16), (8, 16), (8, 4), (0, 4)])
    for eaves_m in (0.0, EAVES_M):
        scene = make_scene(tmp_path, [bar_and_stem], 9.0, roof="hipped", eaves_m=eaves_m, color=[0.6, 0.3, 0.2])
        facades, placement = scene.objects.facades, scene.objects.placement
        assert facades is not None and placement is not None
        body = placement.visible_bodies[0].body
        rise, edge = ROOF_SLOPE * 4.0, ROOF_SLOPE * eaves_m
        is_slope = slope_triangles(body)
        lowest = body.vertices_m[body.triangles[is_slope]][..., 2].min(axis=1)
        assert lowest.max() > lowest.min() + 0.5
        assert facades.origin_earth_m[facades.kind == TILES][:, 2] == pytest.approx(9.0 - rise - edge, abs=1e-6)


def test_eaves_need_a_sloped_roof_and_footprints(tmp_path):
    with pytest.raises(LevelError, match="eaves_m together with roof: auto, pitched or hipped"):
        make_scene(tmp_path, [L_SHAPE], eaves_m=0.4)
    with pytest.raises(LevelError, match=r"eaves_m: .*2\.5"):
        make_scene(tmp_path, [L_SHAPE], roof="hipped", eaves_m=2.5)
    level = {
        "version": 1, "terrain": {"flat": {"size": [200, 100], "cells": [20, 10]}},
        "meshes": [{"generate": "boxgrid", "eaves_m": 0.5, "roof": "auto"}],
    }  # fmt: skip
    (tmp_path / "level.yaml").write_text(json.dumps(level))
    with pytest.raises(LevelError, match="applies to footprints only"):
        assert build_scene(load_level(tmp_path / "level.yaml")).objects.placement


def test_a_thousand_l_shapes_take_seconds():
    """Skeletons take 1.5 ms, twice that with meshes and eaves."""
    start = time.process_time()
    for turn in range(100):
        assert build(affinity.rotate(L_SHAPE, 3.3 * turn), "pitched", EAVES_M).block is not None
    assert time.process_time() - start < 1.5
