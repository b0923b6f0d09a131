"""Level files: what a scene is made of, as an immutable, validated value.

A level is YAML 1.2 (so `on` and `off` are words, not booleans). Every error names the file, the key's path, the value
and what is allowed.
"""

from __future__ import annotations

import hashlib
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from terrain.errors import InputError, LevelError

AlgorithmName = Literal["shadow_map", "truth", "none"]
"""Shadow algorithms a level may name; a test holds this equal to ``shadows.registry``."""

EffectName = Literal["cast_shadows"]
"""Effects a level may name; a test holds this equal to ``terrain.effects``."""

CasterKind = Literal["relief"]
"""What can cast: ``relief`` is the heightfield."""

LightName = Literal["sun"]

Choice = dict[LightName, dict[CasterKind, AlgorithmName]]
"""An override of the algorithm: light -> caster kind -> name; whatever it leaves out is chosen by the selector."""

Units = Literal["m", "ft", "us-ft"]
METRES_PER_UNIT: dict[str, float] = {"m": 1.0, "ft": 0.3048, "us-ft": 1200.0 / 3937.0}


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _name_unknown_keys(cls, data: Any) -> Any:
        if isinstance(data, dict):
            for key in data:
                if key not in cls.model_fields:
                    raise PydanticCustomError("unknown_key", "unknown key", {"key": str(key), "known": ", ".join(cls.model_fields)})
        return data


class Terrain(_Model):
    """The ground: a raster of heights.

    ``bounds`` (west, south, east, north, degrees) says which part is looked at: it places the anchor and the default
    view; ground beyond it still casts. ``resolution`` is in metres, ``exaggeration`` multiplies heights.
    """

    source: str = Field(min_length=1)
    bounds: tuple[float, float, float, float] | None = None
    resolution: float | None = Field(default=None, gt=0)
    units: Units | None = None
    exaggeration: float = Field(default=1.0, gt=0, le=100)

    @field_validator("bounds")
    @classmethod
    def _ordered(cls, value: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
        if value is not None:
            west, south, east, north = value
            if not (-180 <= west < east <= 540 and -90 <= south < north <= 90):
                raise PydanticCustomError("bounds", "west < east and -90 <= south < north <= 90, in degrees")
        return value


class SunSpec(_Model):
    """Where the sun is: an ISO 8601 ``time`` with an offset, or apparent ``azimuth`` and ``altitude`` at the anchor.

    ``azimuth`` is in degrees clockwise from true north (from grid north in a flat world), ``altitude`` in degrees above
    the horizon.
    """

    time: datetime | None = None
    azimuth: float | None = Field(default=None, ge=-360, le=720)
    altitude: float | None = Field(default=None, ge=-90, le=90)

    @model_validator(mode="after")
    def _one_way(self) -> SunSpec:
        angles = (self.azimuth is not None) + (self.altitude is not None)
        if (self.time is None) == (angles == 0) or angles == 1:
            raise PydanticCustomError("sun", "either time, or azimuth and altitude")
        if self.time is not None and self.time.tzinfo is None:
            raise PydanticCustomError("sun", "an ISO 8601 time with an offset, as 2024-10-21T16:30:00-04:00")
        return self


class MapSpec(_Model):
    """A map view: orthographic, straight down. ``bounds`` are in ``crs``; what is left out follows from the level."""

    kind: Literal["map"]
    bounds: tuple[float, float, float, float] | None = None
    crs: str | None = None
    size: tuple[Annotated[int, Field(ge=1, le=16384)], Annotated[int, Field(ge=1, le=16384)]] | None = None


class Shadows(_Model):
    """What is asked of the shadows; ``auto`` leaves a choice to the selector."""

    algorithm: Literal["auto"] | AlgorithmName | dict[str, Any] = "auto"
    max_error: float = Field(default=0.03, gt=0, le=1)
    max_ms: float | None = Field(default=None, gt=0)
    map_size: Literal["auto"] | Annotated[int, Field(ge=64, le=8192)] = "auto"
    depth_bits: Literal["auto", 16, 24, 32] = "auto"
    filter: Literal["auto", 1, 2, 3, 5] = "auto"

    @field_validator("algorithm")
    @classmethod
    def _known(cls, value: Any) -> Any:
        algorithm_choice(value)
        return value


class Level(_Model):
    """A whole level file."""

    version: Literal[1]
    title: str = ""
    attribution: str = ""
    terrain: Terrain
    sun: SunSpec | Literal["none"] = SunSpec(azimuth=315, altitude=45)
    views: dict[str, MapSpec] = {"map": MapSpec(kind="map")}
    shadows: Shadows = Shadows()
    effects: Literal["auto"] | dict[EffectName, Literal["auto", "on", "off"]] = "auto"


class LoadedLevel(BaseModel):
    """A level with its name and the place it came from; ``digest`` changes with its text."""

    model_config = ConfigDict(frozen=True)

    name: str
    path: Path
    level: Level
    digest: str

    @property
    def source(self) -> str:
        """The raster's path, relative to nothing; a bundled data set's name stays as it is."""
        from terrain.bundled import BUNDLED

        source = self.level.terrain.source
        if source in BUNDLED or "://" in source or source.startswith("/"):
            return source
        return str((self.path.parent / source).resolve())


def algorithm_choice(value: str | dict[str, Any]) -> Choice:
    """Spell out an override: a name, ``{kind: name}`` or ``{light: name}`` or ``{light: {kind: name}}``.

    ``auto`` gives an empty choice. Raises ``PydanticCustomError`` with what is allowed.
    """
    kinds, lights, names = get_args(CasterKind), get_args(LightName), (*get_args(AlgorithmName), "auto")

    def name_of(item: Any) -> str:
        if item not in names:
            raise PydanticCustomError("algorithm", "one of {names}", {"names": ", ".join(names)})
        return item

    choice: dict[str, dict[str, str]] = {}
    if not isinstance(value, dict):
        value = {"sun": value}
    for key, item in value.items():
        if key in kinds:
            choice.setdefault("sun", {})[key] = name_of(item)
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
    automatic = {light: {k: n for k, n in kinds_.items() if n != "auto"} for light, kinds_ in choice.items()}
    return {light: kinds_ for light, kinds_ in automatic.items() if kinds_}  # type: ignore[misc]


def parse_algorithm(text: str, parameter: str = "algorithm") -> str | dict[str, Any]:
    """Read ``shadow_map`` or ``relief=sweep,forest=shadow_map,lamp=shadow_map``; raises ``InputError``."""
    text = text.strip()
    value: str | dict[str, Any] = text
    if "=" in text:
        value = {}
        for part in text.split(","):
            key, _, name = part.partition("=")
            value[key.strip()] = name.strip()
    try:
        algorithm_choice(value)
    except PydanticCustomError as error:
        raise InputError(parameter, text, error.message()) from None
    return value


def override(shadows: Shadows, changes: dict[str, Any]) -> Shadows:
    """What is asked of the shadows with a request's changes (``None`` changes nothing). Raises ``InputError``."""
    changes = {key: value for key, value in changes.items() if value is not None}
    try:
        return Shadows.model_validate({**shadows.model_dump(), **changes})
    except ValidationError as error:
        details = error.errors()
        name = str(details[0]["loc"][0]) if details[0]["loc"] else "shadows"
        said = (detail["msg"].removeprefix("Input should be ") for detail in details if detail["loc"][:1] == (name,))
        allowed = " or ".join(dict.fromkeys(said))
        raise InputError(name, changes.get(name), allowed) from None


def parse_sun(time: str | None, azimuth: float | None, altitude: float | None) -> SunSpec | None:
    """A sun from query or command-line parameters; ``None`` where none is given. Raises ``InputError``.

    A ``+`` of an offset that arrived as a space is understood.
    """
    if time is None and azimuth is None and altitude is None:
        return None
    if time is not None:
        given = time.strip()
        head, space, tail = given.rpartition(" ")
        if space and "T" in head:
            given = f"{head}+{tail}"
        try:
            moment = datetime.fromisoformat(given)
        except ValueError:
            raise InputError("time", time, "an ISO 8601 time with an offset, as 2024-10-21T16:30:00-04:00") from None
        fields: dict[str, Any] = {"time": moment, "azimuth": azimuth, "altitude": altitude}
    else:
        fields = {"azimuth": azimuth, "altitude": altitude}
    try:
        return SunSpec(**fields)
    except ValidationError as error:
        detail = error.errors()[0]
        given = {key: value for key, value in (("time", time), ("azimuth", azimuth), ("altitude", altitude)) if value is not None}
        name = ".".join(str(part) for part in detail["loc"]) or ("time" if time else "azimuth, altitude")
        both = ", ".join(f"{key}={value}" for key, value in given.items())
        value = given[name] if name in given and (len(given) == 1 or name != "time") else both
        raise InputError(name, value, detail["msg"].removeprefix("Input should be ")) from None


def load_level(path: Path | str) -> LoadedLevel:
    """Read and check a level file. Raises ``LevelError``."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not UTF-8 text"
        raise LevelError(str(path), reason, "a readable YAML file") from None
    try:
        data = YAML(typ="safe", pure=True).load(text)
    except (ValueError, RecursionError) as error:  # a date that is none, brackets without end
        raise LevelError(str(path), str(error), "well-formed YAML 1.2") from None
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path}: line {mark.line + 1}" if mark else str(path)
        raise LevelError(where, getattr(error, "problem", None) or "broken YAML", "well-formed YAML 1.2") from None
    if not isinstance(data, dict):
        raise LevelError(str(path), data, "a mapping that starts with 'version: 1'")
    try:
        level = Level.model_validate(data)
    except ValidationError as error:
        raise _level_error(str(path), data, error.errors()) from None
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    return LoadedLevel(name=path.stem, path=path.resolve(), level=level, digest=digest)


def _level_error(path: str, data: Any, errors: list[ErrorDetails]) -> LevelError:
    """One message of pydantic's many (a union gives one per branch): the one that leads deepest into the file."""
    for error in errors:
        if error["type"] == "unknown_key":
            context = error["ctx"]
            where = ".".join([*_keys(data, error["loc"]), context["key"]])
            return LevelError(f"{path}: {where}", "unknown key", context["known"])
    paths = [_keys(data, error["loc"]) for error in errors]
    deepest = max(paths, key=len)
    here = [error for error, keys in zip(errors, paths, strict=True) if keys == deepest]
    value = "nothing" if here[0]["type"] == "missing" else here[0]["input"]
    allowed = " or ".join(dict.fromkeys(error["msg"][:1].lower() + error["msg"][1:] for error in here))
    return LevelError(f"{path}: {'.'.join(deepest)}", value, allowed.replace("input should be ", ""))


def _keys(data: Any, location: tuple[int | str, ...]) -> list[str]:
    """The keys of a file on the way to an error: pydantic's location without the names of its own union branches."""
    keys: list[str] = []
    for number, part in enumerate(location):
        inside = isinstance(data, dict) and part in data
        if inside or (isinstance(data, list | tuple) and isinstance(part, int) and part < len(data)):
            keys.append(str(part))
            data = data[part]
        elif isinstance(data, dict) and number == len(location) - 1 and part != "[key]" and "[" not in str(part):
            keys.append(str(part))  # a key that is missing
    return keys
