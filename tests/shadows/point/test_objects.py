"""Houses and trees around a point: horizon angles in closed form, occluders, and agreement with ray-traced truth."""

from __future__ import annotations

import json

import numpy as np
import pytest

from skugga.shadows.point.horizon import (
    GROUND,
    LEAVES,
    SOLIDS,
    horizon_profile,
    load_surroundings,
    sees_sun,
    sun_occluder_groups,
    sun_occluders,
)
from skugga.shadows.point.place import place_at
from skugga.shadows.truth.truth import trace_truth
from skugga.terrain.casters.rays import RayScene, trees_as_mesh
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.tree_instances import tree_instances_in_map
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.sun import azimuth_and_altitude, direction_enu
from skugga.terrain.level.parts import SunSpec
from tests.rasters import ENGINEERING, write_geotiff


def write_geojson(path, kind, coordinates, **properties):
    """Write one feature with a geometry of a kind as a GeoJSON file."""
    feature = {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}), encoding="utf-8")


@pytest.fixture
def village(tmp_path, make_scene):
    """Return ``village(heights, ...)``: ground with a house and a tree.

    The house is 12 m high, 20 to 30 m east of the middle; the tree stands 30 m south of it.
    """

    def make(heights=None, azimuth=90.0, altitude=20.0, tree_m=10.0):
        side = 64
        heights = np.zeros((side, side), np.float32) if heights is None else heights
        x, y = 500_000.0, 5_300_000.0
        write_geotiff(tmp_path / "dem.tif", heights, "EPSG:32633", x, y, 4.0)
        middle = x + side * 2.0, y - side * 2.0
        from pyproj import Transformer

        degrees = Transformer.from_crs("EPSG:32633", "OGC:CRS84", always_xy=True)

        def place(east, north):
            return list(degrees.transform(middle[0] + east, middle[1] + north))

        ring = [place(*corner) for corner in ((20, -10), (30, -10), (30, 10), (20, 10), (20, -10))]
        write_geojson(tmp_path / "house.geojson", "Polygon", [ring], height_m=12.0)
        write_geojson(tmp_path / "tree.geojson", "Point", place(0.0, -30.0), height=tree_m)
        scene = make_scene(
            tmp_path / "dem.tif", azimuth, altitude, meshes=[{"source": "house.geojson", "height": "height_m"}],
            forest=[{"source": "tree.geojson", "height": "height", "species": "conifer"}],
        )  # fmt: skip
        return scene, tuple(place(0.0, 0.0))

    return make


def test_horizon_of_a_house_is_its_eaves(village):
    scene, middle = village()
    surroundings = load_surroundings(scene, place_at(scene, middle))
    facing = np.arange(-20.0, 21.0)
    east = 90.0 + facing - 0.0  # the zone's central meridian: grid north is true north
    horizon = horizon_profile(surroundings, east)
    expected = np.degrees(np.arctan(12.0 * np.cos(np.radians(facing)) / 20.0))
    assert horizon.solids_deg == pytest.approx(expected, abs=0.02)
    assert (horizon_profile(surroundings, np.array([180.0, 270.0, 0.0, 120.0])).solids_deg == -90.0).all()
    upstairs = load_surroundings(scene, place_at(scene, middle, height_m=12.5))
    assert (horizon_profile(upstairs, east).solids_deg < 0.0).all()


def test_sun_over_beside_and_behind_a_house(village):
    scene, middle = village()
    surroundings = load_surroundings(scene, place_at(scene, middle))
    top = np.degrees(np.arctan(12.0 / 20.0))
    azimuth, altitude = np.array([90.0, 90.0, 140.0, 270.0, 90.0]), np.array([top + 0.1, top - 0.1, 10.0, 10.0, -1.0])
    assert sees_sun(surroundings, azimuth, altitude).tolist() == [True, False, True, True, False]
    occluders = sun_occluders(surroundings, azimuth, altitude)
    assert [caster and caster.kind for caster in occluders] == [None, "building", None, None, None]
    assert occluders[1].distance_m == pytest.approx(20.0, abs=0.02)
    assert occluders[1].elevation_deg == pytest.approx(top, abs=0.02)
    assert occluders[1].height_m == pytest.approx(12.0, abs=0.05)
    assert occluders[1].lon_deg > middle[0] and occluders[1].lat_deg == pytest.approx(middle[1], abs=1e-5)


def test_horizon_of_a_tree_is_its_highest_leaf(village):
    """The sun is visible just above the highest leaf, and not at it. Rays through the crown agree with Embree's."""
    scene, middle = village()
    surroundings = load_surroundings(scene, place_at(scene, middle))
    azimuth = np.linspace(176.5, 183.5, 141)
    horizon = horizon_profile(surroundings, azimuth)
    crown = horizon.forest_deg > 0.0
    assert crown.sum() > 30 and horizon.forest_deg.max() == pytest.approx(np.degrees(np.arctan(10 / 30)), abs=0.7)
    # A leaf's rim may exceed the horizon by less than a quarter of a texel.
    assert (~sees_sun(surroundings, azimuth, np.maximum(horizon.elevation_deg, 0.0) + 0.02)).sum() <= 2
    assert sees_sun(surroundings, azimuth, np.maximum(horizon.elevation_deg, 0.0) + 0.08).all()
    assert not sees_sun(surroundings, azimuth[crown], horizon.elevation_deg[crown] - 1e-4).any()
    frame = scene.world.frame_near_earth(surroundings.place.eye_earth_m)
    rays = RayScene(alpha_meshes=[trees_as_mesh(tree_instances_in_map(scene.objects, frame, 1e-3))])
    rng = np.random.default_rng(3)
    azimuth, altitude = rng.uniform(176.5, 183.5, 4000), rng.uniform(0.5, 19.0, 4000)
    enu = np.stack([direction_enu(*angles) for angles in zip(azimuth, altitude, strict=True)])
    directions = frame.directions_from_earth(enu @ surroundings.place.earth_from_enu.T)
    start = np.repeat(frame.points_from_earth(surroundings.place.eye_earth_m)[None], len(enu), axis=0)
    blocked = rays.is_blocked(start, directions)
    assert 300 < blocked.sum() < 3700
    assert (sees_sun(surroundings, azimuth, altitude) == blocked).mean() < 0.002  # rounding at the rims of leaves


def test_sees_sun_agrees_with_truth(village):
    """The points are nodes of a map over hills, with a house and a tree. Ray-traced truth gives the expected values."""
    rows, cols = np.mgrid[0:64, 0:64]
    hills = (8.0 * np.sin(rows / 5.0) * np.cos(cols / 7.0)).astype(np.float32)
    scene, _ = village(hills, tree_m=14.0)
    dark_count = 0
    for azimuth, altitude in ((100.0, 9.0), (175.0, 14.0), (265.0, 7.0)):
        scene = scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
        view = scene.view(bounds=(500_004.0, 5_299_756.0, 500_256.0, 5_299_996.0), size=(63, 60))
        buffer = geometry_buffer(scene, view)
        truth = trace_truth(buffer, scene, find_casters(scene, buffer))
        decidable_cells = np.argwhere(truth.decidable & (buffer.surface_kind == RELIEF) & buffer.valid)
        assert len(decidable_cells) > 1000
        for i, j in decidable_cells[:: len(decidable_cells) // 150]:
            xy = float(view.grid.x(view.col0 + j * view.col_step)), float(view.grid.y(view.row0 + i * view.row_step))
            place = place_at(scene, xy, view.grid.crs)
            sun = azimuth_and_altitude(scene.sun.to_sun_earth, place.earth_from_enu)
            is_sunlit = sees_sun(load_surroundings(scene, place), *(np.array([angle]) for angle in sun))[0]
            assert is_sunlit == truth.lit[i, j], (azimuth, i, j)
            dark_count += not is_sunlit
    assert dark_count > 60


def test_sees_sun_is_false_under_a_roof(village):
    scene, middle = village()
    indoor_place = place_at(scene, (middle[0] + 25.0 / 74_000.0, middle[1]))
    surroundings = load_surroundings(scene, indoor_place)
    assert not sees_sun(surroundings, np.arange(0.0, 360.0, 15.0), np.full(24, 60.0)).any()
    assert (horizon_profile(surroundings, np.arange(0.0, 360.0, 15.0)).solids_deg > 80.0).all()


def test_generated_meshes_are_no_buildings(make_scene, tmp_path):
    write_geotiff(tmp_path / "floor.tif", np.zeros((21, 21), np.float32), ENGINEERING, 0.0, 0.0, 10.0)
    scene = make_scene(tmp_path / "floor.tif", meshes=[{"generate": "boxgrid"}])
    surroundings = load_surroundings(scene, place_at(scene, (0.0, 0.0)))
    assert len(surroundings.triangles) and not surroundings.is_building.any()


def test_sees_sun_on_columns_agrees_with_truth(tmp_path, make_scene):
    """The points are the middles of cells with flat tops and vertical walls. Ray-traced truth gives the expected values."""
    heights = np.zeros((64, 64), np.float32)
    rng = np.random.default_rng(2)
    for row, col in rng.integers(4, 56, (25, 2)):
        heights[row : row + 4, col : col + 3] = rng.integers(4, 20)
    write_geotiff(tmp_path / "blocks.tif", heights, "EPSG:32633", 500_000.0, 5_300_000.0, 4.0)
    scene = make_scene(tmp_path / "blocks.tif", 235.0, 21.0, terrain={"surface": "blocks"})
    view = scene.view(bounds=(500_000.0, 5_299_744.0, 500_256.0, 5_300_000.0), size=(64, 64))
    buffer = geometry_buffer(scene, view)
    truth = trace_truth(buffer, scene, find_casters(scene, buffer))
    dark_count = 0
    for i, j in np.argwhere(truth.decidable & buffer.valid)[::9]:
        xy = float(view.grid.x(view.col0 + j * view.col_step)), float(view.grid.y(view.row0 + i * view.row_step))
        place = place_at(scene, xy, view.grid.crs)
        assert place.ground_m == heights[i, j]
        sun = azimuth_and_altitude(scene.sun.to_sun_earth, place.earth_from_enu)
        is_sunlit = sees_sun(load_surroundings(scene, place), *(np.array([angle]) for angle in sun))[0]
        assert is_sunlit == truth.lit[i, j], (i, j)
        dark_count += not is_sunlit
    assert dark_count > 50


def test_groups_of_occluders_are_those_of_single_suns(village):
    """On hills with a house and a tree each sun has the same caster, and each group hides some suns."""
    rows, cols = np.mgrid[0:64, 0:64]
    scene, middle = village((8.0 * np.sin(rows / 5.0) * np.cos(cols / 7.0)).astype(np.float32), tree_m=24.0)
    surroundings = load_surroundings(scene, place_at(scene, middle))
    rng = np.random.default_rng(5)
    azimuth = np.concatenate([rng.uniform(0.0, 360.0, 800), rng.uniform(174.0, 186.0, 200)])
    altitude = rng.uniform(-3.0, 40.0, 1000)
    names = {-1: None, GROUND: "relief", SOLIDS: "building", LEAVES: "forest"}
    groups = [names[group] for group in sun_occluder_groups(surroundings, azimuth, altitude).tolist()]
    assert groups == [caster and caster.kind for caster in sun_occluders(surroundings, azimuth, altitude)]
    assert [group is None for group in groups] == [
        bool(is_lit or at <= 0.0) for is_lit, at in zip(sees_sun(surroundings, azimuth, altitude), altitude, strict=True)
    ]
    assert min(groups.count(name) for name in names.values()) > 5


@pytest.mark.parametrize(("ridge_m", "kind", "group"), [(30.0, "building", SOLIDS), (130.0, "relief", GROUND)])
def test_the_highest_of_two_casters_is_named(village, ridge_m, kind, group):
    """A ridge 100 m behind a house hides a low sun, too: the one with the larger elevation angle is the occluder."""
    heights = np.zeros((64, 64), np.float32)
    heights[:, 57:] = ridge_m
    scene, middle = village(heights)
    surroundings = load_surroundings(scene, place_at(scene, middle))
    azimuth, altitude = np.array([90.0]), np.array([10.0])
    (caster,) = sun_occluders(surroundings, azimuth, altitude)
    assert caster.kind == kind and caster.elevation_deg > 25.0
    assert sun_occluder_groups(surroundings, azimuth, altitude).tolist() == [group]
