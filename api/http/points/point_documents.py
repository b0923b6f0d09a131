"""Write the sun report of a point as text, HTML or GeoJSON. Map clients show it for a clicked point."""

from __future__ import annotations

import json
from datetime import datetime
from html import escape
from typing import Any

ReportRows = list[tuple[str, str]]
"""Rows of a report: a name and a text, which is not escaped."""


def report_rows(report: dict[str, Any]) -> ReportRows:
    """Return a report as rows of (name, text). ``report`` is the decoded JSON of a ``skugga.api.point.report.PointReport``."""
    rows = [
        ("Level", str(report["level"])),
        ("Place", f"{report['lat']}, {report['lon']}"),
    ]
    if report["elevation_m"] is not None:
        rows.append(("Elevation", f"{report['elevation_m']:.1f} m"))
    moment, day = report["now"], report["day"]
    if moment is not None:
        rows.append(("Sun", f"azimuth {moment['azimuth']:.1f}°, altitude {moment['altitude']:.1f}°"))
        rows.append(("Lit", "yes" if moment["lit"] else "no" + (f", by {_occluder_text(moment['by'])}" if moment["by"] else "")))
    if day is not None:
        rows += [
            ("Date", f"{day['date']} ({day['clock']})"),
            ("Direct sun", f"{day['direct_h']:.2f} of {day['daylight_h']:.2f} hours"),
        ]
        rows += [
            ("From", f"{_format_clock_time(interval['begin'])} to {_format_clock_time(interval['end'])}")
            for interval in day["sunlit"]
        ]
    if report["remark"]:
        rows.append(("Remark", report["remark"]))
    return rows


def report_text(rows: ReportRows) -> str:
    """Return rows as lines of plain text."""
    return "".join(f"{name}: {value}\n" for name, value in rows)


def report_page(rows: ReportRows) -> str:
    """Return rows as an HTML page with a table."""
    table = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
    head = '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Skugga</title></head>'
    return f"{head}<body><table>{table}</table></body></html>\n"


def report_features(lon_lat_deg: tuple[float, float] | None, report: dict[str, Any]) -> str:
    """Return a report as a GeoJSON collection of one feature.

    ``lon_lat_deg`` is (longitude, latitude) in degrees, or ``None`` for a feature without geometry. The member ``crs`` is for QGIS:
    without it QGIS assumes the CRS of the map layer.
    """
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}
    geometry = None if lon_lat_deg is None else {"type": "Point", "coordinates": lon_lat_deg}
    feature = {"type": "Feature", "geometry": geometry, "properties": report}
    return json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]})


def _occluder_text(caster: dict[str, Any]) -> str:
    """Return an occluder's kind, distance and elevation angle as text. ``caster`` is its object in the report's JSON."""
    return f"{caster['kind']} {caster['distance_m']:.0f} m away, {caster['elevation']:.1f}° high"


def _format_clock_time(moment: str) -> str:
    """Return the hour and minute of an ISO 8601 time."""
    return datetime.fromisoformat(moment).strftime("%H:%M")
