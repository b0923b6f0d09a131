"""Parse requests of WMS and WMTS that are encoded as keys and values (KVP).

Keys may be in upper or lower case. Layers are named ``level:layer``, such as ``jacksboro:color``.
"""

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
"""File formats that map clients know, in order of preference."""

RESERVED_KEYS = frozenset({"WIDTH", "HEIGHT", "FORMAT", "STYLE", "STYLES", "TIME", "DATE", "I", "J"})
"""Keys that WMS and WMTS define. They do not set a product option of the same name."""


class KeyValuePairs:
    """The keys and values of a request's query. Keys are stored in upper case.

    Raises ``InputError`` for a repeated key.
    """

    def __init__(self, request: Request) -> None:
        self._values: dict[str, str] = {}
        for name, value in request.query_params.multi_items():
            if name.upper() in self._values:
                raise InputError(name.upper(), Problem("given more than once"), "Give it once")
            self._values[name.upper()] = value

    def get(self, name: str) -> str | None:
        """Return the value of a key; ``None`` if it is missing or empty."""
        return self._values.get(name) or None

    def require(self, name: str, remedy: str) -> str:
        """Return the value of a key. Raises ``InputError`` with the text ``remedy`` if it is missing or empty."""
        value = self.get(name)
        if value is None:
            raise InputError.missing(name, remedy)
        return value

    def require_integer(self, name: str) -> int:
        """Return the value of a required key as a whole number. Raises ``InputError`` for other values, and if it is missing."""
        value = self.require(name, "Give a whole number")
        if not (value.isascii() and value.isdigit() and len(value) < 10):
            raise InputError(name, value, "a whole number")
        return int(value)

    def get_number(self, name: str) -> float | None:
        """Return the value of a key as a number; ``None`` if it is missing. Raises ``InputError`` for other texts."""
        value = self.get(name)
        get_number = None if value is None else parse_decimal(value)
        if value is not None and get_number is None:
            raise InputError(name, value, "a number")
        return get_number


def styles_of(layer: str) -> dict[str, str]:
    """Return the shading styles of a layer: a description by each style's name.

    The level's own style comes first, as ``default``. Layers of data have no other style.
    """
    named_styles = {style.name: style.description for style in STYLES.values()} if PRODUCTS[layer].is_display else {}
    return {DEFAULT_STYLE: "Default", **named_styles}


def layer_title(level: ServedLevel, layer: str) -> str:
    """Return the title that clients show for a layer of a level."""
    title = level.loaded.level.title or level.name
    return f"{title}: {layer}"


def layer_name(level: ServedLevel, layer: str) -> str:
    """Return the name of a layer of a level in WMTS and WMS."""
    return f"{level.name}:{layer}"


def split_layer(parameter: str, name: str) -> tuple[str, str]:
    """Split a layer name of WMS or WMTS into the level's name and the layer.

    Raises ``NotServedError`` for an unknown layer. Its message names ``parameter``, the key of the request.
    """
    level, colon, layer = name.rpartition(":")
    if not colon or layer not in MAP_PRODUCTS:
        message = f"{parameter}: layer {name[:80]!r} does not exist. Use LEVEL:LAYER; layers are {', '.join(MAP_PRODUCTS)}."
        raise NotServedError(parameter, message)
    return level, layer


def gis_formats(layer: str) -> tuple[MapFormat, ...]:
    """Return the formats of a layer that map clients know, the preferred one first."""
    return tuple(format for format in GIS_FORMATS if format in PRODUCTS[layer].map_formats)


def format_of_media_type(media_type: str) -> MapFormat:
    """Return the file format of a media type. Raises ``InputError`` for an unknown media type."""
    for format, known_media_type in MEDIA_TYPES.items():
        if media_type.lower().split(";")[0].strip() in (known_media_type, format):
            return format
    raise InputError("FORMAT", media_type, ", ".join(MEDIA_TYPES[format] for format in GIS_FORMATS))


def layer_options(level: ServedLevel, layer: str, parameters: KeyValuePairs) -> ProductOptions:
    """Return the options of a layer's product from the keys of a request.

    The key of an option is its name. A product of whole dates, such as hours of sun, takes its date from TIME, unless a
    YEAR is given. Raises
    ``InputError``.
    """
    product = PRODUCTS[layer]
    names = [name for name in served_options(product) if name.upper() not in RESERVED_KEYS]
    for name in PRODUCT_OPTIONS:
        key = name.upper()
        if name not in names and key not in RESERVED_KEYS and parameters.get(key) is not None:
            raise InputError(key, Problem(f"layer {layer} has no such option"), "Omit it")
    values: dict[str, object] = {name: value for name in names if (value := parameters.get(name.upper())) is not None}
    if product.when == "days" and "year" not in values:
        values["date"] = requested_date(parameters.get("TIME"), default_date(level, current_year()))
    try:
        return product.options_of({**product.options.UNSERVED, **values})
    except InputError as error:
        raise error.renamed(error.name.upper()) from None


def requested_sun(request: Request, level: ServedLevel, parameters: KeyValuePairs) -> SunSpec | None:
    """Return the sun that a request's TIME, or its AZIMUTH and ALTITUDE, defines; ``None`` means the level's own sun.

    Raises ``InputError``.
    """
    instant = requested_instant(parameters.get("TIME"), level.world.anchor_lon_deg)
    grain_s = service_of(request).settings.time_grain_s
    return request_sun(request, instant, parameters.get_number("AZIMUTH"), parameters.get_number("ALTITUDE"), grain_s)


def layer_request(request: Request, level: ServedLevel, layer: str, parameters: KeyValuePairs, style_key: str) -> ProductRequest:
    """Return the request for a layer's product, with the options, the sun and the style from the keys.

    ``style_key`` is the key of the style: STYLES in WMS, STYLE in WMTS. Raises ``InputError``.
    """
    options = layer_options(level, layer, parameters)
    if PRODUCTS[layer].when != "sun":
        return ProductRequest(product=layer, options=options)
    style = style_named(parameters.get(style_key), style_key)
    if style is not None and not PRODUCTS[layer].is_display:
        raise InputError(style_key, style, DEFAULT_STYLE)
    return ProductRequest(product=layer, options=options, sun=requested_sun(request, level, parameters), style=style)


def current_year() -> int:
    """Return the current year in UTC. Capabilities list its times for levels whose sun has no time."""
    return datetime.now(UTC).year


def exception_response(
    request: Request, error: SkuggaError, codes_by_parameter: dict[str, str], write_xml: Callable[[str, str | None, str], bytes]
) -> Response:
    """Return an error as a response in the XML of WMS or WMTS, with the HTTP status from ``skugga.api.errors``.

    Parameters
    ----------
    request
        The request, for the log.
    error
        The error.
    codes_by_parameter
        Exception codes by the wrong parameter. The key ``""`` is for errors without a parameter, ``"*"`` for other parameters, and
        ``"missing"`` for missing parameters.
    write_xml
        Returns the body for an exception code, the parameter's name (or ``None``) and the message.
    """
    report, text = public_error(request, error)
    headers = {"Cache-Control": "no-store"}
    if report.retry_after_s is not None:
        headers["Retry-After"] = str(report.retry_after_s)
    name = getattr(error, "name", None) if report.public_message is None else None
    code = codes_by_parameter.get((name or "").upper(), codes_by_parameter[""] if name is None else codes_by_parameter["*"])
    if isinstance(error, InputError) and error.value is MISSING_VALUE:
        code = codes_by_parameter["missing"]
    return Response(write_xml(code, name, text), report.status, headers, "text/xml")
