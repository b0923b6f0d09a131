"""Height attributes of footprints: common names and units, floors above the ground, notes and warnings."""

from __future__ import annotations

import json

import numpy as np
import pytest
import shapely
from shapely import affinity

from skugga.shadows.point.horizon import load_surroundings, sees_sun
from skugga.shadows.point.place import place_at
from skugga.terrain.errors import LevelError, SourceError
from skugga.terrain.level.level import load_level
from skugga.terrain.meshes.assemble import place_meshes
from skugga.terrain.meshes.buildings import WALL_DEPTH_BELOW_GROUND_M
from skugga.terrain.scene import build_scene
from tests.rasters import ENGINEERING
from tests.terrain.meshes.test_buildings import write_footprints

FOOTPRINT_ROW = [shapely.box(30 * k, 0, 30 * k + 20, 10) for k in range(4)]
"""Footprints on a floor at height 0."""


def place_on_floor(tmp_path, geometry, mesh=None, **attributes):
    """Return the placement of footprints on a flat floor, and the heights (n, 2) of their floors and roofs."""
    source = write_footprints(tmp_path / "b.gpkg", geometry, crs=ENGINEERING, **attributes)
    return place_source(tmp_path, source, **(mesh or {}))


def place_source(tmp_path, source, **mesh):
    """Return the placed bodies of a source, and the lowest and highest point of each (n, 2)."""
    scene = scene_of(tmp_path, source, **mesh)
    placement = place_meshes(scene.loaded, scene.world, scene.elevation)
    up = [body.origin_earth_m[2] + body.body.vertices_m[:, 2] for body in placement.visible_bodies]
    return placement, np.array([(vertex_heights.min(), vertex_heights.max()) for vertex_heights in up])


def scene_of(tmp_path, source, **mesh):
    """Return the scene of a mesh source on a level floor."""
    path = tmp_path / "level.yaml"
    terrain = {"flat": {"size": [400, 400], "cells": [40, 40]}}
    sun = {"azimuth": 180, "altitude": 45}
    text = {"version": 1, "terrain": terrain, "sun": sun, "meshes": [{"source": str(source), **mesh}]}
    path.write_text(json.dumps(text), encoding="utf-8")
    return build_scene(load_level(path))


@pytest.mark.parametrize(
    ("name", "value", "top_m"),
    [
        ("Height", 8.0, 8.0), ("HEIGHT_M", 8.0, 8.0), ("building:height", 8.0, 8.0), ("Building_Height", 8.0, 8.0),
        ("height", "8", 8.0), ("height", "8,5 m", 8.5), ("Height", "40 ft", 12.192), ("height_ft", 10.0, 3.048),
        ("height_ft", "10,5", 3.2004), ("height_ft", "10 m", 10.0), ("building:levels", 4, 12.0), ("building_levels", "2.5", 7.5),
        ("num_floors", 3, 9.0), ("height_dm", 85, 8.5), ("Height (cm)", 850, 8.5), ("building_height_feet", 10, 3.048),
    ],
)  # fmt: skip
def test_common_attributes_and_units_are_recognized(tmp_path, name, value, top_m):
    _, up = place_on_floor(tmp_path, FOOTPRINT_ROW[:1], **{name: [value]})
    np.testing.assert_allclose(up, [[-WALL_DEPTH_BELOW_GROUND_M, top_m]], atol=1e-6)


def test_height_takes_precedence_and_storeys_fill_gaps(tmp_path):
    """Null and 0 are not heights. The fourth footprint has neither a height nor storeys."""
    values = {"height": np.array([7.0, np.nan, 0.0, np.nan]), "building:levels": np.array([9, 2, 3, 0], np.int32)}
    placement, up = place_on_floor(tmp_path, FOOTPRINT_ROW, **values)
    assert up[:, 1].tolist() == [7.0, 6.0, 9.0]
    assert placement.notes[0].endswith("b.gpkg: heights: 1 of 4 footprints from the attribute 'height'")
    assert placement.notes[1].endswith("heights: 2 of 4 footprints from the attribute 'building:levels' (3 m a storey)")
    assert placement.notes[2].endswith("1 footprints left out: without a height") and placement.warnings == ()


def test_text_that_is_no_length_is_reported_and_ignored(tmp_path):
    values = np.array(["7 m", "tall", None, "12-15"], object)
    placement, up = place_on_floor(tmp_path, FOOTPRINT_ROW, height=values)
    assert up[:, 1].tolist() == [7.0]
    (warning,) = placement.warnings
    assert "b.gpkg: height = tall at feature 2 of 4, and 1 more: ignored, not a length" in warning


def test_boolean_is_no_height(tmp_path):
    placement, up = place_on_floor(tmp_path, FOOTPRINT_ROW[:2], height=[True, False], levels=[2, 3])
    assert up[:, 1].tolist() == [6.0, 9.0]
    (warning,) = placement.warnings
    assert warning.endswith("b.gpkg: height = true at feature 1 of 2, and 1 more: ignored, not a length")
    with pytest.raises(SourceError, match="height = true at feature 1 of 1, which is not a length"):
        place_on_floor(tmp_path, FOOTPRINT_ROW[:1], height=[True])


def test_empty_layer_of_footprints_is_reported(tmp_path):
    with pytest.raises(SourceError, match=r"b.gpkg: no features\. Use"):
        place_on_floor(tmp_path, [])


def test_named_attribute_is_case_insensitive_and_exclusive(tmp_path):
    _, up = place_on_floor(tmp_path, FOOTPRINT_ROW[:2], mesh={"height": "eaves"}, Eaves=[5.0, np.nan], height=[9.0, 9.0])
    assert up[:, 1].tolist() == [5.0]
    _, up = place_on_floor(tmp_path, FOOTPRINT_ROW[:1], mesh={"height": "building:levels"}, **{"building:levels": [2]})
    assert up[:, 1].tolist() == [6.0]
    with pytest.raises(SourceError, match="no attribute 'ridge'. Use one of Eaves"):
        place_on_floor(tmp_path, FOOTPRINT_ROW[:1], mesh={"height": "ridge"}, Eaves=[5.0])


def test_missing_height_lists_the_attributes(tmp_path):
    with pytest.raises(
        LevelError, match=r"meshes\.0\.height: missing\. Set it to metres or to an attribute of .*\(colour\), or set surface"
    ):
        place_on_floor(tmp_path, FOOTPRINT_ROW[:1], colour=["red"])


@pytest.mark.parametrize(
    ("name", "value", "base_m"),
    [("min_height", 5.0, 5.0), ("Min_Height", "5 m", 5.0), ("base_height", 5, 5.0), ("building:min_level", 2, 6.0)],
)
def test_raised_footprint_is_a_closed_block(tmp_path, name, value, base_m):
    placement, up = place_on_floor(
        tmp_path,
        FOOTPRINT_ROW[:2],
        height=[9.0, 9.0],
        **{name: np.array([value, None], object) if isinstance(value, str) else [value, 0]},
    )
    np.testing.assert_allclose(up, [[base_m, 9.0], [-WALL_DEPTH_BELOW_GROUND_M, 9.0]], atol=1e-6)
    raised = placement.visible_bodies[0].body
    assert raised.is_closed and raised.volume_m3 == pytest.approx(200.0 * (9.0 - base_m))
    assert any(f"base heights: 1 of 2 footprints from the attribute '{name}'" in note for note in placement.notes)


def test_sun_shines_below_a_bridge(tmp_path):
    """The deck is 4 m wide and 10 m to 11 m high, and the sun is in the south at 45 degrees.

    Its shadow lies 10 m to 15 m north of its southern edge. A deck that stands on the ground has a shadow from its edge on.
    """
    deck = shapely.box(-100, 0, 100, 4)
    shadow = {}
    for name, values in (("raised", {"height": [11.0], "min_height": [10.0]}), ("standing", {"height": [11.0]})):
        scene = scene_of(tmp_path, write_footprints(tmp_path / f"{name}.gpkg", [deck], crs=ENGINEERING, **values))
        north_m = np.arange(-1.75, 17.0, 0.5)
        visibility = [
            sees_sun(load_surroundings(scene, place_at(scene, (0.0, float(y)))), np.array([180.0]), np.array([45.0]))[0]
            for y in north_m
        ]
        shadow[name] = north_m[~np.array(visibility)]
    assert (shadow["raised"].min(), shadow["raised"].max(), len(shadow["raised"])) == (10.25, 14.75, 10)
    assert shadow["standing"].max() == 14.75 and len(shadow["standing"]) >= 22


def test_pitched_roof_of_a_raised_house_leaves_walls(tmp_path):
    house = affinity.translate(shapely.box(0, 0, 8, 10), 0, 0)
    placement, up = place_on_floor(tmp_path, [house], mesh={"roof": "pitched"}, height=[9.0], min_height=[6.0])
    np.testing.assert_allclose(up, [[6.0, 9.0]], atol=1e-6)
    eaves = np.unique(
        np.round(placement.visible_bodies[0].origin_earth_m[2] + placement.visible_bodies[0].body.vertices_m[:, 2], 6)
    )
    assert placement.visible_bodies[0].body.is_closed and len(eaves) == 3 and eaves[1] > 6.0 + 0.5 * 3.0


def test_floor_above_its_roof_is_omitted_and_reported(tmp_path):
    placement, up = place_on_floor(tmp_path, FOOTPRINT_ROW, height=[9.0, 4.0, 9.0, 9.0], min_height=[0.0, 4.0, 3.0, 6.0])
    np.testing.assert_allclose(up, [[-WALL_DEPTH_BELOW_GROUND_M, 9.0], [3.0, 9.0], [6.0, 9.0]], atol=1e-6)
    (warning,) = placement.warnings
    assert warning.endswith("b.gpkg: feature 2 of 4 left out: the floor is not below the roof")


def test_floors_above_sea_level_are_ignored(tmp_path):
    placement, up = place_on_floor(tmp_path, FOOTPRINT_ROW, height=[9.0, 12.0, 60.0, 8.0], base_height=[52.0, 52.5, 53.0, np.nan])
    np.testing.assert_allclose(up, [[-WALL_DEPTH_BELOW_GROUND_M, top] for top in (9.0, 12.0, 60.0, 8.0)], atol=1e-6)
    (warning,) = placement.warnings
    assert "2 of 3 floors are not below their roofs, such as that of feature 1 of 4. All heights of floors are ignored" in warning


def test_footprints_in_a_second_layer_are_found(tmp_path):
    import pyogrio

    path = write_footprints(tmp_path / "town.gpkg", [shapely.Point(3, 3)], crs=ENGINEERING)
    for name, values in (("parcels", {}), ("houses", {"height": [6.0]})):
        pyogrio.raw.write(
            path, shapely.to_wkb(np.array(FOOTPRINT_ROW[:1], object)), [np.array(v) for v in values.values()], list(values),
            crs=ENGINEERING,
            geometry_type="Polygon", layer=name, append=True,
        )  # fmt: skip
    placement, up = place_source(tmp_path, path)
    assert up[:, 1].tolist() == [6.0]
    assert any("layer 'houses', not parcels (the key layer selects another one)" in note for note in placement.notes)
    _, up = place_source(tmp_path, path, layer="parcels", height=4)
    assert up[:, 1].tolist() == [4.0]
    with pytest.raises(SourceError, match="no layer 'roofs'. Use one of town, parcels, houses"):
        place_source(tmp_path, path, layer="roofs")
