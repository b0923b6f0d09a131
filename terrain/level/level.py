"""Level files: what a scene is made of, as an immutable, validated value.

A level is YAML 1.2 (so `on` and `off` are words, not booleans). Every error names the file, the key's path, the value
and what is allowed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, field_validator, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError
from ruamel.yaml.error import YAMLError

from skugga.terrain.errors import Problem, InputError, LevelError, printable
from skugga.terrain.level.algorithm_names import ALGORITHM_NAMES, AlgorithmName
from skugga.terrain.level.data_files import special_kind
from skugga.terrain.level.data_roots import DataRoots
from skugga.terrain.level.level_errors import UNKNOWN_KEY, level_error
from skugga.terrain.level.level_source import KEYS_OF_OPTIONS, LevelSource
from skugga.terrain.level.level_text import MOST_CHARACTERS, parse_level_text
from skugga.terrain.level.linked_files import is_remote, linked_files
from skugga.terrain.level.model import Model
from skugga.terrain.level.motion import ClockSeconds
from skugga.terrain.level.parts import (
    TIME_WORDS,
    ForestSpec,
    LightSpec,
    MapSpec,
    MeshSpec,
    StyleSpec,
    SunSpec,
    Terrain,
    ViewSpec,
    Water,
    Weather,
    time_of,
)
from skugga.terrain.level.pin_scope import PinScope, never_taken
from skugga.terrain.level.rasters import LEVEL_SUFFIXES, is_level_raster
from skugga.terrain.level.setting import Requests

EffectName = Literal[
    "refraction", "cast_shadows", "alpha_test", "soft_edges", "outside_casters",
    "ground_detail", "snow", "crowns", "clouds", "sky_view", "lamps", "water", "haze",
]  # fmt: skip
"""Effects: each is the file of its name in ``skugga.terrain.effects``; those of one stage run in this order."""

CasterKind = Literal["relief", "meshes", "forest"]
"""What can cast: the heightfield, buildings and models, alpha-tested trees."""

SUN = "sun"
"""The sun's name among the lights."""

LightName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_-]{0,31}$")]

AlgorithmOverride = dict[str, dict[CasterKind, AlgorithmName]]
"""An override of the algorithm: light -> caster kind -> name; whatever it leaves out is chosen by the selector."""


class ShadowSettings(Model):
    """How shadows are to be drawn: what can be pinned; ``auto`` leaves a choice to the selector.

    A setting is declared here and nowhere else. Its type, limits and description make the options of ``skugga render`` and
    ``skugga select``, the parameters over HTTP and what crosses to render processes; ``Requests`` says where it is taken, if
    that is not everywhere.
    """

    algorithm: Annotated[
        Literal["auto"] | AlgorithmName | dict[str, Any], Requests(spelt=Annotated[str, Field(max_length=200)])
    ] = Field(default="auto", description="`auto`, a name, or `relief=NAME,forest=NAME,LIGHT=NAME`.", examples=["auto"])
    map_size: Literal["auto"] | Annotated[int, Field(ge=64, le=8192)] = Field(
        default="auto", description="Size of a shadow map: texels a side.", examples=[1024]
    )
    cascades: Annotated[Literal["auto", 1, 2, 3, 4], Requests(take=("render", "select", "plans"))] = Field(
        default="auto", description="Number of cascades: shadow maps of a perspective view, each for a range of distances."
    )
    depth_bits: Literal["auto", 16, 24, 32] = Field(default="auto", description="Bits of depth of a shadow map.")
    filter: Literal["auto", 1, 2, 3, 5, "sun"] = Field(
        default="auto",
        description="Filter of shadows: a map's taps a side, or `sun` for the penumbra of the sun's disc, or of a lamp's radius.",
    )
    fit: Annotated[Literal["auto", "stable", "tight"], Requests(take=("render", "select"))] = Field(
        default="auto", description="Fit of a shadow map: on a lattice fixed to the ground, or tight round the view."
    )
    bias: Literal["auto", "receiver_plane", "normal_offset", "polygon_offset"] = Field(
        default="auto", description="Bias of a shadow map: what keeps a surface from shading itself."
    )
    culling: Literal["auto", "none", "front"] = Field(
        default="auto", description="Culling: faces of closed bodies that are left out of a shadow map."
    )
    stencil: Literal["auto", "one_pass", "two_pass"] = Field(
        default="auto", description="Stencil passes of shadow volumes: both sides at once, or one after the other."
    )
    counting: Annotated[Literal["auto", "z_fail"], Requests(auto=True)] = Field(
        default="auto",
        description="Stencil counting of shadow volumes: z-pass or z-fail as each caster needs, or z-fail for all.",
    )
    mask: Literal["auto", "conservative", "original"] = Field(
        default="auto", description="Mask of the hybrid: how it finds the pixels left to shadow volumes."
    )

    @field_validator("algorithm")
    @classmethod
    def _known(cls, value: Any) -> Any:
        expand_override(value, lights_named(value))  # whether the level has such lights is checked there
        return value


class Shadows(ShadowSettings):
    """What is asked of the shadows: how they are to be drawn, and the target where that is left to the selector."""

    max_error: Annotated[FiniteFloat, Requests(take=("select", "plans"))] = Field(
        default=0.03, ge=0, le=1, description="Error limit: share of the cast shadow that may be wrong.", examples=[0.03]
    )
    max_ms: Annotated[FiniteFloat | None, Requests(take=("select", "plans"))] = Field(
        default=None,
        gt=0,
        description="Time limit: milliseconds for the shadows of a frame (of a map: of a block of 1024 x 1024 pixels).",
        examples=[40],
    )

    def pin_for(self, view: str, sun_altitude_deg: float | None) -> int | None:
        """The number of the pin that holds for a view under a sun (``None``: without one); a request has none."""
        return None

    @property
    def all_settings(self) -> dict[str, ShadowSettings]:
        """All that may come to be asked for, by its key in a level file."""
        return {"shadows": self}


class Pin(PinScope, ShadowSettings):
    """Settings for some views and suns of a level. Those that it names go before the level's own."""

    @property
    def settings(self) -> dict[str, Any]:
        """The settings that it names."""
        return self.model_dump(include=self.model_fields_set & ShadowSettings.model_fields.keys())

    @model_validator(mode="after")
    def _pins_something(self) -> Pin:
        if not self.settings:
            raise PydanticCustomError("pin", "one of {keys} besides", {"keys": ", ".join(ShadowSettings.model_fields)})
        return self


class LevelShadows(Shadows):
    """What a level asks of the shadows: for all of its views and suns, and in ``pins`` for some, of which the first that holds
    counts.
    """

    pins: tuple[Pin, ...] = ()

    def pin_for(self, view: str, sun_altitude_deg: float | None) -> int | None:
        """The number of the first pin that holds for a view under a sun; ``None`` where none does."""
        return next((number for number, pin in enumerate(self.pins) if pin.holds(view, sun_altitude_deg)), None)

    @property
    def all_settings(self) -> dict[str, ShadowSettings]:
        """All that may come to be asked for, by its key in the file."""
        return {**super().all_settings, **{f"shadows.pins.{number}": pin for number, pin in enumerate(self.pins)}}


class Level(Model):
    """A whole level file."""

    version: Literal[1]
    title: str = ""
    attribution: str = ""
    terrain: Terrain
    water: Water | None = None
    forest: tuple[ForestSpec, ...] = ()
    meshes: tuple[MeshSpec, ...] = ()
    sun: SunSpec | Literal["none"] | None = None  # a low one of the level's own place: ``skugga.terrain.own_sun``
    lights: dict[LightName, LightSpec] = {}
    weather: Weather = Weather()
    style: StyleSpec = StyleSpec()
    seconds: ClockSeconds = 0.0
    views: dict[str, ViewSpec] = {"map": MapSpec(kind="map")}
    shadows: LevelShadows = LevelShadows()
    effects: Literal["auto"] | dict[EffectName, Literal["auto", "on", "off"]] = "auto"
    archive: Annotated[str, Field(min_length=1)] | tuple[str, ...] = ()  # of tiles that were drawn ahead, for what serves the level

    @field_validator("lights")
    @classmethod
    def _own_names(cls, value: dict[str, LightSpec]) -> dict[str, LightSpec]:
        reserved = (SUN, *get_args(CasterKind), *ALGORITHM_NAMES, "auto")
        for name in value:
            if name in reserved:
                raise PydanticCustomError("light", "names other than {taken}", {"taken": ", ".join(reserved)})
        return value

    @field_validator("style", mode="before")
    @classmethod
    def _by_name(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @field_validator("archive")
    @classmethod
    def _files(cls, value: str | tuple[str, ...]) -> str | tuple[str, ...]:
        if any(is_remote(name) or not name for name in ((value,) if isinstance(value, str) else value)):
            raise PydanticCustomError("archive", "a file of this machine, or a list of such")
        return value

    @model_validator(mode="after")
    def _lights_exist(self) -> Level:
        expand_override(self.shadows.algorithm, self.light_names)
        return self

    @model_validator(mode="after")
    def _pins_hold(self) -> Level:
        """Each pin is for a view and lights that there are, and for something that earlier pins leave."""
        pins, views, wrong = self.shadows.pins, {"map": None, **self.views}, []
        for number, pin in enumerate(pins):
            if pin.view is not None and pin.view not in views:
                problem = PydanticCustomError("pin", "one of the level's views: {views}", {"views": ", ".join(views)})
                wrong.append(InitErrorDetails(type=problem, loc=("shadows", "pins", number, "view"), input=pin.view))
            try:
                expand_override(pin.algorithm, self.light_names)
            except PydanticCustomError as error:
                where = ("shadows", "pins", number, "algorithm")
                wrong.append(InitErrorDetails(type=error, loc=where, input=pin.algorithm))
        if not wrong:
            for number, earlier in never_taken(pins, views, self.sun == "none"):
                before = " and ".join(f"shadows.pins.{each} ({pins[each].where})" for each in earlier)
                problem = PydanticCustomError("pin", "views and suns that are left by {before}", {"before": before})
                wrong.append(InitErrorDetails(type=problem, loc=("shadows", "pins", number), input=pins[number].where))
        if wrong:
            raise ValidationError.from_exception_data("Level", wrong)
        return self

    @model_validator(mode="after")
    def _blocks_in_maps(self) -> Level:
        eyes = [name for name, view in self.views.items() if view.kind == "perspective"]
        if self.terrain.surface == "blocks" and eyes:
            raise PydanticCustomError("blocks", "smooth: blocks is for maps, and {views} is a perspective view", {"views": eyes[0]})
        return self

    @property
    def movers(self) -> tuple[str, ...]:
        """What moves by the level's clock, by its key in the file: meshes, lamps, and clouds that hide a part of the sky."""
        meshes = [f"meshes.{number}" for number, mesh in enumerate(self.meshes) if mesh.moves]
        lamps = [f"lights.{name}" for name, light in self.lights.items() if light.moves]
        return (*meshes, *lamps, *(("weather.cloud_cover",) if self.weather.drifts else ()))

    @property
    def light_names(self) -> tuple[str, ...]:
        """The sun (there or not), then the other lights."""
        return (SUN, *self.lights)


class LoadedLevel(BaseModel):
    """A level with its name and the place it came from; ``digest`` changes with what its text says of pictures."""

    model_config = ConfigDict(frozen=True)

    name: str
    path: Path
    level: Level
    digest: str

    @property
    def source(self) -> str:
        """The raster's path, relative to nothing; a bundled data set's name stays as it is, a made ground has none ("")."""
        from skugga.terrain.level.bundled import BUNDLED

        source = self.level.terrain.source
        return source or "" if source is None or source in BUNDLED else self.resolve(source)

    @property
    def without_sun(self) -> LoadedLevel:
        """The same level without a sun, to place which a time needs a library that takes most of a second to import."""
        return self.model_copy(update={"level": self.level.model_copy(update={"sun": "none"})})

    @property
    def sources(self) -> tuple[str, ...]:
        """All files that the level names, relative to nothing."""
        from skugga.terrain.level.bundled import BUNDLED

        level = self.level
        named = [level.terrain.source, level.terrain.imagery, *(stand.source for stand in level.forest)]
        for mesh in level.meshes:
            named += [mesh.source, mesh.caster, mesh.surface, mesh.ground]
        return tuple(self.resolve(name) for name in named if name is not None and name not in BUNDLED)

    @property
    def archives(self) -> tuple[Path, ...]:
        """The archives of tiles that the level names, relative to nothing. No picture hangs on them: they are no ``sources``."""
        named = self.level.archive
        return tuple(Path(self.resolve(name)) for name in ((named,) if isinstance(named, str) else named))

    @property
    def linked_sources(self) -> tuple[str, ...]:
        """``sources``, and all that these lead to: parts of virtual rasters, materials and textures of models, addresses."""
        return tuple(dict.fromkeys(each for source in self.sources for each in (source, *linked_files(source))))

    def resolve(self, source: str) -> str:
        """A path of the level file, relative to the file, as one relative to nothing; GDAL's own paths stay as they are."""
        if "://" in source or source.startswith("/"):
            return source
        return str((self.path.parent / source).resolve())


def expand_override(
    value: str | dict[str, Any], lights: tuple[str, ...] = (SUN,), names: Sequence[str] = ALGORITHM_NAMES
) -> AlgorithmOverride:
    """Spell out an override: a name, ``{kind: name}`` or ``{light: name}`` or ``{light: {kind: name}}``.

    A name alone is for every one of the ``lights``; kinds without a light are the sun's. ``auto`` gives an empty choice.
    Raises ``PydanticCustomError`` with what is allowed.
    """
    kinds, words = get_args(CasterKind), (*names, "auto")

    def name_of(item: Any) -> str:
        if item not in words:
            raise PydanticCustomError("algorithm", "one of {names}", {"names": ", ".join(words)})
        return item

    choice: dict[str, dict[Any, Any]] = {}  # what gets in is one of the words
    if not isinstance(value, dict):
        value = {light: value for light in lights}
    for key, item in value.items():
        if key in kinds:
            choice.setdefault(SUN, {})[key] = name_of(item)
        elif key in lights:
            per_kind = item if isinstance(item, dict) else {kind: item for kind in kinds}
            for kind, name in per_kind.items():
                if kind not in kinds:
                    raise PydanticCustomError("algorithm", "caster kinds: {kinds}", {"kinds": ", ".join(kinds)})
                choice.setdefault(key, {})[kind] = name_of(name)
        else:
            raise PydanticCustomError(
                "algorithm",
                "keys that are a light ({lights}) or a caster kind ({kinds})",
                {"lights": ", ".join(lights), "kinds": ", ".join(kinds)},
            )
    named = {light: {k: n for k, n in kinds_.items() if n != "auto"} for light, kinds_ in choice.items()}
    return {light: kinds_ for light, kinds_ in named.items() if kinds_}


def lights_named(value: Any) -> tuple[str, ...]:
    """The keys of an override that can only be lights."""
    keys = value if isinstance(value, dict) else ()
    return (SUN, *(key for key in keys if isinstance(key, str) and key not in (SUN, *get_args(CasterKind))))


def parse_algorithm(text: str, parameter: str = "algorithm", names: Sequence[str] = ALGORITHM_NAMES) -> str | dict[str, Any]:
    """Read ``shadow_map`` or ``relief=sweep,forest=shadow_map,lamp=shadow_map``, of these ``names``; raises ``InputError``.

    Whether a level has the lights named is for ``expand_override`` to say.
    """
    text = text.strip()
    value: str | dict[str, Any] = text
    if "=" in text:
        value = {}
        for part in text.split(","):
            key, _, name = part.partition("=")
            value[key.strip()] = name.strip()
    try:
        expand_override(value, lights_named(value), names)
    except PydanticCustomError as error:
        raise InputError(parameter, text, error.message()) from None
    return value


def spelt(algorithm: str | dict[str, Any]) -> str:
    """An override as ``parse_algorithm`` reads it."""
    if isinstance(algorithm, str):
        return algorithm
    flat: dict[str, Any] = {}
    for key, value in algorithm.items():
        flat |= value if isinstance(value, dict) else {key: value}
    return ",".join(f"{key}={value}" for key, value in flat.items())


def override(shadows: Shadows, changes: dict[str, Any]) -> Shadows:
    """What is asked of the shadows with a request's changes (``None`` changes nothing). Raises ``InputError``."""
    changes = {key: value for key, value in changes.items() if value is not None}
    try:
        return Shadows.model_validate({**shadows.model_dump(include=set(Shadows.model_fields)), **changes})
    except ValidationError as error:
        details = error.errors()
        if details[0]["type"] == UNKNOWN_KEY:
            raise InputError(details[0]["ctx"]["key"], Problem("unknown"), details[0]["ctx"]["known"]) from None
        name = str(details[0]["loc"][0]) if details[0]["loc"] else "shadows"
        messages = (detail["msg"].removeprefix("Input should be ") for detail in details if detail["loc"][:1] == (name,))
        allowed = " or ".join(dict.fromkeys(messages))
        raise InputError(name, changes.get(name), allowed) from None


def parse_sun(time: str | None, azimuth: float | None, altitude: float | None) -> SunSpec | None:
    """A sun from query or command-line parameters; ``None`` where none is given. Raises ``InputError``.

    A ``+`` of an offset that arrived as a space is understood.
    """
    if time is None and azimuth is None and altitude is None:
        return None
    if time is not None:
        written = time.strip()
        head, space, tail = written.rpartition(" ")
        if space and "T" in head:
            written = f"{head}+{tail}"
        try:
            moment = time_of(written)
        except ValueError:
            raise InputError("time", time, TIME_WORDS) from None
        fields: dict[str, Any] = {"time": moment, "azimuth": azimuth, "altitude": altitude}
    else:
        fields = {"azimuth": azimuth, "altitude": altitude}
    try:
        return SunSpec(**fields)
    except ValidationError as error:
        detail = error.errors()[0]
        parameters = {
            key: value for key, value in (("time", time), ("azimuth", azimuth), ("altitude", altitude)) if value is not None
        }
        name = ".".join(str(part) for part in detail["loc"]) or ("time" if time else "azimuth, altitude")
        both = ", ".join(f"{key}={value}" for key, value in parameters.items())
        value = parameters[name] if name in parameters and (len(parameters) == 1 or name != "time") else both
        raise InputError(name, value, detail["msg"].removeprefix("Input should be ")) from None


TEXT_SUFFIXES = (*LEVEL_SUFFIXES, ".json", ".txt", "")
"""Of files whose text is looked at closely: of another, what is wrong with it as YAML means nothing."""

_NEITHER = "neither a level file nor a raster that GDAL reads"
_EITHER = "a raster of heights, or a YAML file that starts with 'version: 1'"


def load_level(source: Path | str | LevelSource) -> LoadedLevel:
    """Read and check a level file, or make the level that a raster is by itself, with what its options say stands on it.

    Raises ``LevelError``, also for what lies in none of the source's ``roots``, and ``InputError`` for options that are not for a
    level file.
    """
    source = LevelSource.of(source)
    loaded = _loaded(source)
    if source.name is not None:
        loaded = loaded.model_copy(update={"name": source.name})
    if source.roots is not None:
        DataRoots(source.roots).check_level(loaded)
    return loaded


def _loaded(source: LevelSource) -> LoadedLevel:
    path = source.path
    if source.roots is not None:
        DataRoots(source.roots).check_path(path, str(path))
    if is_level_raster(path):
        for file in ("canopy", "buildings"):
            if (value := getattr(source, file)) is not None and not value.is_file():
                raise InputError(file, str(value), "a file that is there")
        level = Level.model_validate(source.level_keys)
        return LoadedLevel(name=printable(path.stem), path=path.resolve(), level=level, digest=source.digest)
    for name in source.options:
        raise InputError(
            name,
            str(getattr(source, name)),
            f"a raster's own level; the level file {path} says it itself, as {KEYS_OF_OPTIONS[name]}",
        )
    if (kind := special_kind(path)) is not None:
        raise LevelError(str(path), Problem(kind), "a readable YAML file, or a raster that GDAL reads")
    try:
        with path.open(encoding="utf-8") as level_file:
            text = level_file.read(MOST_CHARACTERS + 1)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not UTF-8 text"
        raise LevelError(str(path), reason, "a readable YAML file, or a raster that GDAL reads") from None
    if len(text) > MOST_CHARACTERS:
        raise LevelError(
            str(path), Problem(f"more than {MOST_CHARACTERS} characters"), "a readable YAML file, or a raster that GDAL reads"
        )
    try:
        data = parse_level_text(text)
    except (ValueError, RecursionError, YAMLError) as error:  # also of a date that is none, brackets without end
        if path.suffix.lower() not in TEXT_SUFFIXES:
            raise LevelError(str(path), Problem(_NEITHER), _EITHER) from None
        if not isinstance(error, YAMLError):
            raise LevelError(str(path), str(error), "well-formed YAML 1.2") from None
        mark = getattr(error, "problem_mark", None)
        where = f"{path}: line {mark.line + 1}" if mark else str(path)
        raise LevelError(where, getattr(error, "problem", None) or "broken YAML", "well-formed YAML 1.2") from None
    if not isinstance(data, dict):
        if path.suffix.lower() not in TEXT_SUFFIXES:
            raise LevelError(str(path), Problem(_NEITHER), _EITHER)
        raise LevelError(str(path), data, "a mapping that starts with 'version: 1'")
    try:
        level = Level.model_validate(data)
    except ValidationError as error:
        raise level_error(str(path), data, error.errors()) from None
    # Without the archives: tiles that were drawn ahead are those of the level before it named them.
    digest = hashlib.sha256(repr({key: value for key, value in data.items() if key != "archive"}).encode()).hexdigest()[:16]
    return LoadedLevel(name=printable(path.stem), path=path.resolve(), level=level, digest=digest)
