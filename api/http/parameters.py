"""Parse and check the query parameters of requests before any work starts."""

from __future__ import annotations

import datetime
from collections.abc import Awaitable, Callable, Iterable
from dataclasses import dataclass
from inspect import signature
from typing import Annotated, Any, cast, get_args

from annotated_types import MaxLen
from fastapi import Depends, Query, Request
from pydantic import BeforeValidator
from pydantic.fields import FieldInfo

from skugga.api.http.numbers import INTEGER_OR_WORD, PLAIN_DECIMAL, PLAIN_INTEGER
from skugga.api.http.request_times import PLAIN_DATE, request_sun
from skugga.api.http.state.service import service_of
from skugga.api.products import MAP_PRODUCTS, PRODUCTS, VIEW_PRODUCTS, product_named
from skugga.api.products.product import Product
from skugga.api.request import PictureRequest, ProductRequest, RequestedSettings
from skugga.api.signature_parameters import FunctionT, with_parameters, with_shadow_settings
from skugga.api.workers.jobs import ServedPolicy
from skugga.terrain.color_ramp import ALLOWED_RAMP_TEXTS, MAX_RAMP_CHARACTERS
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.algorithm_names import served_algorithms
from skugga.terrain.level.level import parse_algorithm
from skugga.terrain.level.parts import SkyName, StyleName, SunSpec
from skugga.terrain.level.setting import Setting
from skugga.terrain.scene import MAX_PERSPECTIVE_SIDE_PX
from skugga.terrain.style import STYLES


@dataclass(frozen=True)
class PlanQuery:
    """The query of a plan.

    Attributes
    ----------
    policy : ServedPolicy
        The policy that chooses the plan: fixed ``rules``, or ``predict`` (predicted costs and errors).
    overrides : RequestedSettings
        Shadow settings of the request, which replace the level's.
    """

    policy: ServedPolicy
    overrides: RequestedSettings


def allow_only_parameters(*names: str) -> Callable[[Request], Awaitable[None]]:
    """Return a FastAPI dependency that raises ``InputError`` for query parameters that are repeated or not in ``names``."""

    async def check_names(request: Request) -> None:
        items = request.query_params.multi_items()
        for name, value in items:
            if name not in names:
                fault = Problem(f"unknown parameter (value '{value[:80]}')")
                raise InputError(name, fault, f"Allowed parameters: {', '.join(names) or 'none'}")
            if sum(name == other for other, _ in items) > 1:
                raise InputError(name, Problem("given more than once"), "Give it once")

    return check_names


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

DEFAULT_STYLE = "default"
"""The value of ``style`` that means the level's own style, for map clients that require a name."""

StyleQuery = Annotated[
    str | None,
    Query(
        description="How relief is shaded: "
        + "; ".join(f"`{style.name}`: {style.description}" for style in STYLES.values())
        + f". `{DEFAULT_STYLE}`, or nothing: the level's own.",
        json_schema_extra={"enum": [DEFAULT_STYLE, *STYLES]},
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

SkyQuery = Annotated[
    SkyName | None,
    Query(
        description="The sky that lights the ground of maps: `even`; or `clear` or `overcast`, a CIE sky with shadows. "
        "Nothing: the style's own.",
        examples=["clear"],
    ),
]

RampQuery = Annotated[
    str | None,
    Query(
        max_length=MAX_RAMP_CHARACTERS,
        description="Colours of the ground by its height above the level's zero, in place of the style's: "
        f"{ALLOWED_RAMP_TEXTS}. Colours between two heights are mixed.",
        examples=["0:a9be98,1500:d9d2ae,4000:f4f4f4"],
    ),
]

LocalLightQuery = Annotated[
    float | None,
    PLAIN_DECIMAL,
    Query(
        ge=0.0, le=45.0, allow_inf_nan=False, examples=[30],
        description="Largest turn in degrees of the light that shades relief along it, in maps; shadows stay those of the sun.",
    ),
]  # fmt: skip
GeneralisationQuery = Annotated[
    float | None,
    PLAIN_DECIMAL,
    Query(
        ge=0.0, le=1.0, allow_inf_nan=False, examples=[0.6],
        description="Share of large landforms in the slopes of maps of small scale; shadows stay those of the true ground.",
    ),
]  # fmt: skip


def style_named(name: str | None, parameter_name: str = "style") -> StyleName | None:
    """Return the style of a request; ``None`` means the level's own. Raises ``InputError`` for an unknown name."""
    if name is None or name == DEFAULT_STYLE:
        return None
    if name not in STYLES:
        raise InputError(parameter_name, name, ", ".join((DEFAULT_STYLE, *STYLES)))
    return cast(StyleName, name)


_NUMBER_VALIDATORS: dict[type, tuple[BeforeValidator, ...]] = {int: (PLAIN_INTEGER,), float: (PLAIN_DECIMAL,)}


def _shadow_parameter(setting: Setting) -> Any:
    """Return the type annotation of the query parameter for a shadow setting."""
    is_number = any(isinstance(word, int) for word in setting.literal_values)
    numbers = (INTEGER_OR_WORD,) if is_number else _NUMBER_VALIDATORS.get(setting.command_line_type, ())
    value_type: Any = setting.type
    return Annotated[(value_type | None, *numbers, Query(description=setting.description, examples=[setting.example]))]


@with_shadow_settings("pictures", _shadow_parameter)
async def picture_query(
    request: Request,
    time: TimeQuery = None,
    azimuth: AzimuthQuery = None,
    altitude: AltitudeQuery = None,
    style: StyleQuery = None,
    slope_exaggeration: SlopeExaggerationQuery = None,
    sky: SkyQuery = None,
    ramp: RampQuery = None,
    local_light: LocalLightQuery = None,
    generalisation: GeneralisationQuery = None,
    **shadow_settings: Any,
) -> PictureRequest:
    """Return the request for a picture (a FastAPI dependency). Raises ``InputError``."""
    sun = request_sun(request, time, azimuth, altitude, service_of(request).settings.time_grain_s)
    return PictureRequest(
        sun=sun, style=style_named(style), slope_exaggeration=slope_exaggeration, sky=sky, ramp=ramp,
        local_light=local_light, generalisation=generalisation,
        overrides=served_settings(shadow_settings),
    )  # fmt: skip


async def sun_query(
    request: Request, time: TimeQuery = None, azimuth: AzimuthQuery = None, altitude: AltitudeQuery = None
) -> SunSpec | None:
    """Return the sun of a request (a FastAPI dependency); ``None`` means the level's own. Raises ``InputError``."""
    return request_sun(request, time, azimuth, altitude, service_of(request).settings.time_grain_s)


@with_shadow_settings("plans", _shadow_parameter)
async def plan_query(
    policy: Annotated[
        str,
        Query(
            description="`rules`: fixed rules; `predict`: cost and error models, calibrated for the service's device.",
            json_schema_extra={"enum": ["predict", "rules"]},
            examples=["rules"],
        ),
    ] = "predict",
    **shadow_settings: Any,
) -> PlanQuery:
    """Return the query of a plan (a FastAPI dependency). Raises ``InputError``."""
    if policy in ("probe", "measure"):
        raise InputError(
            "policy",
            Problem(f"{policy} takes too long for a request"),
            f"Use rules or predict, or run skugga select --policy {policy}",
        )
    if policy not in get_args(ServedPolicy):
        raise InputError("policy", policy, ", ".join(get_args(ServedPolicy)))
    return PlanQuery(cast(ServedPolicy, policy), served_settings(shadow_settings))


def served_settings(shadow_settings: dict[str, Any]) -> RequestedSettings:
    """Return a request's shadow settings from the query's values, of which ``None`` are left out.

    Raises ``InputError`` for an algorithm that the service does not offer.
    """
    if shadow_settings.get("algorithm") is not None:
        parse_algorithm(shadow_settings["algorithm"], names=served_algorithms())
    return RequestedSettings.of(shadow_settings)


SUN_PARAMETERS = tuple(name for name in signature(sun_query).parameters if name != "request")
PICTURE_PARAMETERS = tuple(name for name in signature(picture_query).parameters if name != "request")
"""Query parameters of every picture."""

PLAN_PARAMETERS = tuple(signature(plan_query).parameters)
"""Query parameters of every plan, without those of the sun."""


def parse_size(text: str) -> tuple[int, int]:
    """Return (width, height) in pixels from a text such as ``1280x1024``. Raises ``InputError``."""
    width, _, height = text.partition("x")
    if not all(part.isascii() and part.isdigit() and 1 <= int(part) <= MAX_PERSPECTIVE_SIDE_PX for part in (width, height)):
        raise InputError("size", text, f"WIDTHxHEIGHT in pixels, as 1280x1024, at most {MAX_PERSPECTIVE_SIDE_PX} a side")
    return int(width), int(height)


def check_pixels(size: tuple[int, int], max_pixels: int) -> None:
    """Raise ``InputError`` if a picture of ``size`` (width, height) has more than ``max_pixels`` pixels."""
    if size[0] * size[1] > max_pixels:
        remedy = "Ask for fewer pixels, or have the operator raise SKUGGA_MAX_SNAPSHOT_PIXELS"
        raise InputError.over_limit("size", f"{size[0]}x{size[1]} pixels", f"{max_pixels} pixels in all", remedy)


def _product_descriptions(names: Iterable[str]) -> str:
    """Return the descriptions of products as text for the documentation of a query parameter."""
    return "; ".join(f"`{name}` is {PRODUCTS[name].description}" for name in names)


LayerQuery = Annotated[
    str,
    Query(
        description=f"{_product_descriptions(name for name in VIEW_PRODUCTS if PRODUCTS[name].pass_layer is None)}. "
        "Intermediate results of render passes, as PNG, if the plan's algorithms have them: "
        f"{_product_descriptions(name for name in VIEW_PRODUCTS if PRODUCTS[name].pass_layer is not None)}.",
        json_schema_extra={"enum": [*VIEW_PRODUCTS]},
        examples=["mask"],
    ),
]

TileLayerQuery = Annotated[
    str,
    Query(description=f"{_product_descriptions(MAP_PRODUCTS)}.", json_schema_extra={"enum": [*MAP_PRODUCTS]}, examples=["shadow"]),
]


def _product_parameter(name: str) -> Any:
    """Return the type annotation of the query parameter for a product option. Its description lists the products."""
    products = [product for product in MAP_PRODUCTS if name in served_options(PRODUCTS[product])]
    field = served_options(PRODUCTS[products[0]])[name]
    value_type: Any = field.annotation
    kinds = {*get_args(value_type), value_type}
    readers = [reader for kind, reader in OPTION_VALIDATORS.items() if kind in kinds]
    description = f"For {', '.join(f'`{product}`' for product in products)}. {field.description or ''}".rstrip()
    limits: dict[str, Any] = {"allow_inf_nan": False} if float in kinds else {}
    if str in kinds and not any(isinstance(constraint, MaxLen) for constraint in field.metadata):
        limits["max_length"] = MAX_OPTION_CHARACTERS
    query = Query(description=description, examples=field.examples or [], **limits)
    return Annotated[(value_type | None, *readers[:1], *field.metadata, query)]


OPTION_VALIDATORS: dict[type, BeforeValidator] = {datetime.date: PLAIN_DATE, int: PLAIN_INTEGER, float: PLAIN_DECIMAL}

MAX_OPTION_CHARACTERS = 100
"""Maximum number of characters of a text option."""


def served_options(product: Product) -> dict[str, FieldInfo]:
    """Return the options of a product that are available by HTTP, by name."""
    return {name: field for name, field in product.options.model_fields.items() if name not in product.options.UNSERVED}


PRODUCT_OPTIONS = tuple(dict.fromkeys(name for product in MAP_PRODUCTS for name in served_options(PRODUCTS[product])))
"""Names of the options of all products that HTTP serves as tiles and maps."""

TILE_PARAMETERS = ("layer", *PICTURE_PARAMETERS, *PRODUCT_OPTIONS)
"""Query parameters of tiles."""


def with_product_options_query(*excluded: str) -> Callable[[FunctionT], FunctionT]:
    """Return a decorator for FastAPI dependencies with ``**options``.

    The decorator replaces ``**options`` in the signature by a query parameter for each product option, except ``excluded``.
    """
    parameters = [(name, _product_parameter(name)) for name in PRODUCT_OPTIONS if name not in excluded]
    return with_parameters(parameters)


async def product_query(request: Request, picture: PictureRequest, layer: str, options: dict[str, Any]) -> ProductRequest:
    """Return the request for a product as tiles or as a map.

    ``layer`` names the product, and ``options`` has its options; those that are ``None`` are left out. Raises ``InputError`` for an
    unknown layer, an option of another product, and a parameter that a layer of whole dates does not take.
    """
    product = product_named(layer, MAP_PRODUCTS)
    given_options = {name: value for name, value in options.items() if value is not None}
    for name in given_options:
        if name not in product.options.model_fields:
            product_names = [product_name for product_name in MAP_PRODUCTS if name in served_options(PRODUCTS[product_name])]
            raise InputError.conflict(name, f"layer={layer}", f"Use it with layer={' or '.join(product_names)}")
    if product.when == "days":
        for name in PICTURE_PARAMETERS:
            if name in request.query_params:
                raise InputError.conflict(name, f"layer={layer}", "Leave it out: the layer covers a whole date")
    return ProductRequest(
        product=layer, options=product.options_of({**product.options.UNSERVED, **given_options}), **dict(picture)
    )  # fmt: skip


@with_product_options_query("width", "height")
async def map_query(
    request: Request, picture: Annotated[PictureRequest, Depends(picture_query)], layer: TileLayerQuery = "color", **options: Any
) -> ProductRequest:
    """Return the request for a map (a FastAPI dependency). Raises ``InputError``.

    ``width`` and ``height`` are no product options here: they are the map's size in pixels.
    """
    return await product_query(request, picture, layer, options)


@with_product_options_query()
async def tile_query(
    request: Request, picture: Annotated[PictureRequest, Depends(picture_query)], layer: TileLayerQuery = "color", **options: Any
) -> ProductRequest:
    """Return the request for tiles (a FastAPI dependency). Raises ``InputError``."""
    return await product_query(request, picture, layer, options)


ViewQuery = Annotated[
    str | None, Query(max_length=100, description="A view of the level; default: `map`, else its first one.", examples=["map"])
]
