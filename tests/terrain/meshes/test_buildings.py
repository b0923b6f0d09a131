"""Buildings: bodies and their normals, extruded footprints, sources of heights, and rejected input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity

from skugga.terrain.errors import LevelError, SourceError
from skugga.terrain.level.level import load_level
from skugga.terrain.meshes.assemble import place_meshes, solids
from skugga.terrain.meshes.block_triangles import block_triangles, roof_triangles
from skugga.terrain.meshes.body import Body, box, srgb_albedo, transformed
from skugga.terrain.meshes.buildings import WALL_DEPTH_BELOW_GROUND_M
from skugga.terrain.scene import build_scene
from tests.rasters import ENGINEERING

UTM = "EPSG:32633"
SQUARE = shapely.box(500100, 5000100, 500120, 5000110)
COURTYARD = shapely.box(500140, 5000135, 500150, 5000145)
COURTYARD_BLOCK = shapely.box(500130, 5000130, 500160, 5000150).difference(COURTYARD)


def write_footprints(path: Path, geometry, crs: str = UTM, **attributes) -> Path:
    """Write geometries to a GeoPackage, and return its path."""
    geometry = np.atleast_1d(np.array(geometry, object))
    kinds = {g.geom_type for g in geometry}
    pyogrio.raw.write(
        path, shapely.to_wkb(geometry), [np.array(v) for v in attributes.values()], list(attributes), crs=crs,
        geometry_type=kinds.pop() if len(kinds) == 1 else "Unknown", driver="GPKG",
    )  # fmt: skip
    return path


def load_world(tmp_path: Path, terrain: dict, **mesh):
    """Return the loaded level, world and elevation of a level with one mesh entry."""
    path = tmp_path / "level.yaml"
    path.write_text(json.dumps({"version": 1, "terrain": terrain, "meshes": [mesh]}, default=str), encoding="utf-8")
    scene = build_scene(load_level(path))
    return scene.loaded, scene.world, scene.elevation


def place_footprints(tmp_path: Path, dem: Path, **mesh):
    """Return the bodies of the only mesh of a level over a raster, and the level's world and elevation."""
    loaded, world, elevation = load_world(tmp_path, {"source": str(dem)}, **mesh)
    return place_meshes(loaded, world, elevation).visible_bodies, world, elevation


def heights(body, world, elevation) -> np.ndarray:
    """Return the heights (n,) of a body's vertices in the raster's CRS."""
    return world.map_position(elevation.crs, body.origin_earth_m + body.body.vertices_m @ body.earth_from_body.T)[2]


@pytest.fixture
def level_ground(write_raster):
    """File of a raster of level ground at 50 m."""
    return write_raster(np.full((40, 40), 50.0, np.float32), UTM, 500000, 5000400, 10)


@pytest.fixture
def slope(write_raster):
    """Write a raster that rises 0.2 m per metre east."""
    return write_raster(np.tile(np.arange(40, dtype=np.float32) * 2.0, (40, 1)), UTM, 500000, 5000400, 10)


def test_srgb_albedo_is_linear():
    np.testing.assert_allclose(srgb_albedo((0.0, 1.0, 0.5)), [0.0, 1.0, 0.21404], atol=1e-5)
    assert srgb_albedo(0.04) == pytest.approx(0.04 / 12.92)


def test_box_is_closed_with_sharp_edges():
    body = box((2, 4, 6), (1, 2, 3))
    assert body.is_closed and body.volume_m3 == pytest.approx(48)
    assert body.vertices_m.min(axis=0) == pytest.approx([0, 0, 0])
    corners = body.vertices_m[body.triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    np.testing.assert_allclose(body.corner_normals(), np.repeat(face[:, None], 3, axis=1), atol=1e-6)


def test_cylinder_has_a_smooth_side_and_a_sharp_rim():
    cylinder = trimesh.creation.cylinder(2.0, 5.0, sections=24)
    body = Body(np.asarray(cylinder.vertices), np.asarray(cylinder.faces), np.ones(3))
    assert body.is_closed
    normal, corner = body.corner_normals(), body.vertices_m[body.triangles]
    side = np.abs(normal[..., 2]) < 0.5
    radial = corner[side] * (1, 1, 0) / 2.0
    np.testing.assert_allclose(normal[side], radial, atol=1e-6)
    assert np.abs(normal[~side][:, 2]).min() == pytest.approx(1.0)
    sharp = body.corner_normals(crease_deg=10.0)  # facets differ by 15 degrees
    np.testing.assert_allclose(sharp, np.repeat(sharp[:, :1], 3, axis=1), atol=1e-6)


def test_open_or_doubled_surface_is_not_closed():
    body = box((1, 1, 1))
    assert not Body(body.vertices_m, body.triangles[1:], body.albedo[1:]).is_closed
    flipped_triangles = np.vstack([body.triangles[:1, ::-1], body.triangles[1:]])
    assert not Body(body.vertices_m, flipped_triangles, body.albedo).is_closed
    doubled_surface = np.vstack([body.vertices_m] * 2), np.vstack([body.triangles, body.triangles + len(body.vertices_m)])
    assert not Body(*doubled_surface, np.ones(3)).is_closed
    assert not Body(np.empty((0, 3)), np.empty((0, 3)), np.ones(3)).is_closed


def test_coincident_vertices_are_merged():
    body = box((1, 1, 1))
    soup = Body(body.vertices_m[body.triangles].reshape(-1, 3), np.arange(36).reshape(-1, 3), body.albedo)
    assert soup.is_closed


def test_triangles_without_area_are_dropped():
    body = Body(np.eye(3), [[0, 1, 2], [0, 0, 1]], (0.5, 0.5, 0.5))
    assert len(body.triangles) == len(body.albedo) == 1


def test_transformed_scales_turns_and_shifts():
    body = transformed(Body([[1, 0, 0], [2, 0, 0], [1, 0, 1]], [[0, 1, 2]], (1, 1, 1)), (10, 20, 30), yaw_deg=90, scale=2)
    np.testing.assert_allclose(body.vertices_m, [[10, 22, 30], [10, 24, 30], [10, 22, 32]], atol=1e-12)


@st.composite
def town_blocks(draw):
    """Draw rotated right-angled outlines with courtyards and many collinear corners, as people digitize them."""
    cell = st.tuples(st.integers(0, 9), st.integers(0, 9), st.integers(1, 6), st.integers(1, 6))
    outline = shapely.union_all([shapely.box(x, y, x + w, y + h) for x, y, w, h in draw(st.lists(cell, min_size=1, max_size=6))])
    cut = shapely.union_all([shapely.box(x, y, x + 1, y + 1) for x, y, _, _ in draw(st.lists(cell, max_size=4))])
    turned = affinity.rotate(outline.difference(cut), draw(st.sampled_from([0.0, 17.3, 45.0])), origin=(0, 0))
    parts = [part for part in shapely.get_parts(turned) if part.area > 0.5]

    # Rings that touch themselves or each other share a corner, so that the block is not a manifold.
    def corners(part):
        return np.concatenate([np.array(ring.coords)[:-1] for ring in (part.exterior, *part.interiors)])

    parts = [part for part in parts if len(np.unique(corners(part).round(6), axis=0)) == len(corners(part))]
    return [shapely.orient_polygons(shapely.simplify(shapely.normalize(part), 1e-6)) for part in parts]


@settings(max_examples=200, deadline=None)
@given(town_blocks())
def test_block_is_closed_and_has_the_roof_of_its_footprint(polygons):
    for polygon in polygons:
        rings = [np.array(ring.coords)[:-1] for ring in (polygon.exterior, *polygon.interiors)]
        xy, ends = np.concatenate(rings), np.cumsum([len(ring) for ring in rings])
        roof = roof_triangles(xy - xy[0], ends)
        a, b, c = np.moveaxis(xy[roof], 1, 0)
        area = ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])) / 2
        assert (area > 0).all() and area.sum() == pytest.approx(polygon.area)
        triangles, is_roof = block_triangles(roof, ends)
        vertices = np.concatenate([np.insert(xy, 2, height, axis=1) for height in (7.0, 0.0)])
        body = Body(vertices, triangles, (0.5, 0.5, 0.5))
        assert body.is_closed, polygon.wkt
        assert body.volume_m3 == pytest.approx(7.0 * polygon.area)
        assert is_roof.sum() == len(roof)


def test_building_stands_on_level_ground(tmp_path, level_ground):
    source = write_footprints(tmp_path / "b.gpkg", [SQUARE, COURTYARD_BLOCK], height_m=[8.0, 12.0])
    bodies, world, elevation = place_footprints(tmp_path, level_ground, source=source)
    assert len(bodies) == 2
    for body, footprint, height_m in zip(bodies, (SQUARE, COURTYARD_BLOCK), (8.0, 12.0), strict=True):
        assert body.body.is_closed
        # The UTM scale here is 0.9996: areas on the ground are larger by its inverse square.
        assert body.body.volume_m3 == pytest.approx(footprint.area / 0.9996**2 * (height_m + WALL_DEPTH_BELOW_GROUND_M), rel=1e-4)
        up = heights(body, world, elevation)
        assert up.max() == pytest.approx(50 + height_m, abs=1e-3) and up.min() == pytest.approx(
            50 - WALL_DEPTH_BELOW_GROUND_M, abs=1e-3
        )


def test_building_on_a_slope_stands_on_its_mean_ground(tmp_path, slope):
    source = write_footprints(tmp_path / "b.gpkg", [SQUARE])
    (body,), world, elevation = place_footprints(tmp_path, slope, source=source, height=8.0)
    west, east = (elevation.ground_m(np.float64(x), np.float64(5000105)) for x in (500100, 500120))
    up = heights(body, world, elevation)
    assert body.body.is_closed and body.body.volume_m3 > 0
    assert east - west == pytest.approx(4.0)
    assert up.max() == pytest.approx((west + east) / 2 + 8.0, abs=1e-3)
    assert up.min() == pytest.approx(west - WALL_DEPTH_BELOW_GROUND_M, abs=1e-3)


def test_redundant_corners_and_orientation_do_not_matter(tmp_path, level_ground):
    ring = np.array(shapely.segmentize(SQUARE, 2.5).exterior.coords)
    redundant_outline = shapely.Polygon(np.repeat(ring[::-1], 2, axis=0))
    source = write_footprints(tmp_path / "b.gpkg", [SQUARE, redundant_outline])
    (body, redundant_body), *_ = place_footprints(tmp_path, level_ground, source=source, height=8.0)
    assert len(body.body.triangles) == len(redundant_body.body.triangles) == 12
    assert redundant_body.body.is_closed and redundant_body.body.volume_m3 == pytest.approx(body.body.volume_m3)


def test_multipolygons_and_self_intersections_are_handled(tmp_path, level_ground):
    bow_tie = shapely.Polygon([(500100, 5000100), (500120, 5000120), (500120, 5000100), (500100, 5000120)])
    multipolygon = shapely.MultiPolygon([SQUARE, COURTYARD_BLOCK])
    source = write_footprints(tmp_path / "b.gpkg", [multipolygon], height=[5])
    bodies, *_ = place_footprints(tmp_path, level_ground, source=source)
    assert [body.body.is_closed for body in bodies] == [True, True]
    source = write_footprints(tmp_path / "c.gpkg", [bow_tie], height=[5])
    bodies, *_ = place_footprints(tmp_path, level_ground, source=source)
    assert sum(b.body.volume_m3 for b in bodies) == pytest.approx(200 / 0.9996**2 * 5.5, rel=1e-3)


def test_colours_depend_on_the_building(tmp_path, level_ground):
    row = [affinity.translate(SQUARE, 0, 12 * k) for k in range(12)]
    source = write_footprints(tmp_path / "b.gpkg", row)
    first, *_ = place_footprints(tmp_path, level_ground, source=source, height=8)
    source = write_footprints(tmp_path / "c.gpkg", row[::-1])
    other, *_ = place_footprints(tmp_path, level_ground, source=source, height=8)
    for a, b in zip(first, other[::-1], strict=True):
        np.testing.assert_array_equal(a.body.albedo, b.body.albedo)
    assert len({tuple(body.body.albedo[0]) for body in first}) > 6
    assert all(0.02 < body.body.albedo.min() < body.body.albedo.max() < 0.75 for body in first)
    red_bodies, *_ = place_footprints(tmp_path, level_ground, source=source, height=8, color=[1, 0, 0])
    assert (red_bodies[0].body.albedo == (1, 0, 0)).all()


def test_footprints_without_a_positive_height_are_omitted(tmp_path, level_ground):
    row = [affinity.translate(SQUARE, 0, 20 * k) for k in range(4)]
    source = write_footprints(tmp_path / "b.gpkg", row, tall=[np.nan, 0.0, -3.0, 6.0])
    bodies, *_ = place_footprints(tmp_path, level_ground, source=source, height="tall")
    assert len(bodies) == 1


def test_footprints_mostly_off_the_terrain_are_omitted(tmp_path, write_raster):
    ground = write_raster(np.full((80, 80), 50.0, np.float32), UTM, 500000, 5000400, 5)
    shifts = (0, -107, -113, -130, 5000)  # inside, by 13 m of 20 m, by 7 m, and outside
    source = write_footprints(tmp_path / "b.gpkg", [affinity.translate(SQUARE, dx, 0) for dx in shifts])
    bodies, world, elevation = place_footprints(tmp_path, ground, source=source, height=4)
    assert len(bodies) == 2
    assert all(heights(body, world, elevation).max() == pytest.approx(54.0, abs=1e-3) for body in bodies)


def test_hole_in_the_ground_under_a_building_is_filled(tmp_path, write_raster):
    values = np.full((80, 80), 50.0, np.float32)
    values[50:70, 15:30] = np.nan  # SQUARE and its surroundings
    ground = write_raster(values, UTM, 500000, 5000400, 5)
    bodies, world, elevation = place_footprints(tmp_path, ground, source=write_footprints(tmp_path / "b.gpkg", [SQUARE]), height=4)
    assert heights(bodies[0], world, elevation).max() == pytest.approx(54.0, abs=1e-3)


def test_heights_from_surface_and_ground_in_other_units(tmp_path, level_ground, write_raster):
    x, y = np.meshgrid(500000.5 + np.arange(400), 5000399.5 - np.arange(400))
    roofed = shapely.contains_xy(SQUARE, x, y) | shapely.contains_xy(COURTYARD_BLOCK, x, y)
    top = np.where(roofed, 60.0, 50.0)
    # A chimney on less than a tenth of the roof
    top[shapely.contains_xy(shapely.box(500109, 5000104, 500111, 5000105), x, y)] = 75.0
    surface = write_raster((top / 0.3048).astype(np.float32), UTM, 500000, 5000400, 1, name="dsm.tif")
    with rasterio.open(surface, "r+") as dataset:
        dataset.units = ("ft",)
    west, north = 14.999, 45.157
    ground = write_raster(np.full((200, 200), 50.0, np.float32), "EPSG:4326", west, north, 5e-5, name="dtm.tif")
    shed = shapely.box(500140.2, 5000137.2, 500140.6, 5000137.6)  # smaller than a cell, in the yard
    source = write_footprints(tmp_path / "b.gpkg", [SQUARE, COURTYARD_BLOCK, shed])
    bodies, world, elevation = place_footprints(tmp_path, level_ground, source=source, surface=str(surface), ground=str(ground))
    assert len(bodies) == 2  # the shed has no height above the ground
    for body in bodies:
        assert heights(body, world, elevation).max() == pytest.approx(60.0, abs=0.02)


@pytest.fixture
def terraced(write_raster):
    """Write 1 m cells: ground that rises 0.2 m per metre east, and a level roof at 31 m over the footprint's downhill half."""
    x, y = np.meshgrid(500000.5 + np.arange(400), 5000399.5 - np.arange(400))
    ground = 0.2 * (x - 500000.5)
    surface = np.where(shapely.contains_xy(SQUARE, x, y) & (x < 500113), 31.0, ground)
    return {
        name: str(write_raster(values.astype(np.float32), UTM, 500000, 5000400, 1, name=f"{name}.tif"))
        for name, values in (("ground", ground), ("surface", surface))
    }


def test_measured_roof_on_a_slope_equals_the_surface(tmp_path, terraced, slope):
    """The roof is 10 m above the ground downhill and less uphill. A height above each cell's own ground would lift it."""
    source = write_footprints(tmp_path / "b.gpkg", [SQUARE])
    (body,), world, elevation = place_footprints(tmp_path, terraced["ground"], source=source, **terraced)
    assert heights(body, world, elevation).max() == pytest.approx(31.0, abs=0.01)
    # Over other ground, the roof keeps its height above the mean: 31 m - 0.2 * (110 m - 0.5 m). This ground is 0.9 m lower.
    (body,), world, elevation = place_footprints(tmp_path, slope, source=source, **terraced)
    assert heights(body, world, elevation).max() == pytest.approx(31.0 - 0.9, abs=0.01)


def test_slabs_and_mostly_uncovered_footprints_are_omitted(tmp_path, level_ground, write_raster):
    row = [affinity.translate(SQUARE, 30 * k, 0) for k in range(4)]  # 500100 ... 500210
    x, y = np.meshgrid(500000.5 + np.arange(198), 5000399.5 - np.arange(400))
    top = np.full(x.shape, 50.0)
    for footprint, height in zip(row, (8.0, 1.4, 1.6, 8.0), strict=True):
        top[shapely.contains_xy(footprint, x, y)] += height
    # Ends within the last footprint, at 500198
    surface = write_raster(top.astype(np.float32), UTM, 500000, 5000400, 1, name="dsm.tif")
    source = write_footprints(tmp_path / "b.gpkg", row, low=[1.0] * 4)
    bodies, world, elevation = place_footprints(
        tmp_path, level_ground, source=source, surface=str(surface), ground=str(level_ground)
    )
    assert [heights(body, world, elevation).max() for body in bodies] == pytest.approx([58.0, 51.6], abs=0.01)
    assert len(place_footprints(tmp_path, level_ground, source=source, height="low")[0]) == 4, "a stated height is taken as it is"


def test_real_footprints_get_heights_from_real_rasters(tmp_path, shared_data):
    folder = shared_data / "urban" / "goteborg_1m"
    bodies, world, elevation = place_footprints(
        tmp_path, folder / "DEM.tif", source=folder / "buildings.shp", surface=folder / "DSM.tif", ground=folder / "DEM.tif"
    )
    assert 20 < len(bodies) < 137
    assert all(body.body.is_closed and body.body.volume_m3 > 0 for body in bodies)
    spans = [np.ptp(heights(body, world, elevation)) for body in bodies]
    assert 10 < np.median(spans) < 25 and max(spans) < 60


def test_building_in_a_flat_world(tmp_path):
    source = write_footprints(tmp_path / "b.gpkg", [shapely.box(-10, -5, 10, 5)], crs=ENGINEERING, height=[6.0])
    loaded, world, elevation = load_world(tmp_path, {"flat": {"size": [200, 100], "cells": [20, 10]}}, source=source)
    vertices = solids(place_meshes(loaded, world, elevation), 0.0).vertices_earth_m
    np.testing.assert_allclose(vertices.min(axis=0), [-10, -5, -WALL_DEPTH_BELOW_GROUND_M], atol=1e-9)
    np.testing.assert_allclose(vertices.max(axis=0), [10, 5, 6], atol=1e-9)


@pytest.mark.parametrize(
    "mesh, kind, expected_text",
    [
        ({"height": "storeys"}, SourceError, ["b.gpkg", "no attribute 'storeys'", "tall, name"]),
        ({}, LevelError, ["meshes.0.height: missing", "b.gpkg (tall, name)", "surface and ground"]),
        ({"height": "name"}, SourceError, ["b.gpkg", "name = tower"]),
        ({"height": "tall"}, SourceError, ["b.gpkg", "1500 m at feature 2 of 2", "the limit of 1000 m"]),
        ({"height": "low"}, SourceError, ["no attribute 'low'"]),
        (
            {"height": 5, "surface": "dem.tif", "ground": "dem.tif"},
            LevelError,
            ["meshes.0.height", "cannot be combined with surface and ground. Use either height, or surface"],
        ),
        ({"height": 5, "at": [15, 45]}, LevelError, ["meshes.0.at", "footprints"]),
        ({"height": 5, "motion": {"spin": 3}}, LevelError, ["meshes.0.motion", "footprints"]),
        ({"surface": "dem.tif", "ground": "dem.tif"}, SourceError, ["b.gpkg", "no footprint with 1.5 m of", "dem.tif above"]),
        ({"surface": "none.tif", "ground": "dem.tif"}, SourceError, ["none.tif"]),
    ],
)
def test_building_error_names_the_key_in_one_line(tmp_path, level_ground, mesh, kind, expected_text):
    source = write_footprints(tmp_path / "b.gpkg", [SQUARE, COURTYARD_BLOCK], tall=[3.0, 1500.0], name=["tower", "yard"])
    with pytest.raises(kind) as caught:
        place_footprints(tmp_path, level_ground, source=source, **mesh)
    assert all(part in str(caught.value) for part in expected_text), str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "geometry, expected_text",
    [
        (shapely.Point(500100, 5000100), ["Point geometries", "Use polygons, or a model"]),
        (affinity.translate(SQUARE, 50000, 0), ["footprints within 15.6", "on the terrain: within 15.0"]),
    ],
)
def test_invalid_geometry_is_rejected(tmp_path, level_ground, geometry, expected_text):
    source = write_footprints(tmp_path / "b.gpkg", [geometry])
    with pytest.raises(SourceError) as caught:
        place_footprints(tmp_path, level_ground, source=source, height=5)
    assert all(part in str(caught.value) for part in expected_text), str(caught.value)


def test_no_usable_height_is_a_single_error(tmp_path, level_ground):
    source = write_footprints(tmp_path / "b.gpkg", [SQUARE], tall=[0.0])
    with pytest.raises(SourceError, match="no footprint with a height above 0 in the attribute 'tall'"):
        place_footprints(tmp_path, level_ground, source=source, height="tall")
    with pytest.raises(SourceError, match="no such file"):
        place_footprints(tmp_path, level_ground, source=tmp_path / "none.gpkg", height=3)
