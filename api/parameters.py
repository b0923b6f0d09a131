"""Query parameters: what a request may ask of a picture, checked before anything is done for it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal
from urllib.parse import urlencode

from fastapi import Query, Request
from pydantic import BeforeValidator

from api.jobs import Overrides
from api.layers import PictureLayer
from api.served import SERVED_ALGORITHMS, names_in
from shadows.plan import Culling, MapBias
from terrain.errors import InputError
from terrain.level import SunSpec, parse_sun
from terrain.scene import MAX_PERSPECTIVE_PX

PICTURE_PARAMETERS = (
    "time", "azimuth", "altitude", "algorithm", "map_size", "depth_bits", "filter", "bias", "culling",
    "stencil", "counting", "mask",
)  # fmt: skip
"""What may be asked of any picture or plan."""


@dataclass(frozen=True)
class Wishes:
    """What a request asks of the sun (``None``: the level's own) and of the shadows."""

    sun: SunSpec | None
    overrides: Overrides

    def query(self, **more: str) -> str:
        """The same wishes as a query string, with others before them; empty where nothing is asked."""
        sun = {} if self.sun is None else self.sun.model_dump(mode="json", exclude_none=True)
        return urlencode({**more, **sun, **self.overrides.model_dump(exclude_none=True)})


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


async def wishes(
    time: Annotated[
        str | None, Query(description="ISO 8601 with an offset, as 2024-10-21T16:30:00-04:00; default: the level's.")
    ] = None,
    azimuth: Annotated[
        float | None, Query(description="With `altitude`, instead of `time`: degrees clockwise from true north.")
    ] = None,
    altitude: Annotated[float | None, Query(description="Apparent degrees above the horizon.")] = None,
    algorithm: Annotated[
        str | None, Query(max_length=200, description="`auto`, a name, or `relief=NAME,forest=NAME,LIGHT=NAME`.")
    ] = None,
    map_size: Annotated[int | None, Query(ge=64, le=8192, description="Shadow-map texels a side.")] = None,
    depth_bits: Annotated[Literal[16, 24, 32] | None, BeforeValidator(_whole), Query()] = None,
    filter: Annotated[
        Literal[1, 2, 3, 5, "sun"] | None,
        BeforeValidator(_whole),
        Query(description="Shadow-map taps a side, or `sun` for the penumbra of the sun's disc."),
    ] = None,
    bias: Annotated[MapBias | None, Query(description="What keeps a surface from shading itself in a shadow map.")] = None,
    culling: Annotated[Culling | None, Query(description="Faces of closed bodies that are left out of a shadow map.")] = None,
    stencil: Annotated[
        Literal["one_pass", "two_pass"] | None, Query(description="Whether both sides of shadow volumes are drawn at once.")
    ] = None,
    counting: Annotated[
        Literal["auto", "z_fail"] | None,
        Query(description="Faces of shadow volumes that count: what each caster needs, or those behind the point for all."),
    ] = None,
    mask: Annotated[
        Literal["conservative", "original"] | None, Query(description="How a hybrid finds the pixels that it leaves to volumes.")
    ] = None,
) -> Wishes:
    """The dependency for pictures and plans. Raises ``InputError``."""
    overrides = Overrides(
        algorithm=algorithm, map_size=map_size, depth_bits=depth_bits, filter=filter, bias=bias, culling=culling,
        stencil=stencil, counting=counting, mask=mask,
    )  # fmt: skip
    names = names_in(overrides.for_selector()["algorithm"])
    if not names <= set(SERVED_ALGORITHMS):
        raise InputError("algorithm", algorithm, ", ".join(["auto", *SERVED_ALGORITHMS]))
    return Wishes(parse_sun(time, azimuth, altitude), overrides)


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
