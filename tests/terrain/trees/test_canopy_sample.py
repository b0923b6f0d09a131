"""Checks and reports on canopies: units, low and absurd cells, heights above sea level, and notes on planted trees."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio

from skugga.shadows.point.horizon import load_surroundings, sees_sun
from skugga.shadows.point.place import place_at
from skugga.terrain.errors import LevelError, SourceError
from skugga.terrain.trees import forest as module
from skugga.terrain.trees.canopy_sample import check_above_ground, height_class_shares
from skugga.terrain.trees.forest import plant_trees
from tests.terrain.trees.test_forest import UTM, X0, Y0, base_coordinates, hill, plane, vectors  # noqa: F401


@pytest.fixture
def plant_canopy(hill, make_scene, write_raster):  # noqa: F811
    """Return ``plant_canopy(heights, cell_m, unit)``, which plants a canopy in the corner of a slope from 200 m to 400 m."""

    def plant(heights: np.ndarray, cell_m: float = 1.0, unit: str | None = None, **keys):
        source = write_raster(heights.astype(np.float32), UTM, X0 + 500, Y0 - 500, cell_m, name="canopy.tif")
        if unit is not None:
            with rasterio.open(source, "r+") as dataset:
                dataset.units = [unit]
        scene = make_scene(hill, forest=[{"source": str(source), "species": "conifer", **keys}])
        return plant_trees(scene.loaded, scene.world, scene.elevation)

    return plant


def tops(value: float) -> np.ndarray:
    """Return 10,000 cells, nine of which have a height."""
    heights = np.zeros((100, 100))
    heights[20:80:25, 20:80:25] = value
    return heights


def test_height_class_shares_are_fractions_of_cells():
    cells = height_class_shares(np.array([np.nan, 0.0, -3.0, 0.49, 0.5, 1.99, 2.0, 150.0, 150.1, 9000.0]))
    assert (cells.nodata_share, cells.bare_share, cells.shrub_share, cells.tree_share, cells.implausible_share) == pytest.approx(
        (0.1, 0.3, 0.2, 0.2, 0.2)
    )
    assert cells.omission_text(2.0) == (
        "30 % lower than 0.5 m, 20 % of 0.5 m to 2 m (set least_height to include them), "
        "10 % without a height, 20 % higher than 150 m"
    )
    assert cells.omission_text(0.5) == "30 % lower than 0.5 m, 10 % without a height, 20 % higher than 150 m"


@pytest.mark.parametrize(("unit", "value"), [("dm", 80.0), ("cm", 800.0), ("decimetre", 80.0), ("m", 8.0), ("ft", 8.0 / 0.3048)])
def test_heights_are_in_the_unit_of_the_band(plant_canopy, unit, value):
    result = plant_canopy(tops(value), unit=unit)
    np.testing.assert_allclose(result.trees.height_m, np.full(9, 8.0), rtol=1e-6)
    assert result.warnings == ()
    (note,) = result.notes
    assert note.endswith("canopy.tif: 9 trees planted; left out: of its cells 99.9 % lower than 0.5 m")


def test_unknown_unit_is_rejected(plant_canopy):
    with pytest.raises(SourceError, match="canopy.tif: the unit furlong of its band is unknown. Use one of .*dm"):
        plant_canopy(tops(8.0), unit="furlong")


@pytest.mark.parametrize(("value", "has_warning"), [(120.0, True), (60.0, False)])
def test_implausibly_tall_wood_is_reported(plant_canopy, value, has_warning):
    result = plant_canopy(tops(value))  # 12 m in decimetres without a unit, or giant trees
    assert result.trees is not None and ("higher than 80 m. Check the unit" in " ".join(result.warnings)) is has_warning


def test_canopy_without_trees_explains_why(plant_canopy):
    result = plant_canopy(tops(250.0))  # decimetres without a unit
    assert result.trees is None and len(result.warnings) == 2
    assert "most of its cells with trees are higher than 80 m. Check the unit of its heights." in result.warnings[0]
    assert result.warnings[1].endswith(
        "canopy.tif: no tree is planted: of its cells 99.9 % lower than 0.5 m, 0.09 % higher than 150 m"
    )
    empty = plant_canopy(np.zeros((20, 20)))
    assert empty.trees is None and empty.warnings[0].endswith("no tree is planted: of its cells 100 % lower than 0.5 m")


@pytest.mark.parametrize("height_m", [0.6, 1.0, 1.8])
def test_hedges_and_vines_are_planted(plant_canopy, height_m):
    """Rows are 1 m wide and 5 m apart."""
    rows = np.zeros((100, 100))
    rows[::5] = height_m
    result = plant_canopy(rows)
    assert 300 < len(result.trees.thinning_rank) < 3000
    np.testing.assert_allclose(result.trees.height_m, height_m, rtol=1e-6)
    assert result.notes[0].endswith("left out: of its cells 80 % lower than 0.5 m")


def test_hedge_casts_a_shadow(hill, make_scene, write_raster):  # noqa: F811
    """The hedge is 1.8 m high and 2 m wide, with the sun in the south at 30 degrees.

    Its shadow covers most of the ground nearby and ends 3.1 m north of it (1.8 m / tan 30 degrees).
    """
    heights = np.zeros((60, 60))
    heights[30:32] = 1.8
    source = write_raster(heights.astype(np.float32), UTM, X0 + 500, Y0 - 500, 1, name="canopy.tif")
    scene = make_scene(hill, forest=[{"source": str(source)}])
    shaded = {}
    for north_m in (0.5, 4.0):
        places = [(X0 + 500 + east, Y0 - 530 + north_m) for east in np.arange(10.0, 50.0, 0.5)]
        visibility = [
            sees_sun(load_surroundings(scene, place_at(scene, place, scene.elevation.crs)), np.array([180.0]), np.array([30.0]))[0]
            for place in places
        ]
        shaded[north_m] = 1.0 - np.mean(visibility)
    assert shaded[0.5] > 0.6 and shaded[4.0] == 0.0


def test_undergrowth_needs_a_least_height(plant_canopy):
    wood = np.zeros((100, 100))
    wood[:, :40] = 1.2
    wood[::3, 40::3] = 15.0
    wood[:, 40:] = np.maximum(wood[:, 40:], 3.0)
    without_undergrowth, with_undergrowth = plant_canopy(wood), plant_canopy(wood, least_height=1.0)
    assert without_undergrowth.trees.height_m.min() >= 2.0 and without_undergrowth.notes[0].endswith(
        "of its cells 40 % of 0.5 m to 2 m (set least_height to include them)"
    )
    assert (
        with_undergrowth.trees.height_m.min() == pytest.approx(1.2)
        and len(with_undergrowth.trees.thinning_rank) > len(without_undergrowth.trees.thinning_rank) + 1000
    )
    assert plant_canopy(wood, least_height=10.0).trees.height_m.min() == 15.0


def test_coarse_or_too_many_shrubs_are_omitted(plant_canopy, monkeypatch):
    scrub = np.full((40, 40), 1.0)
    assert (
        plant_canopy(scrub, cell_m=10.0)
        .warnings[0]
        .endswith("no tree is planted: of its cells 100 % of 0.5 m to 2 m (set least_height to include them)")
    )
    assert len(plant_canopy(scrub).trees.thinning_rank) > 500
    monkeypatch.setattr(module, "MAX_SHRUBS", 100)
    assert plant_canopy(scrub).trees is None


def test_canopy_above_sea_level_is_rejected(plant_canopy):
    """The raster is the surface over crowns of up to 25 m, on a slope of 0.1 in x and 0.05 in y."""
    row, col = np.mgrid[0:100, 0:100]
    ground = plane(X0 + 500 + col + 0.5, Y0 - 500 - row - 0.5)
    crowns = np.random.default_rng(1).uniform(0.0, 25.0, ground.shape)
    with pytest.raises(
        SourceError, match=r"canopy.tif: it has heights above the sea, 1 to 24 m above the terrain\. Use heights above ground"
    ):
        plant_canopy(ground + crowns)
    assert len(plant_canopy(crowns).trees.thinning_rank) > 500


def test_heights_above_sea_level_differ_from_tall_trees():
    rng = np.random.default_rng(2)
    crowns = rng.uniform(0.0, 25.0, 4000)
    slope, flat = np.linspace(5.0, 40.0, 4000), np.full(4000, 40.0)
    for ground in (slope, flat):
        with pytest.raises(SourceError, match="heights above the sea"):
            check_above_ground("canopy.tif", ground + crowns, ground)
    for heights, ground in ((crowns, slope / 10), (crowns + 5.0, np.full(4000, 5.0)), (crowns, flat), (flat, slope)):
        check_above_ground("canopy.tif", heights, ground)
    check_above_ground("canopy.tif", np.full(10, 45.0), np.full(10, 40.0))  # too few values to decide


def test_sea_level_check_ignores_exaggeration(hill, make_scene, write_raster):  # noqa: F811
    row, col = np.mgrid[0:100, 0:100]
    surface = plane(X0 + 500 + col + 0.5, Y0 - 500 - row - 0.5) + 10.0 * np.random.default_rng(1).random((100, 100))
    source = write_raster(surface.astype(np.float32), UTM, X0 + 500, Y0 - 500, 1, name="canopy.tif")
    scene = make_scene(hill, terrain={"exaggeration": 2.0}, forest=[{"source": str(source)}])
    with pytest.raises(SourceError, match="heights above the sea"):
        plant_trees(scene.loaded, scene.world, scene.elevation)


def test_notes_report_omitted_points_of_a_stand(hill, make_scene, vectors):  # noqa: F811
    import shapely

    points = shapely.points([[5, 5], [15, 5], [25, 5], [-50, 5]])
    source = vectors(list(points), Height=np.array(["12 m", "40 ft", None, "9"], object))
    scene = make_scene(hill, forest=[{"source": source}])
    result = plant_trees(scene.loaded, scene.world, scene.elevation)
    assert sorted(result.trees.height_m.tolist()) == pytest.approx([12.0, 12.192])
    assert result.notes[-1].endswith(
        "2 trees planted; left out: 1 off the terrain, over its holes or under water; 1 without a usable height or crown"
    )
    with pytest.raises(LevelError, match=r"forest\.0\.least_height: '3.0' needs a raster of canopy heights"):
        scene = make_scene(hill, forest=[{"source": source, "least_height": 3}])
        plant_trees(scene.loaded, scene.world, scene.elevation)
