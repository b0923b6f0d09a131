"""Level files: the description of a scene, as an immutable, validated value.

A level is YAML 1.2, in which `on` and `off` are strings, not booleans. Every error names the file, the key's path, the value
and the allowed values.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError
from ruamel.yaml.error import YAMLError

from skugga.terrain.errors import InputError, LevelError, Problem, printable
from skugga.terrain.level.algorithm_names import ALGORITHM_NAMES, AlgorithmName
from skugga.terrain.level.data_files import special_file_kind
from skugga.terrain.level.data_roots import DataRoots
from skugga.terrain.level.level_errors import UNKNOWN_KEY, allowed_phrase, level_error
from skugga.terrain.level.level_source import LEVEL_KEYS_BY_OPTION, LevelSource
from skugga.terrain.level.level_text import MAX_CHARACTERS, parse_level_text
from skugga.terrain.level.linked_files import is_remote, linked_files
from skugga.terrain.level.model import Model
from skugga.terrain.level.motion import ClockSeconds
from skugga.terrain.level.parts import (
    ALLOWED_TIMES,
    ForestSpec,
    LandCoverSpec,
    LightSpec,
    LineSpec,
    MapSpec,
    MeshSpec,
    StyleSpec,
    SunSpec,
    Terrain,
    ViewSpec,
    Water,
    Weather,
    parse_time,
)
from skugga.terrain.level.pin_scope import PinScope, covered_pins
from skugga.terrain.level.rasters import LEVEL_SUFFIXES, is_level_raster
from skugga.terrain.level.setting import RequestOptions, limits_text

EffectName = Literal[
    "refraction", "cast_shadows", "alpha_test", "soft_edges", "outside_casters",
    "normal_maps", "ground_materials", "ground_detail", "roads", "facades", "textures", "snow", "crowns", "clouds", "sky_view",
    "ambient_occlusion", "sky_light", "texture_shading", "lamps", "highlights", "water", "haze", "precipitation",
]  # fmt: skip
"""Names of the rendering effects, each a module of ``skugga.terrain.effects``.

Effects that change the same array (``skugga.terrain.effects.effect.Stage``) run in this order.
"""

CasterKind = Literal["relief", "meshes", "forest"]
"""Kinds of shadow casters: the heightfield, the meshes (buildings and models), and the alpha-tested trees."""

SUN = "sun"
"""Name of the sun among the lights."""

LightName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,31}$")]

AlgorithmOverride = dict[str, dict[CasterKind, AlgorithmName]]
"""Algorithms that a level or a request sets: light -> kind of casters -> name of the algorithm.

For all other lights and kinds the selector chooses the algorithm.
"""


class ShadowSettings(Model):
    """Shadow settings that a level or a request can set. With ``auto`` the selector chooses the value.

    Each setting is declared only here. The field's type, limits and description define the options of ``skugga render`` and
    ``skugga select``, the HTTP parameters and the messages to render processes. If only some of these accept a setting,
    ``RequestOptions`` names them.
    """

    algorithm: Annotated[
        Literal["auto"] | AlgorithmName | dict[str, Any], RequestOptions(request_type=Annotated[str, Field(max_length=200)])
    ] = Field(default="auto", description="`auto`, a name, or `relief=NAME,forest=NAME,LIGHT=NAME`.", examples=["auto"])
    map_size: Literal["auto"] | Annotated[int, Field(ge=64, le=8192)] = Field(
        default="auto", description="Size of a shadow map: texels per side.", examples=[1024]
    )
    cascades: Annotated[Literal["auto", 1, 2, 3, 4], RequestOptions(front_ends=("render", "select", "plans"))] = Field(
        default="auto", description="Number of cascades: shadow maps of a perspective view, each for a range of distances."
    )
    depth_bits: Literal["auto", 16, 24, 32] = Field(default="auto", description="Bits of depth of a shadow map.")
    filter: Literal["auto", 1, 2, 3, 5, "sun"] = Field(
        default="auto",
        description="Shadow filter: taps per side in a map, or `sun` for the penumbra of the sun's disc or of a lamp's radius.",
    )
    fit: Annotated[Literal["auto", "stable", "tight"], RequestOptions(front_ends=("render", "select"))] = Field(
        default="auto", description="Fit of a shadow map: on a lattice fixed to the ground, or tight around the view."
    )
    bias: Literal["auto", "receiver_plane", "normal_offset", "polygon_offset", "slope_clamped"] = Field(
        default="auto", description="Bias of a shadow map, which keeps a surface from shading itself."
    )
    bias_scale: Annotated[
        Literal["auto"] | Annotated[float, Field(ge=0, le=100)], RequestOptions(front_ends=("render", "select", "plans"))
    ] = Field(
        default="auto",
        description="Factor of a shadow map's bias: 1 is right, 0 shows acne, much more shows peter-panning.",
        examples=[0],
    )
    culling: Literal["auto", "none", "front"] = Field(
        default="auto", description="Culling: faces of closed bodies that a shadow map omits."
    )
    stencil: Literal["auto", "one_pass", "two_pass"] = Field(
        default="auto", description="Stencil passes of shadow volumes: both sides at once, or one after the other."
    )
    counting: Annotated[Literal["auto", "z_fail", "z_pass"], RequestOptions(allows_auto=True)] = Field(
        default="auto",
        description="Stencil counting of shadow volumes: z-pass or z-fail as each caster needs, or one of them for all.",
    )
    mask: Literal["auto", "conservative", "original", "off"] = Field(
        default="auto", description="Mask of the hybrid: how it finds the pixels for shadow volumes; `off`: all pixels."
    )
    slide_back: Annotated[Literal["auto", "off"], RequestOptions(front_ends=("render", "select", "plans"))] = Field(
        default="auto", description="Slide-back of a perspective shadow map: its virtual camera behind the real one, or at it."
    )

    @field_validator("algorithm")
    @classmethod
    def _check_algorithm(cls, value: Any) -> Any:
        expand_override(value, override_lights(value))  # ``Level`` checks whether these lights exist
        return value


class Shadows(ShadowSettings):
    """Requested shadows: their settings, and the error and time limits for the choices of the selector."""

    max_error: Annotated[FiniteFloat, RequestOptions(front_ends=("select", "plans"))] = Field(
        default=0.03, ge=0, le=1, description="Error limit: share of the cast shadow that may be wrong.", examples=[0.03]
    )
    max_ms: Annotated[FiniteFloat | None, RequestOptions(front_ends=("select", "plans"))] = Field(
        default=None,
        gt=0,
        description="Time limit: milliseconds for the shadows of a frame (of a map: of a block of 1024 x 1024 pixels).",
        examples=[40],
    )

    def pin_number(self, view: str, sun_altitude_deg: float | None) -> int | None:
        """Return ``None``, since the settings of a request have no pins (settings for some views and sun altitudes of a level)."""
        return None

    @property
    def all_settings(self) -> dict[str, ShadowSettings]:
        """All groups of settings that may apply, by their key in a level file."""
        return {"shadows": self}


class Pin(PinScope, ShadowSettings):
    """A pin: shadow settings for some views and sun altitudes of a level.

    They take precedence over the level's settings for all views.
    """

    @property
    def settings(self) -> dict[str, Any]:
        """Names and values of the shadow settings that the pin sets."""
        return self.model_dump(include=self.model_fields_set & ShadowSettings.model_fields.keys())

    @model_validator(mode="after")
    def _check_settings(self) -> Pin:
        if not self.settings:
            raise PydanticCustomError("pin", "at least one setting of {keys}", {"keys": ", ".join(ShadowSettings.model_fields)})
        return self


class LevelShadows(Shadows):
    """Shadow settings of a level, for all of its views and suns.

    ``pins`` replace them for some views and sun altitudes. If several pins apply, the first one counts.
    """

    pins: tuple[Pin, ...] = ()

    def pin_number(self, view: str, sun_altitude_deg: float | None) -> int | None:
        """Return the index in ``pins`` of the first pin that applies to a view and a sun altitude; ``None`` if no pin does.

        ``sun_altitude_deg`` is ``None`` without a sun.
        """
        return next((number for number, pin in enumerate(self.pins) if pin.applies_to(view, sun_altitude_deg)), None)

    @property
    def all_settings(self) -> dict[str, ShadowSettings]:
        """All groups of settings that may apply, the level's own and those of its pins, by their key in the file."""
        return {**super().all_settings, **{f"shadows.pins.{number}": pin for number, pin in enumerate(self.pins)}}


class Level(Model):
    """The contents of a level file."""

    version: Literal[1]
    title: str = ""
    attribution: str = ""
    terrain: Terrain
    water: Water | None = None
    roads: tuple[LineSpec, ...] = ()
    rivers: tuple[LineSpec, ...] = ()
    land_cover: tuple[LandCoverSpec, ...] = ()
    forest: tuple[ForestSpec, ...] = ()
    meshes: tuple[MeshSpec, ...] = ()
    sun: SunSpec | Literal["none"] | None = None  # default: a low sun at the level's place, ``skugga.terrain.default_sun``
    lights: dict[LightName, LightSpec] = {}
    weather: Weather = Weather()
    style: StyleSpec = StyleSpec()
    seconds: ClockSeconds = 0.0
    views: dict[str, ViewSpec] = {"map": MapSpec(kind="map")}
    shadows: LevelShadows = LevelShadows()
    effects: Literal["auto"] | dict[EffectName, Literal["auto", "on", "off"]] = "auto"
    archive: Annotated[str, Field(min_length=1)] | tuple[str, ...] = ()  # archives of pre-rendered tiles, for servers

    @field_validator("lights")
    @classmethod
    def _check_light_names(cls, value: dict[str, LightSpec]) -> dict[str, LightSpec]:
        reserved = (SUN, *get_args(CasterKind), *ALGORITHM_NAMES, "auto")
        for name in value:
            if name in reserved:
                raise PydanticCustomError("light", "light names other than {taken}", {"taken": ", ".join(reserved)})
        return value

    @field_validator("style", mode="before")
    @classmethod
    def _expand_style_name(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @field_validator("archive")
    @classmethod
    def _check_archive(cls, value: str | tuple[str, ...]) -> str | tuple[str, ...]:
        if any(is_remote(name) or not name for name in ((value,) if isinstance(value, str) else value)):
            raise PydanticCustomError("archive", "a local file, or a list of local files")
        return value

    @model_validator(mode="after")
    def _check_lights(self) -> Level:
        expand_override(self.shadows.algorithm, self.light_names)
        return self

    @model_validator(mode="after")
    def _check_pins(self) -> Level:
        """Check that each pin names an existing view and existing lights, and that it can apply.

        A pin cannot apply if earlier pins cover all of its views and sun altitudes.
        """
        pins, views, error_details = self.shadows.pins, {"map": None, **self.views}, []
        for number, pin in enumerate(pins):
            if pin.view is not None and pin.view not in views:
                problem = PydanticCustomError("pin", "one of the level's views: {views}", {"views": ", ".join(views)})
                error_details.append(InitErrorDetails(type=problem, loc=("shadows", "pins", number, "view"), input=pin.view))
            try:
                expand_override(pin.algorithm, self.light_names)
            except PydanticCustomError as error:
                location = ("shadows", "pins", number, "algorithm")
                error_details.append(InitErrorDetails(type=error, loc=location, input=pin.algorithm))
        if not error_details:
            for number, earlier in covered_pins(pins, views, self.sun == "none"):
                before = " and ".join(f"shadows.pins.{index} ({pins[index].scope_text})" for index in earlier)
                problem = PydanticCustomError(
                    "pin", "a view or sun altitudes that earlier pins do not cover: {before}", {"before": before}
                )
                error_details.append(InitErrorDetails(type=problem, loc=("shadows", "pins", number), input=pins[number].scope_text))
        if error_details:
            raise ValidationError.from_exception_data("Level", error_details)
        return self

    @model_validator(mode="after")
    def _check_blocks(self) -> Level:
        perspective_views = [name for name, view in self.views.items() if view.kind == "perspective"]
        if self.terrain.surface == "blocks" and perspective_views:
            raise PydanticCustomError(
                "blocks", "smooth: blocks works in maps only, and {views} is a perspective view", {"views": perspective_views[0]}
            )
        return self

    @property
    def moving_keys(self) -> tuple[str, ...]:
        """Keys of the parts that move with the level's clock: meshes, lamps, drifting clouds and precipitation."""
        meshes = [f"meshes.{number}" for number, mesh in enumerate(self.meshes) if mesh.moves]
        lamps = [f"lights.{name}" for name, light in self.lights.items() if light.moves]
        clouds = ["weather.cloud_cover"] if self.weather.has_drifting_clouds else []
        falling = [] if self.weather.precipitation == "none" else ["weather.precipitation"]
        return (*meshes, *lamps, *clouds, *falling)

    @property
    def light_names(self) -> tuple[str, ...]:
        """Names of the sun, even if the level has none, and then of the other lights."""
        return (SUN, *self.lights)


class LoadedLevel(BaseModel):
    """A level with its name and the path of its file.

    ``digest`` is a hash of the content of the level file that pictures depend on.
    """

    model_config = ConfigDict(frozen=True)

    name: str
    path: Path
    level: Level
    digest: str

    @property
    def source(self) -> str:
        """Absolute path of the terrain's raster, the name of a bundled data set, or "" for generated ground."""
        from skugga.terrain.level.bundled import BUNDLED

        source = self.level.terrain.source
        return source or "" if source is None or source in BUNDLED else self.resolve(source)

    @property
    def without_sun(self) -> LoadedLevel:
        """The same level without a sun. It saves the import of a library, which takes most of a second if the sun has a time."""
        return self.model_copy(update={"level": self.level.model_copy(update={"sun": "none"})})

    @property
    def sources(self) -> tuple[str, ...]:
        """Absolute paths, or addresses, of all files that the level names, without tile archives and bundled data sets."""
        from skugga.terrain.level.bundled import BUNDLED

        level = self.level
        names = [level.terrain.source, level.terrain.imagery]
        names += [spec.source for spec in (*level.roads, *level.rivers)]
        names += [spec.source for spec in level.land_cover]
        names += [stand.source for stand in level.forest]
        for mesh in level.meshes:
            names += [mesh.source, mesh.caster, mesh.surface, mesh.ground]
        return tuple(self.resolve(name) for name in names if name is not None and name not in BUNDLED)

    @property
    def archives(self) -> tuple[Path, ...]:
        """Absolute paths of the tile archives that the level names. ``sources`` omits them, since no picture depends on them."""
        names = self.level.archive
        return tuple(Path(self.resolve(name)) for name in ((names,) if isinstance(names, str) else names))

    @property
    def linked_sources(self) -> tuple[str, ...]:
        """``sources`` and all files that they refer to: parts of virtual rasters, materials and textures of models, addresses."""
        return tuple(dict.fromkeys(file for source in self.sources for file in (source, *linked_files(source))))

    def resolve(self, source: str) -> str:
        """Return the absolute path of a path relative to the level file. Addresses and GDAL's own paths stay as they are."""
        if "://" in source or source.startswith("/"):
            return source
        return str((self.path.parent / source).resolve())


def expand_override(
    value: str | dict[str, Any], lights: tuple[str, ...] = (SUN,), names: Sequence[str] = ALGORITHM_NAMES
) -> AlgorithmOverride:
    """Convert any allowed form of the setting ``algorithm`` to the form light -> kind of casters -> name of the algorithm.

    The forms are a name, ``{kind: name}``, ``{light: name}`` and ``{light: {kind: name}}``. A name alone applies to all ``lights``.
    Kinds without a light apply to the sun. The name ``auto`` gives no entry. ``names`` are the allowed algorithms.
    Raises ``PydanticCustomError`` with the allowed values.
    """
    kinds, words = get_args(CasterKind), (*names, "auto")

    def name_of(item: Any) -> str:
        if item not in words:
            raise PydanticCustomError("algorithm", "one of {names}", {"names": ", ".join(words)})
        return item

    choice: dict[str, dict[Any, Any]] = {}  # all keys and values are checked to be known words
    if not isinstance(value, dict):
        value = {light: value for light in lights}
    for key, item in value.items():
        if key in kinds:
            choice.setdefault(SUN, {})[key] = name_of(item)
        elif key in lights:
            per_kind = item if isinstance(item, dict) else {kind: item for kind in kinds}
            for kind, name in per_kind.items():
                if kind not in kinds:
                    raise PydanticCustomError("algorithm", "the caster kinds {kinds}", {"kinds": ", ".join(kinds)})
                choice.setdefault(key, {})[kind] = name_of(name)
        else:
            raise PydanticCustomError(
                "algorithm",
                "keys that name a light ({lights}) or a caster kind ({kinds})",
                {"lights": ", ".join(lights), "kinds": ", ".join(kinds)},
            )
    named = {light: {k: n for k, n in names_by_kind.items() if n != "auto"} for light, names_by_kind in choice.items()}
    return {light: names_by_kind for light, names_by_kind in named.items() if names_by_kind}


def override_lights(value: Any) -> tuple[str, ...]:
    """Return the names of the sun and of the other lights in a value of the setting ``algorithm``.

    Every key of the value that is no kind of casters counts as the name of a light.
    """
    keys = value if isinstance(value, dict) else ()
    return (SUN, *(key for key in keys if isinstance(key, str) and key not in (SUN, *get_args(CasterKind))))


def parse_algorithm(text: str, parameter: str = "algorithm", names: Sequence[str] = ALGORITHM_NAMES) -> str | dict[str, Any]:
    """Parse the setting ``algorithm`` from text such as ``shadow_map`` or ``relief=sweep,forest=shadow_map,lamp=shadow_map``.

    ``names`` are the allowed algorithms. Raises ``InputError``, which names ``parameter``. Does not check whether a level has the
    named lights; ``expand_override`` does.
    """
    text = text.strip()
    value: str | dict[str, Any] = text
    if "=" in text:
        value = {}
        for part in text.split(","):
            key, _, name = part.partition("=")
            value[key.strip()] = name.strip()
    try:
        expand_override(value, override_lights(value), names)
    except PydanticCustomError as error:
        raise InputError(parameter, text, error.message()) from None
    return value


def override_text(algorithm: str | dict[str, Any]) -> str:
    """Return a value of the setting ``algorithm`` as text that ``parse_algorithm`` reads."""
    if isinstance(algorithm, str):
        return algorithm
    flat: dict[str, Any] = {}
    for key, value in algorithm.items():
        flat |= value if isinstance(value, dict) else {key: value}
    return ",".join(f"{key}={value}" for key, value in flat.items())


def override_settings(shadows: Shadows, changes: dict[str, Any]) -> Shadows:
    """Return shadow settings with the values that a request changes.

    ``changes`` are the values by name of the setting; a value ``None`` changes nothing. Raises ``InputError``.
    """
    changes = {key: value for key, value in changes.items() if value is not None}
    try:
        return Shadows.model_validate({**shadows.model_dump(include=set(Shadows.model_fields)), **changes})
    except ValidationError as error:
        details = error.errors()
        if details[0]["type"] == UNKNOWN_KEY:
            raise InputError(
                details[0]["ctx"]["key"], Problem("unknown setting"), f"Use one of {details[0]['ctx']['known']}"
            ) from None
        name = str(details[0]["loc"][0]) if details[0]["loc"] else "shadows"
        phrases = (_allowed_setting(name, detail) for detail in details if detail["loc"][:1] == (name,))
        allowed = " or ".join(dict.fromkeys(phrases))
        raise InputError(name, changes.get(name), allowed) from None


def _allowed_setting(name: str, detail: ErrorDetails) -> str:
    """Return a pydantic error of a setting as a phrase of allowed values, with both of its limits."""
    is_beyond_limit = detail["type"] in ("greater_than_equal", "less_than_equal")
    return (limits_text(Shadows.model_fields[name]) if is_beyond_limit else "") or allowed_phrase(detail)


ALLOWED_ANGLES = {"azimuth": "-360 to 720 degrees", "altitude": "-90 to 90 degrees"}


def parse_sun(time: str | None, azimuth: float | None, altitude: float | None) -> SunSpec | None:
    """Return the sun that query or command-line parameters give, by a time or by angles in degrees; ``None`` if all are ``None``.

    Accepts a space instead of the ``+`` of a time's offset, because URLs decode ``+`` to a space. Raises ``InputError``.
    """
    angles = {name: angle for name, angle in (("azimuth", azimuth), ("altitude", altitude)) if angle is not None}
    if time is None and not angles:
        return None
    if time is not None and angles:
        raise InputError.conflict("time", next(iter(angles)))
    if len(angles) == 1:
        raise InputError.missing("altitude" if "azimuth" in angles else "azimuth", "Give both angles of the sun, or a time")
    fields: dict[str, Any] = dict(angles)
    if time is not None:
        text = time.strip()
        head, space, tail = text.rpartition(" ")
        if space and "T" in head:
            text = f"{head}+{tail}"
        try:
            fields["time"] = parse_time(text)
        except ValueError:
            raise InputError("time", time, ALLOWED_TIMES) from None
    try:
        return SunSpec(**fields)
    except ValidationError as error:
        detail = error.errors()[0]
        name = str(detail["loc"][0]) if detail["loc"] else "time"
        allowed = ALLOWED_ANGLES.get(name, allowed_phrase(detail))
        raise InputError(name, time if name == "time" else angles[name], allowed) from None


YAML_LIKE_SUFFIXES = (*LEVEL_SUFFIXES, ".json", ".txt", "")
"""Suffixes of files whose YAML errors are reported in detail. Files with other suffixes are probably not meant to be YAML."""

_NOT_A_LEVEL_PROBLEM = "neither a level file nor a raster that GDAL reads"
_LEVEL_REMEDY = "Use a raster of heights, or a YAML file that starts with 'version: 1'"
_READABLE_REMEDY = "Use a readable YAML file, or a raster that GDAL reads"


def load_level(source: Path | str | LevelSource) -> LoadedLevel:
    """Read and validate a level file, or make a level from a raster and the options of a ``LevelSource``.

    Raises ``LevelError``, also if a file lies outside the source's ``roots``. Raises ``InputError`` for options of rasters that are
    given with a level file.
    """
    source = LevelSource.of(source)
    loaded = _load(source)
    if source.name is not None:
        loaded = loaded.model_copy(update={"name": source.name})
    if source.roots is not None:
        DataRoots(source.roots).check_level(loaded)
    return loaded


def _load(source: LevelSource) -> LoadedLevel:
    """Return the level of a source. Raises the errors of ``load_level``. The files that the level names are not checked here."""
    path = source.path
    if source.roots is not None:
        DataRoots(source.roots).check_path(path, str(path))
    if is_level_raster(path):
        for file in ("canopy", "buildings"):
            if (value := getattr(source, file)) is not None and not value.is_file():
                raise InputError(file, str(value), "an existing file")
        level = Level.model_validate(source.level_keys)
        return LoadedLevel(name=printable(path.stem), path=path.resolve(), level=level, digest=source.digest)
    for name in source.options:
        raise InputError(
            name,
            Problem(f"applies to rasters only, and {path} is a level file"),
            f"Write {LEVEL_KEYS_BY_OPTION[name]} in the level file",
        )
    if (kind := special_file_kind(path)) is not None:
        raise LevelError(str(path), Problem(f"{kind}, not a regular file"), _READABLE_REMEDY)
    try:
        with path.open(encoding="utf-8") as level_file:
            text = level_file.read(MAX_CHARACTERS + 1)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not UTF-8 text"
        raise LevelError(str(path), Problem(reason), _READABLE_REMEDY) from None
    if len(text) > MAX_CHARACTERS:
        raise LevelError(str(path), Problem(f"more than {MAX_CHARACTERS} characters"), "Use a shorter file")
    try:
        data = parse_level_text(text)
    except (ValueError, RecursionError, YAMLError) as error:  # also of an impossible date, or too deeply nested brackets
        if path.suffix.lower() not in YAML_LIKE_SUFFIXES:
            raise LevelError(str(path), Problem(_NOT_A_LEVEL_PROBLEM), _LEVEL_REMEDY) from None
        if not isinstance(error, YAMLError):
            raise LevelError(str(path), Problem(str(error)), "Use well-formed YAML 1.2") from None
        mark = getattr(error, "problem_mark", None)
        location = f"{path}: line {mark.line + 1}" if mark else str(path)
        problem = Problem(getattr(error, "problem", None) or "malformed YAML")
        raise LevelError(location, problem, "Use well-formed YAML 1.2") from None
    if not isinstance(data, dict):
        if path.suffix.lower() not in YAML_LIKE_SUFFIXES:
            raise LevelError(str(path), Problem(_NOT_A_LEVEL_PROBLEM), _LEVEL_REMEDY)
        raise LevelError(str(path), data, "a mapping that starts with 'version: 1'")
    try:
        level = Level.model_validate(data)
    except ValidationError as error:
        raise level_error(str(path), data, error.errors()) from None
    # The digest omits the archives. The tiles of an archive were drawn before the level named it, and must keep their digest.
    digest = hashlib.sha256(repr({key: value for key, value in data.items() if key != "archive"}).encode()).hexdigest()[:16]
    return LoadedLevel(name=printable(path.stem), path=path.resolve(), level=level, digest=digest)
