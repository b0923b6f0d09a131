"""The scene: a level with its elevation opened and its sun and lamps placed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from pyproj import CRS
from pyproj.aoi import AreaOfInterest
from pyproj.database import query_utm_crs_info
from pyproj.exceptions import CRSError, ProjError

from skugga.terrain.cache import MIB, cached, clear_scene_caches
from skugga.terrain.color_ramp import ColorRamp
from skugga.terrain.default_sun import default_sun
from skugga.terrain.errors import InputError, LevelError, Problem, SourceError
from skugga.terrain.geo.axes import axes_of, check_axes
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.geo.grid import Grid, MapView, map_view
from skugga.terrain.geo.sun import Sun, azimuth_and_altitude, sun_of
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, LocalFrame, World, is_on_earth, longitude_latitude_of, transformer
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.geolocate import Geolocator
from skugga.terrain.ground.raster_warnings import raster_warnings
from skugga.terrain.level.bundled import BUNDLED
from skugga.terrain.level.level import SUN, LoadedLevel
from skugga.terrain.level.parts import MapSpec, PerspectiveSpec, StyleSpec, SunSpec
from skugga.terrain.level_world import world_of_level
from skugga.terrain.lights import Lamp, LightPosition, light_position
from skugga.terrain.scene_objects import SceneObjects
from skugga.terrain.style import Style, style_of, style_spec

if TYPE_CHECKING:
    from skugga.terrain.geo.light_space import LightSpace
    from skugga.terrain.ground.surface import Surface

DEFAULT_MAP_SIDE_PX = 1024
"""Longest side of a map view without a given size, in pixels."""


MAX_PERSPECTIVE_SIDE_PX = 4096
"""Maximum side of a perspective view in pixels."""

MAX_UTM_WIDTH_DEG = 18.0


OVERLAP_SAMPLES_PER_SIDE = 33
"""Sample points along a side that decide whether a map shows anything of a level."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A level's ground, objects and light. Immutable.

    ``with_sun``, ``with_style`` and ``with_lamp`` return another scene over the same ground.

    Attributes
    ----------
    loaded
        The level and its file.
    world
        The level's CRS, its anchor and its earth-fixed coordinates.
    elevation
        The level's raster.
    sun
        The sun, or ``None``.
    objects
        Trees, meshes and lamps.
    clock_seconds
        The time of the level's clock in seconds. Meshes, lamps and clouds have their positions of this time.
    lamp_overrides
        Lamps by name that replace the level's; empty for the level's own.
    style_spec
        The style that replaces the level's, or ``None``.
    sun_is_default
        Whether the level names no sun and no other sun was set.
    """

    loaded: LoadedLevel
    world: World
    elevation: Elevation
    sun: Sun | None
    objects: SceneObjects
    clock_seconds: float = 0.0
    lamp_overrides: Mapping[str, Lamp] = field(default_factory=dict)
    style_spec: StyleSpec | None = None
    sun_is_default: bool = False

    @property
    def geolocator(self) -> Geolocator:
        """Locates positions on the level's ground."""
        return Geolocator(self.world, self.elevation)

    @cached_property
    def lamps(self) -> dict[str, Lamp]:
        """The lights besides the sun by name."""
        if self.lamp_overrides:
            return dict(self.lamp_overrides)
        return {name: rig.at_second(self.clock_seconds) for name, rig in self.objects.animated_lamps.items()}

    @cached_property
    def style(self) -> Style:
        """The style that shades the scene."""
        cell_m = self.elevation.cell_size_m(self.world.metres_per_unit)
        return style_of(
            self.loaded.level, self.style_spec or self.loaded.level.style, cell_m, lambda: self.objects.crown_area_share
        )

    @property
    def light_names(self) -> tuple[str, ...]:
        """Names of the scene's lights. The sun is the first one, if the scene has a sun."""
        return (*((SUN,) if self.sun is not None else ()), *self.loaded.level.lights)

    def light_position(self, light: str, frame: LocalFrame) -> LightPosition:
        """Return the homogeneous position of a light in a frame.

        For the sun it is the direction to the sun. The scene must then have a sun.
        """
        if light != SUN:
            return light_position(self.lamps[light].in_frame(frame).position_frame_m, 1.0)
        assert self.sun is not None
        return light_position(self.sun.in_frame(frame), 0.0)

    @property
    def sun_is_up(self) -> bool:
        """Whether direct sunlight reaches any part of the level. False by night and under an overcast sky."""
        return self.sun is not None and (self.highest_sun_deg or 0.0) > 0.0 and not self.loaded.level.weather.is_overcast

    @cached_property
    def without_refraction(self) -> Scene:
        """The same scene with the sun's geometric position, as without an atmosphere."""
        return (
            self if self.sun is None or not self.sun.refraction_deg else replace(self, sun=self.sun.without_refraction(self.world))
        )

    def close(self) -> None:
        """Close the level's raster and release its objects. Evict the cache entries computed from either, for all suns."""
        clear_scene_caches(self.elevation)
        self.objects.close()
        self.elevation.close()

    def at_second(self, seconds: float | None) -> Scene:
        """Return the scene at another second of the level's clock (``None``: the level's).

        Returns the scene itself if nothing in it depends on the clock.
        """
        if seconds is None or seconds == self.clock_seconds or not self.loaded.level.moving_keys:
            return self
        return replace(self, objects=self.objects.at_second(seconds), clock_seconds=seconds)

    def with_sun(self, spec: SunSpec | None) -> Scene:
        """Return the same scene under another sun (``None``: the level's)."""
        return self if spec is None else replace(self, sun=sun_of(spec, self.world), sun_is_default=False)

    def with_style(
        self,
        name: str | None,
        slope_exaggeration: float | None = None,
        sky: str | None = None,
        ramp: ColorRamp | None = None,
        local_light: float | None = None,
        generalisation: float | None = None,
    ) -> Scene:
        """Return the same scene in another style (``None``: the level's), with changes.

        The changes are those of ``StyleSpec``; ``None``: no change.

        A style given by name does not use the level's colour ramp. Raises ``InputError``.
        """
        level_spec = self.loaded.level.style
        spec = style_spec(level_spec, name, slope_exaggeration, sky, ramp, local_light, generalisation)
        return self if spec == level_spec else replace(self, style_spec=spec)

    def with_lamp(self, lamp: Lamp) -> Scene:
        """Return the same scene with a lamp that replaces the one of its name."""
        return replace(self, lamp_overrides={**self.lamps, lamp.name: lamp})

    @cached_property
    def light_space(self) -> LightSpace | None:
        """The sun's light space (axes right, up and away from the sun); ``None`` without a sun."""
        from skugga.terrain.geo.light_space import light_space

        return None if self.sun is None else light_space(self.world, self.sun)

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on probable mistakes in the level's raster, each with its remedy. The level can still be drawn."""
        source = self.loaded.level.terrain.source
        if source is None or source in BUNDLED:
            return ()
        return raster_warnings(self.elevation)

    @cached_property
    def height_range_m(self) -> tuple[float, float]:
        """Lowest and highest ground of the level in metres, from its overview."""
        overview = self.elevation.overview
        return float(np.nanmin(overview.mean_heights_m)), float(np.nanmax(overview.max_heights_m))

    @cached_property
    def bounds_lon_lat(self) -> tuple[float, float, float, float] | None:
        """Bounds of the part of the raster that the level uses: west, south, east, north in degrees.

        ``None`` in a flat world. The east is above 180 if the part crosses the antimeridian.
        """
        if self.world.is_flat:
            return None
        level_bounds = self.loaded.level.terrain.bounds
        if level_bounds is not None:
            return level_bounds
        west, south, east, north = transformer(self.elevation.crs, LONGITUDE_LATITUDE).transform_bounds(
            *self.elevation.bounds, densify_pts=21
        )
        if not np.isfinite([west, south, east, north]).all():
            raise SourceError(
                self.elevation.name,
                f"PROJ cannot transform its CRS '{self.elevation.crs.name}' into longitude and latitude",
                "Use a raster with a CRS that PROJ can transform",
            )
        return west, max(south, -90.0), east + 360.0 if east < west else east, min(north, 90.0)

    @cached_property
    def highest_sun_deg(self) -> float | None:
        """The sun's largest altitude anywhere over the level in degrees. ``None`` without a sun."""
        if self.sun is None:
            return None
        if self.world.is_flat:
            return self.sun.altitude_deg
        west, south, east, north = self.bounds_lon_lat or (0.0, 0.0, 0.0, 0.0)
        lon, lat = np.meshgrid(np.linspace(west, east, 5), np.linspace(south, north, 5))
        point, up = self.world.points_at_zero_height(LONGITUDE_LATITUDE, lon, lat)
        rotations = (self.world.earth_from_enu(p, u) for p, u in zip(point.reshape(-1, 3), up.reshape(-1, 3), strict=True))
        return max(self.sun.altitude_deg, *(azimuth_and_altitude(self.sun.to_sun_earth, r)[1] for r in rotations))

    def surface(self, grid: Grid) -> Surface:
        """Return the ground at the nodes of a grid."""
        from skugga.terrain.ground.surface import Surface

        return Surface(self.world, self.elevation, grid)

    @cached_property
    def map_crs(self) -> CRS:
        """The CRS of map views that name none.

        - The raster's CRS, if it is projected, with axes that run east and north, or if it is an engineering CRS.
        - Else the UTM zone of the anchor, or a polar stereographic CRS where UTM does not reach.
        - Longitude and latitude for a level wider than ``MAX_UTM_WIDTH_DEG``, which fits no zone.
        - On another celestial body the raster's CRS, or the body's longitude and latitude if the axes run in other directions.
        """
        source_crs = self.elevation.crs
        if self.world.is_flat or (source_crs.is_projected and axes_of(source_crs).are_standard):
            return source_crs
        if not self.world.is_on_earth:
            return source_crs if axes_of(source_crs).are_standard else longitude_latitude_of(source_crs)
        west, _, east, _ = self.bounds_lon_lat or (0.0, 0.0, 0.0, 0.0)
        if east - west > MAX_UTM_WIDTH_DEG:
            return source_crs if source_crs.is_geographic and axes_of(source_crs).are_standard else LONGITUDE_LATITUDE
        lon = (self.world.anchor_lon_deg + 180.0) % 360.0 - 180.0
        lat = self.world.anchor_lat_deg
        if not -80.0 <= lat <= 84.0:
            return CRS.from_epsg(3413 if lat > 0 else 3031)
        return _utm_zone(lon, lat)

    def view(
        self,
        name: str = "map",
        bounds: tuple[float, float, float, float] | None = None,
        crs: str | None = None,
        size: tuple[int, int] | None = None,
    ) -> MapView | PerspectiveView:
        """Return a view of the level. Arguments override the level's settings.

        ``size`` is (width, height). The view ``map`` exists whether the level lists it or not. Raises ``InputError``.
        """
        views = {"map": MapSpec(kind="map"), **self.loaded.level.views}
        if name not in views:
            raise InputError("view", name, ", ".join(views))
        spec = views[name]
        if isinstance(spec, MapSpec):
            return self._map_view(spec, bounds, crs, size)
        for parameter, value in (("bounds", bounds), ("crs", crs)):
            if value is not None:
                raise InputError(parameter, Problem(f"does not apply to '{name}', a perspective view"), f"Omit {parameter}")
        key_path = f"{self.loaded.path}: views.{name}"
        return self._perspective_view(spec, size, f"{key_path}.eye", f"{key_path}.target")

    def view_from(self, spec: PerspectiveSpec, size: tuple[int, int] | None = None) -> PerspectiveView:
        """Return a perspective view that the level does not list.

        Raises ``InputError``, which names ``eye`` or ``target`` where it lies outside of the ground's data.
        """
        try:
            return self._perspective_view(spec, size, "eye", "target")
        except LevelError as error:  # the caller's input is wrong, not the level
            raise InputError(error.name, error.value, error.allowed) from None

    def _perspective_view(
        self, spec: PerspectiveSpec, size: tuple[int, int] | None, eye_name: str, target_name: str
    ) -> PerspectiveView:
        """Return the view that a level's or a request's settings describe.

        ``size`` (width, height) overrides that of ``spec``. ``eye_name`` and ``target_name`` are the names of the positions in
        messages.
        """
        width, height = size or spec.size
        if max(width, height) > MAX_PERSPECTIVE_SIDE_PX:
            limit = f"{MAX_PERSPECTIVE_SIDE_PX} pixels a side in a perspective view"
            raise InputError.over_limit("size", f"{width}x{height}", limit, "Use a smaller size")
        eye, up = self.geolocator.point_above_ground(spec.eye, eye_name)
        target, _ = self.geolocator.point_above_ground(spec.target, target_name)
        return look_at(eye, target, up, spec.fov, height, width)

    def _map_view(
        self,
        spec: MapSpec,
        bounds: tuple[float, float, float, float] | None,
        crs: str | None,
        size: tuple[int, int] | None,
    ) -> MapView:
        """Return the map view that a level's settings describe. ``None`` leaves a value to ``spec``, or else to its default.

        ``bounds`` are west, south, east and north in the view's CRS, ``size`` is (width, height). Raises ``InputError``.
        """
        target = self._parse_crs(crs or spec.crs)
        extent = bounds or (spec.bounds if crs is None else None) or self.default_bounds(target)
        west, south, east, north = extent
        if not (np.isfinite(extent).all() and west < east and south < north):
            raise InputError("bounds", extent, f"west < east and south < north, in units of {target.name}")
        pixels = (east - west) / (size or (1, 1))[0], (north - south) / (size or (1, 1))[1]
        if max(map(abs, extent)) > 1e9 or min(pixels) < 1e-9 * max(map(abs, extent)):
            raise InputError(
                "bounds", extent, f"coordinates below 1e9 in {target.name}, and pixels larger than the rounding of coordinates"
            )
        if target.is_geographic and not (-540 <= west and east <= 540 and -90.001 <= south and north <= 90.001):
            raise InputError("bounds", extent, "degrees: -540 to 540 from west to east, -90 to 90 from south to north")
        if bounds is not None and not self.overlaps(target, extent):
            level_bounds_text = ",".join(f"{value:.9g}" for value in self.default_bounds(target))
            raise InputError(
                "bounds", extent, f"bounds that overlap the level's, which are {level_bounds_text} in units of {target.name}"
            )
        size = size or spec.size
        if size is None:  # square pixels; the shorter side grows to a whole number of pixels
            pixel = max(east - west, north - south) / DEFAULT_MAP_SIDE_PX
            size = max(int(np.rint((east - west) / pixel)), 1), max(int(np.rint((north - south) / pixel)), 1)
            margin_x, margin_y = (size[0] * pixel - (east - west)) / 2, (size[1] * pixel - (north - south)) / 2
            extent = west, south, east, north = west - margin_x, south - margin_y, east + margin_x, north + margin_y
        return map_view(self.world, target, extent, rows=size[1], cols=size[0])

    def overlaps(self, crs: CRS, extent: tuple[float, float, float, float]) -> bool:
        """Return whether an extent (west, south, east, north) in a CRS overlaps the raster.

        Both are sampled at lattice points. They overlap if a point of one lies in the other.
        """
        west, south, east, north = extent
        x, y = np.meshgrid(np.linspace(west, east, OVERLAP_SAMPLES_PER_SIDE), np.linspace(south, north, OVERLAP_SAMPLES_PER_SIDE))
        with np.errstate(invalid="ignore"):
            source_xy = (x, y) if crs == self.elevation.crs else transformer(crs, self.elevation.crs).transform(x, y)
            if self.elevation.covers(*source_xy).any():
                return True
            rows, cols = (
                np.linspace(-0.5, count - 0.5, OVERLAP_SAMPLES_PER_SIDE) for count in (self.elevation.rows, self.elevation.cols)
            )
            x, y = self.elevation.xy(*np.meshgrid(rows, cols, indexing="ij"))
            x, y = (x, y) if crs == self.elevation.crs else transformer(self.elevation.crs, crs).transform(x, y)
            longitude_shifts = (-360.0, 0.0, 360.0) if crs.is_geographic else (0.0,)
            return any(bool(((x + t >= west) & (x + t <= east) & (y >= south) & (y <= north)).any()) for t in longitude_shifts)

    def _parse_crs(self, text: str | None) -> CRS:
        """Return the CRS of a map that a text names (``None``: ``map_crs``). Raises ``InputError``."""
        if text is None:
            return self.map_crs
        try:
            crs = CRS.from_user_input(int(text) if text.isascii() and text.isdigit() else text)
        except CRSError:
            raise InputError("crs", text, "a CRS that PROJ knows, such as EPSG:32616") from None
        if self.world.is_flat and crs != self.world.crs:
            raise InputError("crs", text, f"the level's own engineering CRS '{self.world.crs.name}'")
        if not (crs.is_projected or crs.is_geographic or crs.is_engineering):
            raise InputError("crs", text, "a projected or geographic CRS")
        check_axes("crs", crs)
        self.check_crs("crs", crs, text)
        return crs

    def check_crs(self, name: str, crs: CRS, text: str | None = None) -> None:
        """Raise ``InputError`` for a CRS in which the level cannot be drawn.

        That is a CRS of another celestial body, or one into which PROJ cannot transform the level's. For the message, ``name`` is
        the parameter and ``text`` is the CRS as the user wrote it.
        """
        source_crs = self.elevation.crs
        if crs == source_crs:
            return
        try:
            if not self.world.is_flat and is_on_earth(crs) == self.world.is_on_earth:
                transformer(source_crs, crs), transformer(crs, LONGITUDE_LATITUDE)
                return
        except ProjError:
            pass
        raise InputError(name, text or crs.name, f"a CRS into which PROJ can transform the level's CRS '{source_crs.name}'")

    def default_bounds(self, crs: CRS) -> tuple[float, float, float, float]:
        """Return the bounds in a CRS of the part of the raster that the level uses: west, south, east, north.

        Raises ``InputError``.
        """
        if self.world.is_flat or (crs == self.elevation.crs and self.loaded.level.terrain.bounds is None):
            west, south, east, north = self.elevation.bounds
            return (west, max(south, -90.0), east, min(north, 90.0)) if crs.is_geographic else (west, south, east, north)
        assert self.bounds_lon_lat is not None
        if self.bounds_lon_lat[2] > 180.0 and not crs.is_geographic and crs != self.elevation.crs:
            return self._bounds_across_antimeridian(crs, self.bounds_lon_lat)
        try:
            bounds = transformer(LONGITUDE_LATITUDE, crs).transform_bounds(*self.bounds_lon_lat, densify_pts=21)
        except ProjError:
            bounds = (np.inf,) * 4
        if not np.isfinite(bounds).all():
            raise InputError("crs", crs.name, "a CRS that covers the level")
        return bounds

    def _bounds_across_antimeridian(self, crs: CRS, bounds: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
        """Return the bounds (west, south, east, north) in a CRS of a level that crosses the antimeridian.

        ``bounds`` are those in degrees. Raises ``InputError`` if the CRS ends at the antimeridian.
        """
        lon, lat = np.meshgrid(
            np.linspace(bounds[0], bounds[2], OVERLAP_SAMPLES_PER_SIDE), np.linspace(bounds[1], bounds[3], OVERLAP_SAMPLES_PER_SIDE)
        )
        positions = np.stack(transformer(LONGITUDE_LATITUDE, crs).transform(lon, lat))
        with np.errstate(invalid="ignore"):  # points outside of a CRS have infinite coordinates
            extent = np.ptp(positions, axis=(1, 2))
            is_split = np.abs(np.diff(positions, axis=2)).max(axis=(1, 2)) > extent / 2
        if not np.isfinite(extent).all() or is_split.any():
            problem = Problem(f"'{crs.name}' ends at the antimeridian, which the level crosses")
            raise InputError("crs", problem, "Use a CRS that continues there, such as a UTM zone, or give bounds")
        (west, south), (east, north) = positions.min(axis=(1, 2)), positions.max(axis=(1, 2))
        return float(west), float(south), float(east), float(north)


def build_scene(loaded: LoadedLevel) -> Scene:
    """Return the scene of a level: open its elevation, and place its anchor and sun.

    Trees and meshes are read on first use. Raises ``LevelError``, ``SourceError`` or ``InputError``.
    """
    terrain, generated = loaded.level.terrain, None
    if terrain.source is None:
        from skugga.terrain.ground.generated_ground import generated_ground

        generated = generated_ground(terrain)
    name = loaded.source or f"{loaded.path}: terrain"
    water_m = None if loaded.level.water is None else loaded.level.water.level
    elevation = Elevation(
        name, terrain.units, terrain.exaggeration, terrain.resolution, generated, water_m, terrain.surface, terrain.nodata,
        terrain.positive,
    )  # fmt: skip
    if terrain.surface == "blocks" and not elevation.is_north_up:
        raise LevelError(
            f"{loaded.path}: terrain.surface", "blocks", "smooth, since the raster's rows do not run from west to east"
        )
    world = world_of_level(loaded, elevation)
    sun_is_default = loaded.level.sun is None
    loaded = with_default_sun(loaded, world, elevation)
    spec = loaded.level.sun
    sun = None if spec is None or spec == "none" else sun_of(spec, world)
    seconds = loaded.level.seconds
    objects = SceneObjects(loaded, world, elevation, seconds)
    return Scene(loaded, world, elevation, sun, objects, seconds, sun_is_default=sun_is_default)


def with_default_sun(loaded: LoadedLevel, world: World, elevation: Elevation) -> LoadedLevel:
    """Return the level with a default sun if it names none."""
    if loaded.level.sun is not None:
        return loaded
    return loaded.model_copy(update={"level": loaded.level.model_copy(update={"sun": default_sun(world, elevation)})})


@cached("process", MIB)
def _utm_zone(lon_deg: float, lat_deg: float) -> CRS:
    """Return the UTM zone of a position.

    Cached, since a look-up in PROJ's database takes tens of milliseconds. Scenes of the same level under other suns ask for it
    again.
    """
    zones = query_utm_crs_info("WGS 84", AreaOfInterest(lon_deg, lat_deg, lon_deg, lat_deg))
    return CRS.from_epsg(int(zones[0].code))
