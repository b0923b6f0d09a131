"""Parse requests of WMS and WMTS by keys and values (KVP): keys in any case, and layers named ``level:layer``."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime

from fastapi import Request, Response

from skugga.api.errors import NotServedError
from skugga.api.http.numbers import parse_decimal
from skugga.api.http.ogc.ogc_times import default_date, requested_date, requested_instant
from skugga.api.http.parameters import DEFAULT_STYLE, PRODUCT_OPTIONS, served_options, style_named
from skugga.api.http.problems import public_error
from skugga.api.http.request_times import request_sun
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.http.state.service import service_of
from skugga.api.products import MAP_PRODUCTS, PRODUCTS
from skugga.api.products.product import MEDIA_TYPES, MapFormat, ProductOptions
from skugga.api.request import ProductRequest
from skugga.terrain.errors import MISSING_VALUE, InputError, Problem, SkuggaError
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.style import STYLES

GIS_FORMATS: tuple[MapFormat, ...] = ("png", "webp", "jpg", "tif")
"""Formats that map clients know. The first one that a layer has is preferred."""

RESERVED_KEYS = frozenset({"WIDTH", "HEIGHT", "FORMAT", "STYLE", "STYLES", "TIME", "DATE", "I", "J"})
"""Keys that WMS and WMTS define. They are no options of products, although some options have the same names."""


class KeyValuePairs:
    """The keys and values of a request. Keys are in upper case. Raises ``InputError`` for a repeated key."""

    def __init__(self, request: Request) -> None:
        self._values: dict[str, str] = {}
        for name, value in request.query_params.multi_items():
            if name.upper() in self._values:
                raise InputError(name.upper(), Problem("given more than once"), "Give it once")
            self._values[name.upper()] = value

    def get(self, name: str) -> str | None:
        """Return a value; ``None`` if it is missing or empty."""
        return self._values.get(name) or None

    def require(self, name: str, remedy: str) -> str:
        """Return a value. Raises ``InputError`` with a remedy if it is missing."""
        value = self.get(name)
        if value is None:
            raise InputError.missing(name, remedy)
        return value

    def integer(self, name: str) -> int:
        """Return a whole number. Raises ``InputError``."""
        value = self.require(name, "Give a whole number")
        if not (value.isascii() and value.isdigit() and len(value) < 10):
            raise InputError(name, value, "a whole number")
        return int(value)

    def number(self, name: str) -> float | None:
        """Return a number; ``None`` if it is missing. Raises ``InputError``."""
        value = self.get(name)
        number = None if value is None else parse_decimal(value)
        if value is not None and number is None:
            raise InputError(name, value, "a number")
        return number


def styles_of(layer: str) -> dict[str, str]:
    """Return the styles of a layer, as descriptions by name. The level's own style comes first."""
    named_styles = {style.name: style.about for style in STYLES.values()} if PRODUCTS[layer].is_display else {}
    return {DEFAULT_STYLE: "Default", **named_styles}


def layer_title(level: ServedLevel, layer: str) -> str:
    """Return the title of a layer of a level."""
    title = level.loaded.level.title or level.name
    return f"{title}: {layer}"


def layer_name(level: ServedLevel, layer: str) -> str:
    """Return the name of a layer of a level in WMTS and WMS."""
    return f"{level.name}:{layer}"


def split_layer(key: str, name: str) -> tuple[str, str]:
    """Return the level's name and the layer of a WMS or WMTS layer name. Raises ``NotServedError``."""
    level, colon, layer = name.rpartition(":")
    if not colon or layer not in MAP_PRODUCTS:
        message = f"{key}: layer {name[:80]!r} does not exist. Use LEVEL:LAYER; layers are {', '.join(MAP_PRODUCTS)}."
        raise NotServedError(key, message)
    return level, layer


def gis_formats(layer: str) -> tuple[MapFormat, ...]:
    """Return the formats of a layer that map clients know."""
    return tuple(format for format in GIS_FORMATS if format in PRODUCTS[layer].map_formats)


def format_of_media_type(media_type: str) -> MapFormat:
    """Return the format of a media type. Raises ``InputError``."""
    for format, known_media_type in MEDIA_TYPES.items():
        if media_type.lower().split(";")[0].strip() in (known_media_type, format):
            return format
    raise InputError("FORMAT", media_type, ", ".join(MEDIA_TYPES[format] for format in GIS_FORMATS))


def layer_options(level: ServedLevel, layer: str, parameters: KeyValuePairs) -> ProductOptions:
    """Return the options of a product from the keys of a request.

    Keys have the names of the options. A product of whole dates takes its date from TIME. Raises ``InputError``.
    """
    product = PRODUCTS[layer]
    names = [name for name in served_options(product) if name.upper() not in RESERVED_KEYS]
    for name in PRODUCT_OPTIONS:
        key = name.upper()
        if name not in names and key not in RESERVED_KEYS and parameters.get(key) is not None:
            raise InputError(key, Problem(f"layer {layer} has no such option"), "Omit it")
    values: dict[str, object] = {name: value for name in names if (value := parameters.get(name.upper())) is not None}
    if product.when == "days":
        values["date"] = requested_date(parameters.get("TIME"), default_date(level, this_year()))
    try:
        return product.options_of({**product.options.UNSERVED, **values})
    except InputError as error:
        raise error.renamed(error.name.upper()) from None


def requested_sun(request: Request, level: ServedLevel, parameters: KeyValuePairs) -> SunSpec | None:
    """Return the sun of a request's TIME, or of its AZIMUTH and ALTITUDE; ``None``: the level's own. Raises ``InputError``."""
    instant = requested_instant(parameters.get("TIME"), level.world.anchor_lon_deg)
    grain_s = service_of(request).settings.time_grain_s
    return request_sun(request, instant, parameters.number("AZIMUTH"), parameters.number("ALTITUDE"), grain_s)


def layer_request(request: Request, level: ServedLevel, layer: str, parameters: KeyValuePairs, style_key: str) -> ProductRequest:
    """Return the product request of a layer, with the request's options, sun, and the style of ``style_key``.

    Raises ``InputError``.
    """
    options = layer_options(level, layer, parameters)
    if PRODUCTS[layer].when != "sun":
        return ProductRequest(product=layer, options=options)
    style = style_named(parameters.get(style_key), style_key)
    if style is not None and not PRODUCTS[layer].is_display:
        raise InputError(style_key, style, DEFAULT_STYLE)
    return ProductRequest(product=layer, options=options, sun=requested_sun(request, level, parameters), style=style)


def this_year() -> int:
    """Return the current year, which levels without a time of their own use."""
    return datetime.now(UTC).year


def exception_answer(
    request: Request, error: SkuggaError, codes: dict[str, str], write_xml: Callable[[str, str | None, str], bytes]
) -> Response:
    """Return an error as a response in a service's XML, with its status from ``skugga.api.errors``.

    ``codes`` are the exception codes of the service by parameter. ``write_xml`` writes the XML of a code, a parameter and a text.
    """
    report, text = public_error(request, error)
    headers = {"Cache-Control": "no-store"}
    if report.retry_after_s is not None:
        headers["Retry-After"] = str(report.retry_after_s)
    name = getattr(error, "name", None) if report.public is None else None
    code = codes.get((name or "").upper(), codes[""] if name is None else codes["*"])
    if isinstance(error, InputError) and error.value is MISSING_VALUE:
        code = codes["missing"]
    return Response(write_xml(code, name, text), report.status, headers, "text/xml")
