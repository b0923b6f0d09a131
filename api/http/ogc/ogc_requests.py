"""Requests by keys and values, as WMTS and WMS have them: names of any case, layers as ``level:layer``, and what is shown."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Literal

from fastapi import Request, Response

from skugga.api.errors import NotServedError
from skugga.api.http.moments import asked_sun
from skugga.api.http.numbers import decimal_in
from skugga.api.http.ogc.ogc_times import date_asked, default_date, instant_asked
from skugga.api.http.parameters import OWN_STYLE, PRODUCT_OPTIONS, served_options, style_named
from skugga.api.http.problems import public_error
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.http.state.service import service_of
from skugga.api.products import MAP_PRODUCTS, PRODUCTS
from skugga.api.products.product import MEDIA_TYPES, MapFormat, ProductOptions
from skugga.api.request import ProductRequest
from skugga.terrain.errors import MISSING_VALUE, Problem, InputError, SkuggaError
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.style import STYLES

GIS_FORMATS: tuple[MapFormat, ...] = ("png", "webp", "jpg", "tif")
"""Formats that map clients know, the first one of a layer the one to take."""

OWN_KEYS = frozenset({"WIDTH", "HEIGHT", "FORMAT", "STYLE", "STYLES", "TIME", "DATE", "I", "J"})
"""Keys that have a meaning of their own: no options of products, though some have the same name."""

DocumentKind = Literal["WMTS", "WMS"]


class KeyValues:
    """The keys and values of a request. Raises ``InputError`` for a key given twice."""

    def __init__(self, request: Request) -> None:
        self._values: dict[str, str] = {}
        for name, value in request.query_params.multi_items():
            if name.upper() in self._values:
                raise InputError(name.upper(), Problem("given more than once"), "one value")
            self._values[name.upper()] = value

    def get(self, name: str) -> str | None:
        """A value; ``None`` where there is none, or an empty one."""
        return self._values.get(name) or None

    def need(self, name: str, allowed: str) -> str:
        """A value. Raises ``InputError``."""
        value = self.get(name)
        if value is None:
            raise InputError(name, MISSING_VALUE, allowed)
        return value

    def whole(self, name: str) -> int:
        """A whole number. Raises ``InputError``."""
        value = self.need(name, "a whole number")
        if not (value.isascii() and value.isdigit() and len(value) < 10):
            raise InputError(name, value, "a whole number")
        return int(value)

    def number(self, name: str) -> float | None:
        """A number, if there is one. Raises ``InputError``."""
        value = self.get(name)
        number = None if value is None else decimal_in(value)
        if value is not None and number is None:
            raise InputError(name, value, "a number")
        return number


def styles_of(layer: str) -> dict[str, str]:
    """The styles of a layer by name, and what they are, the level's own first."""
    others = {style.name: style.about for style in STYLES.values()} if PRODUCTS[layer].is_display else {}
    return {OWN_STYLE: "Default", **others}


def layer_title(level: ServedLevel, layer: str) -> str:
    """A layer of a level in words."""
    title = level.loaded.level.title or level.name
    return f"{title}: {layer}"


def layer_name(level: ServedLevel, layer: str) -> str:
    """A layer of a level by its name in WMTS and WMS."""
    return f"{level.name}:{layer}"


def split_layer(key: str, name: str) -> tuple[str, str]:
    """A level's name and a layer. Raises ``NotServedError``."""
    level, colon, layer = name.rpartition(":")
    if not colon or layer not in MAP_PRODUCTS:
        raise NotServedError(key, f"{key}: there is no layer {name[:80]!r}; layers are LEVEL:{{{','.join(MAP_PRODUCTS)}}}.")
    return level, layer


def gis_formats(layer: str) -> tuple[MapFormat, ...]:
    """The formats of a layer that map clients know."""
    return tuple(format for format in GIS_FORMATS if format in PRODUCTS[layer].map_formats)


def format_named(media_type: str) -> MapFormat:
    """The format of a media type. Raises ``InputError``."""
    for format, known in MEDIA_TYPES.items():
        if media_type.lower().split(";")[0].strip() in (known, format):
            return format
    raise InputError("FORMAT", media_type, ", ".join(MEDIA_TYPES[format] for format in GIS_FORMATS))


def options_asked(level: ServedLevel, layer: str, asked: KeyValues) -> ProductOptions:
    """The options of a product by keys of their names; the date of one of whole dates is that of TIME. Raises ``InputError``."""
    product = PRODUCTS[layer]
    names = [name for name in served_options(product) if name.upper() not in OWN_KEYS]
    for name in PRODUCT_OPTIONS:
        key = name.upper()
        if name not in names and key not in OWN_KEYS and asked.get(key) is not None:
            raise InputError(key, asked.get(key), f"nothing: {layer} has no such option")
    given: dict[str, object] = {name: value for name in names if (value := asked.get(name.upper())) is not None}
    if product.when == "days":
        given["date"] = date_asked(asked.get("TIME"), default_date(level, this_year()))
    try:
        return product.options_of({**product.options.UNSERVED, **given})
    except InputError as error:
        raise InputError(error.name.upper(), error.value, error.allowed) from None


def sun_at_time(request: Request, level: ServedLevel, asked: KeyValues) -> SunSpec | None:
    """The sun of a request's TIME, or of its AZIMUTH and ALTITUDE; ``None``: the level's own. Raises ``InputError``."""
    instant = instant_asked(asked.get("TIME"), level.world.anchor_lon_deg)
    grain_s = service_of(request).settings.time_grain_s
    return asked_sun(request, instant, asked.number("AZIMUTH"), asked.number("ALTITUDE"), grain_s)


def shown_asked(request: Request, level: ServedLevel, layer: str, asked: KeyValues, style_key: str) -> ProductRequest:
    """What a layer shows at a request's TIME, or under the sun of its AZIMUTH and ALTITUDE, in the style of a key.

    Raises ``InputError``.
    """
    options = options_asked(level, layer, asked)
    if PRODUCTS[layer].when != "sun":
        return ProductRequest(product=layer, options=options)
    style = style_named(asked.get(style_key), style_key)
    if style is not None and not PRODUCTS[layer].is_display:
        raise InputError(style_key, style, OWN_STYLE)
    return ProductRequest(product=layer, options=options, sun=sun_at_time(request, level, asked), style=style)


def this_year() -> int:
    """The year that levels without a time of their own are shown in."""
    return datetime.now(UTC).year


def exception_answer(
    request: Request, error: SkuggaError, codes: dict[str, str], written: Callable[[str, str | None, str], bytes]
) -> Response:
    """An error in a service's own XML, with the status that ``skugga.api.errors`` has for it. ``codes`` are the service's codes by
    the names of parameters.
    """
    outcome, text = public_error(request, error)
    headers = {"Cache-Control": "no-store"}
    if outcome.retry_after_s is not None:
        headers["Retry-After"] = str(outcome.retry_after_s)
    name = getattr(error, "name", None) if outcome.public is None else None
    code = codes.get((name or "").upper(), codes[""] if name is None else codes["*"])
    if isinstance(error, InputError) and error.value is MISSING_VALUE:
        code = codes["missing"]
    return Response(written(code, name, text), outcome.status, headers, "text/xml")
