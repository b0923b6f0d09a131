"""Bodies on a map's ground: buildings cover their outlines, and trees stand at their places, whichever part of a map is drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
import trimesh
from pyproj import Transformer

from skugga.shadows.render import render_frame
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, NO_SURFACE, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.scene import Scene
from skugga.terrain.trees.foliage import TREE_VARIANTS
from tests.rasters import ENGINEERING
from tests.render import plan_of

UTM = "EPSG:32633"
X0, Y0 = 450_000.0, 6_000_000.0


@pytest.fixture
def floor(write_raster) -> Path:
    """File of a raster of level ground."""
    return write_raster(np.full((41, 41), 5.0, np.float32), ENGINEERING, -205.0, 205.0, 10.0)


@pytest.fixture
def rolling(write_raster) -> Path:
    """File of a raster of smooth hills."""
    y, x = np.mgrid[0:61, 0:61] / 60.0
    heights = 200 + 12 * np.sin(8 * x + 3 * y) + 9 * np.cos(7 * y)
    return write_raster(heights.astype(np.float32), UTM, X0, Y0, 10.0)


def write_geopackage(path: Path, geometries: list, crs: str = UTM, **attributes) -> str:
    """Write a GeoPackage of geometries in a CRS and return its name for a level in the same folder."""
    fields = [np.asarray(values) for values in attributes.values()]
    pyogrio.raw.write(
        path, shapely.to_wkb(np.array(geometries, object)), fields, list(attributes), geometry_type="Unknown", crs=crs
    )
    return path.name


def pixel_centres(view) -> tuple[np.ndarray, np.ndarray]:
    """Return the map coordinates (rows, cols) of a view's pixel centres."""
    col, row = np.meshgrid(np.arange(view.cols), np.arange(view.rows))
    return view.grid.x(view.col0 + col * view.col_step), view.grid.y(view.row0 + row * view.row_step)


def buffer_and_coordinates(scene: Scene, bounds, size) -> tuple[GeometryBuffer, np.ndarray, np.ndarray]:
    """Return the visible points of a map, and the coordinates of its pixels' centres."""
    view = scene.view(bounds=bounds, size=size)
    return geometry_buffer(scene, view), *pixel_centres(view)


@pytest.mark.parametrize("turn", [0.0, 30.0, 45.0])
def test_a_box_covers_pixels_with_centres_in_its_outline(gl, floor, make_scene, tmp_path, turn):
    """The box is turned about its place, with corners between pixel centres. Rasterisers round its outline to 1/256 of a pixel."""
    trimesh.creation.box(extents=(20.3, 10.7, 8.0)).export(tmp_path / "box.obj")
    scene = make_scene(floor, meshes=[{"source": "box.obj", "at": [30.1, -20.2], "turn": turn}])
    buffer, x, y = buffer_and_coordinates(scene, (0, -60, 60, 0), (240, 240))
    outline = shapely.affinity.rotate(shapely.box(-10.15, -5.35, 10.15, 5.35), turn, origin=(0, 0))
    points = shapely.points(x - 30.1, y + 20.2)
    inside, outline_distance = shapely.contains(outline, points), shapely.distance(outline.exterior, points)
    is_decidable = outline_distance > 0.25 / 128
    assert is_decidable.mean() > 0.99 and 0.05 < inside.mean() < 0.1
    np.testing.assert_array_equal((buffer.surface_kind == MESHES)[is_decidable], inside[is_decidable])
    roof, ground = inside & is_decidable, ~inside & is_decidable
    np.testing.assert_allclose(buffer.height_m[roof], 13.0, atol=1e-5)
    np.testing.assert_allclose(buffer.height_m[ground], 5.0, atol=1e-5)
    assert (buffer.surface_kind[ground] == RELIEF).all()
    np.testing.assert_allclose(buffer.normal_frame[roof], np.tile([0, 0, 1], (roof.sum(), 1)), atol=1e-6)
    position = buffer.position_frame_m + buffer.frame.origin_earth_m
    np.testing.assert_allclose(
        position[is_decidable], np.stack([x, y, np.where(inside, 13.0, 5.0)], axis=-1)[is_decidable], atol=1e-3
    )
    np.testing.assert_array_equal(buffer.corners_frame_m[ground], 0.0)
    assert (buffer.corners_frame_m[roof] != 0.0).any(axis=1).all()
    assert np.isnan(buffer.albedo[ground]).all() and np.isfinite(buffer.albedo[roof]).all()


def test_a_building_on_the_globe_covers_its_footprint(gl, rolling, make_scene, tmp_path):
    """A footprint in a UTM zone keeps its outline, its roof's height, and its points on the globe."""
    outline = shapely.Polygon(np.array([(100, 120), (131, 127), (128, 150), (115, 146), (104, 149)]) + (X0, Y0 - 400))
    source = write_geopackage(tmp_path / "houses.gpkg", [outline], height=[9.0])
    scene = make_scene(rolling, meshes=[{"source": source, "height": "height"}])
    buffer, x, y = buffer_and_coordinates(scene, (X0 + 90, Y0 - 290, X0 + 140, Y0 - 240), (200, 200))
    points = shapely.points(x, y)
    inside = shapely.contains(outline, points)
    is_decidable = shapely.distance(outline.exterior, points) > 0.02
    np.testing.assert_array_equal((buffer.surface_kind == MESHES)[is_decidable], inside[is_decidable])
    roof = inside & is_decidable
    assert roof.sum() > 5000 and np.ptp(buffer.height_m[roof]) < 1e-3
    ground = scene.elevation.ground_m(*np.array(outline.exterior.coords).T)
    assert ground.min() + 8.9 < buffer.height_m[roof].mean() < ground.max() + 9.1
    earth = buffer.position_frame_m[roof] @ buffer.frame.frame_from_earth + buffer.frame.origin_earth_m
    map_points = np.stack(scene.world.map_position(scene.elevation.crs, earth), axis=-1)
    np.testing.assert_allclose(map_points, np.stack([x, y, buffer.height_m], axis=-1)[roof], atol=0.01)


def test_buried_bodies_are_hidden_and_the_highest_one_shows(gl, floor, make_scene, tmp_path):
    """A box wholly below the ground is not visible. Of two boxes that overlap, the taller one is."""
    trimesh.creation.box(extents=(40.0, 40.0, 3.0)).export(tmp_path / "low.obj")
    trimesh.creation.box(extents=(10.0, 10.0, 9.0)).export(tmp_path / "tower.obj")
    slab = trimesh.creation.box(extents=(20.0, 20.0, 1.0))
    slab.apply_translation((0, 0, -4.0))
    post = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    post.apply_translation((60, 0, -40.0))  # the lowest point of the model stands on the ground: the slab hangs above it
    (slab + post).export(tmp_path / "raised.obj")
    meshes = [{"source": "low.obj", "at": [0, 0]}, {"source": "tower.obj", "at": [5, 5]}]
    scene = make_scene(floor, meshes=meshes)
    buffer, x, y = buffer_and_coordinates(scene, (-40, -40, 40, 40), (160, 160))
    tower = (np.abs(x - 5) < 4.9) & (np.abs(y - 5) < 4.9)
    on_low_box = (np.abs(x) < 19.9) & (np.abs(y) < 19.9) & ~((np.abs(x - 5) < 5.1) & (np.abs(y - 5) < 5.1))
    np.testing.assert_allclose(buffer.height_m[tower], 14.0, atol=1e-5)
    np.testing.assert_allclose(buffer.height_m[on_low_box], 8.0, atol=1e-5)

    raised = make_scene(floor, meshes=[{"source": "raised.obj", "at": [0, 0]}])
    solids = raised.objects.solids
    lowered_solids = type(solids)(**{**vars(solids), "vertices_earth_m": solids.vertices_earth_m - [0.0, 0.0, 60.0]})
    raised.objects.__dict__["solids"] = lowered_solids
    buffer, _, _ = buffer_and_coordinates(raised, (-80, -80, 80, 80), (160, 160))
    assert (buffer.surface_kind == RELIEF).all() and (buffer.height_m == 5.0).all()


def test_a_building_over_nodata_is_visible(gl, write_raster, make_scene, tmp_path):
    """Where nodata lies under a part of a roof, the roof is valid and the rest is not."""
    heights = np.full((41, 41), 5.0, np.float32)
    heights[:, 20:] = -9999.0
    floor = write_raster(heights, ENGINEERING, -205.0, 205.0, 10.0, nodata=-9999.0)
    trimesh.creation.box(extents=(30.0, 30.0, 8.0)).export(tmp_path / "box.obj")
    scene = make_scene(floor, meshes=[{"source": "box.obj", "at": [-20, 0]}])
    buffer, x, y = buffer_and_coordinates(scene, (-60, -30, 30, 30), (180, 120))
    roof = (np.abs(x + 20) < 14.9) & (np.abs(y) < 14.9)
    assert buffer.valid[roof].all() and (buffer.surface_kind[roof] == MESHES).all()
    assert np.isfinite(buffer.position_frame_m[roof]).all()
    assert not buffer.valid[(x > 0) & ~roof].any() and (buffer.surface_kind[(x > 0) & ~roof] == NO_SURFACE).all()


@pytest.mark.parametrize("species", ["conifer", "broadleaf"])
def test_a_crown_lies_centred_at_its_tree_s_place(gl, rolling, make_scene, tmp_path, species):
    """Seen from above, the crown lies within its level quad and its upright edges, centred on its place.

    The height is that of the crown quad.
    """
    place = np.array([X0 + 303.3, Y0 - 296.1])
    source = write_geopackage(tmp_path / "tree.gpkg", [shapely.Point(*place)], height=[20.0], crown=[12.0])
    scene = make_scene(rolling, forest=[{"source": source, "height": "height", "crown": "crown", "species": species}])
    buffer, x, y = buffer_and_coordinates(scene, (place[0] - 16, place[1] - 16, place[0] + 16, place[1] + 16), (256, 256))
    tree = buffer.surface_kind == FOREST
    assert len(buffer.tree_instances) == 1 and tree.sum() > 300
    rotation_rad = np.radians(scene.objects.trees.yaw_deg[0])
    # The frame's axes are the anchor's east and north; the zone's grid is turned from them by its convergence there.
    east, north = x[tree] - place[0], y[tree] - place[1]
    convergence = -np.radians(_convergence_deg(*place))
    east, north = (
        east * np.cos(convergence) - north * np.sin(convergence), east * np.sin(convergence) + north * np.cos(convergence)
    )  # fmt: skip
    along_crown, across_crown = (
        east * np.cos(rotation_rad) + north * np.sin(rotation_rad),
        -east * np.sin(rotation_rad) + north * np.cos(rotation_rad),
    )
    assert max(np.abs(along_crown).max(), np.abs(across_crown).max()) <= 6.0 + 0.02
    assert max(np.abs(along_crown).max(), np.abs(across_crown).max()) > 4.5
    assert abs(along_crown.mean()) < 0.6 and abs(across_crown.mean()) < 0.6
    ground = float(scene.elevation.ground_m(*place))
    crown = 20.0 * TREE_VARIANTS[int(scene.objects.trees.variant[0])].crown_quad_height
    level = np.abs(buffer.height_m[tree] - ground - crown) < 0.01
    assert level.mean() > 0.9  # the rest are the upright quads, seen edge on
    np.testing.assert_allclose(buffer.normal_frame[tree][level][:, 2], 1.0, atol=1e-6)
    base_distance = np.linalg.norm(buffer.position_frame_m[tree] - buffer.tree_instances.base_frame_m, axis=-1)
    assert base_distance.max() < np.hypot(np.hypot(6, 6), 20.0) + 0.1
    assert np.isfinite(buffer.albedo[tree]).all() and buffer.albedo[tree][:, 1].mean() > buffer.albedo[tree][:, 2].mean()


def _convergence_deg(x: float, y: float) -> float:
    """Return the clockwise angle from true north to grid north at a place of the zone."""
    to = Transformer.from_crs("EPSG:4326", UTM, always_xy=True)
    lon, lat = to.transform(x, y, direction="INVERSE")
    further = to.transform(lon, lat + 1e-5)
    return -float(np.degrees(np.arctan2(further[0] - x, further[1] - y)))


def test_every_tree_of_a_wood_covers_pixels_around_its_foot(gl, rolling, make_scene, tmp_path):
    """Pixels without a tree near are those of the bare ground."""
    rng = np.random.default_rng(4)
    places = np.column_stack([X0 + rng.uniform(100, 500, 60), Y0 - rng.uniform(100, 500, 60)])
    source = write_geopackage(
        tmp_path / "trees.gpkg", [shapely.Point(*p) for p in places], height=np.full(60, 15.0), crown=np.full(60, 8.0)
    )
    scene = make_scene(rolling, forest=[{"source": source, "height": "height", "crown": "crown"}])
    bare_scene = make_scene(rolling)
    bounds, size = (X0 + 90, Y0 - 510, X0 + 510, Y0 - 90), (420, 420)
    buffer, x, y = buffer_and_coordinates(scene, bounds, size)
    bare_buffer, _, _ = buffer_and_coordinates(bare_scene, bounds, size)
    tree_distance = np.hypot(x[..., None] - places[:, 0], y[..., None] - places[:, 1])
    tree = buffer.surface_kind == FOREST
    assert len(buffer.tree_instances) == 60 and not tree[tree_distance.min(axis=-1) > np.hypot(4, 4) + 0.1].any()
    assert all((tree & (tree_distance[..., k] < 4.0)).sum() > 5 for k in range(60))
    np.testing.assert_array_equal(buffer.position_frame_m[~tree], bare_buffer.position_frame_m[~tree])
    assert (buffer.height_m >= bare_buffer.height_m).all()


def test_whole_pixel_shifts_leave_a_map_unchanged(gl, rolling, make_scene, tmp_path):
    """Pixels lie on nodes, so points, visibility and colours come from the same blocks, whatever the view's corner."""
    rng = np.random.default_rng(5)
    places = np.column_stack([X0 + rng.uniform(250, 500, 150), Y0 - rng.uniform(280, 500, 150)])
    trees = write_geopackage(tmp_path / "trees.gpkg", [shapely.Point(*p) for p in places], height=rng.uniform(8, 20, 150))
    outline = shapely.affinity.rotate(shapely.box(X0 + 350, Y0 - 390, X0 + 383, Y0 - 370), 20)
    houses = write_geopackage(tmp_path / "houses.gpkg", [outline], height=[15.0])
    scene = make_scene(
        rolling, 222.0, 25.0, forest=[{"source": trees, "height": "height"}], meshes=[{"source": houses, "height": "height"}]
    )

    def view(down: int, right: int):
        west, north = X0 + 310 + right, Y0 - 322 - down
        return scene.view(bounds=(west, north - 128, west + 128, north), size=(128, 128))

    plan = plan_of(scene, view(0, 0))
    assert view(0, 0).is_on_nodes
    full_frame = render_frame(scene, view(0, 0), plan)
    assert 0.1 < (full_frame.visibility < 0.5).mean() < 0.9 and np.ptp(full_frame.height_m) > 20
    for down, right in ((37, 23), (5, -64)):  # in the same block, and across the border of two
        part = render_frame(scene, view(down, right), plan)
        full_slices = slice(max(down, 0), 128 + min(down, 0)), slice(max(right, 0), 128 + min(right, 0))
        part_slices = tuple(slice(s.start - o, s.stop - o) for s, o in zip(full_slices, (down, right), strict=True))
        np.testing.assert_array_equal(part.height_m[part_slices], full_frame.height_m[full_slices])
        np.testing.assert_array_equal(part.visibility[part_slices], full_frame.visibility[full_slices])
        np.testing.assert_array_equal(part.color[part_slices], full_frame.color[full_slices])


def test_a_part_of_a_block_has_the_block_s_points(gl, rolling, make_scene, tmp_path):
    """In the frame of the whole view, heights and kinds of trees and meshes agree except at edges in float32."""
    rng = np.random.default_rng(6)
    places = np.column_stack([X0 + rng.uniform(150, 450, 100), Y0 - rng.uniform(150, 450, 100)])
    trees = write_geopackage(tmp_path / "trees.gpkg", [shapely.Point(*p) for p in places], height=rng.uniform(8, 20, 100))
    scene = make_scene(rolling, forest=[{"source": trees, "height": "height"}])
    view = scene.view(bounds=(X0 + 200, Y0 - 400, X0 + 400, Y0 - 200), size=(300, 300))
    full_buffer = geometry_buffer(scene, view)
    part = geometry_buffer(scene, view.part(31, 77, 128, 96), full_buffer.frame)
    overlap = slice(31, 159), slice(77, 173)
    is_other_kind = part.surface_kind != full_buffer.surface_kind[overlap]
    assert is_other_kind.mean() < 1e-3 and (full_buffer.surface_kind[overlap] == FOREST).mean() > 0.02
    is_same_point = ~is_other_kind & (np.abs(part.height_m - full_buffer.height_m[overlap]) < 1e-4)
    assert is_same_point.mean() > 0.998
