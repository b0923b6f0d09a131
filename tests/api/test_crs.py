"""Rasters in any CRS: their shadows follow geodesics, on the raster's own cells, or one error gives the reason for refusal."""

from __future__ import annotations

import json
import warnings
from datetime import date
from pathlib import Path

import numpy as np
import pytest
import rasterio
from affine import Affine
from pyproj import CRS, Transformer
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import CRSError, ProjError

import skugga
from skugga.api.compute import write_rasters
from skugga.api.products.mask import MASK_NO_SURFACE, MASK_SHADOW
from skugga.api.raster_view import raster_view
from skugga.terrain.errors import InputError, SourceError, UnsupportedError
from skugga.terrain.geo.clock import parse_clock
from skugga.terrain.geo.daily_windows import parse_window, windows_between
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, ellipsoid_of, is_on_earth, longitude_latitude_of, transformer
from skugga.terrain.level.level import load_level, parse_sun
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.api.crs_towers import ALTITUDE_DEG, AZIMUTHS_DEG, SIDE, mask_of, plain_with_tower, shadow_deviation, write_plain
from tests.products import shade_array, sun_hours_of, write_shade
from tests.rasters import write_geotiff

BEARING_DEG, LENGTH_M = 2.0, 15.0
"""Tolerance of a shadow's bearing and length. Cells are 10 m wide, the tower 50 m."""

DAY = date(2024, 10, 21)

ROTATED = "+proj=ob_tran +o_proj=longlat +o_lon_p=0 +o_lat_p=39.25 +lon_0=18 +ellps=WGS84"

SAMPLES = [
    ("EPSG:32632", 9.3, 48.0),
    ("EPSG:4326", 9.3, 48.0),
    ("EPSG:4807", 2.0, 46.0),  # Paris, grads
    ("IGNF:NTFPGRAD", 2.0, 46.0),  # longitude first
    ("EPSG:4806", 12.0, 42.0),  # Rome
    ("EPSG:4817", 10.0, 60.0),  # Oslo
    ("EPSG:4816", 10.0, 35.0),  # Paris, grads, on another datum
    ("+proj=longlat +pm=paris +ellps=clrk80ign +towgs84=-168,-60,320", 2.0, 46.0),
    (ROTATED, 10.0, 50.0),
    ("EPSG:5513", 15.0, 49.8),  # south, west
    ("EPSG:5513+5705", 15.0, 49.8),
    ("EPSG:2053", 29.0, -26.0),  # west, south
    ("EPSG:3035", 10.0, 52.0),  # north, east
    ("EPSG:3413", -45.0, 75.0),  # south, south
    ("EPSG:3031", 120.0, -75.0),  # north, north
    ("+proj=tmerc +lon_0=9 +axis=wnu +ellps=WGS84", 9.3, 48.0),
    ("+proj=tmerc +lon_0=9 +axis=nwu +ellps=WGS84", 9.3, 48.0),
    ("+proj=tmerc +lon_0=9 +axis=esu +ellps=WGS84", 9.3, 48.0),
    ("EPSG:2225", -122.0, 41.0),  # feet
    ("IAU_2015:30100", 10.0, 20.0),  # the Moon
    ("IAU_2015:30110", 10.0, 20.0),
    ("IAU_2015:49901", 10.0, 20.0),  # Mars, north, west
    ("IAU_2015:49911", 10.0, 20.0),  # west, north
    ("IAU_2015:51300", 10.0, 20.0),  # Leda, 5 km in radius
    ("IAU_2015:61500", 12.0, 21.3),  # Atlas, 15 km
    ("IAU_2015:71410", 12.0, 21.3),  # Belinda, 33 km
    ("IAU_2015:51400", 12.0, 21.3),  # Thebe, 49 km
    ("IAU_2015:200043301", 12.0, 21.3),  # Eros, 17 km by 5.5 km
]


def open_scene(raster: Path) -> Scene:
    """Return the scene of a raster file."""
    return build_scene(load_level(raster))


def shadow_faults(folder: Path, crs: CRS, lon: float, lat: float, azimuths: tuple[float, ...] = AZIMUTHS_DEG) -> list[str]:
    """Return the faults of a tower's shadows at a place of a CRS's own celestial body.

    A body so small that the tower's shadow has no end, or that night covers a corner of the plain, is not judged.
    """
    lon_lat_crs, geod = longitude_latitude_of(crs), ellipsoid_of(crs)
    source = folder / "tower.vrt"
    write_plain(source, crs, lon, lat, lon_lat_crs, geod)
    faults, scene = [], open_scene(source)
    for azimuth in azimuths:
        mask = shade_array(scene, raster_view(scene), "mask", SunSpec(azimuth=azimuth, altitude=ALTITUDE_DEG))
        deviation = shadow_deviation(mask, source, crs, azimuth, lon_lat_crs, geod)
        if np.isinf(deviation.length_error_m):
            continue
        if abs(deviation.bearing_error_deg) > BEARING_DEG or abs(deviation.length_error_m) > LENGTH_M or deviation.dark_rim_cells:
            faults.append(f"{crs.name}, azimuth {azimuth}: {deviation}")
    scene.close()
    return faults


@pytest.mark.parametrize(("code", "lon", "lat"), SAMPLES)
def test_shadows_follow_geodesics(tmp_path, code, lon, lat):
    assert not shadow_faults(tmp_path, CRS.from_user_input(code), lon, lat, AZIMUTHS_DEG[::2])


CRS_TYPES = (PJType.PROJECTED_CRS, PJType.GEOGRAPHIC_2D_CRS, PJType.DERIVED_PROJECTED_CRS)


def all_crs(kinds: tuple[PJType, ...]) -> list[tuple[str, tuple[float, float, float, float] | None]]:
    """Return codes of PROJ's database with their areas of use."""
    infos = query_crs_info(pj_types=list(kinds), allow_deprecated=True)
    return [(f"{info.auth_name}:{info.code}", info.area_of_use and tuple(info.area_of_use)[:4]) for info in infos]  # type: ignore[misc]


def centre_of_area(area: tuple[float, float, float, float] | None) -> tuple[float, float]:
    """Return a place in an area of use.

    In the area of a whole globe it avoids poles, axes and multiples of 5 degrees of latitude: PROJ interpolates the projection
    between these, and its inverse has a kink there.
    """
    if area is None or area[2] - area[0] > 300.0:
        south, north = (-80.0, 80.0) if area is None else (area[1], area[3])
        return 12.0, float(np.clip(21.3, south + 1.0, north - 1.0))
    west, south, east, north = area
    lon = (west + east + (360.0 if east < west else 0.0)) / 2.0
    return (lon + 180.0) % 360.0 - 180.0, float(np.clip((south + north) / 2.0, -89.0, 89.0))


def place_in(crs: CRS, area: tuple[float, float, float, float] | None) -> tuple[float, float]:
    """Return a place of a CRS: the centre of its area of use, or 50 km off its origin if the centre is off its map.

    Raises ``ProjError``.
    """
    lon_lat_crs, place = longitude_latitude_of(crs), centre_of_area(area)
    if np.isfinite(Transformer.from_crs(lon_lat_crs, crs, always_xy=True).transform(*place)).all():
        return place
    lon, lat = Transformer.from_crs(crs, lon_lat_crs, always_xy=True).transform(5e4, 5e4)
    if not np.isfinite([lon, lat]).all():
        raise ProjError(f"no place of {crs.name} is known")
    return lon, lat


SAMPLE_INTERVAL = 80
"""The test takes one of this many of PROJ's CRSs. Each needs most of a second, all of them some hours."""


@pytest.mark.soak  # run by hand: takes minutes
def test_every_crs_of_proj_is_correct_or_refused(tmp_path):
    """Shadows in a CRS are correct, or one error names the CRS."""
    faults, served_count = [], 0
    for number, (code, area) in enumerate(all_crs(CRS_TYPES)[::SAMPLE_INTERVAL]):
        folder = tmp_path / str(number)
        folder.mkdir()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            crs = CRS.from_user_input(code)
        try:
            faults += [f"{code}: {fault}" for fault in shadow_faults(folder, crs, *place_in(crs, area))]
            served_count += 1
        except (ProjError, CRSError):  # PROJ itself cannot transform it
            origin_and_cell = (10.0, 20.0, 1e-4) if crs.is_geographic else (3e5, 4e5, 10.0)
            with pytest.raises(SourceError, match=r"(PROJ cannot transform its CRS|Give a raster in a projected)"):
                open_scene(write_geotiff(folder / "plain.tif", plain_with_tower(), crs.to_wkt(), *origin_and_cell)).close()
        except (InputError, SourceError) as error:
            assert str(error).count("\n") == 0
            # On small bodies, and at kinks of a projection, rays bend across a plain of a kilometre. On the earth they must not.
            refuses_earth = isinstance(error, UnsupportedError) and is_on_earth(crs)
            if refuses_earth or crs.name not in str(error):
                faults.append(f"{code}: {error}")
    assert served_count > 100
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(
    ("code", "lon", "lat", "expected_text"),
    [
        ("IAU_2015:30155", 0.1, 21.3, "beyond the area of its CRS"),  # the Moon, 3 km off the edge of a map of all of it
        ("IAU_2015:1025", 12.0, 21.3, "coordinates below 1e9"),  # the Sun
        ("IAU_2015:200417940", 12.0, 21.3, "outside of the area of"),  # Toutatis, off its map for a camera's fit
    ],
)
def test_a_body_that_cannot_be_shaded_is_refused_by_its_crs(tmp_path, code, lon, lat, expected_text):
    crs = CRS.from_user_input(code)
    with pytest.raises(InputError, match=expected_text) as caught:
        shadow_faults(tmp_path, crs, lon, lat, AZIMUTHS_DEG[:1])
    assert crs.name in str(caught.value) and "\n" not in str(caught.value)


def test_a_crs_without_a_transformation_is_refused(tmp_path):
    """PROJ does not implement Lambert Conic Conformal (West Orientated)."""
    raster = write_geotiff(tmp_path / "iceland.tif", plain_with_tower(), "EPSG:32627", 4e5, 7.1e6, 10.0)
    with pytest.raises(ProjError):
        Transformer.from_crs("EPSG:3052", "OGC:CRS84", always_xy=True)
    scene = open_scene(raster)
    with pytest.raises(InputError, match="crs: 'EPSG:3052' is not allowed. Allowed: a CRS into which PROJ can transform"):
        scene.check_crs("crs", CRS.from_user_input("EPSG:3052"), "EPSG:3052")
    other = write_geotiff(tmp_path / "own.tif", plain_with_tower(), "EPSG:3052", 4e5, 7.1e6, 10.0)
    with pytest.raises(SourceError, match="PROJ cannot transform its CRS '.*' into longitude and latitude and back. Use a raster"):
        open_scene(other)


def test_a_crs_with_a_one_way_transformation_is_refused(tmp_path):
    """PROJ transforms ATIG of France (grads of Paris) into WGS 84, but loses its prime meridian in the other direction."""
    write_plain(tmp_path / "tower.vrt", CRS.from_user_input("IGNF:ATIGG"), 2.25, 46.5)
    with pytest.raises(SourceError, match="PROJ cannot transform its CRS '.*ATIG .*' into longitude and latitude and back. Use"):
        open_scene(tmp_path / "tower.vrt")


@pytest.mark.parametrize("code", ["EPSG:5513", "EPSG:4807"])
def test_maps_in_a_crs_with_other_axes_are_refused(tmp_path, code):
    scene = open_scene(write_geotiff(tmp_path / "dem.tif", plain_with_tower(), "EPSG:32632", 5e5, 5.3e6, 10.0))
    with pytest.raises(InputError, match=r"the axes of .* run .*\. Use a CRS whose axes run east and north"):
        scene.view("map", crs=code)


@pytest.mark.parametrize(("code", "lon", "lat"), [("EPSG:4807", 2.0, 46.0), ("EPSG:5513", 15.0, 49.8), (ROTATED, 10.0, 50.0)])
def test_other_maps_show_the_same_shadow(tmp_path, code, lon, lat):
    """A map in longitude and latitude has the same area in shadow."""
    write_plain(tmp_path / "tower.vrt", CRS.from_user_input(code), lon, lat)
    scene = open_scene(tmp_path / "tower.vrt")
    raster_mask, sun = mask_of(tmp_path / "tower.vrt", tmp_path / "own.tif", 110.0), SunSpec(azimuth=110.0, altitude=15.0)
    write_shade(scene, raster_view(scene, crs="EPSG:4326"), "mask", [sun], [tmp_path / "map.tif"])
    with rasterio.open(tmp_path / "map.tif") as dataset:
        mask, cell = dataset.read(1), dataset.res
    area_m2 = (mask == MASK_SHADOW).sum() * cell[0] * cell[1] * 111_195.0**2 * np.cos(np.radians(lat))
    assert area_m2 / ((raster_mask == MASK_SHADOW).sum() * 100.0) == pytest.approx(1.0, abs=0.1)
    assert scene.world.anchor_lon_deg == pytest.approx(lon, abs=1e-3)
    assert scene.world.anchor_lat_deg == pytest.approx(lat, abs=1e-3)


def test_sunrise_is_equal_in_paris_and_greenwich_longitudes(tmp_path):
    """The same place is given in grads of Paris and in degrees of Greenwich."""
    for name, code in (("paris", "EPSG:4807"), ("twin", "EPSG:4326")):
        write_plain(tmp_path / f"{name}.vrt", CRS.from_user_input(code), 2.0, 46.0)
    days = []
    for name in ("paris", "twin"):
        with skugga.open_level(tmp_path / f"{name}.vrt") as level:
            days.append(level.point(2.003, 46.003, date="2024-10-21").day)
    for moment in ("sunrise", "noon", "sunset"):
        assert abs((getattr(days[0], moment) - getattr(days[1], moment)).total_seconds()) < 2.0
    assert days[0].clock == days[1].clock
    assert days[0].direct_h == pytest.approx(days[1].direct_h, abs=0.01)


def test_a_point_uses_the_crs_s_own_axis_order(tmp_path):
    """Krovak has southing and westing. GDAL puts the southing first."""
    crs = CRS.from_user_input("EPSG:5513")
    write_plain(tmp_path / "tower.vrt", crs, 15.0, 49.8)
    x, y = Transformer.from_crs("OGC:CRS84", crs, always_xy=True).transform(15.0, 49.8)
    with skugga.open_level(tmp_path / "tower.vrt") as level:
        assert level.horizon(x, y + 100.0, crs=crs).elevation_deg.max() > 20.0  # 100 m to the west of the tower
        with pytest.raises(InputError, match="point"):
            level.horizon(y, x, crs=crs)


# Another celestial body.


@pytest.mark.parametrize("code", ["IAU_2015:30100", "IAU_2015:30110", "ESRI:104905"])
def test_another_body_has_no_sun_at_a_time(tmp_path, code):
    crs = CRS.from_user_input(code)
    write_plain(tmp_path / "moon.vrt", crs, 10.0, 20.0, longitude_latitude_of(crs), ellipsoid_of(crs))
    scene = open_scene(tmp_path / "moon.vrt")
    with pytest.raises(InputError, match=r"time: .*, since '.*' is not a CRS of the earth\. Give azimuth and altitude"):
        scene.with_sun(parse_sun("2024-10-21T12:00:00Z", None, None))
    with pytest.raises(InputError, match=r"date: .*is not a CRS of the earth"):
        windows_between(scene.world, DAY, DAY, 1, parse_window("00:00-24:00"), parse_clock("clock", "utc"))
    for other in ("EPSG:4326", "EPSG:3857"):
        with pytest.raises(InputError, match=f"crs: '{other}' is not allowed. Allowed: a CRS into which PROJ can transform"):
            scene.view("map", crs=other)


def test_ground_curves_with_the_moon_s_radius(tmp_path):
    """From 100 m above level ground the horizon dips by the angle of the Moon's radius, not of the earth's."""
    crs = CRS.from_user_input("IAU_2015:30110")
    heights = np.zeros((201, 201), np.float32)
    raster = write_geotiff(tmp_path / "moon.tif", heights, crs.to_wkt(), 0.0, 201 * 500.0, 500.0)
    with skugga.open_level(raster) as level:
        middle = transformer(crs, LONGITUDE_LATITUDE).transform(100.5 * 500.0, 100.5 * 500.0)
        dip = -level.horizon(*middle, height=100.0).elevation_deg
    radius_m = ellipsoid_of(crs).a
    assert radius_m == pytest.approx(1_737_400.0)
    assert np.median(dip) == pytest.approx(np.degrees(np.arccos(radius_m / (radius_m + 100.0))), rel=0.05)


def test_mountains_of_mars_are_valid_heights(tmp_path):
    """Olympus Mons is higher than any ground of the earth."""
    heights = np.full((20, 20), 21_229.0, np.float32)
    heights[0, 0] = -32768.0  # a sentinel that the file does not declare
    scene = open_scene(write_geotiff(tmp_path / "mars.tif", heights, "IAU_2015:49910", 0.0, 2e5, 1000.0))
    assert scene.height_range_m == pytest.approx((21_229.0, 21_229.0))
    assert not np.isfinite(scene.elevation.ground_m(*scene.elevation.xy(0, 0)))
    assert scene.elevation.ground_m(*scene.elevation.xy(9, 9)) == pytest.approx(21_229.0)


# Rasters whose rows do not begin in the north-west.

FLIPS = {
    "south-up": lambda heights: (heights[::-1], Affine(10.0, 0.0, 5e5, 0.0, 10.0, 5.3e6)),
    "half turn": lambda heights: (heights[::-1, ::-1], Affine(-10.0, 0.0, 5e5 + 10 * heights.shape[1], 0.0, 10.0, 5.3e6)),
    "mirrored": lambda heights: (heights[:, ::-1], Affine(-10.0, 0.0, 5e5 + 10 * heights.shape[1], 0.0, -10.0, 5.3e6 + 1010.0)),
    "transposed": lambda heights: (heights.T, Affine(0.0, 10.0, 5e5, -10.0, 0.0, 5.3e6 + 1010.0)),
}


def asymmetric_heights() -> np.ndarray:
    """Return heights (101, 90) without any symmetry under flips."""
    row, col = np.mgrid[:101, :90].astype(np.float32)
    heights = (45.0 * np.sin(row / 9.0) * np.cos(col / 6.0 + row / 20.0)).astype(np.float32)
    heights[20:31, 55:66] += 60.0
    return heights


@pytest.fixture(params=FLIPS)
def flipped(request, tmp_path) -> tuple[Path, Path, object]:
    """Return a flipped raster, the same raster north up, and the function that flips cells of the latter."""
    heights = asymmetric_heights()
    north_up_raster = write_geotiff(tmp_path / "north_up_raster.tif", heights, "EPSG:32632", 5e5, 5.3e6 + 1010.0, 10.0)
    cells, transform = FLIPS[request.param](heights)
    flipped_raster = write_geotiff(
        tmp_path / "flipped_raster.tif", np.ascontiguousarray(cells), "EPSG:32632", 0, 0, 1.0, transform=transform
    )
    return flipped_raster, north_up_raster, lambda array: FLIPS[request.param](array)[0]


def test_masks_lie_on_flipped_cells(tmp_path, flipped):
    flipped_raster, north_up_raster, flip = flipped
    masks = {path: mask_of(path, tmp_path / "mask.tif", 200.0) for path in (flipped_raster, north_up_raster)}
    assert 0.05 < (masks[north_up_raster] == MASK_SHADOW).mean() < 0.9
    np.testing.assert_array_equal(masks[flipped_raster], flip(masks[north_up_raster]))
    assert not (masks[flipped_raster] == MASK_NO_SURFACE).any()


def test_like_accepts_flipped_cells(tmp_path, flipped):
    flipped_raster, north_up_raster, flip = flipped
    scene, sun = open_scene(north_up_raster), SunSpec(azimuth=200.0, altitude=15.0)
    write_shade(scene, raster_view(scene, like=flipped_raster), "mask", [sun], [tmp_path / "like.tif"])
    with rasterio.open(tmp_path / "like.tif") as output_dataset, rasterio.open(flipped_raster) as source_dataset:
        assert (output_dataset.transform, output_dataset.shape, output_dataset.crs) == (
            source_dataset.transform,
            source_dataset.shape,
            source_dataset.crs,
        )
        np.testing.assert_array_equal(output_dataset.read(1), flip(mask_of(north_up_raster, tmp_path / "mask.tif", 200.0)))


def test_sun_hours_lie_on_flipped_cells(tmp_path, flipped):
    flipped_raster, north_up_raster, flip = flipped
    hours_by_path = {}
    for path in (flipped_raster, north_up_raster):
        scene = open_scene(path)
        hours = sun_hours_of(date=DAY, window="10:00-12:00", step_min=60.0)
        write_rasters(scene, raster_view(scene), [hours], [tmp_path / "hours.tif"])
        with rasterio.open(tmp_path / "hours.tif") as output_dataset, rasterio.open(path) as source_dataset:
            assert (output_dataset.transform, output_dataset.shape) == (source_dataset.transform, source_dataset.shape)
            hours_by_path[path] = output_dataset.read(1)
    assert 0.1 < hours_by_path[north_up_raster].mean() < 1.95
    np.testing.assert_allclose(hours_by_path[flipped_raster], flip(hours_by_path[north_up_raster]), atol=0.02)


def test_the_library_returns_flipped_cells(tmp_path, flipped):
    flipped_raster, north_up_raster, flip = flipped
    answers = {}
    for path in (flipped_raster, north_up_raster):
        with skugga.open_level(path) as level, rasterio.open(path) as source_dataset:
            assert (level.transform, level.shape) == (source_dataset.transform, source_dataset.shape)
            answers[path] = level.shade(azimuth=200.0, altitude=15.0), level.sun_hours("2024-10-21", step_min=60.0)
    for flipped_array, north_up_array in zip(answers[flipped_raster], answers[north_up_raster], strict=True):
        np.testing.assert_allclose(flipped_array, flip(north_up_array), atol=0.02)


def test_a_part_of_flipped_cells_equals_the_whole(tmp_path, flipped):
    flipped_raster, _, _ = flipped
    scene, sun = open_scene(flipped_raster), SunSpec(azimuth=200.0, altitude=15.0)
    full_mask = mask_of(flipped_raster, tmp_path / "mask.tif", 200.0)
    bounds = 5e5 + 200.0, 5.3e6 + 300.0, 5e5 + 600.0, 5.3e6 + 900.0
    write_shade(scene, raster_view(scene, bounds=bounds), "mask", [sun], [tmp_path / "part.tif"])
    with rasterio.open(tmp_path / "part.tif") as part, rasterio.open(flipped_raster) as source_dataset:
        offset = ~source_dataset.transform @ part.transform
        col, row = round(offset.c), round(offset.f)
        corners = np.array([[part.transform.c, part.transform.f]]) + np.array([[0, 0], [part.width, part.height]]) @ (
            np.array([[part.transform.a, part.transform.d], [part.transform.b, part.transform.e]])
        )
        assert (*corners.min(axis=0), *corners.max(axis=0)) == pytest.approx(bounds, abs=1e-3)
        np.testing.assert_array_equal(part.read(1), full_mask[row : row + part.height, col : col + part.width])


@pytest.mark.parametrize("cell", [(10.0, 10.0003), (10.0, 13.4), (13.4, 10.0), (11.7, 10.0)])
def test_cells_that_are_not_square_are_all_valid(tmp_path, cell):
    raster = write_geotiff(tmp_path / "oblong.tif", np.zeros((SIDE, SIDE), np.float32), "EPSG:32632", 5e5, 5.3e6, cell)
    assert not (mask_of(raster, tmp_path / "mask.tif", 200.0) == MASK_NO_SURFACE).any()


@pytest.mark.parametrize("cell", [(10.0, 13.4), (14.4, 10.0), (10.0, 35.0)])
def test_cells_that_are_not_square_have_their_own_heights(tmp_path, cell):
    heights = np.random.default_rng(5).uniform(0.0, 30.0, (SIDE, SIDE)).astype(np.float32)
    raster = write_geotiff(tmp_path / "oblong.tif", heights, "EPSG:32632", 5e5 - cell[0] * SIDE / 2, 5.3e6, cell)
    mask = mask_of(raster, tmp_path / "mask.tif", 247.0, 25.0)
    library_shadow = skugga.shadow(heights, cell[::-1], 247.0, 25.0, lines=64)
    inside = np.s_[2:-2, 2:-2]  # the two differ in their treatment of the rim
    assert ((mask == MASK_SHADOW) != library_shadow)[inside].mean() < 0.002


@pytest.mark.parametrize("algorithm", ["auto", "shadow_map", "shadow_volume", "truth"])
def test_buildings_keep_their_place_on_oblong_cells(gl, tmp_path, algorithm):
    x0, y0, cell = 5e5, 5.3e6, (5.0, 10.0)
    ground = write_geotiff(tmp_path / "oblong.tif", np.zeros((60, 120), np.float32), "EPSG:32632", x0, y0, cell)
    footprint = [[x0 + x, y0 - y] for x, y in ((200, 300), (240, 300), (240, 340), (200, 340), (200, 300))]
    feature = {"type": "Feature", "properties": {"height": 60.0}, "geometry": {"type": "Polygon", "coordinates": [footprint]}}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    houses = tmp_path / "houses.geojson"
    houses.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}), encoding="utf-8")
    with skugga.open_level(ground, buildings=houses) as level:
        mask = level.shade("mask", azimuth=270.0, altitude=45.0, algorithm=algorithm)
    rows, cols = np.nonzero(mask == MASK_SHADOW)
    assert (rows.min(), rows.max()) == (30, 33)
    assert (cols.min(), cols.max()) == (48, 59)  # 60 m from the wall on; roofs are lit
