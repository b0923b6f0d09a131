"""The parts of a level file that say what is there: ground, forest, meshes, sun, lights and views, as validated values."""

from __future__ import annotations

import re
from datetime import datetime
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from skugga.terrain.level.model import MapPosition, Model, Position
from skugga.terrain.level.motion import LampMotion, MeshMotion, wrong_parts

Units = Literal["m", "ft", "us-ft", "dm", "cm", "mm", "km", "yd", "fathom"]
METRES_PER_UNIT: dict[Units, float] = {
    "m": 1.0, "ft": 0.3048, "us-ft": 1200.0 / 3937.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "km": 1000.0, "yd": 0.9144,
    "fathom": 1.8288,
}  # fmt: skip

Positive = Literal["up", "down"]
"""Whether numbers grow upwards, as heights do, or downwards, as depths (the attribute ``positive`` of the CF conventions)."""

Species = Literal["conifer", "broadleaf", "mixed"]
MeshGenerator = Literal["boxgrid", "rocks", "street", "room", "water_tower", "tetrahedra", "wood_hill"]
RoofForm = Literal["auto", "flat", "pitched", "hipped"]
GroundGenerator = Literal["ridges", "landscape"]
GroundSurface = Literal["smooth", "blocks"]

Metres = Annotated[float, Field(gt=0, le=1e7)]
PixelCount = Annotated[int, Field(ge=1, le=16384)]


TIME_WORDS = "an ISO 8601 time with an offset, as 2024-10-21T16:30:00-04:00"
"""What a time has to be."""

_TIME = re.compile(r"[-0-9:.,+TtWZz ]+")


def time_of(text: str) -> datetime:
    """A time from its text in ISO 8601, with an offset or without. Raises ``ValueError``, also for characters that no time has: the
    library reads past some.
    """
    if not _TIME.fullmatch(text):
        raise ValueError(TIME_WORDS)
    return datetime.fromisoformat(text)


def _without_nul(name: str) -> str:
    if "\0" in name:
        raise PydanticCustomError("file", "a file's name, without a NUL character")
    return name


FileName = Annotated[str, Field(min_length=1), AfterValidator(_without_nul)]


class FlatGround(Model):
    """A flat floor at height 0, its middle at the origin: ``size`` in metres and ``cells`` in quads, each (east, north)."""

    size: tuple[Metres, Metres]
    cells: tuple[Annotated[int, Field(ge=1, le=8192)], Annotated[int, Field(ge=1, le=8192)]]


class GeneratedGround(Model):
    """Ground made up from a seed: ``size`` in metres (east, north), ``cell`` the metres between heights, ``relief`` metres."""

    kind: GroundGenerator
    size: tuple[Metres, Metres]
    cell: Metres
    relief: float = Field(gt=0, le=9000)
    seed: int = Field(default=0, ge=0, le=2**32 - 1)

    @model_validator(mode="after")
    def _bounded(self) -> GeneratedGround:
        if not 4 <= min(self.size) / self.cell <= max(self.size) / self.cell <= 8192:
            raise PydanticCustomError("cell", "a cell that gives 4 to 8192 cells a side")
        return self


class Terrain(Model):
    """The ground: a raster of heights, or a floor or ground that is made.

    ``bounds`` (west, south, east, north, degrees) says which part is looked at: it places the anchor and the default
    view; ground beyond it still casts. ``resolution`` is in metres, ``exaggeration`` multiplies heights. ``units`` and ``positive``
    say what the raster's numbers are (``None``: what it says itself, else metres, up). ``nodata`` is a value of
    the raster's cells that means no height, besides the one that the file declares. ``imagery`` is an RGB raster draped over the
    ground. ``surface`` is what lies between the heights: ``smooth`` (bilinear between the cells' centres) or, in maps, ``blocks``
    (every cell is a column with a flat top and upright walls, as in surface models of cities).
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
    def _ordered(cls, value: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
        if value is not None:
            west, south, east, north = value
            if not (-180 <= west < east <= 540 and -90 <= south < north <= 90):
                raise PydanticCustomError("bounds", "west < east and -90 <= south < north <= 90, in degrees")
        return value

    @model_validator(mode="after")
    def _one_ground(self) -> Terrain:
        if (self.source is not None) + (self.flat is not None) + (self.generate is not None) != 1:
            raise PydanticCustomError("ground", "one of source, flat and generate")
        if self.nodata is not None and self.source is None:
            raise PydanticCustomError("ground", "nodata of a source: made ground has no cells without a height")
        if self.positive == "down" and self.source is None:
            raise PydanticCustomError("ground", "positive: down of a source: made ground grows upwards")
        return self


class Water(Model):
    """Standing water: whatever ground lies below ``level``, metres in the heights as drawn, is under it."""

    level: float = Field(ge=-11500, le=9500)


class Weather(Model):
    """The weather.

    ``visibility`` is the meteorological range in metres: how far a dark object can be told from the horizon (contrast 2 %);
    ``None`` for air that is clear. ``cloud_cover`` is the share of the sky behind clouds, ``snow`` whether snow lies.
    """

    visibility: float | None = Field(default=None, ge=10, le=1e7)
    cloud_cover: float = Field(default=0.0, ge=0, le=1)
    snow: bool = False

    @property
    def drifts(self) -> bool:
        """Whether clouds hide a part of the sky, and so drift by the level's clock."""
        return 0.0 < self.cloud_cover < 1.0

    @property
    def overcast(self) -> bool:
        """Whether clouds cover the whole sky, so that no direct sun arrives."""
        return self.cloud_cover >= 1.0


StyleName = Literal["natural", "swiss", "grey", "urban", "analysis"]
"""Named styles: ``skugga.terrain.style.STYLES``."""

SlopeExaggeration = Annotated[float, Field(ge=0.1, le=20)]

RAMP_WORDS = "pairs of a height in metres and a colour as '#b3c2a2', heights rising"


class StyleSpec(Model):
    """How relief is shaded: a named style (``auto``: by the ground), in a file also by its name alone.

    ``ramp`` goes before the style's own colours: heights in metres and sRGB colours. ``slope_exaggeration`` multiplies slopes in
    shading; cast shadows stay those of the true ground.
    """

    name: Literal["auto"] | StyleName = "auto"
    ramp: tuple[tuple[Annotated[float, Field(ge=-12000, le=10000)], str], ...] | None = None
    slope_exaggeration: SlopeExaggeration = 1.0

    @field_validator("ramp")
    @classmethod
    def _rising(cls, value: tuple[tuple[float, str], ...] | None) -> tuple[tuple[float, str], ...] | None:
        if value is None:
            return None
        heights = [height for height, _ in value]
        if not value or not all(low < high for low, high in pairwise(heights)):
            raise PydanticCustomError("ramp", RAMP_WORDS)
        if not all(re.fullmatch("#[0-9a-fA-F]{6}", color) for _, color in value):
            raise PydanticCustomError("ramp", RAMP_WORDS)
        return value


class ForestSpec(Model):
    """A stand of trees: polygons with a density, points (one a tree), or a canopy-height raster.

    ``density`` is in trees per hectare (polygons alone), ``height`` in metres: a range, or the name of an attribute;
    ``crown`` the crown's diameter likewise (default: from the height). A canopy raster needs neither; of one, canopy below
    ``least_height`` metres is left out (default: 2, where most of it is lower 0.5). Of a file of several layers ``layer`` names the
    trees' one.
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
    def _range(cls, value: tuple[float, float] | str | None) -> tuple[float, float] | str | None:
        if isinstance(value, tuple) and not 0.1 <= value[0] <= value[1] <= 150:
            raise PydanticCustomError("range", "an attribute's name, or [least, most] in metres from 0.1 to 150")
        return value


BESIDE_PATH = "nothing beside a path of its motion, which says where it is"


class MeshSpec(Model):
    """Buildings from footprints (``height``: an attribute's name, metres for all, or a surface and a ground raster), a model
    from a file (OBJ, PLY, glTF), or a generated one. Of a file of several layers ``layer`` names the footprints' one.

    ``roof`` is the form of the roofs over footprints that are nearly rectangles; others are flat. ``at`` is where a model
    stands: one place or several (degrees; metres on a made ground), its lowest point on the ground; a path of its ``motion`` says
    so instead. ``turn`` is in degrees counter-clockwise, ``color`` an sRGB albedo in [0, 1].
    """

    source: FileName | None = None
    layer: str | None = None
    generate: MeshGenerator | None = None
    height: str | Annotated[float, Field(gt=0, le=1000)] | None = None
    surface: FileName | None = None
    ground: FileName | None = None
    roof: RoofForm = "flat"
    at: MapPosition | list[MapPosition] | None = None
    scale: float = Field(default=1.0, gt=0, le=1e6)
    turn: float = Field(default=0.0, ge=-1e6, le=1e6)
    color: tuple[float, float, float] | None = None
    caster: FileName | None = None
    motion: MeshMotion | None = None

    @field_validator("color")
    @classmethod
    def _share(cls, value: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if value is not None and not all(0 <= v <= 1 for v in value):
            raise PydanticCustomError("color", "three numbers from 0 to 1")
        return value

    @model_validator(mode="after")
    def _one_mesh(self) -> MeshSpec:
        if (self.source is None) == (self.generate is None):
            raise PydanticCustomError("mesh", "either source or generate")
        if (self.surface is None) != (self.ground is None):
            raise PydanticCustomError("mesh", "surface and ground together: heights are surface minus ground")
        if self.at is not None and self.motion is not None and self.motion.path is not None:
            raise wrong_parts("mesh", [(("at",), self.at, BESIDE_PATH)])
        return self

    @property
    def moves(self) -> bool:
        """Whether it moves by the level's clock."""
        return self.motion is not None and self.motion.moves

    @property
    def places(self) -> list[MapPosition]:
        """Where the mesh stands; empty where the file does not say."""
        if self.at is None:
            return []
        return list(self.at) if isinstance(self.at, list) else [self.at]


class SunSpec(Model):
    """Where the sun is: an ISO 8601 ``time`` with an offset, or apparent ``azimuth`` and ``altitude`` at the anchor.

    ``azimuth`` is in degrees clockwise from true north (from grid north in a flat world), ``altitude`` in degrees above
    the horizon.
    """

    time: datetime | None = None
    azimuth: float | None = Field(default=None, ge=-360, le=720)
    altitude: float | None = Field(default=None, ge=-90, le=90)

    @field_validator("time", mode="before")
    @classmethod
    def _moment(cls, value: Any) -> Any:
        if isinstance(value, str):
            try:
                return time_of(value)
            except ValueError:
                raise PydanticCustomError("time", TIME_WORDS) from None
        if value is not None and not isinstance(value, datetime):
            raise PydanticCustomError("time", TIME_WORDS)
        return value

    @model_validator(mode="after")
    def _one_way(self) -> SunSpec:
        angles = (self.azimuth is not None) + (self.altitude is not None)
        if (self.time is None) == (angles == 0) or angles == 1:
            raise PydanticCustomError("sun", "either time, or azimuth and altitude")
        if self.time is not None and self.time.tzinfo is None:
            raise PydanticCustomError("sun", TIME_WORDS)
        return self


class LightSpec(Model):
    """A light besides the sun. Positions as in views: degrees and height above ground, or metres on a made ground.

    ``cutoff`` is the half angle of a spot's cone, degrees. ``intensity`` is the irradiance at normal incidence, in units of the
    sun's, at the spot's target (an omni light: on the ground below it); it falls off with the square of the distance. ``radius``
    is that of the ball that shines, metres, whose shadows have penumbrae; 0: a point.

    A path of its ``motion`` says where its position, its target or both are instead; ``intensity`` is that at its first key.
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
    def _share(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not all(0 <= v <= 1 for v in value):
            raise PydanticCustomError("color", "three numbers from 0 to 1")
        return value

    @model_validator(mode="after")
    def _aimed(self) -> LightSpec:
        moved = () if self.motion is None else self.motion.moved
        twice = [name for name in moved if getattr(self, name) is not None]
        if twice:
            raise wrong_parts("light", [((name,), getattr(self, name), BESIDE_PATH) for name in twice])
        if self.position is None and "position" not in moved:
            raise ValidationError.from_exception_data("light", [InitErrorDetails(type="missing", loc=("position",), input=None)])
        if (self.kind == "spot") != (self.target is not None or "target" in moved):
            raise PydanticCustomError("target", "a target for a spot, none for an omni light")
        if self.target is not None and self.target == self.position:
            raise PydanticCustomError("target", "a target other than the position")
        return self

    @property
    def moves(self) -> bool:
        """Whether it moves by the level's clock."""
        return self.motion is not None


class MapSpec(Model):
    """A map view: orthographic, straight down. ``bounds`` are in ``crs``; what is left out follows from the level."""

    kind: Literal["map"]
    bounds: tuple[float, float, float, float] | None = None
    crs: str | None = None
    size: tuple[PixelCount, PixelCount] | None = None

    @field_validator("bounds")
    @classmethod
    def _ordered(cls, value: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
        if value is not None and not (value[0] < value[2] and value[1] < value[3]):
            raise PydanticCustomError("bounds", "west < east and south < north")
        return value


class PerspectiveSpec(Model):
    """A perspective view. ``eye`` and ``target``: longitude, latitude, metres above the ground there; on a made ground metres
    east and north of its middle and above it. ``fov`` is the vertical field of view in degrees.
    """

    kind: Literal["perspective"]
    eye: Position
    target: Position
    fov: float = Field(default=50.0, ge=0.01, le=179)
    size: tuple[PixelCount, PixelCount] = (1280, 1024)

    @model_validator(mode="after")
    def _apart(self) -> PerspectiveSpec:
        if self.eye == self.target:
            raise PydanticCustomError("target", "a target other than the eye")
        return self


ViewSpec = Annotated[MapSpec | PerspectiveSpec, Field(discriminator="kind")]
