"""A closed scene leaves no entry in any cache. The test first fills all caches by drawing with every feature."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable

import numpy as np
import pytest
from pyproj import CRS

from skugga.api.compute import compute
from skugga.api.request import ProductRequest
from skugga.selector.measure.footprint import texel_footprint_px
from skugga.selector.measure.view_truth import truth_of_view
from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.ground_pictures import _generalised_ground_normals, _ground_between_nodes
from skugga.shadows.point.horizon import horizon_profile, load_surroundings
from skugga.shadows.point.place import place_at
from skugga.shadows.render import render_frame
from skugga.shadows.sky_light.sky_light import block_sky_light
from skugga.shadows.sunlit_ground import rim_points
from skugga.terrain.cache import caches, clear_caches
from skugga.terrain.casters.caster_types import Patch
from skugga.terrain.casters.patch_bounds import patch_bounds
from skugga.terrain.describe import describe
from skugga.terrain.effects import ground_detail
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.facts.plane_facts import _roof_planes
from skugga.terrain.facts.relief_rays import overview_probes
from skugga.terrain.facts.visible_points import probes_in_map
from skugga.terrain.gbuffer.bare_ground import bare_ground
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.gbuffer.ground_mesh import ground_mesh
from skugga.terrain.gbuffer.landforms import landforms
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, transformer
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import write_geotiff

WEST_M, NORTH_M = 500_000.0, 5_300_480.0
"""North-west corner of the ground."""


def lon_lat_at(east_m: float, south_m: float) -> list[float]:
    """Return longitude and latitude of a place at some distance from the corner."""
    return list(transformer(CRS.from_epsg(32633), LONGITUDE_LATITUDE).transform(WEST_M + east_m, NORTH_M - south_m))


@pytest.fixture
def scene(scene_factory) -> Scene:
    """A new scene of hills with a pond, a wood, a house, a lamp, clouds, haze and imagery."""
    return scene_factory()


@pytest.fixture
def scene_factory(tmp_path) -> Callable[[], Scene]:
    """Return a function that builds hills with a pond, a wood, a house, a lamp, clouds, haze and imagery."""
    rows, cols = np.mgrid[0:48, 0:48]
    heights = (20.0 * np.sin(rows / 6.0) * np.cos(cols / 7.0)).astype(np.float32)
    for name, cells in (("dem", heights), ("ortho", np.full((3, 48, 48), 90, np.uint8))):
        write_geotiff(tmp_path / f"{name}.tif", cells, "EPSG:32633", WEST_M, NORTH_M, 10.0)
    house = [[200, 200], [220, 200], [220, 215], [200, 215], [200, 200]]
    wood = [[250, 150], [330, 150], [330, 230], [250, 230], [250, 150]]
    for name, ring, tags in (("houses", house, {"height_m": 9}), ("woods", wood, {})):
        polygon = {"type": "Polygon", "coordinates": [[lon_lat_at(*corner) for corner in ring]]}
        feature = {"type": "Feature", "properties": tags, "geometry": polygon}
        collection = {"type": "FeatureCollection", "features": [feature]}
        (tmp_path / f"{name}.geojson").write_text(json.dumps(collection), encoding="utf-8")
    camera = {"eye": [*lon_lat_at(150, 120), 25], "target": [*lon_lat_at(240, 200), 5]}
    level = {
        "version": 1, "terrain": {"source": "dem.tif", "imagery": "ortho.tif"}, "water": {"level": -15},
        "meshes": [{"source": "houses.geojson", "height": "height_m"}],
        "forest": [{"source": "woods.geojson", "density": 300, "height": [8, 12]}],
        "lights": {"lamp": {"kind": "omni", "position": [*lon_lat_at(240, 190), 12]}},
        "sun": {"azimuth": 235, "altitude": 25}, "weather": {"visibility": 3000, "cloud_cover": 0.4},
        "views": {"eye": {"kind": "perspective", **camera, "fov": 60, "size": [96, 64]}},
    }  # fmt: skip
    path = tmp_path / "level.yaml"
    path.write_text(json.dumps(level), encoding="utf-8")
    return lambda: build_scene(load_level(path))


CASTER_KINDS = ("relief", "meshes")
ALL_OVERRIDES = [
    {"algorithm": "shadow_map", "filter": "sun"},
    {"algorithm": {"sun": dict.fromkeys((*CASTER_KINDS, "forest"), "perspective_shadow_map")}},
    {"algorithm": {"sun": {"relief": "sweep"}}},
    {"algorithm": {"sun": dict.fromkeys(CASTER_KINDS, "shadow_volume")}},
    {"algorithm": {"sun": dict.fromkeys(CASTER_KINDS, "hybrid")}},
    {"algorithm": "truth"},
]


def draw_with_everything(scene: Scene) -> list[object]:
    """Fill all caches. Return the objects that are weakly referenced keys of some caches."""
    for view in (scene.view(size=(64, 64)), scene.view("eye")):
        descriptor = describe(scene, view)
        for overrides in ALL_OVERRIDES:
            if "perspective_shadow_map" not in str(overrides) or not isinstance(view, MapView):
                render_frame(scene, view, make_plan(descriptor, scene.loaded.level, overrides))
    probes = probes_in_map(scene, descriptor.pixel_m, None)
    overview_probes(scene.world, scene.elevation, probes)
    plan = make_plan(descriptor, scene.loaded.level, {"algorithm": "shadow_map"})
    buffer, view_truth = geometry_buffer(scene, view), truth_of_view(scene, view, "sun")
    block = geometry_buffer(scene, scene.view(size=(64, 64)))
    attached_shadow_mask(block, scene)
    block_sky_light(ShadingBlock(scene, block.view, block, {}))
    landforms(scene, block.view, block.frame)
    assert isinstance(view, PerspectiveView)
    ground_mesh(scene, view, 100)  # decimated
    ground_detail._albedo_changes(buffer, scene, view)  # a level with imagery leaves it out
    texel_footprint_px(scene, plan.steps_of_light("sun")[0], buffer, 1.0)
    nodes = MapView(block.view.grid, 0.0, 0.0, 1.0, 1.0, 32, 32)
    bare_nodes(scene, nodes, 1)
    ground = bare_ground(scene, nodes, None)
    assert ground is not None
    _generalised_ground_normals(scene, nodes, ground)
    _ground_between_nodes(scene, nodes.part(0, 0, 8, 8).shifted(0.25, 0.25), None)
    patch_bounds(scene.world, scene.elevation, block.view.grid, [Patch(0, 0, 0)])
    rim_points(scene, nodes)
    compute(scene, nodes, ProductRequest(product="height"), None)
    _roof_planes(scene.objects)  # a map of ground that is not a plane leaves it out
    point = place_at(scene, tuple(lon_lat_at(240, 200)))
    horizon_profile(load_surroundings(scene, point))
    view_truth.errors([np.ones(buffer.valid.shape)], plan.steps_of_light("sun"), 1.0)
    return [probes, buffer, view_truth, block, point]


def test_a_closed_scene_leaves_no_cache_entry(gl, scene):
    clear_caches("light", "scene")
    cache_keys = draw_with_everything(scene)
    assert [cache.name for cache in caches("light", "scene") if not len(cache)] == [], (
        "these caches were not filled, so the test does not check them"
    )
    scene.close()
    del cache_keys
    gc.collect()
    assert {cache.name: len(cache) for cache in caches("light", "scene") if len(cache)} == {}
    assert sum(cache.nbytes for cache in caches("light", "scene") if cache.name != "skugga.terrain.gl.depth_targets") == 0


def test_an_unreferenced_scene_leaves_no_cache_entry(gl, scene_factory):
    clear_caches("light", "scene")
    scene = scene_factory()
    for view in (scene.view(size=(64, 64)), scene.view("eye")):
        render_frame(scene, view, make_plan(describe(scene, view), scene.loaded.level, {"algorithm": "shadow_map"}))
    assert sum(len(cache) for cache in caches("scene")) > 20
    del scene, view
    gc.collect()
    assert {cache.name: len(cache) for cache in caches("scene") if len(cache)} == {}
