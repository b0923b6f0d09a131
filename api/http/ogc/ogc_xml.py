"""Build the XML of OGC services: elements with namespace prefixes, and exception documents."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree.ElementTree import Element, SubElement, indent, tostring

XLINK = "http://www.w3.org/1999/xlink"
XSI = "http://www.w3.org/2001/XMLSchema-instance"

WEST_180, EAST_180 = -180.0, 180.0


def add(parent: Element, tag: str, text: object = None, **attributes: str) -> Element:
    """Append a child and return it. The first underscore of an attribute stands for the colon after its prefix."""
    child = SubElement(parent, tag, {name.replace("_", ":", 1): value for name, value in attributes.items()})
    child.text = None if text is None else str(text)
    return child


def document(root: Element) -> bytes:
    """Return the bytes of a document, indented."""
    indent(root)
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="utf-8") + b"\n"


def format_numbers(values: Iterable[float], separator: str = " ") -> str:
    """Return coordinates as text that reads back to the same floats."""
    return separator.join(repr(float(value)) for value in values)


def lon_lat_box(bounds: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Return west, south, east and north in degrees, within -180 and 180.

    A level that crosses the antimeridian gets all longitudes, because boxes may not cross it.
    """
    west, south, east, north = bounds
    return bounds if west >= WEST_180 and east <= EAST_180 else (WEST_180, south, EAST_180, north)


def ows_exception(code: str, locator: str | None, text: str) -> bytes:
    """Return an ``ExceptionReport`` of OWS Common 1.1.0, 8.3."""
    root = Element(
        "ows:ExceptionReport", {"xmlns:ows": "http://www.opengis.net/ows/1.1", "version": "1.1.0", "xml:lang": "en"}
    )  # fmt: skip
    exception = add(root, "ows:Exception", exceptionCode=code, **({} if locator is None else {"locator": locator}))
    add(exception, "ows:ExceptionText", text)
    return document(root)


def wms_exception(code: str, locator: str | None, text: str) -> bytes:
    """Return a ``ServiceExceptionReport`` of WMS 1.3.0, 6.11."""
    root = Element("ServiceExceptionReport", {"xmlns": "http://www.opengis.net/ogc", "version": "1.3.0"})
    add(root, "ServiceException", text, code=code, **({} if locator is None else {"locator": locator}))
    return document(root)
