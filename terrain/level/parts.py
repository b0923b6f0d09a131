"""Parts of a level file as validated values: ground, water, weather, style, forest, meshes, sun, lights and views."""

from __future__ import annotations

import re
from datetime import datetime
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from skugga.terrain.color_ramp import MAX_RAMP_HEIGHT_M, MIN_RAMP_HEIGHT_M
from skugga.terrain.level.model import MapPosition, Model, Position
from skugga.terrain.level.motion import LampMotion, MeshMotion, nested_values_error

Units = Literal["m", "ft", "us-ft", "dm", "cm", "mm", "km", "yd", "fathom"]
METRES_PER_UNIT: dict[Units, float] = {
    "m": 1.0, "ft": 0.3048, "us-ft": 1200.0 / 3937.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "km": 1000.0, "yd": 0.9144,
    "fathom": 1.8288,
}  # fmt: skip

Positive = Literal["up", "down"]
"""Whether values increase upwards (heights) or downwards (depths): the attribute ``positive`` of the CF conventions."""

Species = Literal["conifer", "broadleaf", "mixed"]
MeshGenerator = Literal["boxgrid", "rocks", "street", "room", "water_tower", "tetrahedra", "wood_hill"]
RoofForm = Literal["auto", "flat", "pitched", "hipped"]
GroundGenerator = Literal["ridges", "landscape"]
GroundSurface = Literal["smooth", "blocks"]

Metres = Annotated[float, Field(gt=0, le=1e7)]
PixelCount = Annotated[int, Field(ge=1, le=16384)]


ALLOWED_TIMES = "an ISO 8601 time with an offset, such as 2024-10-21T16:30:00-04:00"
"""The allowed times, for messages."""

_TIME = re.compile(r"[-0-9:.,+TtWZz ]+")


def parse_time(text: str) -> datetime:
    """Parse an ISO 8601 time, with an offset from UTC or without.

    Raises ``ValueError``. Characters that never occur in times are rejected first, since ``fromisoformat`` ignores some of them.
    """
    if not _TIME.fullmatch(text):
        raise ValueError(ALLOWED_TIMES)
    return datetime.fromisoformat(text)


def _check_no_nul(name: str) -> str:
    """Return a file name. Raises ``PydanticCustomError`` if it contains a NUL character."""
    if "\0" in name:
        raise PydanticCustomError("file", "a file name without NUL characters")
    return name


FileName = Annotated[str, Field(min_length=1), AfterValidator(_check_no_nul)]


class FlatGround(Model):
    """Flat ground at height 0, centred on the origin.

    ``size`` is its extent in metres, ``cells`` the number of its quads, each as (east, north).
    """

    size: tuple[Metres, Metres]
    cells: tuple[Annotated[int, Field(ge=1, le=8192)], Annotated[int, Field(ge=1, le=8192)]]


class GeneratedGround(Model):
    """Ground generated from a seed.

    ``size`` is its extent (east, north), ``cell`` the spacing of its heights and ``relief`` the range of its heights, in metres.
    """

    kind: GroundGenerator
    size: tuple[Metres, Metres]
    cell: Metres
    relief: float = Field(gt=0, le=9000)
    seed: int = Field(default=0, ge=0, le=2**32 - 1)

    @model_validator(mode="after")
    def _check_cell(self) -> GeneratedGround:
        if not 4 <= min(self.size) / self.cell <= max(self.size) / self.cell <= 8192:
            raise PydanticCustomError("cell", "a cell size that gives 4 to 8192 cells per side")
        return self


class Terrain(Model):
    """The ground: a raster of heights, or flat or generated ground.

    ``bounds`` (west, south, east, north, degrees) is the area of interest. It sets the anchor and the default view; ground beyond
    it still casts shadows. ``resolution`` is the finest spacing of heights that is used, in metres. ``exaggeration`` multiplies
    heights. ``units`` and ``positive`` are the unit and the direction of the raster's values; ``None`` stands for what the raster
    declares, else for metres, up. ``nodata`` is a cell value that means no height, in addition to the one that the file declares.
    ``imagery`` is an RGB raster draped over the ground.

    ``surface`` is the interpolation between heights. ``smooth`` is bilinear between cell centres. With ``blocks``, in maps only,
    every cell is a column with a flat top and upright walls, as in surface models of cities.
    """

    source: FileName | None = None
    flat: FlatGround | None = None
    generate: GeneratedGround | None = None
    bounds: tuple[float, float, float, float] | None = None
    resolution: float | None = Field(default=None, gt=0)
    units: Units | None = None
    positive: Positive | None = None
    nodata: float | None = None
    exaggeration: float = Field(default=1.0, gt=0, le=100)
    imagery: FileName | None = None
    surface: GroundSurface = "smooth"

    @field_validator("bounds")
    @classmethod
    def _check_bounds(cls, value: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
        if value is not None:
            west, south, east, north = value
            if not (-180 <= west < east <= 540 and -90 <= south < north <= 90):
                raise PydanticCustomError("bounds", "-180 <= west < east <= 540 and -90 <= south < north <= 90, in degrees")
        return value

    @model_validator(mode="after")
    def _check_ground(self) -> Terrain:
        if (self.source is not None) + (self.flat is not None) + (self.generate is not None) != 1:
            raise PydanticCustomError("ground", "exactly one of source, flat and generate")
        if self.nodata is not None and self.source is None:
            raise PydanticCustomError("ground", "nodata with a source only: other ground has a height in every cell")
        if self.positive == "down" and self.source is None:
            raise PydanticCustomError("ground", "positive: down with a source only: other ground has heights, not depths")
        return self


class Water(Model):
    """Standing water over all ground below ``level``: metres, after unit conversion and exaggeration."""

    level: float = Field(ge=-11500, le=9500)


class Weather(Model):
    """The weather."""

    visibility: float | None = Field(
        default=None,
        ge=10,
        le=1e7,
        description="Meteorological range in metres: the distance at which a dark object has 2 % contrast to the horizon. "
        "Below 1 km it is fog, at 20 km an ordinary day. Default: 100 km, clear air.",
    )
    cloud_cover: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Share of the sky behind clouds, which also turn it grey. Below 1 single clouds throw shadows. At 1 no "
        "sun comes through.",
    )
    snow: bool = Field(default=False, description="Whether snow lies.")
    precipitation: Literal["none", "rain", "snowfall"] = Field(
        default="none",
        description="What falls. It moves by the clock and reduces the visibility (ITU-R P.1814): rain of 8 mm/h to 4 km, "
        "snowfall of 1.5 mm/h to 3.3 km.",
    )
    precipitation_rate: float = Field(default=4.0, ge=0.1, le=100, description="Millimetres of water per hour.")

    @property
    def precipitation_extinction_per_m(self) -> float:
        """The extinction of light by what falls, per metre.

        ITU-R P.1814 (2007) gives the attenuation in dB/km at a rate R: 1.076 R^0.67 of rain, and 3.84 R^0.72 of wet snow in green
        light.
        """
        if self.precipitation == "none":
            return 0.0
        factor, exponent = (1.076, 0.67) if self.precipitation == "rain" else (3.84, 0.72)
        return float(factor * self.precipitation_rate**exponent / 4343.0)

    @property
    def has_drifting_clouds(self) -> bool:
        """Whether clouds cover a part of the sky, and so drift with the level's clock."""
        return 0.0 < self.cloud_cover < 1.0

    @property
    def is_overcast(self) -> bool:
        """Whether clouds cover the whole sky, which blocks direct sunlight."""
        return self.cloud_cover >= 1.0


StyleName = Literal["natural", "swiss", "grey", "urban", "analysis"]
"""Names of the styles in ``skugga.terrain.style.STYLES``."""

SkyName = Literal["even", "clear", "overcast"]
"""Names of the skies that light the ground of maps."""

SlopeExaggeration = Annotated[float, Field(ge=0.1, le=20)]

LocalLightDeg = Annotated[float, Field(ge=0, le=45)]
Generalisation = Annotated[float, Field(ge=0, le=1)]

ALLOWED_RAMPS = "pairs of a height in metres and a colour such as '#b3c2a2', with increasing heights"


class StyleSpec(Model):
    """Style of relief shading. In a level file, the name of a style alone is allowed, too.

    The name ``auto`` chooses a style by the kind of ground. ``ramp`` replaces the style's colours by pairs of a height in metres
    and an sRGB colour. ``slope_exaggeration`` multiplies slopes in shading; it does not change cast shadows.
    ``sky`` replaces the style's sky, which lights the ground of maps: ``even``, or ``clear`` or ``overcast`` with shadows of its
    own. ``local_light`` is the largest turn, in degrees, of the light that shades relief along it, in maps; ``generalisation`` is
    the share of large landforms in the slopes of maps of small scale. Both replace the style's own, and leave shadows alone.
    """

    name: Literal["auto"] | StyleName = "auto"
    ramp: tuple[tuple[Annotated[float, Field(ge=MIN_RAMP_HEIGHT_M, le=MAX_RAMP_HEIGHT_M)], str], ...] | None = None
    slope_exaggeration: SlopeExaggeration = 1.0
    sky: SkyName | None = None
    local_light: LocalLightDeg | None = None
    generalisation: Generalisation | None = None

    @field_validator("ramp")
    @classmethod
    def _check_ramp(cls, value: tuple[tuple[float, str], ...] | None) -> tuple[tuple[float, str], ...] | None:
        if value is None:
            return None
        heights = [height for height, _ in value]
        if not value or not all(low < high for low, high in pairwise(heights)):
            raise PydanticCustomError("ramp", ALLOWED_RAMPS)
        if not all(re.fullmatch("#[0-9a-fA-F]{6}", color) for _, color in value):
            raise PydanticCustomError("ramp", ALLOWED_RAMPS)
        return value


class ForestSpec(Model):
    """A group of trees, from one of three kinds of files: polygons with a density, points (one for each tree), or canopy heights.

    ``density`` is in trees per hectare, for polygons only. ``height`` is the trees' height in metres, as a range or as the name of
    an attribute. ``crown`` is the diameter of the crowns in the same forms; by default it follows from the height. A raster of
    canopy heights needs neither. Its cells below ``least_height`` metres have no trees; the default is 2, or 0.5 if most of the
    canopy is lower. ``layer`` names the layer of the trees in a file of several layers.
    """

    source: FileName
    layer: str | None = None
    density: float | None = Field(default=None, gt=0, le=20000)
    height: tuple[float, float] | str | None = None
    crown: tuple[float, float] | str | None = None
    least_height: float | None = Field(default=None, ge=0.1, le=150)
    species: Species = "mixed"
    seed: int = Field(default=0, ge=0, le=2**32 - 1)

    @field_validator("height", "crown")
    @classmethod
    def _check_range(cls, value: tuple[float, float] | str | None) -> tuple[float, float] | str | None:
        if isinstance(value, tuple) and not 0.1 <= value[0] <= value[1] <= 150:
            raise PydanticCustomError("range", "an attribute name, or [minimum, maximum] in metres from 0.1 to 150")
        return value


class LineSpec(Model):
    """Roads or rivers from a vector file of lines, draped over the ground.

    ``width`` is in metres, or the name of an attribute. By default it follows from OpenStreetMap's tags ``highway`` and
    ``waterway``. ``layer`` names the layer of the lines in a file of several layers.
    """

    source: FileName
    layer: str | None = None
    width: str | Annotated[float, Field(gt=0, le=1000)] | None = None


class LandCoverSpec(Model):
    """Polygons of land cover from a vector file, which colour natural ground in perspective views.

    ``attribute`` names the class of a polygon: a value of OpenStreetMap's tags ``landuse`` and ``natural``, or a code of ESA
    WorldCover. By default it is one with a usual name, such as ``class`` or ``landuse``. ``layer`` names the layer of the polygons
    in a file of several layers.
    """

    source: FileName
    layer: str | None = None
    attribute: str | None = None


EXCLUDED_BY_PATH = "no value together with a path in motion, which sets it"


class MeshSpec(Model):
    """Buildings from footprints, a model from a file (OBJ, PLY, glTF), or a generated model.

    ``height`` of buildings is the name of an attribute, or one height in metres for all. Alternatively, a building's height is the
    difference of the rasters ``surface`` and ``ground``. ``layer`` names the layer of the footprints in a file of several layers.
    ``roof`` is the form of roofs. Pitched and hipped roofs over footprints that are not nearly rectangular follow the straight
    skeleton of the outline; ``auto`` makes these flat. ``eaves_m`` is the overhang of sloped roofs beyond the walls, in metres.

    ``at`` is the position of a model, or a list of positions, in degrees (on flat or generated ground in metres). The model's
    lowest point stands on the ground. A path in ``motion`` replaces ``at``. ``turn`` is in degrees counter-clockwise. ``color`` is
    an sRGB albedo in [0, 1]. ``caster`` is a file with the model's simplified mesh, which casts the shadows instead.
    """

    source: FileName | None = None
    layer: str | None = None
    generate: MeshGenerator | None = None
    height: str | Annotated[float, Field(gt=0, le=1000)] | None = None
    surface: FileName | None = None
    ground: FileName | None = None
    roof: RoofForm = "flat"
    eaves_m: float = Field(default=0.0, ge=0, le=2)
    at: MapPosition | list[MapPosition] | None = None
    scale: float = Field(default=1.0, gt=0, le=1e6)
    turn: float = Field(default=0.0, ge=-1e6, le=1e6)
    color: tuple[float, float, float] | None = None
    caster: FileName | None = None
    motion: MeshMotion | None = None

    @field_validator("color")
    @classmethod
    def _check_color(cls, value: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if value is not None and not all(0 <= v <= 1 for v in value):
            raise PydanticCustomError("color", "three numbers from 0 to 1")
        return value

    @model_validator(mode="after")
    def _check_mesh(self) -> MeshSpec:
        if (self.source is None) == (self.generate is None):
            raise PydanticCustomError("mesh", "either source or generate")
        if (self.surface is None) != (self.ground is None):
            raise PydanticCustomError("mesh", "surface and ground together, because heights are surface minus ground")
        if self.eaves_m > 0.0 and self.roof == "flat":
            raise PydanticCustomError("mesh", "eaves_m together with roof: auto, pitched or hipped; flat roofs have no eaves")
        if self.at is not None and self.motion is not None and self.motion.path is not None:
            raise nested_values_error("mesh", [(("at",), self.at, EXCLUDED_BY_PATH)])
        return self

    @property
    def moves(self) -> bool:
        """Whether the mesh moves with the level's clock."""
        return self.motion is not None and self.motion.moves

    @property
    def positions(self) -> list[MapPosition]:
        """The positions of the mesh; empty if the file gives none."""
        if self.at is None:
            return []
        return list(self.at) if isinstance(self.at, list) else [self.at]


class SunSpec(Model):
    """Position of the sun: an ISO 8601 ``time`` with an offset, or apparent ``azimuth`` and ``altitude`` at the anchor.

    ``azimuth`` is in degrees clockwise from true north (from grid north in a flat world), ``altitude`` in degrees above
    the horizon.
    """

    time: datetime | None = None
    azimuth: float | None = Field(default=None, ge=-360, le=720)
    altitude: float | None = Field(default=None, ge=-90, le=90)

    @field_validator("time", mode="before")
    @classmethod
    def _validate_time(cls, value: Any) -> Any:
        if isinstance(value, str):
            try:
                return parse_time(value)
            except ValueError:
                raise PydanticCustomError("time", ALLOWED_TIMES) from None
        if value is not None and not isinstance(value, datetime):
            raise PydanticCustomError("time", ALLOWED_TIMES)
        return value

    @model_validator(mode="after")
    def _check_angles(self) -> SunSpec:
        angles = (self.azimuth is not None) + (self.altitude is not None)
        if (self.time is None) == (angles == 0) or angles == 1:
            raise PydanticCustomError("sun", "either time, or azimuth and altitude")
        if self.time is not None and self.time.tzinfo is None:
            raise PydanticCustomError("sun", ALLOWED_TIMES)
        return self


class LightSpec(Model):
    """A light besides the sun.

    ``position`` and ``target`` are longitude, latitude and metres above the ground, or metres on flat or generated ground, as in
    views. ``cutoff`` is the half angle of a spot's cone, degrees. ``intensity`` is the irradiance at normal incidence, in units of
    the sun's irradiance. It applies at a spot's target, or on the ground below an omni light, and falls off with the square of the
    distance. ``radius`` is the radius of the spherical light source, metres, which causes penumbrae; 0 is a point light.

    A path in ``motion`` replaces the position, the target or both. ``intensity`` then applies at the path's first key.
    """

    kind: Literal["spot", "omni"]
    position: Position | None = None
    target: Position | None = None
    cutoff: float = Field(default=35.0, gt=0, lt=85)
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    intensity: float = Field(default=1.0, gt=0, le=1000)
    radius: float = Field(default=0.0, ge=0, le=100, allow_inf_nan=False)
    motion: LampMotion | None = None

    @field_validator("color")
    @classmethod
    def _check_color(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not all(0 <= v <= 1 for v in value):
            raise PydanticCustomError("color", "three numbers from 0 to 1")
        return value

    @model_validator(mode="after")
    def _check_target(self) -> LightSpec:
        moved_fields = () if self.motion is None else self.motion.moved_fields
        duplicates = [name for name in moved_fields if getattr(self, name) is not None]
        if duplicates:
            raise nested_values_error("light", [((name,), getattr(self, name), EXCLUDED_BY_PATH) for name in duplicates])
        if self.position is None and "position" not in moved_fields:
            raise ValidationError.from_exception_data("light", [InitErrorDetails(type="missing", loc=("position",), input=None)])
        if (self.kind == "spot") != (self.target is not None or "target" in moved_fields):
            raise PydanticCustomError("target", "a target for a spot, none for an omni light")
        if self.target is not None and self.target == self.position:
            raise PydanticCustomError("target", "a target other than the position")
        return self

    @property
    def moves(self) -> bool:
        """Whether the light moves with the level's clock."""
        return self.motion is not None


class MapSpec(Model):
    """A map: an orthographic view straight down.

    ``bounds`` (west, south, east, north) are in the CRS ``crs``, ``size`` is (width, height) in pixels. Defaults follow from the
    level.
    """

    kind: Literal["map"]
    bounds: tuple[float, float, float, float] | None = None
    crs: str | None = None
    size: tuple[PixelCount, PixelCount] | None = None

    @field_validator("bounds")
    @classmethod
    def _check_bounds(cls, value: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
        if value is not None and not (value[0] < value[2] and value[1] < value[3]):
            raise PydanticCustomError("bounds", "west < east and south < north")
        return value


class PerspectiveSpec(Model):
    """A perspective view.

    ``eye`` and ``target`` are longitude, latitude and metres above the ground there. On flat or generated ground they are metres
    east and north of its centre, and above it. ``fov`` is the vertical field of view in degrees.
    """

    kind: Literal["perspective"]
    eye: Position
    target: Position
    fov: float = Field(default=50.0, ge=0.01, le=179)
    size: tuple[PixelCount, PixelCount] = (1280, 1024)

    @model_validator(mode="after")
    def _check_eye(self) -> PerspectiveSpec:
        if self.eye == self.target:
            raise PydanticCustomError("target", "a target other than the eye")
        return self


ViewSpec = Annotated[MapSpec | PerspectiveSpec, Field(discriminator="kind")]
