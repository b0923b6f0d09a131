"""Stands of trees: number, positions, heights, ground below, and rejected input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Transformer
from scipy.spatial import cKDTree

from skugga.terrain.errors import LevelError, SourceError
from skugga.terrain.trees import forest as module
from skugga.terrain.trees.crown_sizes import MAX_CROWN_DEVIATION_SHARE
from skugga.terrain.trees.foliage import TREE_VARIANTS
from skugga.terrain.trees.forest import plant_trees
from skugga.terrain.trees.planting_map import PlantingMap
from skugga.terrain.trees.scatter import MIN_SPACING_CELLS, join_positions, pair_keys, point_keys, scatter_trees, uniform_numbers
from skugga.terrain.trees.trees import Trees
from tests.rasters import ENGINEERING

UTM = "EPSG:32632"
X0, Y0 = 500000.0, 5202000.0
SIDE_M = 2000.0
CONIFERS = [n for n, variant in enumerate(TREE_VARIANTS) if variant.species == "conifer"]


def plane(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the heights of a tilted plane in metres at positions."""
    return 300.0 + 0.1 * (x - X0) + 0.05 * (y - Y0)


@pytest.fixture
def hill(write_raster) -> Path:
    """Write a slope of 2 km x 2 km with its north-west corner at (X0, Y0)."""
    col, row = np.meshgrid(np.arange(200), np.arange(200))
    return write_raster(plane(X0 + 10 * col + 5, Y0 - 10 * row - 5).astype(np.float32), UTM, X0, Y0, 10)


@pytest.fixture
def vectors(tmp_path: Path):
    """Return a function that writes geometries, in metres east and north of the terrain's south-west corner."""

    def write(geometries: list, name: str = "stand.gpkg", crs: str = UTM, origin=(X0, Y0 - SIDE_M), **attributes) -> str:
        shifted_geometries = shapely.transform(np.array(geometries, object), lambda p: p + origin)
        path = tmp_path / name
        path.unlink(missing_ok=True)
        fields = [np.asarray(values) for values in attributes.values()]
        pyogrio.raw.write(path, shapely.to_wkb(shifted_geometries), fields, list(attributes), geometry_type="Unknown", crs=crs)
        return str(path)

    return write


def planted_trees(scene) -> Trees | None:
    """Return the trees of a scene; ``None`` without any."""
    return plant_trees(scene.loaded, scene.world, scene.elevation).trees


def base_coordinates(scene, trees: Trees) -> np.ndarray:
    """Return the coordinates of tree bases in the raster's CRS, with heights (n, 3)."""
    return np.column_stack(scene.world.map_position(scene.elevation.crs, trees.base_earth_m))


# -- lattice


def test_number_of_scattered_trees_follows_the_density():
    area = shapely.Point(13.0, -7.0).buffer(700.0)
    for density in (7.0, 120.0, 3000.0):
        expected = area.area / 1e4 * density
        # There is one tree per cell, so only cells on the rim vary.
        rim = area.length / np.sqrt(1e4 / density)
        assert len(scatter_trees(area, density, 5)) == pytest.approx(expected, abs=3 * np.sqrt(rim))


def test_scattered_trees_keep_a_distance_and_form_no_rows():
    places = scatter_trees(shapely.box(-500, -500, 500, 500), 900.0, 1)
    pitch = np.sqrt(1e4 / 900.0)
    points = np.column_stack([places.x, places.y])
    assert cKDTree(points).query(points, k=2)[0][:, 1].min() >= MIN_SPACING_CELLS * pitch
    for wave in ((1, 0), (0, 1), (1, 1), (0.5, 0), (0, 0.5), (0.5, 0.5)):  # an orchard has 1 here
        assert abs(np.exp(2j * np.pi * (points / pitch) @ np.array(wave)).mean()) < 0.06


@settings(max_examples=25, deadline=None)
@given(
    cut=st.floats(-180, 180),
    angle=st.floats(0, np.pi),
    density=st.sampled_from([40.0, 400.0, 9000.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_polygon_cut_in_two_keeps_its_trees(cut, angle, density, seed):
    area = shapely.Point(1000.0, -2000.0).buffer(200.0)
    cut_direction, cut_normal = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    middle = np.array([1000.0, -2000.0]) + cut * cut_normal
    half = shapely.Polygon(
        [
            middle - 500 * cut_direction,
            middle + 500 * cut_direction,
            middle + 500 * (cut_direction + cut_normal),
            middle + 500 * (cut_normal - cut_direction),
        ]
    )
    uncut_trees, _ = join_positions([scatter_trees(area, density, seed)])
    parts, _ = join_positions([scatter_trees(area & half, density, seed), scatter_trees(area - half, density, seed)])
    np.testing.assert_array_equal(uncut_trees.key, parts.key)
    np.testing.assert_array_equal(uncut_trees.x, parts.x)


def test_another_seed_gives_another_stand():
    area = shapely.box(0, 0, 300, 300)
    first, second = scatter_trees(area, 100.0, 1), scatter_trees(area, 100.0, 2)
    assert not np.intersect1d(first.x, second.x).size


def test_hashes_are_uniform_and_streams_uncorrelated():
    i, j = np.meshgrid(np.arange(-150, 150), np.arange(-150, 150))
    key = pair_keys(4, i.ravel(), j.ravel())
    assert len(np.unique(key)) == key.size
    streams = np.stack([uniform_numbers(key, stream) for stream in range(6)])
    assert streams.min() >= 0 and streams.max() < 1
    counts = np.stack([np.histogram(s, bins=50, range=(0, 1))[0] for s in streams])
    assert (abs(counts - key.size / 50) < 5 * np.sqrt(key.size / 50)).all()
    assert abs(np.corrcoef(streams) - np.eye(6)).max() < 0.02
    neighbours = streams[0].reshape(300, 300)
    assert abs(np.corrcoef(neighbours[:, 1:].ravel(), neighbours[:, :-1].ravel())[0, 1]) < 0.02


# -- stands of polygons


def test_stand_has_its_density_on_the_ground(hill, vectors, make_scene):
    area = shapely.Point(1000, 1000).buffer(600)
    scene = make_scene(hill, forest=[{"source": vectors([area]), "density": 300}])
    trees = planted_trees(scene)
    stretch = 0.9996**-2  # UTM on its central meridian: map lengths are smaller than ground lengths
    assert len(trees.thinning_rank) == pytest.approx(
        area.area / 1e4 * 300 * stretch, abs=3 * np.sqrt(area.length / np.sqrt(1e4 / 300))
    )
    assert shapely.contains_xy(area, *(base_coordinates(scene, trees)[:, :2] - [X0, Y0 - SIDE_M]).T).all()


def test_trees_stand_on_the_ground(hill, vectors, make_scene):
    scene = make_scene(hill, forest=[{"source": vectors([shapely.box(100, 100, 1900, 1900)]), "density": 20}])
    x, y, height = base_coordinates(scene, planted_trees(scene)).T
    np.testing.assert_allclose(height, plane(x, y), atol=2e-3)


def test_tree_does_not_depend_on_other_features(hill, vectors, make_scene):
    uncut_polygon, west, east = shapely.box(200, 300, 1700, 900), shapely.box(200, 300, 950, 900), shapely.box(950, 300, 1700, 900)
    far = shapely.box(1000, 1500, 1200, 1600)
    spec = {"density": 150, "species": "mixed", "seed": 9}
    uncut_trees = planted_trees(make_scene(hill, forest=[{"source": vectors([uncut_polygon, far]), **spec}]))
    cut_trees = planted_trees(make_scene(hill, forest=[{"source": vectors([east, far, west, far, east], "cut.gpkg"), **spec}]))
    for name in Trees.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(uncut_trees, name), getattr(cut_trees, name))


def test_multipolygons_and_holes(hill, vectors, make_scene):
    ring = shapely.box(200, 200, 900, 900) - shapely.box(300, 300, 800, 800)
    scene = make_scene(hill, forest=[{"source": vectors([ring | shapely.box(1200, 1200, 1500, 1500)]), "density": 100}])
    trees = planted_trees(scene)
    x, y, _ = (base_coordinates(scene, trees) - [X0, Y0 - SIDE_M, 0]).T
    assert not ((x > 300) & (x < 800) & (y > 300) & (y < 800)).any()
    assert len(trees.thinning_rank) == pytest.approx(100 * (24 + 9), rel=0.05)


def test_heights_of_polygons(hill, vectors, make_scene):
    boxes = [shapely.box(100, 100, 600, 600), shapely.box(700, 100, 1200, 600), shapely.box(100, 700, 600, 1200)]
    source = vectors(boxes, tall=[12.0, np.nan, 30.0], height=[1.0, 1.0, 1.0])
    default = planted_trees(make_scene(hill, forest=[{"source": source, "density": 50}])).height_m
    assert 8.0 <= default.min() < 8.3 and 17.7 < default.max() <= 18.0 and default.mean() == pytest.approx(13.0, abs=0.3)
    ranged = planted_trees(make_scene(hill, forest=[{"source": source, "density": 50, "height": [20, 21]}])).height_m
    assert 20.0 <= ranged.min() and ranged.max() <= 21.0
    scene = make_scene(hill, forest=[{"source": source, "density": 50, "height": "tall"}])
    trees = planted_trees(scene)
    x, y, _ = (base_coordinates(scene, trees) - [X0, Y0 - SIDE_M, 0]).T
    np.testing.assert_array_equal(trees.height_m, np.where(y > 650, 30.0, 12.0))
    assert not ((x > 650) & (y < 650)).any()  # the polygon without a height


def test_variants_follow_species_and_crowns_follow_height(hill, vectors, make_scene):
    source = vectors([shapely.box(100, 100, 1900, 1900)])
    shares_of = {}
    for species in ("conifer", "broadleaf", "mixed"):
        trees = planted_trees(make_scene(hill, forest=[{"source": source, "density": 40, "species": species, "height": [5, 30]}]))
        shares_of[species] = np.isin(trees.variant, CONIFERS).mean()
        base, slope = np.mean(
            [module.CROWN_DIAMETER_LINES[s] for s in (["conifer", "broadleaf"] if species == "mixed" else [species])], axis=0
        )
        expected_crown_m = base + slope * trees.height_m
        assert (trees.crown_diameter_m / expected_crown_m).mean() == pytest.approx(1.0, abs=0.02)
        assert ((trees.yaw_deg >= 0) & (trees.yaw_deg < 180)).all() and trees.yaw_deg.std() == pytest.approx(52, abs=1)
        assert ((trees.thinning_rank >= 0) & (trees.thinning_rank < 1)).all() and trees.thinning_rank.mean() == pytest.approx(
            0.5, abs=0.01
        )
    assert shares_of["conifer"] == 1 and shares_of["broadleaf"] == 0
    assert shares_of["mixed"] == pytest.approx(0.5, abs=0.02)
    assert 0 < MAX_CROWN_DEVIATION_SHARE < 1
    crown = planted_trees(make_scene(hill, forest=[{"source": source, "density": 5, "crown": [2, 2.5]}])).crown_diameter_m
    assert 2.0 <= crown.min() and crown.max() <= 2.5


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857"])
def test_density_is_on_the_ground_in_any_crs(crs, write_raster, make_scene, vectors):
    """Web Mercator at 60 degrees doubles lengths, and degrees are not metres."""
    lon, lat = 9.0, 60.0
    x0, y0 = (lon, lat) if crs == "EPSG:4326" else Transformer.from_crs(4326, crs, always_xy=True).transform(lon, lat)
    cell = 0.001 if crs == "EPSG:4326" else 100.0
    dem = write_raster(np.full((60, 60), 50, np.float32), crs, x0, y0, cell)
    to_utm = Transformer.from_crs(crs, UTM, always_xy=True)
    east, north = to_utm.transform(x0 + 30 * cell, y0 - 30 * cell)
    source = vectors([shapely.box(0, 0, 800, 800)], origin=(east - 400, north - 400))
    trees = planted_trees(make_scene(dem, forest=[{"source": source, "density": 200}]))
    assert len(trees.thinning_rank) == pytest.approx(64 * 200 * 0.9996**-2, rel=0.006)


def test_flat_world_in_feet(write_raster, make_scene, vectors):
    feet = ENGINEERING.replace('LENGTHUNIT["metre",1]', 'LENGTHUNIT["foot",0.3048]')
    dem = write_raster(np.zeros((100, 100), np.float32), feet, 7000, 9000, 10)
    source = vectors([shapely.box(0, 0, 800, 800)], crs=feet, origin=(7100, 8100))
    scene = make_scene(dem, forest=[{"source": source, "density": 400}])
    trees = planted_trees(scene)
    assert len(trees.thinning_rank) == pytest.approx((800 * 0.3048) ** 2 / 1e4 * 400, rel=0.02)
    x, y, _ = base_coordinates(scene, trees).T
    assert 7100 <= x.min() and x.max() <= 7900 and 8100 <= y.min() and y.max() <= 8900


def test_longitudes_wrap_around_the_earth(write_raster, make_scene, vectors):
    dem = write_raster(np.zeros((40, 40), np.float32), "EPSG:4326", 179.98, 0.02, 0.001)  # up to 180.02
    source = vectors([shapely.box(-179.995, -0.005, -179.99, 0.005)], crs="EPSG:4326", origin=(0, 0))
    assert len(planted_trees(make_scene(dem, forest=[{"source": source, "density": 100}])).thinning_rank) == pytest.approx(
        0.55 * 1.11 * 100 * 100, rel=0.03
    )


def test_trees_off_the_terrain_and_over_holes_are_omitted(hill, vectors, make_scene, write_raster):
    source = vectors([shapely.box(-5000, -5000, 500, 7000)])
    scene = make_scene(hill, forest=[{"source": source, "density": 100}])
    trees = planted_trees(scene)
    assert base_coordinates(scene, trees)[:, 0].min() >= X0
    assert len(trees.thinning_rank) == pytest.approx(100 * 100, rel=0.02)
    values = np.full((50, 50), 10, np.float32)
    values[:, 20:40] = np.nan
    scene = make_scene(write_raster(values, UTM, X0, Y0, 40, name="holes.tif"), forest=[{"source": source, "density": 10}])
    scene = make_scene(scene.elevation.name, forest=[{"source": vectors([shapely.box(0, 0, 2000, 2000)]), "density": 10}])
    x = base_coordinates(scene, planted_trees(scene))[:, 0] - X0
    assert not ((x > 840) & (x < 1560)).any() and (x < 800).any() and (x > 1600).any()


# -- points


def test_points_are_trees_with_their_heights(hill, vectors, make_scene):
    rng = np.random.default_rng(2)
    place, height_m, crown_m = rng.uniform(50, 1950, (200, 2)), rng.uniform(3, 40, 200), rng.uniform(1, 9, 200)
    order = rng.permutation(200)
    source = vectors(list(shapely.points(place)), height=height_m, w=crown_m)
    shuffled_source = vectors(
        list(shapely.points(place[order])), "mixed.gpkg", height=height_m[order].astype(str), w=crown_m[order]
    )
    scene = make_scene(hill, forest=[{"source": source, "crown": "w"}])
    trees = planted_trees(scene)
    tree_xy = base_coordinates(scene, trees)[:, :2] - [X0, Y0 - SIDE_M]
    distance, row = cKDTree(place).query(tree_xy)
    assert len(np.unique(row)) == 200 and distance.max() < 1e-3
    np.testing.assert_allclose(trees.height_m, height_m[row], rtol=1e-6)
    np.testing.assert_allclose(trees.crown_diameter_m, crown_m[row], rtol=1e-6)
    replanted = planted_trees(make_scene(hill, forest=[{"source": shuffled_source, "crown": "w"}]))
    for name in Trees.__dataclass_fields__:
        np.testing.assert_allclose(getattr(replanted, name), getattr(trees, name), rtol=1e-6)


def test_points_without_heights_draw_them_by_position(hill, vectors, make_scene):
    place = np.random.default_rng(2).uniform(50, 1950, (300, 2))
    point_source = vectors([shapely.MultiPoint(place[:150]), *shapely.points(place[150:])])
    default = planted_trees(make_scene(hill, forest=[{"source": point_source}])).height_m
    assert len(default) == 300 and 8 <= default.min() and default.max() <= 18 and default.std() == pytest.approx(2.9, abs=0.3)
    subset = planted_trees(make_scene(hill, forest=[{"source": vectors(list(shapely.points(place[150:])), "fewer.gpkg")}])).height_m
    assert np.isin(subset, default).all()


@pytest.mark.parametrize(
    ("name", "value", "height_m", "unit"),
    [
        ("height", 8.0, 8.0, ""), ("Height_FT", 10.0, 3.048, " (feet)"), ("HEIGHT (ft)", "10,5", 3.2004, " (feet)"),
        ("height_dm", 85, 8.5, " (decimetres)"), ("height_cm", 850, 8.5, " (centimetres)"), ("height_ft", "10 m", 10.0, " (feet)"),
        ("Tree Height", "12 m", 12.0, ""), ("HAUTEUR", 9, 9.0, ""), ("est_height", "40 ft", 12.192, ""),
    ],
)  # fmt: skip
def test_heights_of_points_are_read_in_usual_units(hill, vectors, make_scene, name, value, height_m, unit):
    scene = make_scene(hill, forest=[{"source": vectors([shapely.Point(100, 100)], **{name: [value]})}])
    planting = plant_trees(scene.loaded, scene.world, scene.elevation)
    np.testing.assert_allclose(planting.trees.height_m, [height_m], rtol=1e-6)
    assert planting.notes[0].endswith(f"stand.gpkg: heights: 1 of 1 features from the attribute '{name}'{unit}")


def test_named_attributes_of_trees_match_in_any_case(hill, vectors, make_scene):
    for geometry, keys in ((shapely.Point(100, 100), {}), (shapely.box(0, 0, 100, 100), {"density": 100})):
        source = vectors([geometry], HEIGHT_FT=[50.0], Crown_dm=[45.0])
        trees = planted_trees(make_scene(hill, forest=[{"source": source, "height": "height_ft", "crown": "crown_dm", **keys}]))
        np.testing.assert_allclose(trees.height_m, 15.24, rtol=1e-6)
        np.testing.assert_allclose(trees.crown_diameter_m, 4.5, rtol=1e-6)


@pytest.mark.parametrize("attributes", [{}, {"kind": ["oak"]}, {"height": np.array([None], object)}])
def test_heights_without_an_attribute_are_noted(hill, vectors, make_scene, attributes):
    for geometry, keys, reason in (
        (shapely.Point(100, 100), {}, "no attribute has them"),
        (shapely.box(0, 0, 100, 100), {"density": 100}, "the key height sets a range or an attribute"),
    ):
        scene = make_scene(hill, forest=[{"source": vectors([geometry], **attributes), **keys}])
        planting = plant_trees(scene.loaded, scene.world, scene.elevation)
        assert planting.notes[0].endswith(f"stand.gpkg: heights: drawn at random from 8 m to 18 m ({reason})")
        assert ((planting.trees.height_m >= 8.0) & (planting.trees.height_m <= 18.0)).all() and not planting.warnings


def test_heights_that_are_no_lengths_are_reported(hill, vectors, make_scene):
    points = list(shapely.points([[100, 100], [200, 100], [300, 100]]))
    scene = make_scene(hill, forest=[{"source": vectors(points, height=["7 m", "tall", "12-15"])}])
    planting = plant_trees(scene.loaded, scene.world, scene.elevation)
    assert planting.trees.height_m.tolist() == [7.0]
    (warning,) = planting.warnings
    assert warning.endswith("stand.gpkg: height = tall at feature 2 of 3, and 1 more: ignored, not a length")


def test_omitted_trees_are_counted(hill, vectors, make_scene):
    points = [*shapely.points([[100, 100], [100, 100], [-50, 100], [99999, 0], [200, 100]]), None]
    scene = make_scene(hill, forest=[{"source": vectors(points, height=[9.0, 9.0, 9.0, 9.0, 999.0, 9.0])}])
    assert (
        plant_trees(scene.loaded, scene.world, scene.elevation)
        .notes[-1]
        .endswith(
            "1 trees planted; left out: 2 off the terrain, over its holes or under water; 1 at the same place as another; "
            "1 without a usable height or crown; 1 without a geometry"
        )
    )
    polygons = [shapely.box(0, 0, 100, 100), shapely.box(9000, 0, 9100, 100)]
    scene = make_scene(hill, forest=[{"source": vectors(polygons), "density": 100}])
    assert plant_trees(scene.loaded, scene.world, scene.elevation).notes[-1].endswith("left out: 1 polygons off the terrain")


def test_drowned_trees_are_counted_in_the_warning(hill, vectors, make_scene):
    source = vectors([shapely.Point(100, 100)], height=[9.0])
    scene = make_scene(hill, water={"level": 900}, forest=[{"source": source}])
    (warning,) = plant_trees(scene.loaded, scene.world, scene.elevation).warnings
    assert warning.endswith("stand.gpkg: no tree is planted: 1 off the terrain, over its holes or under water")


def test_invalid_rows_are_omitted_and_duplicates_merged(hill, vectors, make_scene):
    points = list(shapely.points([[100, 100], [200, 100], [300, 100], [400, 100], [500, 100], [500, 100], [99999, 0]]))
    source = vectors(points, tall=[10.0, -4.0, 0.0, np.nan, 151.0, 7.0, 9.0])
    assert planted_trees(make_scene(hill, forest=[{"source": source, "height": "tall"}])).height_m.tolist() == [10.0]
    assert len(planted_trees(make_scene(hill, forest=[{"source": source, "height": [9, 9]}])).thinning_rank) == 5


def test_point_keys_distinguish_millimetres():
    assert point_keys(0, [1.0], [2.0]) == point_keys(0, [1.0001], [1.9999])
    assert point_keys(0, [1.0], [2.0]) != point_keys(0, [1.001], [2.0]) and point_keys(0, [1.0], [2.0]) != point_keys(
        1, [1.0], [2.0]
    )
    assert point_keys(0, [1.0], [2.0]) != point_keys(0, [2.0], [1.0])


# -- canopies


def test_canopy_in_another_crs_stands_on_the_terrain(hill, make_scene, write_raster):
    """The canopy is in degrees and larger than the terrain. Its tops lie at their positions in the raster."""
    to_degrees = Transformer.from_crs(UTM, 4326, always_xy=True)
    west, north = to_degrees.transform(X0 + 1800, Y0 - 300)
    canopy = np.zeros((400, 400), np.float32)
    canopy[20::40, 20::40] = 17.0
    source = write_raster(canopy, "EPSG:4326", west, north, (1.3e-5, 9e-6), name="canopy.tif")
    scene = make_scene(hill, forest=[{"source": str(source), "species": "conifer"}])
    trees = planted_trees(scene)
    x, y, height = base_coordinates(scene, trees).T
    np.testing.assert_allclose(height, plane(x, y), atol=2e-3)
    assert (trees.height_m == 17.0).all() and np.isin(trees.variant, CONIFERS).all()
    lon, lat = to_degrees.transform(x, y)
    np.testing.assert_allclose(((lon - west) / 1.3e-5 - 20.5) / 40 % 1, 0.5, atol=0.5)
    np.testing.assert_allclose((((lon - west) / 1.3e-5 - 20.5) / 40 + 0.5) % 1, 0.5, atol=1e-3)
    assert len(trees.thinning_rank) == pytest.approx(100 * 200 / (400 * 1.3e-5 * 75_900), abs=11)


def test_canopy_crowns_end_at_their_neighbours(hill, make_scene, write_raster):
    canopy = np.zeros((100, 100), np.float32)
    canopy[2:60:3, 2:60:3], canopy[90, 90] = 26.0, 26.0
    source = write_raster(canopy, UTM, X0 + 500, Y0 - 500, 1, name="canopy.tif")
    trees = planted_trees(make_scene(hill, forest=[{"source": str(source), "species": "conifer"}]))
    assert np.sort(trees.crown_diameter_m)[-2] < 1.2 * (3 + 3 + 18**0.5) / 3 * 1.001 and np.median(
        trees.crown_diameter_m
    ) == pytest.approx(3.6, rel=1e-3)
    trees_with_fixed_crowns = planted_trees(
        make_scene(hill, forest=[{"source": str(source), "species": "conifer", "crown": [6, 6]}])
    )
    assert trees_with_fixed_crowns.crown_diameter_m.tolist() == [6.0] * 401


def test_broadleaf_canopies_have_fewer_and_wider_crowns(hill, make_scene, write_raster):
    """In a rough canopy of 18 m to 20 m, wider crowns give fewer tops. Mixed stands lie in between."""
    canopy = np.random.default_rng(4).uniform(18, 20, (100, 100)).astype(np.float32)
    source = str(write_raster(canopy, UTM, X0 + 500, Y0 - 500, 1, name="canopy.tif"))
    trees_by_species = {
        species: planted_trees(make_scene(hill, forest=[{"source": source, "species": species}]))
        for species in ("conifer", "mixed", "broadleaf")
    }
    conifer_count, mixed_count, broadleaf_count = (len(trees.thinning_rank) for trees in trees_by_species.values())
    assert 1.3 * broadleaf_count < mixed_count < conifer_count / 1.3
    assert np.median(trees_by_species["broadleaf"].crown_diameter_m) > 1.5 * np.median(trees_by_species["conifer"].crown_diameter_m)


def test_real_canopy_on_its_own_terrain(shared_data, make_scene):
    folder = shared_data / "forest"
    scene = make_scene(folder / "quebec_DTM.tif", forest=[{"source": str(folder / "quebec_CHM.tif")}])
    trees = planted_trees(scene)
    assert 3000 < len(trees.thinning_rank) < 6000 and 20 < trees.height_m.max() < 21
    x, y, height = base_coordinates(scene, trees).T
    np.testing.assert_allclose(height, scene.elevation.ground_m(x, y), atol=2e-3)


# -- rejected input


def test_level_without_a_forest_has_no_trees(hill, make_scene, vectors):
    assert planted_trees(make_scene(hill)) is None
    assert planted_trees(make_scene(hill, forest=[{"source": vectors([shapely.box(5, 5, 6, 6)]), "density": 0.001}])) is None


@pytest.mark.parametrize(
    ("geometry", "spec", "message"),
    [
        (shapely.box(0, 0, 50, 50), {}, r"level.yaml: forest.0.density: missing\. .*the source has polygons"),
        (shapely.Point(5, 5), {"density": 3}, r"forest.0.density: '3.0' .*each a tree"),
        (shapely.LineString([(0, 0), (9, 9)]), {"density": 3}, r"stand.gpkg: it has lines\. Use only polygons"),
        (shapely.GeometryCollection([shapely.Point(5, 5), shapely.box(0, 0, 9, 9)]), {"density": 3}, "both polygons and points"),
        (shapely.Point(5, 5), {"height": "kind"}, r"stand.gpkg: kind = oak at feature 1 of 1, which is not a length\. Use"),
        (shapely.Point(5, 5), {"height": "none"}, "no attribute 'none'. Use one of kind, low"),
        (shapely.Point(5, 5), {"crown": "low"}, r"stand.gpkg: the attribute low .* \(-1.0 ...\)\. Use lengths from 0.1 m to 150"),
        (
            shapely.Point(-5, 5), {},
            r"its trees are off the terrain, at 499995, 5200005, .*on the terrain, at 500000, 5200000, 502000, 5202000",
        ),
        (
            shapely.box(5000, 0, 6000, 9), {"density": 1},
            r"forest.0.source: its trees are off the terrain, at 50[45][^,]*, .*WGS 84 / UTM zone 32N",
        ),
        (
            shapely.box(0, 0, 2000, 2000), {"density": 20000},
            r"forest.0: 8,00.,... trees, more than the limit of 5,000,000 trees in a level\. Plant fewer trees\.$",
        ),
    ],
)  # fmt: skip
def test_invalid_stands_are_rejected_in_one_line(hill, make_scene, vectors, geometry, spec, message):
    source = vectors([geometry], kind=["oak"], low=[-1.0])
    with pytest.raises((LevelError, SourceError), match=message) as caught:
        planted_trees(make_scene(hill, forest=[{"source": source, **spec}]))
    assert "\n" not in str(caught.value)


def test_tree_limit_applies_to_all_stands_together(hill, make_scene, vectors, monkeypatch, write_raster):
    monkeypatch.setattr(module, "MAX_TREES", 1000)
    stand_spec = {"source": vectors([shapely.box(0, 0, 400, 400)]), "density": 50}
    with pytest.raises(LevelError, match=r"forest\.1: 80. trees, .*1,000 trees in a level \((1\d\d|2\d\d) left for this stand\)"):
        planted_trees(make_scene(hill, forest=[stand_spec, stand_spec]))
    points = vectors(list(shapely.points(np.random.default_rng(0).uniform(0, 2000, (1001, 2)))), "p.gpkg")
    with pytest.raises(LevelError, match=r"forest\.0: 1,001 trees, more than the limit of 1,000 trees in a level\. "):
        planted_trees(make_scene(hill, forest=[{"source": points}]))
    canopy = write_raster(np.full((200, 200), 10, np.int16), UTM, X0, Y0, 1, name="canopy.tif")
    with pytest.raises(LevelError, match=r"forest\.0: at least [\d,]+ trees, more than the limit"):
        planted_trees(make_scene(hill, forest=[{"source": str(canopy)}]))


@pytest.mark.parametrize(
    ("spec", "value", "x", "message"),
    [
        ({"density": 4}, 9, X0, r"forest.0.density: '4.0' does not apply to a raster"),
        ({"layer": "trees"}, 9, X0, r"forest.0.layer: 'trees' does not apply to a raster"),
        ({"height": [4, 5]}, 9, X0, r"forest.0.height: '\(4.0, 5.0\)' does not apply to a raster"),
        ({"crown": "w"}, 9, X0, r"forest.0.crown: 'w' .*a raster has no attributes"),
        ({}, 9, X0 + 5000, r"forest.0.source: its trees are off the terrain, at 50[45][^,]*, .*on the terrain, at 500000, 5200000"),
        ({}, np.nan, X0, r"canopy.tif: no height in any cell \(all nodata\)\. "),
    ],
)
def test_invalid_canopies_are_rejected(hill, make_scene, write_raster, spec, value, x, message):
    source = write_raster(np.full((20, 20), value, np.float32), UTM, x, Y0, 1, name="canopy.tif", nodata=np.nan)
    with pytest.raises((LevelError, SourceError), match=message):
        planted_trees(make_scene(hill, forest=[{"source": str(source), **spec}]))


def test_canopy_without_trees_is_no_error(hill, make_scene, write_raster):
    source = write_raster(np.zeros((20, 20), np.float32), UTM, X0, Y0, 1, name="canopy.tif")
    assert planted_trees(make_scene(hill, forest=[{"source": str(source)}])) is None


def test_missing_and_unreadable_files_are_rejected(hill, make_scene, tmp_path):
    with pytest.raises(SourceError, match=r"none.gpkg: no such file\. "):
        planted_trees(make_scene(hill, forest=[{"source": "none.gpkg", "density": 3}]))
    (tmp_path / "text.geojson").write_text("hello", encoding="utf-8")
    with pytest.raises(SourceError, match=r"text.geojson: .*\. Use polygons, points or a raster of canopy heights"):
        planted_trees(make_scene(hill, forest=[{"source": "text.geojson", "density": 3}]))


def test_planting_map_of_a_global_level_has_no_outline(write_raster, make_scene, hill):
    globe = make_scene(write_raster(np.zeros((18, 36), np.float32), "EPSG:4326", -180, 90, 10, name="globe.tif"))
    assert PlantingMap(globe.world, globe.elevation).outline is None
    near = make_scene(hill)
    planting_map = PlantingMap(near.world, near.elevation)
    assert planting_map.outline.area == pytest.approx(SIDE_M**2 / 0.9996**2, rel=0.01)
    assert CRS.from_user_input(planting_map.crs).is_projected
