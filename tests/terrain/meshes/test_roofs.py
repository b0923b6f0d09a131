"""Pitched and hipped roofs: closed, with closed-form heights and volumes, and only over nearly rectangular footprints."""

from __future__ import annotations

import json

import numpy as np
import pyogrio
import pytest
import shapely
from shapely import affinity

from skugga.terrain.errors import LevelError
from skugga.terrain.level.level import load_level
from skugga.terrain.meshes.assemble import place_meshes
from skugga.terrain.meshes.buildings import WALL_DEPTH_BELOW_GROUND_M
from skugga.terrain.meshes.roofs import MAX_RISE_SHARE, ROOF_SLOPE, roof_over
from skugga.terrain.meshes.sloped_blocks import EAVES_THICKNESS_M
from skugga.terrain.scene import build_scene

UTM = "EPSG:32633"
UTM_SCALE = 0.9996
"""UTM scale at the central meridian: metres of the map per metre on the ground."""

GROUND_M, WIDTH_M, LENGTH_M, HEIGHT_M = 50.0, 8.0, 14.0, 6.0


@pytest.fixture
def house(write_raster, tmp_path):
    """Return ``house(form, outline, height)``, which builds a house on level ground and returns its body and vertex heights."""
    ground = write_raster(np.full((40, 40), GROUND_M, np.float32), UTM, 500000, 5000400, 10)

    def make(form: str | None, outline=None, height=HEIGHT_M, **keys):
        outline = rectangle() if outline is None else outline
        pyogrio.raw.write(
            tmp_path / "house.gpkg", shapely.to_wkb(np.array([outline], object)), [np.array([float(height)])], ["height_m"],
            geometry_type="Polygon", crs=UTM,
        )  # fmt: skip
        mesh = {"source": "house.gpkg", **({} if form is None else {"roof": form}), **keys}
        path = tmp_path / "level.yaml"
        path.write_text(json.dumps({"version": 1, "terrain": {"source": str(ground)}, "meshes": [mesh]}), encoding="utf-8")
        scene = build_scene(load_level(path))
        (placed,) = place_meshes(scene.loaded, scene.world, scene.elevation).visible_bodies
        vertices = placed.origin_earth_m + placed.body.vertices_m @ placed.earth_from_body.T
        return placed.body, scene.world.map_position(scene.elevation.crs, vertices)[2] - GROUND_M

    return make


def rectangle(width=WIDTH_M, length=LENGTH_M, turn=0.0):
    """Return a footprint of a width and length on the ground, rotated counter-clockwise."""
    box = shapely.box(500200.0, 5000200.0, 500200.0 + length * UTM_SCALE, 5000200.0 + width * UTM_SCALE)
    return affinity.rotate(box, turn)


def roof_rise_m(width=WIDTH_M, height=HEIGHT_M) -> float:
    """Return the height of a roof's ridge above its eaves, for a house of a width and a height, metres."""
    return min(ROOF_SLOPE * width / 2.0, MAX_RISE_SHARE * height)


@pytest.mark.parametrize("turn", [0.0, 33.0, 90.0, 200.0])
@pytest.mark.parametrize("form", ["pitched", "hipped", "auto"])
def test_ridge_is_at_the_height_and_the_eaves_below_it(house, form, turn):
    body, height = house(form, rectangle(turn=turn))
    assert body.is_closed
    levels = np.unique(height.round(4))
    assert levels == pytest.approx([-WALL_DEPTH_BELOW_GROUND_M, HEIGHT_M - roof_rise_m(), HEIGHT_M], abs=2e-3)


@pytest.mark.parametrize("turn", [0.0, 57.0])
def test_roof_volumes_are_those_of_prisms_and_pyramids(house, turn):
    area, block = WIDTH_M * LENGTH_M, HEIGHT_M - roof_rise_m() + WALL_DEPTH_BELOW_GROUND_M
    pitched, _ = house("pitched", rectangle(turn=turn))
    assert pitched.volume_m3 == pytest.approx(area * (block + roof_rise_m() / 2.0), rel=1e-3)
    hipped, _ = house("hipped", rectangle(turn=turn))
    assert hipped.volume_m3 == pytest.approx(area * block + WIDTH_M * roof_rise_m() * (3.0 * LENGTH_M - WIDTH_M) / 6.0, rel=1e-3)
    tent, _ = house("hipped", rectangle(8.0, 8.0, turn))
    assert tent.is_closed and tent.volume_m3 == pytest.approx(64.0 * (block + roof_rise_m() / 3.0), rel=1e-3)
    flat, _ = house(None, rectangle(turn=turn))
    assert flat.volume_m3 == pytest.approx(area * (HEIGHT_M + WALL_DEPTH_BELOW_GROUND_M), rel=1e-3)


def test_roof_slopes_face_up_and_gables_have_wall_colour(house):
    body, _ = house("pitched", rectangle())
    corner = body.vertices_m[body.triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    up = normal[:4] @ (body.vertices_m[8] - body.vertices_m[[0, 3]].mean(axis=0))
    assert (up > 0.0).all()  # the four triangles of the slopes come first
    roof, wall = body.albedo[:4], body.albedo[4:]
    assert (roof == roof[0]).all() and (wall == wall[0]).all() and (roof[0] != wall[0]).any()


@pytest.mark.parametrize("eaves_m", [0.0, 0.6])
@pytest.mark.parametrize("form", ["pitched", "hipped"])
def test_wings_of_a_map_are_level_on_the_curved_earth(house, form, eaves_m):
    wing = 8.0 * UTM_SCALE
    outline = shapely.Polygon([(0, 0), (3 * wing, 0), (3 * wing, wing), (wing, wing), (wing, 2 * wing), (0, 2 * wing)])
    body, height = house(form, affinity.rotate(affinity.translate(outline, 500200, 5000200), 21.0), eaves_m=eaves_m)
    assert body.is_closed
    rise = roof_rise_m()
    edge, drop, fascia = HEIGHT_M - rise, rise / 4.0 * eaves_m, EAVES_THICKNESS_M
    expected = {-WALL_DEPTH_BELOW_GROUND_M, edge, HEIGHT_M}
    if eaves_m:
        expected = {-WALL_DEPTH_BELOW_GROUND_M, edge - fascia, edge - drop, edge - drop - fascia, HEIGHT_M}
        expected |= {HEIGHT_M - fascia} if form == "pitched" else set()
    levels = np.unique(height.round(2))
    assert all(min(abs(level - value) for value in expected) < 0.011 for level in levels)
    assert all(min(abs(level - value) for level in levels) < 0.011 for value in expected)


def test_low_sheds_keep_walls(house):
    _, height = house("pitched", rectangle(10.0, 14.0), height=2.5)
    assert np.sort(np.unique(height.round(3)))[1] == pytest.approx(2.5 * (1.0 - MAX_RISE_SHARE), abs=2e-3)


def outline_corners(outline) -> np.ndarray:
    """Return the corners (n, 3) of a footprint relative to the first, anticlockwise."""
    xy = np.array(shapely.orient_polygons(outline).exterior.coords)[:-1]
    return np.column_stack([xy - xy[0], np.zeros(len(xy))])


@pytest.mark.parametrize(
    ("outline", "height_m", "forms"),
    [
        (shapely.box(0, 0, 12, 8), 6.0, {"auto", "pitched", "hipped"}),
        (shapely.box(0, 0, 40, 20), 6.0, {"pitched", "hipped"}),  # a hall
        (shapely.box(0, 0, 12, 8), 30.0, {"pitched", "hipped"}),  # a tower
        (shapely.box(0, 0, 2, 2), 2.0, {"pitched", "hipped"}),
        (shapely.Polygon([(0, 0), (12, 0), (12, 8), (6, 8), (6, 4), (0, 4)]), 6.0, set()),
        (shapely.Polygon([(0, 0), (12, 0), (9, 8), (0, 8)]), 6.0, set()),
        (shapely.Polygon([(0, 0), (12, 0), (6, 8)]), 6.0, set()),
    ],
    ids=["house", "hall", "tower", "kiosk", "L", "trapezoid", "triangle"],
)
def test_roof_over_needs_a_rectangle_and_a_suitable_size(outline, height_m, forms):
    accepted_forms = {
        form for form in ("auto", "flat", "pitched", "hipped") if roof_over(outline_corners(outline), height_m, form) is not None
    }
    assert accepted_forms == forms


def test_unsuitable_roof_is_flat_and_other_meshes_reject_it(house):
    outline = affinity.translate(shapely.Polygon([(0, 0), (12, 0), (12, 8), (6, 8), (6, 4), (0, 4)]), 500200, 5000200)
    body, height = house("auto", outline)
    assert body.is_closed and len(np.unique(height.round(3))) == 2
    with pytest.raises(LevelError, match="roof"):
        house("gambrel")
    with pytest.raises(LevelError, match=r"meshes\.0\.roof"):
        house("auto", source=None, generate="boxgrid")
