"""Levels over real rasters and footprints: their content agrees with the data, and they can be drawn.

A bundled level over real heights has woods and houses that do not overlap.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely

from skugga.configs import LEVELS_FOLDER
from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.trees.canopy_sample import MIN_TREE_HEIGHT_M

CITY_FOLDER = "urban/goteborg_1m"
ROOF_M = 0.2
"""Maximum distance of level roofs from the high parts of the surface in their footprints, even on a hillside."""

SCENE_CACHE: dict[str, Scene] = {}
"""Cache of scenes: the canopy of a city takes seconds to plant."""


@dataclass(frozen=True)
class Town:
    """Rasters of a place relative to the sample data, an eye (degrees, metres above ground) and its target."""

    ground: str
    canopy: str
    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    casters: tuple[str, ...] = ("relief", "forest")
    footprints: str | None = None
    surface: str | None = None


PLACES = {
    "goteborg": Town(
        f"{CITY_FOLDER}/DEM.tif", f"{CITY_FOLDER}/CDSM.tif", (11.9625, 57.7064, 80.0), (11.9639, 57.7073, 0.0),
        ("relief", "meshes", "forest"), f"{CITY_FOLDER}/buildings.shp", f"{CITY_FOLDER}/DSM.tif",
    ),
    # Two resolutions, cells of 5.0012 m x 4.9992 m and 2.5021 m x 2.5024 m.
    "bilbao": Town(
        "urban/bilbao/DEM.tif", "urban/bilbao/CDSM.tif", (-2.9800, 43.3150, 100.0), (-2.9840, 43.3180, 0.0),
    ),
    "quebec": Town(
        "forest/quebec_DTM.tif", "forest/quebec_CHM.tif", (-70.9165, 47.6079, 80.0), (-70.9163, 47.6089, 0.0),
    ),
}  # fmt: skip


@pytest.fixture
def scene_of(shared_data: Path, make_scene):
    """Return ``scene_of(name)``, which builds the scene of a place in afternoon light."""

    def make(name: str) -> Scene:
        town = PLACES[name]
        keys: dict = {"forest": [{"source": str(shared_data / town.canopy)}]}
        if town.footprints and town.surface:
            rasters = {"surface": str(shared_data / town.surface), "ground": str(shared_data / town.ground)}
            keys["meshes"] = [{"source": str(shared_data / town.footprints), **rasters}]
        keys["views"] = {"air": {"kind": "perspective", "eye": town.eye, "target": town.target, "size": [200, 150]}}
        return make_scene(shared_data / town.ground, 225.0, 30.0, **keys)

    return lambda name: SCENE_CACHE.get(name) or SCENE_CACHE.setdefault(name, make(name))


def heights_of(path: Path) -> tuple[np.ndarray, rasterio.Affine]:
    """Return heights (rows, cols) and geotransform of a raster file."""
    with rasterio.open(path) as dataset:
        return dataset.read(1).astype(np.float64), dataset.transform


@pytest.mark.parametrize("name", PLACES)
def test_real_place_is_planned_and_drawn(scene_of, name):
    town, scene = PLACES[name], scene_of(name)
    assert scene.objects.caster_kinds == town.casters
    for view in (scene.view("air"), scene.view("map", size=(128, 128))):
        plan = make_plan(describe(scene, view, "view"), scene.loaded.level, {})
        assert tuple(plan.algorithm["sun"]) == town.casters
        frame = render_frame(scene, view, plan)
        assert frame.valid.mean() > 0.5
        visibility = frame.visibility[frame.valid]
        assert 0.02 < (visibility < 0.5).mean() < 0.8, "neither without shadows nor all in shadow"


@pytest.mark.parametrize("name", PLACES)
def test_trees_agree_with_the_canopy(scene_of, shared_data, name):
    town, scene = PLACES[name], scene_of(name)
    trees = scene.objects.trees
    canopy_m, transform = heights_of(shared_data / town.canopy)
    canopy_m2 = (canopy_m >= MIN_TREE_HEIGHT_M).sum() * abs(transform.determinant)
    crowns_m2 = (np.pi / 4 * trees.crown_diameter_m.astype(np.float64) ** 2).sum()
    assert 0.4 < crowns_m2 / canopy_m2 < 1.5
    assert 0.8 * canopy_m.max() < trees.height_m.max() <= canopy_m.max() + 0.01
    assert trees.height_m.min() >= MIN_TREE_HEIGHT_M
    x, y, foot_m = scene.objects.trees_in_crs(scene.elevation.crs).T
    np.testing.assert_allclose(foot_m, scene.elevation.ground_m(x, y), atol=1e-3)
    col, row = (np.floor(v).astype(int) for v in ((x - transform.c) / transform.a, (y - transform.f) / transform.e))
    inside = (row >= 0) & (row < canopy_m.shape[0]) & (col >= 0) & (col < canopy_m.shape[1])
    assert inside.mean() > 0.999
    # Look at the cell below a tree and at its neighbours, because trees are scattered over coarse cells.
    nearest = np.max([np.roll(canopy_m, shift, (0, 1)) for shift in np.ndindex(3, 3)], axis=0)
    nearest = np.roll(nearest, (-1, -1), (0, 1))
    assert (nearest[row[inside], col[inside]] >= MIN_TREE_HEIGHT_M).mean() > 0.99


def test_buildings_agree_with_footprints_and_surface(scene_of, shared_data):
    town, scene = PLACES["goteborg"], scene_of("goteborg")
    solids = scene.objects.solids
    assert all(solids.is_closed)
    ground_m, transform = heights_of(shared_data / town.ground)
    surface_m, _ = heights_of(shared_data / town.surface)
    footprints = shapely.from_wkb(pyogrio.raw.read(shared_data / town.footprints)[2])
    extent = shapely.box(*scene.elevation.bounds)
    inside_count, touching_count = shapely.contains_properly(extent, footprints).sum(), shapely.intersects(extent, footprints).sum()
    assert 0.9 * inside_count <= len(solids.is_closed) < touching_count < len(footprints), (
        "without slabs and those mostly beyond the border"
    )

    rows, cols = np.indices(ground_m.shape)
    x, y = transform.c + transform.a * (cols + 0.5), transform.f + transform.e * (rows + 0.5)
    vertex_m = scene.objects.solids_in_crs(scene.elevation.crs)
    roof_errors = []
    for body in range(len(solids.is_closed)):
        corners = vertex_m[np.unique(solids.triangles[solids.body_index == body])]
        (footprint_index,) = np.flatnonzero(
            shapely.distance(footprints, shapely.points(corners[:, :2])[:, None]).max(axis=0) < 0.01
        )
        inside = shapely.contains_xy(footprints[footprint_index], x, y)
        if not shapely.contains_properly(extent, footprints[footprint_index]) or inside.sum() < 20:
            continue
        assert corners[:, 2].min() < ground_m[inside].min() + 0.1, "walls reach down to the ground"
        roof_errors.append(corners[:, 2].max() - np.percentile(surface_m[inside], 90))
    assert len(roof_errors) >= 15
    assert np.max(np.abs(roof_errors)) < ROOF_M


def test_wooded_valley_has_a_village_and_no_tree_in_a_house():
    scene = build_scene(load_level(LEVELS_FOLDER / "jacksboro_wooded.yaml"))
    houses = pyogrio.raw.read(LEVELS_FOLDER / "jacksboro_houses.geojson")
    footprints, heights_m = shapely.from_wkb(houses[2]), houses[3][0]
    assert scene.objects.caster_kinds == ("relief", "meshes", "forest")
    assert len(footprints) == len(scene.objects.solids.is_closed) > 100 and all(scene.objects.solids.is_closed)
    assert heights_m.min() > 2 and heights_m.max() < 25
    x, y, _ = scene.objects.trees_in_crs(scene.elevation.crs).T
    assert 60_000 < len(x) < 250_000
    nearest = shapely.STRtree(footprints).query(shapely.points(x, y), predicate="intersects")
    assert not nearest.size
    west, south, east, north = scene.bounds_lon_lat
    view_area = shapely.box(west - 0.005, south - 0.005, east + 0.005, north + 0.005)
    assert shapely.contains(view_area, footprints).all()
