"""Query parameters: what a request may ask of a picture, checked before anything is done for it."""

from __future__ import annotations

import datetime
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from inspect import signature
from typing import Annotated, Any, cast, get_args

from fastapi import Depends, Query, Request
from pydantic import BeforeValidator

from skugga.api.http.moments import PLAIN_DATE, asked_sun
from skugga.api.http.numbers import PLAIN_DECIMAL, PLAIN_WHOLE, WHOLE_OR_WORD
from skugga.api.http.state.service import service_of
from skugga.api.layers import BETWEEN_LAYERS, LAYERS, MAP_LAYERS, PICTURE_LAYERS, ViewLayer
from skugga.api.shadow_parameters import takes_settings
from skugga.api.sun_hours_layer import SUN_HOURS_LAYER, SunHoursQuery, SunQuantity
from skugga.api.workers.jobs import PictureRequest, RequestedSettings, ServedPolicy
from skugga.terrain.errors import MISSING_VALUE, Fault, InputError
from skugga.terrain.level.algorithm_names import served_algorithms
from skugga.terrain.level.level import parse_algorithm
from skugga.terrain.level.parts import StyleName, SunSpec
from skugga.terrain.level.setting import Setting
from skugga.terrain.scene import MAX_PERSPECTIVE_PX
from skugga.terrain.style import STYLES


@dataclass(frozen=True)
class PlanQuery:
    """By which policy a plan is made, and what a request asks of the shadows."""

    policy: ServedPolicy
    overrides: RequestedSettings


def allow_only(*names: str) -> Callable[[Request], Awaitable[None]]:
    """A dependency that refuses query parameters other than these, and repeated ones. Raises ``InputError``."""

    async def refuse(request: Request) -> None:
        items = request.query_params.multi_items()
        for name, value in items:
            if name not in names:
                fault = Fault(f"unknown parameter (given: '{value[:80]}')")
                raise InputError(name, fault, ", ".join(names) or "no parameters")
            if sum(name == other for other, _ in items) > 1:
                raise InputError(name, Fault("given more than once"), "one value")

    return refuse


TimeQuery = Annotated[
    str | None,
    Query(
        description="ISO 8601 with an offset, as 2024-10-21T16:30:00-04:00, or `current`; default: the level's. It is rounded "
        "to the minute (a setting); `X-Skugga-Time` says to which.",
        examples=["2024-10-21T16:30:00-04:00"],
    ),
]
AzimuthQuery = Annotated[
    float | None,
    PLAIN_DECIMAL,
    Query(description="With `altitude`, instead of `time`: degrees clockwise from true north.", examples=[235]),
]
AltitudeQuery = Annotated[float | None, PLAIN_DECIMAL, Query(description="Apparent degrees above the horizon.", examples=[22])]

OWN_STYLE = "default"
"""The name of a level's own style where map clients want one."""

StyleQuery = Annotated[
    str | None,
    Query(
        description="How relief is shaded: "
        + "; ".join(f"`{style.name}`: {style.about}" for style in STYLES.values())
        + f". `{OWN_STYLE}`, or nothing: the level's own.",
        json_schema_extra={"enum": [OWN_STYLE, *STYLES]},
        examples=["swiss"],
    ),
]
SlopeExaggerationQuery = Annotated[
    float | None,
    PLAIN_DECIMAL,
    Query(
        ge=0.1, le=20.0, allow_inf_nan=False, examples=[2],
        description="Factor of slopes in shading, for flat country; cast shadows stay those of the true ground.",
    ),
]  # fmt: skip


def style_named(name: str | None, parameter: str = "style") -> StyleName | None:
    """A style by its name in a request; ``None``: the level's own. Raises ``InputError``."""
    if name is None or name == OWN_STYLE:
        return None
    if name not in STYLES:
        raise InputError(parameter, name, ", ".join((OWN_STYLE, *STYLES)))
    return cast(StyleName, name)


_NUMBERS: dict[type, tuple[BeforeValidator, ...]] = {int: (PLAIN_WHOLE,), float: (PLAIN_DECIMAL,)}


def _parameter(setting: Setting) -> Any:
    """A setting of shadows as a query parameter."""
    is_number = any(isinstance(word, int) for word in setting.words)
    numbers = (WHOLE_OR_WORD,) if is_number else _NUMBERS.get(setting.plain_type, ())
    asked: Any = setting.type
    return Annotated[(asked | None, *numbers, Query(description=setting.about, examples=[setting.example]))]


@takes_settings("pictures", _parameter)
async def picture_query(
    request: Request,
    time: TimeQuery = None,
    azimuth: AzimuthQuery = None,
    altitude: AltitudeQuery = None,
    style: StyleQuery = None,
    slope_exaggeration: SlopeExaggerationQuery = None,
    **asked: Any,
) -> PictureRequest:
    """The dependency for pictures. Raises ``InputError``."""
    sun = asked_sun(request, time, azimuth, altitude, service_of(request).settings.time_grain_s)
    return PictureRequest(
        sun=sun, style=style_named(style), slope_exaggeration=slope_exaggeration, overrides=served_settings(asked)
    )  # fmt: skip


async def sun_query(
    request: Request, time: TimeQuery = None, azimuth: AzimuthQuery = None, altitude: AltitudeQuery = None
) -> SunSpec | None:
    """The dependency for a sun alone; ``None``: the level's own. Raises ``InputError``."""
    return asked_sun(request, time, azimuth, altitude, service_of(request).settings.time_grain_s)


@takes_settings("plans", _parameter)
async def plan_query(
    policy: Annotated[
        str,
        Query(
            description="`rules`: fixed rules; `predict`: cost and error models, calibrated for the service's device.",
            json_schema_extra={"enum": ["predict", "rules"]},
            examples=["rules"],
        ),
    ] = "predict",
    **asked: Any,
) -> PlanQuery:
    """The dependency for plans. Raises ``InputError``."""
    if policy in ("probe", "measure"):
        raise InputError(
            "policy", policy, f"rules, predict; {policy} takes too long for a request: skugga select --policy {policy}"
        )
    if policy not in get_args(ServedPolicy):
        raise InputError("policy", policy, ", ".join(get_args(ServedPolicy)))
    return PlanQuery(cast(ServedPolicy, policy), served_settings(asked))


def served_settings(asked: dict[str, Any]) -> RequestedSettings:
    """Overrides that ask for nothing that is not served. Raises ``InputError``."""
    if asked.get("algorithm") is not None:
        parse_algorithm(asked["algorithm"], names=served_algorithms())
    return RequestedSettings.of(asked)


SUN_PARAMETERS = tuple(name for name in signature(sun_query).parameters if name != "request")
PICTURE_PARAMETERS = tuple(name for name in signature(picture_query).parameters if name != "request")
"""What may be asked of any picture."""

PLAN_PARAMETERS = tuple(signature(plan_query).parameters)
"""What may be asked of any plan besides the sun."""


def parse_size(text: str) -> tuple[int, int]:
    """(width, height) of ``WxH``. Raises ``InputError``."""
    width, _, height = text.partition("x")
    if not all(part.isascii() and part.isdigit() and 1 <= int(part) <= MAX_PERSPECTIVE_PX for part in (width, height)):
        raise InputError("size", text, f"WxH in pixels, as 1280x1024, at most {MAX_PERSPECTIVE_PX} a side")
    return int(width), int(height)


def check_pixels(size: tuple[int, int], max_pixels: int) -> None:
    """Raise ``InputError`` where a picture has more pixels than the settings allow."""
    if size[0] * size[1] > max_pixels:
        allowed = f"at most {max_pixels} pixels in all (the service's SKUGGA_MAX_SNAPSHOT_PIXELS)"
        raise InputError("size", f"{size[0]}x{size[1]}", allowed)


@dataclass(frozen=True)
class TileQuery:
    """What is asked of tiles: a layer of a picture, or, with ``sun_hours``, hours of sun."""

    layer: str
    picture: PictureRequest
    sun_hours: SunHoursQuery | None = None

    def query(self) -> str:
        """The same as a query string; empty where nothing is asked."""
        if self.sun_hours is not None:
            return f"layer={self.layer}&{self.sun_hours.query()}"
        return self.picture.query(**({} if self.layer == "color" else {"layer": self.layer}))

    def picture_query(self) -> str:
        """What is asked besides the layer, as a query string; of heights nothing, for they hang on no light."""
        if self.sun_hours is not None:
            return self.sun_hours.query()
        return self.picture.query() if LAYERS[self.layer].encoding is None else ""


def _layers_in_words(names: Iterable[str]) -> str:
    return "; ".join(f"`{name}` is {LAYERS[name].about}" for name in names)


LayerQuery = Annotated[
    ViewLayer,
    Query(
        description=f"{_layers_in_words(PICTURE_LAYERS)}. What passes leave behind, as PNG, where the plan's algorithms have it: "
        f"{_layers_in_words(BETWEEN_LAYERS)}.",
        examples=["mask"],
    ),
]

TILE_LAYERS = (*MAP_LAYERS, SUN_HOURS_LAYER)
"""Layers of tiles and maps."""

TileLayerQuery = Annotated[
    str,
    Query(
        description=f"{_layers_in_words(MAP_LAYERS)}; `{SUN_HOURS_LAYER}` is how long the sun is seen on a `date`.",
        json_schema_extra={"enum": [*TILE_LAYERS]},
        examples=["shadow"],
    ),
]


SunDateQuery = Annotated[
    datetime.date | None,
    PLAIN_DATE,
    Query(description=f"For `{SUN_HOURS_LAYER}`: the date, as 2024-03-21.", examples=["2024-03-21"]),
]
QuantityQuery = Annotated[SunQuantity | None, Query(description=f"For `{SUN_HOURS_LAYER}`; default: `hours`.", examples=["first"])]
WindowQuery = Annotated[
    str | None, Query(max_length=20, description="Part of the date that counts, as 08:00-16:00.", examples=["08:00-16:00"])
]
SunClockQuery = Annotated[
    str | None,
    Query(
        max_length=60,
        description="By which date and window go: solar (the default), utc, +02:00 or Europe/Oslo.",
        examples=["Europe/Oslo"],
    ),
]
LeastAltitudeQuery = Annotated[
    float | None,
    PLAIN_DECIMAL,
    Query(ge=-1.0, lt=90.0, allow_inf_nan=False, description="Of a sun that counts, degrees.", examples=[3]),
]


async def map_query(
    request: Request,
    picture: Annotated[PictureRequest, Depends(picture_query)],
    layer: TileLayerQuery = "color",
    date: SunDateQuery = None,
    quantity: QuantityQuery = None,
    window: WindowQuery = None,
    clock: SunClockQuery = None,
    least_altitude: LeastAltitudeQuery = None,
) -> TileQuery:
    """The dependency for maps, whose ``height`` is in pixels. Raises ``InputError``."""
    return await tile_query(request, picture, layer, date, quantity, window, clock, None, least_altitude)


async def tile_query(
    request: Request,
    picture: Annotated[PictureRequest, Depends(picture_query)],
    layer: TileLayerQuery = "color",
    date: SunDateQuery = None,
    quantity: QuantityQuery = None,
    window: WindowQuery = None,
    clock: SunClockQuery = None,
    height: Annotated[
        float | None,
        PLAIN_DECIMAL,
        Query(ge=0.0, le=1000.0, allow_inf_nan=False, description="Metres above the ground.", examples=[1.7]),
    ] = None,
    least_altitude: LeastAltitudeQuery = None,
) -> TileQuery:
    """The dependency for tiles. Raises ``InputError``."""
    asked = {
        "date": date, "quantity": quantity, "window": window, "clock": clock, "height": height, "least_altitude": least_altitude,
    }  # fmt: skip
    given = {name: value for name, value in asked.items() if value is not None}
    if layer != SUN_HOURS_LAYER:
        if layer not in MAP_LAYERS:
            raise InputError("layer", layer, ", ".join(TILE_LAYERS))
        for name, value in given.items():
            raise InputError(name, str(value), f"nothing but beside layer={SUN_HOURS_LAYER}")
        return TileQuery(layer, picture.of_layer(layer))
    for name in PICTURE_PARAMETERS:
        if name in request.query_params:
            raise InputError(name, request.query_params[name], f"nothing beside layer={SUN_HOURS_LAYER}: it is of a whole date")
    if date is None:
        raise InputError("date", MISSING_VALUE, f"a date beside layer={SUN_HOURS_LAYER}, as 2024-03-21")
    return TileQuery(layer, picture, SunHoursQuery(**given))


SUN_HOURS_PARAMETERS = tuple(SunHoursQuery.model_fields)
TILE_PARAMETERS = ("layer", *PICTURE_PARAMETERS, *SUN_HOURS_PARAMETERS)
"""What may be asked of tiles."""

ViewQuery = Annotated[
    str | None, Query(max_length=100, description="A view of the level; default: `map`, else its first one.", examples=["map"])
]
