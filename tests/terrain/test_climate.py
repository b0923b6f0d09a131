"""Climate colours: ice above the snow line, deserts and tundra, by latitude and height, equal in every map and tile."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from morecantile import tms as matrix_sets

from skugga.shadows.draw import SHADING_NEEDS, can_draw_from_heights
from skugga.shadows.render import render_frame
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.climate import ARID_RAMP, ICE_RAMP, TINT_LATITUDE_ROWS, TUNDRA_RAMP, climate_srgb, ramp_srgb, snow_line_m
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView, tile_grid
from skugga.terrain.level.parts import StyleSpec
from skugga.terrain.shading import albedo_of
from skugga.terrain.style import STYLES, tint_table
from tests.products import draw_by_heights
from tests.render import plan_of

STYLE_RAMP = STYLES["natural"].ramp
HEIGHTS_M = np.arange(-500.0, 7001.0, 50.0)


def srgb_at(latitude: float, height: float) -> np.ndarray:
    """Return the colour (3,) in [0, 255] of a place, from the nearest row of the table."""
    row = round((np.sin(np.radians(latitude)) + 1.0) / 2.0 * (TINT_LATITUDE_ROWS - 1))
    return 255.0 * climate_srgb(STYLE_RAMP, np.array([height]))[row, 0]


def ramp_color(ramp, height: float) -> np.ndarray:
    """Return the colour (3,) of a ramp at a height, sRGB from 0 to 255."""
    return 255.0 * ramp_srgb(ramp, np.array([height]))[0]


@pytest.mark.parametrize(
    ("latitude", "height", "ramp", "max_difference"),
    [
        (-75.0, 3200.0, ICE_RAMP, 0.5),  # Antarctica
        (-72.0, 20.0, ICE_RAMP, 0.5),  # coast of Antarctica
        (72.0, 2500.0, ICE_RAMP, 0.5),  # Greenland
        (72.0, 50.0, TUNDRA_RAMP, 0.5),  # coasts of Greenland and Siberia
        (46.0, 3600.0, ICE_RAMP, 0.5),  # summits of the Alps
        (46.0, 1500.0, STYLE_RAMP, 0.0),  # valleys of the Alps
        (28.0, 6500.0, ICE_RAMP, 0.5),  # the Himalaya
        (60.0, 100.0, STYLE_RAMP, 0.1),  # Oslo
        (51.0, 30.0, STYLE_RAMP, 0.0),  # London
        (36.6, 700.0, STYLE_RAMP, 0.0),  # Jacksboro
        (-3.0, 100.0, STYLE_RAMP, 0.0),  # the Amazon
        (-42.0, 200.0, STYLE_RAMP, 0.0),  # Tasmania
    ],
)
def test_known_places_have_their_climate_colours(latitude, height, ramp, max_difference):
    assert np.abs(srgb_at(latitude, height) - ramp_color(ramp, height)).max() <= max_difference


def test_deserts_have_the_colour_of_sand():
    """Deserts are more red than green; meadows are more green than red."""
    for latitude in (24.0, -24.0):
        for height in (50.0, 500.0, 1000.0):
            red, green, blue = srgb_at(latitude, height)
            assert red > green + 5.0 > blue + 20.0
            assert np.abs(srgb_at(latitude, height) - ramp_color(ARID_RAMP, height)).max() < np.abs(
                srgb_at(latitude, height) - ramp_color(STYLE_RAMP, height)
            ).max()  # fmt: skip


def test_middle_latitudes_have_the_ramp_of_the_style():
    latitude = np.degrees(np.arcsin(np.linspace(-1.0, 1.0, TINT_LATITUDE_ROWS)))
    colors, style_colors = climate_srgb(STYLE_RAMP, HEIGHTS_M), ramp_srgb(STYLE_RAMP, HEIGHTS_M)
    middle = (latitude > 36.0) & (latitude < 60.0)
    below = HEIGHTS_M < snow_line_m(latitude)[:, None] - 250.0
    assert middle.sum() > 20
    assert (np.abs(colors - style_colors)[middle][below[middle]] == 0.0).all()


def test_sea_floor_has_no_climate():
    assert np.allclose(climate_srgb(STYLE_RAMP, np.array([-4000.0, -500.0])), ramp_srgb(STYLE_RAMP, np.array([-4000.0, -500.0])))


@pytest.mark.parametrize("name", [name for name, style in STYLES.items() if not style.has_latitude_tints])
def test_styles_without_climate_have_one_ramp(name):
    assert len(tint_table(STYLES[name].ramp, STYLES[name].has_latitude_tints)) == 1


RASTERS = {
    "Greenland": ("EPSG:3413", 100_000.0, -1_500_000.0, 300.0), "Tromso": ("EPSG:32633", 640_000.0, 7_730_000.0, 1100.0),
    "the Sahara's edge": ("EPSG:32632", 400_000.0, 2_000_000.0, 700.0), "the Alps": ("EPSG:32632", 400_000.0, 5_150_000.0, 2900.0),
    "the Antarctic Peninsula": ("EPSG:3031", -2_400_000.0, 1_500_000.0, 100.0),
}  # fmt: skip


@pytest.fixture(params=RASTERS)
def hilly(request, write_raster, make_scene):
    """Return hilly ground of 160 x 160 cells of 120 m, in a region where colours change with latitude."""
    crs, x0, y0, base = RASTERS[request.param]
    row, col = np.mgrid[:160, :160]
    waves = 250.0 * np.sin(row / 11.0) * np.cos(col / 13.0)
    return make_scene(write_raster((base + waves).astype(np.float32), crs, x0, y0, 120.0), 225.0, 30.0, style="natural")


def test_fast_path_has_the_same_climate(gl, hilly):
    """Compare the loop that shades bare ground row by row with the loop that shades any buffer."""
    grid = tile_grid(matrix_sets.get("WebMercatorQuad"), 10)
    (north, south), (west, east) = extent_on_grid(hilly.world, hilly.elevation, grid)
    rows, cols = int(south - north) // 2, int(east - west) // 2
    view = MapView(grid, float(np.floor(north)) + rows // 2, float(np.floor(west)) + cols // 2, 1.0, 1.0, rows, cols)
    plan = plan_of(hilly, view)
    assert can_draw_from_heights(hilly, view, plan, SHADING_NEEDS)
    fast_picture, frame = draw_by_heights(hilly, view, plan), render_frame(hilly, view, plan)
    assert fast_picture is not None and frame.valid.sum() > 3000
    color_difference = np.abs(fast_picture.color.astype(int) - frame.color).max(axis=-1)
    assert color_difference.max() <= 1 and (color_difference > 0).mean() < 1e-3
    own_ramp = StyleSpec(name="natural", ramp=STYLE_RAMP)
    without_climate = draw_by_heights(dataclasses.replace(hilly, style_spec=own_ramp), view, plan)
    assert without_climate is not None, "a custom ramp applies at all latitudes"
    assert (np.abs(without_climate.color.astype(int) - fast_picture.color).max(axis=-1) > 4).mean() > 0.1, (
        "the climate must change visible colours"
    )


@pytest.mark.parametrize("latitude", [-70.0, -24.0, 25.0, 45.0, 66.0, 80.0])
@pytest.mark.parametrize("height", [20.0, 900.0, 3100.0])
def test_place_has_one_colour_in_all_maps(write_raster, make_scene, latitude, height):
    """Ground of constant height in a raster of degrees, in two CRSs and at two pixel sizes, has the closed-form colour."""
    heights = np.full((60, 60), height, np.float32)
    heights[0, 0] += 50.0
    scene = make_scene(write_raster(heights, "EPSG:4326", 10.0, latitude + 0.5, 1.0 / 60.0), 180.0, 30.0)
    level_pixel_counts = []
    for crs, size in (("EPSG:4326", (61, 61)), ("EPSG:4326", (33, 33)), (f"EPSG:{scene.map_crs.to_epsg()}", (61, 61))):
        buffer = geometry_buffer(scene, scene.view(size=size, crs=crs))
        earth = buffer.frame.points_to_earth(buffer.position_frame_m)
        sine = earth[..., 2] / np.linalg.norm(earth, axis=-1)
        albedo = albedo_of(buffer, scene)
        level = buffer.valid & (np.abs(buffer.height_m - height) < 0.01)
        table = tint_table(STYLE_RAMP, True)
        for k in range(3):
            table_row = (sine[level] + 1.0) / 2.0 * (TINT_LATITUDE_ROWS - 1)
            column = np.array([np.interp(height, -512.0 + 8.0 * np.arange(table.shape[1]), row[:, k]) for row in table])
            np.testing.assert_allclose(albedo[level][:, k], np.interp(table_row, np.arange(TINT_LATITUDE_ROWS), column), atol=2e-6)
        level_pixel_counts.append(level.sum())
    assert min(level_pixel_counts) > 500
