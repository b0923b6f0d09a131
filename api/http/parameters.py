"""Query parameters: what a request may ask of a picture, checked before anything is done for it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar, cast, get_args
from urllib.parse import urlencode

from fastapi import Query, Request
from pydantic import BeforeValidator

from api.http.served import SERVED_ALGORITHMS, names_in
from api.layers import PictureLayer
from api.workers.jobs import Overrides, PlanOverrides, ServedPolicy
from shadows.maps.settings import Culling, MapBias
from terrain.errors import InputError
from terrain.level.level import parse_sun
from terrain.level.parts import SunSpec
from terrain.scene import MAX_PERSPECTIVE_PX

SUN_PARAMETERS = ("time", "azimuth", "altitude")
SHADOW_PARAMETERS = ("algorithm", "map_size", "depth_bits", "filter", "bias", "culling", "stencil", "counting", "mask")
"""What may be asked of the shadows: keys of a level's ``shadows``."""

PICTURE_PARAMETERS = (*SUN_PARAMETERS, *SHADOW_PARAMETERS)
"""What may be asked of any picture."""

PLAN_PARAMETERS = ("policy", "max_error", "max_ms", "cascades", *SHADOW_PARAMETERS)
"""What may be asked of any plan besides the sun."""

OverridesT = TypeVar("OverridesT", bound=Overrides)


@dataclass(frozen=True)
class Wishes:
    """What a request asks of the sun (``None``: the level's own) and of the shadows."""

    sun: SunSpec | None
    overrides: Overrides

    def query(self, **more: str) -> str:
        """The same wishes as a query string, with others before them; empty where nothing is asked."""
        sun = {} if self.sun is None else self.sun.model_dump(mode="json", exclude_none=True)
        return urlencode({**more, **sun, **self.overrides.model_dump(exclude_none=True)})


@dataclass(frozen=True)
class PlanWishes:
    """By which policy a plan is made, and what a request asks of the shadows."""

    policy: ServedPolicy
    overrides: PlanOverrides


def only(*names: str) -> Callable[[Request], Awaitable[None]]:
    """A dependency that refuses query parameters other than these, and repeated ones. Raises ``InputError``."""

    async def refuse(request: Request) -> None:
        given = request.query_params.multi_items()
        for name, value in given:
            if name not in names:
                raise InputError(name, value, f"the parameters {', '.join(names)}" if names else "no parameters")
            if sum(name == other for other, _ in given) > 1:
                raise InputError(name, "given more than once", "one value")

    return refuse


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, str) and value.isascii() and value.isdigit() else value


Time = Annotated[str | None, Query(description="ISO 8601 with an offset, as 2024-10-21T16:30:00-04:00; default: the level's.")]
Azimuth = Annotated[float | None, Query(description="With `altitude`, instead of `time`: degrees clockwise from true north.")]
Altitude = Annotated[float | None, Query(description="Apparent degrees above the horizon.")]
Algorithm = Annotated[str | None, Query(max_length=200, description="`auto`, a name, or `relief=NAME,forest=NAME,LIGHT=NAME`.")]
MapSize = Annotated[int | None, Query(ge=64, le=8192, description="Shadow-map texels a side.")]
DepthBits = Annotated[Literal[16, 24, 32] | None, BeforeValidator(_whole), Query()]
Filter = Annotated[
    Literal[1, 2, 3, 5, "sun"] | None,
    BeforeValidator(_whole),
    Query(description="Shadow-map taps a side, or `sun` for the penumbra of the sun's disc."),
]
Bias = Annotated[MapBias | None, Query(description="What keeps a surface from shading itself in a shadow map.")]
CullingOf = Annotated[Culling | None, Query(description="Faces of closed bodies that are left out of a shadow map.")]
Stencil = Annotated[
    Literal["one_pass", "two_pass"] | None, Query(description="Whether both sides of shadow volumes are drawn at once.")
]
Counting = Annotated[
    Literal["auto", "z_fail"] | None,
    Query(description="Faces of shadow volumes that count: what each caster needs, or those behind the point for all."),
]
Mask = Annotated[
    Literal["conservative", "original"] | None, Query(description="How a hybrid finds the pixels that it leaves to volumes.")
]


async def wishes(
    time: Time = None,
    azimuth: Azimuth = None,
    altitude: Altitude = None,
    algorithm: Algorithm = None,
    map_size: MapSize = None,
    depth_bits: DepthBits = None,
    filter: Filter = None,
    bias: Bias = None,
    culling: CullingOf = None,
    stencil: Stencil = None,
    counting: Counting = None,
    mask: Mask = None,
) -> Wishes:
    """The dependency for pictures. Raises ``InputError``."""
    overrides = Overrides(
        algorithm=algorithm, map_size=map_size, depth_bits=depth_bits, filter=filter, bias=bias, culling=culling,
        stencil=stencil, counting=counting, mask=mask,
    )  # fmt: skip
    return Wishes(parse_sun(time, azimuth, altitude), _served(overrides))


async def sun_wished(time: Time = None, azimuth: Azimuth = None, altitude: Altitude = None) -> SunSpec | None:
    """The dependency for a sun alone; ``None``: the level's own. Raises ``InputError``."""
    return parse_sun(time, azimuth, altitude)


async def plan_wishes(
    policy: Annotated[
        str,
        Query(
            description="`rules`: by what is known beforehand; `predict`: by the calibration of the service's device.",
            json_schema_extra={"enum": ["predict", "rules"]},
        ),
    ] = "predict",
    max_error: Annotated[
        float | None, Query(ge=0, le=1, allow_inf_nan=False, description="Share of the cast shadow that may be wrong.")
    ] = None,
    max_ms: Annotated[
        float | None, Query(gt=0, allow_inf_nan=False, description="Milliseconds that shadows of a block may take.")
    ] = None,
    algorithm: Algorithm = None,
    map_size: MapSize = None,
    cascades: Annotated[Literal[1, 2, 3, 4] | None, BeforeValidator(_whole), Query(description="Shadow maps of a view.")] = None,
    depth_bits: DepthBits = None,
    filter: Filter = None,
    bias: Bias = None,
    culling: CullingOf = None,
    stencil: Stencil = None,
    counting: Counting = None,
    mask: Mask = None,
) -> PlanWishes:
    """The dependency for plans. Raises ``InputError``."""
    if policy == "measure":
        allowed = "rules, predict: to measure takes minutes, at design time (skugga select --policy measure)"
        raise InputError("policy", policy, allowed)
    if policy not in get_args(ServedPolicy):
        raise InputError("policy", policy, ", ".join(get_args(ServedPolicy)))
    overrides = PlanOverrides(
        max_error=max_error, max_ms=max_ms, algorithm=algorithm, map_size=map_size, cascades=cascades, depth_bits=depth_bits,
        filter=filter, bias=bias, culling=culling, stencil=stencil, counting=counting, mask=mask,
    )  # fmt: skip
    return PlanWishes(cast(ServedPolicy, policy), _served(overrides))


def _served(overrides: OverridesT) -> OverridesT:
    """Overrides that ask for nothing that is not served. Raises ``InputError``."""
    if not names_in(overrides.for_selector()["algorithm"]) <= set(SERVED_ALGORITHMS):
        raise InputError("algorithm", overrides.algorithm, ", ".join(["auto", *SERVED_ALGORITHMS]))
    return overrides


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


Layer = Annotated[
    PictureLayer,
    Query(
        description="`color` is shaded relief with cast shadows; `shadow` is black with the shadow as opacity; "
        "`mask` is gray: 0 shadow, 255 lit, 128 no surface."
    ),
]

View = Annotated[str | None, Query(max_length=100, description="A view of the level; default: `map`, else its first one.")]
