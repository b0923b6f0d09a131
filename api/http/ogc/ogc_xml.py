"""Build the XML of OGC services: elements with namespace prefixes, and exception documents."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree.ElementTree import Element, SubElement, indent, tostring

XLINK_NAMESPACE = "http://www.w3.org/1999/xlink"
XSI_NAMESPACE = "http://www.w3.org/2001/XMLSchema-instance"

MIN_LON_DEG, MAX_LON_DEG = -180.0, 180.0


def add_element(parent: Element, tag: str, text: object = None, **attributes: str) -> Element:
    """Append a child element and return it.

    In the names of ``attributes`` the first underscore stands for the colon after a namespace prefix, as ``xlink_href``.
    """
    child = SubElement(parent, tag, {name.replace("_", ":", 1): value for name, value in attributes.items()})
    child.text = None if text is None else str(text)
    return child


def xml_document(root: Element) -> bytes:
    """Return an element as an indented XML document in UTF-8."""
    indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="utf-8") + b"\n"


def format_numbers(values: Iterable[float], separator: str = " ") -> str:
    """Return numbers as text. Parsing the text gives exactly the same floats."""
    return separator.join(repr(float(value)) for value in values)


def lon_lat_box(bounds: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Return bounds (west, south, east, north in degrees) with longitudes between -180 and 180.

    Bounds that cross the antimeridian become the full range of longitudes, since boxes in capabilities may not cross it.
    """
    west, south, east, north = bounds
    return bounds if west >= MIN_LON_DEG and east <= MAX_LON_DEG else (MIN_LON_DEG, south, MAX_LON_DEG, north)


def ows_exception(code: str, locator: str | None, text: str) -> bytes:
    """Return an ``ExceptionReport`` (OWS Common 1.1.0, 8.3).

    ``code`` is the exception code, such as ``InvalidParameterValue``. ``locator`` names the wrong parameter; ``None`` without one.
    """
    root = Element(
        "ows:ExceptionReport", {"xmlns:ows": "http://www.opengis.net/ows/1.1", "version": "1.1.0", "xml:lang": "en"}
    )  # fmt: skip
    exception = add_element(root, "ows:Exception", exceptionCode=code, **({} if locator is None else {"locator": locator}))
    add_element(exception, "ows:ExceptionText", text)
    return xml_document(root)


def wms_exception(code: str, locator: str | None, text: str) -> bytes:
    """Return a ``ServiceExceptionReport`` (WMS 1.3.0, 6.11).

    ``code`` is the exception code, such as ``LayerNotDefined``. ``locator`` names the wrong parameter; ``None`` without one.
    """
    root = Element("ServiceExceptionReport", {"xmlns": "http://www.opengis.net/ogc", "version": "1.3.0"})
    add_element(root, "ServiceException", text, code=code, **({} if locator is None else {"locator": locator}))
    return xml_document(root)
