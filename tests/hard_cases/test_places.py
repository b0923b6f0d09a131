"""Places on earth: masts whose shadows are known in closed form, in every kind of CRS, at the pole and across the antimeridian."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from pyproj import Transformer
from scipy.spatial import ConvexHull

from skugga.selector.measure.footprint import texel_footprint_px
from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.geo.grid import Grid, MapView
from skugga.terrain.geo.sun import apparent_sun_position
from skugga.terrain.geo.world import WGS84
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import RenderedView, Trial, View, hard_case

MAST_M = 100.0
"""Height of a mast: a block of 5 x 5 cells on level ground, whose walls are a cell wide."""


@dataclass(frozen=True)
class Place:
    """The position of a mast, degrees; the CRS of its raster, and the side of the cells in units of it."""

    crs: str
    lon: float
    lat: float
    cell: float
    units: str = "m"
    cells: int = 161

    @property
    def xy(self) -> tuple[float, float]:
        """Return map coordinates of the mast."""
        return Transformer.from_crs("OGC:CRS84", self.crs, always_xy=True).transform(self.lon, self.lat)


def mast(trial: Trial, place: Place, sun: tuple[float, float], name: str = "mast") -> Scene:
    """Return a mast on level ground in the middle of a raster; it is the level's anchor."""
    heights = np.zeros((place.cells, place.cells), np.float32)
    middle = place.cells // 2
    heights[middle - 2 : middle + 3, middle - 2 : middle + 3] = MAST_M / (1200.0 / 3937.0 if place.units == "us-ft" else 1.0)
    return trial.scene({"source": str(_raster(trial, heights, place, name)), "units": place.units}, sun, name=name)


def _raster(trial: Trial, heights: np.ndarray, place: Place, name: str) -> Path:
    """Write heights (rows, cols) as a raster around a place and return its path."""
    x, y = place.xy
    half = place.cells * place.cell / 2
    return trial.raster(heights, place.crs, x - half, y + half, place.cell, name=name)


def _to_local(lon: float, lat: float) -> Transformer:
    """Return the transformer from earth-fixed metres to east, north and up at a place."""
    return Transformer.from_pipeline(f"+proj=topocentric +ellps=WGS84 +lon_0={lon} +lat_0={lat} +h_0=0")


def _to_earth() -> Transformer:
    """Return the transformer from degrees and metres of height to earth-fixed metres."""
    return Transformer.from_pipeline("+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart")


def view_of(trial: Trial, scene: Scene, px: int) -> View:
    """Return the view of the mast and its shadow: a map on the raster's nodes, or a camera above for algorithms without maps."""
    if trial.serves_maps:
        x, y = (float(v) for v in scene.elevation.xy(0, 0))
        step = float(scene.elevation.xy(0, 1)[0]) - x
        pixel = (scene.elevation.cols - 2) / px
        return MapView(Grid(scene.elevation.crs, x, y, step), 0.5 + pixel / 2, 0.5 + pixel / 2, pixel, pixel, px, px)
    anchor, axes = scene.world.anchor_earth_m, scene.world.earth_from_anchor
    eye = anchor + axes @ np.array([90.0, -120.0, 700.0])
    return look_at(eye, anchor, axes[:, 2], 50.0, px, px)


def outline_error_m(rendered: RenderedView, place: Place, azimuth: float, altitude: float) -> float:
    """Return the largest distance of wrong pixels from the outline of the mast's shadow, metres: lit inside or dark outside.

    Outline and points are compared in east, north and up at the mast by PROJ's topocentric conversion. The class of a point is
    exact there, so pixels need not be small.
    """
    local = _to_local(place.lon, place.lat)
    frame = rendered.buffer.frame
    earth_m = rendered.buffer.position_frame_m @ frame.frame_from_earth + frame.origin_earth_m
    points = np.stack(local.transform(*np.moveaxis(earth_m, -1, 0)), axis=-1)
    x, y = place.xy
    # Quads are cut along the higher diagonal: a ridge runs down from each of the mast's corners to that of its foot.
    corners = []
    for half_cells, height_m in ((2, MAST_M), (3, 0.0)):
        at = half_cells * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * place.cell
        lon, lat = Transformer.from_crs(place.crs, "OGC:CRS84", always_xy=True).transform(x + at[:, 0], y + at[:, 1])
        corners.append(np.stack(local.transform(*_to_earth().transform(lon, lat, np.full(len(lon), height_m))), axis=-1))
    shadow_offset = -np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))]) / np.tan(np.radians(altitude))
    projected = [corner[:, :2] + corner[:, 2:] * shadow_offset for corner in (*corners, points.reshape(-1, 3))]
    hull = ConvexHull(np.concatenate(projected[:2]))
    outside = np.max(projected[2] @ hull.equations[:, :2].T + hull.equations[:, 2], axis=-1).reshape(points.shape[:2])
    ground = rendered.buffer.valid & (np.abs(rendered.buffer.height_m) < 1e-3)
    foot_hull = ConvexHull(corners[1][:, :2])
    outside_foot = np.max(points[..., :2] @ foot_hull.equations[:, :2].T + foot_hull.equations[:, 2], axis=-1) > 0.05
    ground &= outside_foot
    assert (ground & (outside < -2.0)).any() and (ground & (outside > 2.0)).any(), "ground inside of the outline and outside"
    return float(np.abs(outside[ground & (rendered.dark != (outside < 0.0))]).max(initial=0.0))


def texel_m(rendered: RenderedView) -> float:
    """Return the longer side of an algorithm's largest texels on the ground; 0 without texels."""
    pixel_m = describe(rendered.scene, rendered.view).pixel_m
    (step,) = rendered.plan.steps
    return float(np.max(texel_footprint_px(rendered.scene, step, rendered.buffer, pixel_m))) * pixel_m


def resampled_m(rendered: RenderedView) -> float:
    """Return the distance of the nodes of a camera's ground mesh if these are not the raster's own; else 0."""
    ground = rendered.buffer.ground
    return (
        0.0 if ground is None or ground.grid.crs == rendered.scene.elevation.crs else describe(rendered.scene, rendered.view).node_m
    )


def worst_outline_error(
    trial: Trial, place: Place, suns: list[tuple[float, float]], tolerance_m: float, name: str = "mast"
) -> float:
    """Return the largest distance of a mast's shadow from its outline under some suns.

    The unit is the tolerance, or a texel if that is larger.
    """
    return max(relative_outline_error(trial, mast(trial, place, sun, name), place, sun, tolerance_m) for sun in suns)


def relative_outline_error(trial: Trial, scene: Scene, place: Place, sun: tuple[float, float], tolerance_m: float) -> float:
    """Return the distance of one scene's shadow from its outline, in units of the tolerance or a texel."""
    px, size = (320, 2048) if trial.thorough else (160, 1024)
    rendered = trial.render_view(scene, view_of(trial, scene, px), map_size=size, filter=1)
    return outline_error_m(rendered, place, *sun) / max(tolerance_m, texel_m(rendered), resampled_m(rendered))


@hard_case(
    "H25",
    "A mast's shadow lies at its bearing from true north",
    "a mast of 100 m in UTM, 3 degrees off the meridian at 57.7 N, where grid north is 2.5 degrees off",
    {"off its outline, of 0.1 m or a texel": 1.0},
)
def test_true_north(trial: Trial) -> dict[str, float]:
    """Cells are 1 m wide. The sweep has eight lines per cell, and may err by a fraction of a cell between two lines."""
    place = Place("EPSG:32633", 18.0, 57.7, 1.0, cells=261)
    suns = [(67.0, 40.0), (180.0, 40.0), (222.0, 40.0), (300.0, 50.0)]
    suns = suns if trial.thorough else suns[:1]
    return {"off its outline, of 0.1 m or a texel": worst_outline_error(trial, place, suns, 0.1)}


SAME_PLACE_BY_CRS = {
    "geographic": Place("EPSG:4326", -85.3, 36.1, 2e-5, cells=321),
    "utm": Place("EPSG:32616", -85.3, 36.1, 4.0),
    "mercator": Place("EPSG:3857", -85.3, 36.1, 5.0),
    "state plane in feet": Place("EPSG:2274", -85.3, 36.1, 13.0, "us-ft"),
}


@hard_case(
    "G3",
    "A scene throws the same shadows in every CRS",
    "a mast of 100 m in longitude and latitude, UTM, Web Mercator, and a state plane and heights in feet",
    {"off its outline, of 1 % of its length": 1.0, "sun_deg": 1e-6},
)
def test_same_scene_in_every_crs(trial: Trial) -> dict[str, float]:
    """The expected sun is that of one time at each place, computed by the library that the engine uses."""
    time = datetime.fromisoformat("2024-10-21T15:00:00-05:00")
    azimuth, altitude, _ = apparent_sun_position(time, -85.3, 36.1)
    length_m, outline_error, sun_error_deg = MAST_M / np.tan(np.radians(altitude)), 0.0, 0.0
    tested_places = (
        SAME_PLACE_BY_CRS if trial.thorough else {name: SAME_PLACE_BY_CRS[name] for name in ("geographic", "state plane in feet")}
    )
    for name, place in tested_places.items():
        outline_error = max(outline_error, worst_outline_error(trial, place, [(azimuth, altitude)], 0.01 * length_m, name))
        sun = mast(trial, place, (0.0, 10.0), name).with_sun(SunSpec(time=time)).sun
        assert sun is not None
        sun_error_deg = max(sun_error_deg, abs(sun.azimuth_deg - azimuth), abs(sun.altitude_deg - altitude))
    return {"off its outline, of 1 % of its length": outline_error, "sun_deg": sun_error_deg}


@hard_case(
    "G4",
    "In Web Mercator a shadow is as long as on the ground, at every latitude",
    "a mast of 100 m under a sun of 30 degrees at latitudes 0, 45, 60 and 80",
    {"off its outline, of 0.5 % of 173.2 m": 1.0},
)
def test_web_mercator(trial: Trial) -> dict[str, float]:
    outline_error = 0.0
    for lat in (0.0, 45.0, 60.0, 80.0) if trial.thorough else (0.0, 80.0):
        place = Place("EPSG:3857", 24.0, lat, 4.0 / np.cos(np.radians(lat)))
        outline_error = max(outline_error, worst_outline_error(trial, place, [(222.0, 30.0)], 0.005 * 173.2, f"at{lat:.0f}"))
    return {"off its outline, of 0.5 % of 173.2 m": outline_error}


POLAR = "+proj=stere +lat_0=90 +lat_ts=70 +lon_0={} +datum=WGS84"
EDGES_OF_THE_MAP = {
    "antimeridian": (Place("EPSG:4326", 180.0, -17.0, 2e-5, cells=321), Place("EPSG:4326", 140.0, -17.0, 2e-5, cells=321)),
    "85 degrees north": (Place(POLAR.format(-45), 180.0, 85.0, 4.0), Place(POLAR.format(15), -120.0, 85.0, 4.0)),
    "pole": (Place(POLAR.format(-45), 0.0, 90.0, 4.0), Place("+proj=stere +lat_0=57 +lon_0=15 +k_0=0.969858", 15.0, 57.0, 4.0)),
}
"""Places where longitudes break or meet, each with a similar place without a break."""

MIDSUMMER = {"antimeridian": "2024-06-21T02:00:00+00:00"}


@hard_case(
    "G2",
    "Where longitudes break and meet, the sun stands right and no seam shows",
    "a level across the antimeridian, one at 85 degrees north, and a polar stereographic one at the pole",
    {"azimuth_deg": 0.1, "off its outline, of 0.1 degrees": 1.0, "seam_255": 2.0},
)
def test_edges_of_the_map(trial: Trial) -> dict[str, float]:
    """``azimuth_deg`` compares the level's one sun, seen from places 10 km around, with the sun's position there; PROJ gives
    the axes.

    ``seam_255`` is the largest difference of the picture of a smooth hill from one at a place without a break.
    """
    azimuth_deg, outline_error, seam_error = 0.0, 0.0, 0.0
    for name, (place, twin) in EDGES_OF_THE_MAP.items():
        if name == "85 degrees north" and not trial.thorough:
            continue
        time = datetime.fromisoformat(MIDSUMMER.get(name, "2024-06-21T07:00:00+00:00"))
        sun = apparent_sun_position(time, place.lon, place.lat)[:2]
        scene = mast(trial, place, (0.0, 10.0), name).with_sun(SunSpec(time=time))
        tolerance_m = np.radians(0.1) * MAST_M / np.sin(np.radians(sun[1]))
        outline_error = max(outline_error, relative_outline_error(trial, scene, place, sun, tolerance_m))
        azimuth_deg = max(azimuth_deg, _azimuth_error_deg(scene, place, time))
        pictures = [_hill(trial, hill_place, f"{kind} at {name}") for kind, hill_place in (("hill", place), ("twin", twin))]
        seam_error = max(seam_error, float(np.abs(pictures[0] - pictures[1]).max()))
    return {"azimuth_deg": azimuth_deg, "off its outline, of 0.1 degrees": outline_error, "seam_255": seam_error}


def _azimuth_error_deg(scene: Scene, place: Place, time: datetime) -> float:
    """Return the largest error of the sun's azimuth at points 10 km round a place, degrees."""
    assert scene.sun is not None
    worst = 0.0
    for bearing in (10.0, 100.0, 190.0, 280.0):
        lon, lat, _ = WGS84.fwd(place.lon, place.lat, bearing, 10_000.0)
        origin_m = np.array(_to_earth().transform(lon, lat, 0.0))
        east, north, _ = _to_local(lon, lat).transform(*(origin_m + 1e6 * scene.sun.to_sun_earth))
        error_deg = np.degrees(np.arctan2(east, north)) - apparent_sun_position(time, lon, lat)[0]
        worst = max(worst, abs(float((error_deg + 180.0) % 360.0 - 180.0)))
    return worst


def _hill(trial: Trial, place: Place, name: str) -> np.ndarray:
    """Return the picture (rows, cols, 3) of a smooth hill at a place, of 255. Grid north is true north there."""
    axis = (np.arange(place.cells) - place.cells // 2) / place.cells
    heights = (40.0 * np.exp(-8.0 * (axis[:, None] ** 2 + axis**2))).astype(np.float32)
    scene = trial.scene(_raster(trial, heights, place, name), (143.0, 27.0), name=name)
    scene = scene.with_style("swiss", None)  # the twin has another latitude: the colours must not depend on it
    view = view_of(trial, scene, 96)
    if isinstance(view, PerspectiveView):
        view = view.part(30, 30, 36, 36)  # only ground
    plan = make_plan(describe(scene, view), scene.loaded.level, {"algorithm": trial.algorithm})
    color = render_frame(scene, view, plan).color.astype(int)
    assert np.ptp(color) > 10, "a hill that is lit from one side"
    return color
