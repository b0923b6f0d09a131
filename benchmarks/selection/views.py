"""Scenes and views for the evaluation of the selector: families of them, each on its own terrain."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from benchmarks.selection.synthetic import SITES, Site, write_site
from skugga.api.catalogue import find_level
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

Family = Literal[
    "thesis, spot", "thesis, sun", "relief, map", "relief, perspective", "wooded, map", "wooded, perspective", "dense wood"
]  # fmt: skip

PERSPECTIVE_PX, MAP_PX, DENSE_PX = (640, 512), (512, 512), (320, 256)
"""Sizes of pictures in pixels, (columns, rows): perspective views, maps, and views of dense woods."""

SunAngles = tuple[float, float]
"""Azimuth and altitude of the sun, degrees."""

FAULT_BOUNDS = (740_900.0, 4_021_000.0, 747_300.0, 4_027_400.0)
"""West, south, east and north, metres in UTM zone 16: the ridge of the Jacksboro fault and the hills west of it."""
VILLAGE_BOUNDS = (754_330.0, 4_012_390.0, 755_530.0, 4_013_590.0)
"""West, south, east and north, metres in UTM zone 16: houses, hedges and woods in the valley of the Jacksboro fault."""

CITY = "urban/goteborg_1m"
"""Folder of the rasters of Gothenburg, below the folder of sample data."""

DENSE_WOOD_BOUNDS = (-84.200, 36.21633, -84.148, 36.25433)
"""West, south, east and north, degrees: a part of the Jacksboro fault, modelled as entirely wooded."""


@dataclass(frozen=True)
class ViewInstance:
    """A view of a scene under a light.

    ``terrain`` is the ground that the view belongs to. All views of a terrain are held out of model fits together. ``level`` is a
    bundled level's name, a made terrain, or the keys of a level whose files lie in the folder of sample data. ``view`` is a view's
    name or its keys. ``bounds`` are those of a map. ``sun`` is azimuth and altitude in degrees; without it the level's light is
    used.
    """

    name: str
    family: Family
    terrain: str
    level: str | Site | dict[str, Any]
    view: str
    sun: SunAngles | None = None
    bounds: tuple[float, float, float, float] | None = None
    unseen: bool = False
    """Whether its terrain is held out of all models."""
    camera: tuple[float, float, float, float, float] | None = None
    """A perspective view without a name in its level: shares of the ground's extent from west and south of the eye and the
    target (eye_x, eye_y, target_x, target_y), and the eye's height above ground, metres.
    """
    size: tuple[int, int] | None = None
    """Columns and rows, if they differ from the default."""

    def open(self, data: Path, folder: Path) -> tuple[Scene, MapView | PerspectiveView]:
        """Build the scene and return it with its view. A level file for a scene of sample data is written into ``folder``."""
        scene = scene_of(self.level, data, folder)
        scene = scene.with_sun(None if self.sun is None else SunSpec(azimuth=self.sun[0], altitude=self.sun[1]))
        if self.camera is not None:
            scene = scene_of(self.level, data, folder, views={"eye": _perspective_view(scene, self.camera)})
            scene = scene.with_sun(None if self.sun is None else SunSpec(azimuth=self.sun[0], altitude=self.sun[1]))
            return scene, scene.view("eye", size=self.size or PERSPECTIVE_PX)
        if self.view == "map":
            return scene, scene.view("map", self.bounds or _central_bounds(scene), size=MAP_PX)
        return scene, scene.view(self.view, size=PERSPECTIVE_PX)


def scene_of(level: str | Site | dict[str, Any], data: Path, folder: Path, **further_keys: Any) -> Scene:
    """Build the scene of a bundled level, a made terrain or the keys of a level. The latter are written to ``folder``."""
    if isinstance(level, str):
        return build_scene(load_level(find_level(level)))
    keys = write_site(level, folder) if isinstance(level, Site) else level
    path = folder / "level.yaml"
    text = json.dumps({"version": 1, **keys, **further_keys}).replace("DATA/", f"{data.resolve()}/")
    (folder / "wood.geojson").write_text(json.dumps(_rectangle(DENSE_WOOD_BOUNDS)), encoding="utf-8")
    path.write_text(text, encoding="utf-8")  # JSON is YAML
    return build_scene(load_level(path))


def _rectangle(bounds: tuple[float, float, float, float]) -> dict[str, Any]:
    """Return a GeoJSON feature of a rectangle. ``bounds`` are west, south, east and north, degrees."""
    west, south, east, north = bounds
    corners = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    return {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [corners]}}


def _central_bounds(scene: Scene) -> tuple[float, float, float, float] | None:
    """Return the bounds of a raster's middle for a picture with one pixel per cell, in units of the map's CRS.

    The bounds are clamped to the raster. In flat worlds return ``None``, which stands for the whole raster.
    """
    if scene.world.is_flat:
        return None
    full_view = scene.view("map")
    assert isinstance(full_view, MapView)
    west, south, east, north = full_view.bounds
    cell = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    unit_m = 111_320.0 if scene.map_crs.is_geographic else scene.world.metres_per_unit
    half = [min(pixels * cell / unit_m, side) / 2 for pixels, side in zip(MAP_PX, (east - west, north - south), strict=True)]
    x, y = (west + east) / 2, (south + north) / 2
    return x - half[0], y - half[1], x + half[0], y + half[1]


def _perspective_view(scene: Scene, look: tuple[float, float, float, float, float]) -> dict[str, Any]:
    """Return the keys of a level's perspective view. ``look`` is ``ViewInstance.camera``."""
    assert scene.bounds_lon_lat is not None
    west, south, east, north = scene.bounds_lon_lat
    (x, y, u, v, above_m) = look
    places = [[west + a * (east - west), south + b * (north - south)] for a, b in ((x, y), (u, v))]
    return {"kind": "perspective", "eye": [*places[0], above_m], "target": [*places[1], 0.0], "fov": 48}


def _raster(path: str, **keys: Any) -> dict[str, Any]:
    """Return the keys of a level whose terrain is the file ``path`` below the folder of sample data, with further ``keys``."""
    return {"terrain": {"source": f"DATA/{path}"}, **keys}


RASTERS: dict[str, dict[str, Any]] = {
    "bigtujunga": _raster("mountain/bigtujunga_30m_utm11.tif"),
    "zion": _raster("mountain/zion_srtm_4326.tif"),
    "grenoble": _raster("mountain/grenoble_copernicus_4326.tif"),
    "sierra": _raster("mountain/sierra_30m_albers.tif"),
    "himalaya": _raster("large/globe_30arcsec_himalaya_4326.tif"),
    "vinschgau": _raster("mountain/vinschgau_250m_utm32.tif"),
    "essen": _raster("urban/essen_dom1_32_356_5699_1_nw_2020.tif"),
    "slovenia": _raster("odd/slovenia_TM1_564_146_nodata.tif"),
    "goteborg": _raster(
        f"{CITY}/DEM.tif",
        forest=[{"source": f"DATA/{CITY}/CDSM.tif"}],
        meshes=[{"source": f"DATA/{CITY}/buildings.shp", "surface": f"DATA/{CITY}/DSM.tif", "ground": f"DATA/{CITY}/DEM.tif"}],
    ),
    "goteborg, houses": _raster(
        f"{CITY}/DEM.tif",
        meshes=[{"source": f"DATA/{CITY}/buildings.shp", "surface": f"DATA/{CITY}/DSM.tif", "ground": f"DATA/{CITY}/DEM.tif"}],
    ),
    "quebec": _raster("forest/quebec_DTM.tif", forest=[{"source": "DATA/forest/quebec_CHM.tif"}]),
    "jacksboro, dense": {
        "terrain": {"source": "jacksboro", "bounds": list(DENSE_WOOD_BOUNDS)},
        "forest": [{"source": "wood.geojson", "density": 220, "height": [14, 24], "crown": [6, 9], "seed": 1}],
    },
    "sanfrancisco": _raster("urban/sanfrancisco_elev_3857.tif"),
    "lisbon": _raster("urban/lisbon_1arcsec_4326.tif"),
    "rmnp": _raster("mountain/rmnp-dem.tif"),
    "autzen": _raster("odd/autzen_feet_DSM.tif"),
    "nz": _raster("odd/nz_elev_1km_oceanholes.tif"),
    "texas": _raster("odd/texas_flat_3arcsec_4326.tif"),
    "bilbao": _raster("urban/bilbao/DEM.tif"),
    "bilbao, trees": _raster("urban/bilbao/DEM.tif", forest=[{"source": "DATA/urban/bilbao/CDSM.tif"}]),
}
"""Keys of the levels on sample rasters, by name. ``DATA`` stands for the folder of sample data."""


def _thesis() -> Iterator[ViewInstance]:
    """Yield views of the thesis's scenes, under a spot light and under the sun."""
    suns: dict[str, SunAngles | None] = {"main": None, "close": (225.0, 12.0), "overview": (140.0, 55.0), "map": (75.0, 25.0)}
    for scene in ("boxgrid", "rocks", "street", "room", "water_tower"):
        for view in ("main", "close", "overview"):
            yield ViewInstance(f"{scene}, spot, {view}", "thesis, spot", scene, f"thesis_{scene}", view)
        for view, sun in suns.items():
            yield ViewInstance(f"{scene}, sun, {view}", "thesis, sun", scene, f"thesis_{scene}_sun", view, sun)


def _relief() -> Iterator[ViewInstance]:
    """Yield maps and perspective views of terrain without trees."""
    for sun in ((237.0, 4.0), (120.0, 15.0), (200.0, 40.0), (180.0, 68.0)):
        yield ViewInstance(f"jacksboro, map, {sun[1]:g}", "relief, map", "jacksboro", "jacksboro", "map", sun, FAULT_BOUNDS)
    maps: tuple[tuple[str, tuple[SunAngles, ...]], ...] = (
        ("bigtujunga", ((301.0, 7.0), (150.0, 33.0))), ("zion", ((263.0, 20.0),)), ("grenoble", ((112.0, 9.0),)),
        ("sierra", ((203.0, 24.0),)), ("himalaya", ((95.0, 2.0), (170.0, 12.0))), ("vinschgau", ((211.0, 16.0),)),
        ("essen", ((248.0, 14.0), (160.0, 45.0))), ("slovenia", ((292.0, 6.0),)),
    )  # fmt: skip
    for name, suns in maps:
        for sun in suns:
            yield ViewInstance(f"{name}, map, {sun[1]:g}", "relief, map", name, RASTERS[name], "map", sun)
    looks: tuple[tuple[str, tuple[float, float, float, float, float], SunAngles], ...] = (
        ("bigtujunga", (0.42, 0.30, 0.55, 0.60, 350.0), (290.0, 18.0)), ("zion", (0.45, 0.35, 0.52, 0.55, 220.0), (110.0, 28.0)),
        ("grenoble", (0.60, 0.30, 0.68, 0.45, 900.0), (245.0, 11.0)), ("sierra", (0.30, 0.40, 0.40, 0.60, 400.0), (170.0, 38.0)),
        ("vinschgau", (0.45, 0.25, 0.50, 0.60, 1500.0), (300.0, 8.0)), ("essen", (0.45, 0.30, 0.50, 0.50, 45.0), (200.0, 30.0)),
    )  # fmt: skip
    for name, look, sun in looks:
        yield ViewInstance(f"{name}, eye, {sun[1]:g}", "relief, perspective", name, RASTERS[name], "eye", sun, camera=look)
    ridges = (0.7558, 0.1876, 0.6367, 0.3271, 120.0)
    for sun in ((237.0, 10.0), (120.0, 35.0)):
        jacksboro = {"terrain": {"source": "jacksboro"}}
        yield ViewInstance(
            f"jacksboro, ridges, {sun[1]:g}", "relief, perspective", "jacksboro", jacksboro, "eye", sun, camera=ridges
        )


def _wooded() -> Iterator[ViewInstance]:
    """Yield maps and perspective views of terrain with trees or houses."""
    for sun in ((255.0, 9.0), (160.0, 42.0)):
        yield ViewInstance(f"village, map, {sun[1]:g}", "wooded, map", "jacksboro", "jacksboro_wooded", "map", sun, VILLAGE_BOUNDS)
    views: tuple[tuple[str, SunAngles | None], ...] = (
        ("village", None),
        ("village", (245.0, 12.0)),
        ("edge", None),
        ("valley", None),
    )
    for view, sun in views:
        altitude = "own" if sun is None else f"{sun[1]:g}"
        name = f"jacksboro wooded, {view}, {altitude}"
        yield ViewInstance(name, "wooded, perspective", "jacksboro", "jacksboro_wooded", view, sun)
    for view, sun in (("main", None), ("overview", (130.0, 12.0)), ("close", (200.0, 50.0))):
        yield ViewInstance(f"spatialace, {view}", "wooded, perspective", "spatialace", "spatialace", view, sun)
    yield ViewInstance("spatialace, map", "wooded, map", "spatialace", "spatialace", "map", (70.0, 30.0))
    for name, sun in (("goteborg", (150.0, 35.0)), ("goteborg, houses", (230.0, 11.0)), ("quebec", (200.0, 25.0))):
        yield ViewInstance(f"{name}, map, {sun[1]:g}", "wooded, map", name.split(",")[0], RASTERS[name], "map", sun)
    looks: tuple[tuple[str, tuple[float, float, float, float, float], SunAngles], ...] = (
        ("goteborg", (0.30, 0.25, 0.55, 0.55, 40.0), (240.0, 22.0)), ("goteborg", (0.5, 0.1, 0.5, 0.6, 90.0), (140.0, 48.0)),
        ("goteborg, houses", (0.25, 0.3, 0.6, 0.5, 30.0), (120.0, 16.0)),
        ("goteborg, houses", (0.5, 0.05, 0.5, 0.5, 110.0), (200.0, 38.0)),
        ("quebec", (0.35, 0.2, 0.5, 0.55, 30.0), (220.0, 14.0)), ("quebec", (0.5, 0.1, 0.5, 0.5, 90.0), (170.0, 50.0)),
    )  # fmt: skip
    for name, look, sun in looks:
        terrain = name.split(",")[0]
        yield ViewInstance(f"{name}, eye, {sun[1]:g}", "wooded, perspective", terrain, RASTERS[name], "eye", sun, camera=look)


def _dense() -> Iterator[ViewInstance]:
    """Yield views across woods where most pixels show leaves of several trees.

    The visibility of single pixels cannot be decided there, so targets use ``coverage``.
    """
    looks: tuple[tuple[tuple[float, float, float, float, float], SunAngles], ...] = (
        ((0.02, 0.02, 0.60, 0.60, 450.0), (248.0, 14.0)), ((0.98, 0.98, 0.30, 0.30, 450.0), (23.0, 24.0)),
        ((0.98, 0.90, 0.20, 0.40, 400.0), (80.0, 22.0)), ((0.02, 0.98, 0.60, 0.40, 350.0), (287.0, 20.0)),
        ((0.60, 0.98, 0.40, 0.05, 450.0), (33.0, 14.0)), ((0.02, 0.50, 0.90, 0.50, 450.0), (245.0, 24.0)),
        ((0.02, 0.60, 0.95, 0.60, 400.0), (290.0, 21.0)), ((0.50, 0.98, 0.45, 0.10, 400.0), (339.0, 20.0)),
        ((0.02, 0.30, 0.80, 0.80, 500.0), (260.0, 14.0)), ((0.40, 0.98, 0.50, 0.05, 350.0), (328.0, 24.0)),
    )  # fmt: skip
    for number, (look, sun) in enumerate(looks, start=1):
        name = f"jacksboro, dense wood {number}, {sun[1]:g}"
        wood = RASTERS["jacksboro, dense"]
        yield ViewInstance(name, "dense wood", "jacksboro", wood, "eye", sun, camera=look, size=DENSE_PX)


def _unseen() -> Iterator[ViewInstance]:
    """Yield views on terrains to which no model is fitted."""
    maps: tuple[tuple[str, tuple[SunAngles, ...]], ...] = (
        ("sanfrancisco", ((118.0, 19.0), (244.0, 7.0))), ("lisbon", ((251.0, 11.0), (171.0, 43.0))), ("rmnp", ((108.0, 14.0),)),
        ("autzen", ((204.0, 31.0), (97.0, 13.0))), ("nz", ((302.0, 5.0),)), ("texas", ((88.0, 1.5),)),
        ("bilbao, trees", ((228.0, 27.0), (133.0, 12.0))),
    )  # fmt: skip
    for name, suns in maps:
        for sun in suns:
            family: Family = "wooded, map" if "trees" in name else "relief, map"
            terrain = name.split(",")[0]
            yield ViewInstance(f"{name}, map, {sun[1]:g}", family, terrain, RASTERS[name], "map", sun, unseen=True)
    looks: tuple[tuple[str, tuple[float, float, float, float, float], SunAngles], ...] = (
        ("sanfrancisco", (0.45, 0.25, 0.55, 0.50, 120.0), (239.0, 6.0)),
        ("lisbon", (0.40, 0.45, 0.48, 0.62, 300.0), (142.0, 7.0)),
        ("rmnp", (0.45, 0.35, 0.52, 0.60, 700.0), (284.0, 13.0)), ("autzen", (0.35, 0.15, 0.45, 0.40, 30.0), (216.0, 21.0)),
        ("autzen", (0.60, 0.20, 0.55, 0.40, 60.0), (124.0, 41.0)), ("nz", (0.28, 0.25, 0.24, 0.17, 9000.0), (48.0, 12.0)),
        ("bilbao", (0.40, 0.30, 0.50, 0.55, 150.0), (247.0, 5.0)),
        ("bilbao, trees", (0.40, 0.30, 0.48, 0.48, 60.0), (231.0, 22.0)),
        ("bilbao, trees", (0.55, 0.50, 0.60, 0.66, 120.0), (111.0, 35.0)),
    )  # fmt: skip
    for name, look, sun in looks:
        family = "wooded, perspective" if "trees" in name else "relief, perspective"
        terrain = name.split(",")[0]
        yield ViewInstance(f"{name}, eye, {sun[1]:g}", family, terrain, RASTERS[name], "eye", sun, unseen=True, camera=look)


def _made() -> Iterator[ViewInstance]:
    """Yield a map and a perspective view of every made terrain, and two perspective views of woods from afar.

    Models are fitted to every second terrain only.
    """
    for number, (name, site) in enumerate(SITES.items()):
        has_objects = site.houses is not None or site.woods is not None
        azimuth_deg = (37.0 + 73.0 * number) % 360.0
        suns = [(azimuth_deg, site.altitudes_deg[0]), ((azimuth_deg + 130.0) % 360.0, site.altitudes_deg[1])]
        if site.is_seen_from_afar:
            for sun, corner in zip(suns, ((0.03, 0.04, 0.6, 0.6, 300.0), (0.97, 0.9, 0.3, 0.4, 300.0)), strict=True):
                yield ViewInstance(
                    f"{name}, eye, {sun[1]:g}", "wooded, perspective", name, site, "eye", sun, unseen=number % 2 == 1,
                    camera=corner, size=DENSE_PX,
                )  # fmt: skip
            continue
        x, y, u, v = ((0.3, 0.2, 0.5, 0.55), (0.7, 0.25, 0.45, 0.5), (0.25, 0.7, 0.55, 0.5))[number % 3]
        above_m = 25.0 + 20.0 * (number % 3) if has_objects else site.cells * site.cell_m * (0.02 + 0.02 * (number % 3))
        map_family: Family = "wooded, map" if has_objects else "relief, map"
        eye_family: Family = "wooded, perspective" if has_objects else "relief, perspective"
        yield ViewInstance(f"{name}, map, {suns[0][1]:g}", map_family, name, site, "map", suns[0], unseen=number % 2 == 1)
        yield ViewInstance(
            f"{name}, eye, {suns[1][1]:g}", eye_family, name, site, "eye", suns[1], unseen=number % 2 == 1,
            camera=(x, y, u, v, above_m),
        )  # fmt: skip


def instances() -> list[ViewInstance]:
    """Return all instances, in order."""
    return [*_thesis(), *_relief(), *_wooded(), *_dense(), *_unseen(), *_made()]
