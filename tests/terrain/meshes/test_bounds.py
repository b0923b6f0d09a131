"""Limits on input files: process large input in bounded time, and reject excessive input with a one-line error."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest
import rasterio
import shapely
import trimesh
from affine import Affine
from PIL import Image
from pyproj import CRS

from skugga.terrain.errors import SourceError
from skugga.terrain.geo import vectors
from skugga.terrain.geo.vectors import read_features
from skugga.terrain.ground import overview as overview_module
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.imagery import Imagery
from skugga.terrain.meshes import block_triangles, buildings, models
from skugga.terrain.meshes import body as body_module
from skugga.terrain.meshes.body import Body
from skugga.terrain.meshes.models import read_model
from skugga.terrain.trees.canopy import Canopy

UTM = "EPSG:32633"


def square_with_courtyards(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (n, 2) and ring ends of a square with ``side`` x ``side`` square courtyards in rows and columns."""
    size = 4 * side + 4
    rings = [[(0, 0), (size, 0), (size, size), (0, size)]]
    for i in range(side):
        for j in range(side):
            x, y = 4 * i + 3, 4 * j + 3
            rings.append([(x, y), (x, y + 2), (x + 2, y + 2), (x + 2, y)])
    return np.concatenate(rings).astype(float), np.cumsum([len(ring) for ring in rings])


@pytest.mark.parametrize("side", [1, 3, 25])
def test_roof_around_rows_of_courtyards_has_no_gap(side):
    xy, ends = square_with_courtyards(side)
    roof = block_triangles.roof_triangles(xy, ends)
    assert len(roof) == len(xy) + 2 * (len(ends) - 1) - 2
    a, b, c = np.moveaxis(xy[roof], 1, 0)
    double_area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (double_area > 0).all() and double_area.sum() / 2 == pytest.approx((4 * side + 4) ** 2 - 4 * side**2)
    edges = {edge for i, j, k in roof.tolist() for edge in ((i, j), (j, k), (k, i))}
    assert len(edges) == 3 * len(roof)
    ring_edges = set(enumerate(block_triangles.next_corners(ends).tolist()))
    assert {edge for edge in edges if edge[::-1] not in edges} == ring_edges


def test_centre_of_a_large_fan_is_shaded_flat(monkeypatch):
    angle = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    rim = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(8)])
    tip = Body(np.vstack([[0.0, 0.0, 0.2], rim]), [(0, 1 + k, 1 + (k + 1) % 8) for k in range(8)], (0.5, 0.5, 0.5))
    a, b, c = np.moveaxis(tip.vertices_m[tip.triangles], 1, 0)
    face_normals = np.cross(b - a, c - a)
    face_normals /= np.linalg.norm(face_normals, axis=1, keepdims=True)
    np.testing.assert_allclose(tip.corner_normals()[:, 0], [[0.0, 0.0, 1.0]] * 8, atol=1e-6)
    monkeypatch.setattr(body_module, "MAX_SMOOTHED_CORNERS", 7)
    centre_normals = Body(tip.vertices_m, tip.triangles, tip.albedo).corner_normals()
    np.testing.assert_allclose(centre_normals[:, 0], face_normals, atol=1e-6)
    np.testing.assert_allclose(centre_normals[:, 1:], tip.corner_normals()[:, 1:], atol=1e-6)  # fewer faces meet at the rim


def test_many_equal_faces_take_no_pairs(tmp_path):
    """There are 300,000 coincident faces: comparing all pairs would take 9e10 steps at each corner."""
    body = Body([(0, 0, 0), (1, 0, 0), (0, 1, 1)], np.tile([0, 1, 2], (300_000, 1)), (0.5, 0.5, 0.5))
    np.testing.assert_allclose(body.corner_normals()[[0, -1], 0], [[0.0, -(0.5**0.5), 0.5**0.5]] * 2, atol=1e-6)


def test_duplicate_faces_are_merged(tmp_path):
    path = tmp_path / "a.obj"
    faces = ["f 1 2 3\n", "f 2 3 1\n"] * 300 + ["f 3 2 1\n", "f 1 2 4\n"]
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 1\nv 0 0 1\n" + "".join(faces))
    assert read_model(str(path)).triangles.tolist() == [[0, 1, 2], [2, 1, 0], [0, 1, 3]]


@pytest.fixture
def geojson(tmp_path):
    """A function that writes geometries as a GeoJSON file and returns its path."""

    def write(*geometries: shapely.Geometry, crs: str = "EPSG::32633"):
        features = [
            {"type": "Feature", "properties": {}, "geometry": shapely.geometry.mapping(geometry)} for geometry in geometries
        ]
        name = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:{crs}"}}
        path = tmp_path / "a.geojson"
        path.write_text(json.dumps({"type": "FeatureCollection", "crs": name, "features": features}))
        return str(path)

    return write


def test_slightly_self_intersecting_outline_is_repaired(geojson):
    bow_tie = shapely.Polygon([(0, 0), (10, 10), (10, 0), (0, 10)])
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    star = shapely.Polygon(np.column_stack([np.cos(7 * angle), np.sin(7 * angle)]) + 50.0)
    features = read_features(geojson(bow_tie, star), CRS.from_user_input(UTM))
    assert shapely.is_valid(features.geometry).all()
    assert shapely.area(features.geometry[0]) == pytest.approx(50.0)
    assert 2.5 < shapely.area(features.geometry[1]) < np.pi


def test_outline_with_too_many_crossings_is_rejected(geojson):
    """A repair would take minutes: half a million pairs of the edges of 1,500 random corners cross."""
    scribble = shapely.Polygon(np.random.default_rng(1).uniform(0, 500, (1500, 2)))
    with pytest.raises(SourceError, match=f"cross themselves more than {vectors.MAX_CROSSINGS} times"):
        read_features(geojson(scribble), CRS.from_user_input(UTM))


def test_outlines_that_circle_the_earth_are_rejected(geojson):
    x = np.where(np.arange(2000) % 2, 170.0, -170.0)
    zigzag = shapely.LineString(np.column_stack([x, np.linspace(-60, 60, 2000)]))
    with pytest.raises(SourceError, match="points 0.01 units apart"):
        read_features(geojson(zigzag, crs="OGC:1.3:CRS84"), CRS.from_user_input(UTM))


@pytest.mark.parametrize("name", ["MAX_FOOTPRINT_CORNERS", "MAX_FILE_CORNERS"])
def test_footprints_with_too_many_corners_are_rejected(geojson, make_scene, write_raster, monkeypatch, name):
    scene = make_scene(write_raster(np.zeros((9, 9), np.float32), UTM, 500e3, 5200e3, 10.0))
    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    round_house = shapely.Polygon(np.column_stack([500040 + 20 * np.cos(angle), 5199950 + 20 * np.sin(angle)]))
    source = geojson(round_house, shapely.box(500010, 5199920, 500020, 5199930))
    scene = make_scene(scene.elevation.name, meshes=[{"source": source, "height": 5}])
    assert len(scene.objects.placement.visible_bodies) == 2
    monkeypatch.setattr(buildings, name, 150)
    scene = make_scene(scene.elevation.name, meshes=[{"source": source, "height": 5}])
    with pytest.raises(SourceError, match=r"of 20\d corners, more than the limit of 150"):
        _ = scene.objects.placement


def write_gltf(path, accessor: int | None = None, count: object = 3, nodes: list[dict] | None = None) -> str:
    """Write a triangle as glTF, optionally with another accessor count and other nodes, and return its path."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes() + np.array([0, 1, 2, 0], "<u2").tobytes()
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
        {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
    ]
    if accessor is not None:
        accessors[accessor]["count"] = count
    data = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}], "accessors": accessors,
        "buffers": [{"byteLength": 44, "uri": f"data:application/octet-stream;base64,{base64.b64encode(points).decode()}"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 6}],
    }  # fmt: skip
    path.write_text(json.dumps(data))
    return str(path)


@pytest.mark.parametrize("count", [-3, 2**31, 10**12, 1.5, "3", None])
@pytest.mark.parametrize("accessor", [0, 1])
def test_gltf_with_impossible_counts_is_rejected(tmp_path, accessor, count):
    with pytest.raises(SourceError, match=f"accessor {accessor} has {count} elements"):
        read_model(write_gltf(tmp_path / "a.gltf", accessor, count))


def test_gltf_triangles_without_vertices_are_rejected(tmp_path):
    with pytest.raises(SourceError, match="refer to missing vertices|cannot be read"):
        read_model(write_gltf(tmp_path / "a.gltf", 0, 1))


@pytest.mark.parametrize(
    "nodes",
    [[{"mesh": 0, "children": [0]}], [{"mesh": 0, "children": [1]}, {"children": [0]}], [{"children": [1]}, {"children": [0]}]],
)
def test_gltf_with_cyclic_nodes_ends(tmp_path, nodes):
    try:
        assert len(read_model(write_gltf(tmp_path / "a.gltf", nodes=nodes)).triangles) == 1
    except SourceError as error:
        assert "a.gltf" in str(error)


def test_instances_of_a_mesh_count_towards_the_limit(tmp_path, monkeypatch):
    source = write_gltf(tmp_path / "a.gltf", nodes=[{"children": [1, 2, 3]}, *({"mesh": 0} for _ in range(3))])
    assert len(read_model(source).triangles) == 3
    monkeypatch.setattr(models, "MAX_MODEL_TRIANGLES", 2)
    with pytest.raises(SourceError, match="3 triangles, more than the limit of 2"):
        read_model(source)


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_large_texture_is_rejected_before_it_is_decoded(tmp_path, monkeypatch, suffix):
    square = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2), (0, 2, 3)])
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    square.visual = trimesh.visual.TextureVisuals(uv, image=Image.new("RGB", (40, 30), (255, 0, 0)))
    square.export(tmp_path / f"a{suffix}")
    assert len(read_model(str(tmp_path / f"a{suffix}")).triangles) == 2
    monkeypatch.setattr(models, "MAX_TEXTURE_PIXELS", 40 * 30 - 1)
    with pytest.raises(SourceError, match="a texture of 40 x 30 pixels, more than the limit of 1199"):
        read_model(str(tmp_path / f"a{suffix}"))


INVALID_GEOTRANSFORMS = [(float("nan"), 0, 5, 0, -2, 9), (2, 0, float("inf"), 0, -2, 9), (2, 0, 5, 0, 0, 9)]


@pytest.mark.parametrize("cells", INVALID_GEOTRANSFORMS)
@pytest.mark.parametrize("reader", [Imagery, Canopy, Elevation])
def test_rasters_with_an_invalid_geotransform_are_rejected(write_raster, reader, cells):
    bands = np.zeros((3, 8, 9), np.uint8) if reader is Imagery else np.zeros((8, 9), np.float32)
    path = write_raster(bands, UTM, 0, 0, 1.0, transform=Affine(*cells))
    with pytest.raises(SourceError, match="geotransform|size above 0|no coordinate"):
        reader(str(path))


def test_rasters_with_huge_cells_are_rejected(write_raster):
    heights = np.zeros((9, 9), np.float32)
    with pytest.raises(SourceError, match="cells of 100 km exceed the limit of 50 km"):
        Elevation(str(write_raster(heights, UTM, 100e3, 5200e3, 100e3, name="large.tif")))
    Elevation(str(write_raster(heights, UTM, 100e3, 5200e3, 25e3, name="real.tif"))).close()


def test_large_raster_needs_overviews(write_raster, monkeypatch):
    path = write_raster(np.ones((1100, 1100), np.float32), UTM, 500e3, 5200e3, 10.0, tiled=True)
    monkeypatch.setattr(overview_module, "MAX_CELLS_READ", 1100 * 1100 // 4)
    monkeypatch.setattr("skugga.terrain.ground.open_raster.MAX_EXACT_MAXIMA_CELLS", 1000)
    monkeypatch.setattr(overview_module, "MAX_EXACT_MAXIMA_CELLS", 1000)
    with pytest.raises(SourceError, match="1100 x 1100 cells and no overview.*gdaladdo"):
        Elevation(str(path))
    with rasterio.open(path, "r+") as dataset:
        dataset.build_overviews([2, 4])
    elevation = Elevation(str(path))
    assert elevation.overview.mean_heights_m.shape == (275, 275)
    elevation.close()
