"""Horizon files for solar tools, with one record per format.

* A file states its first azimuth and its direction of rotation if its format allows text.
* Horizon angles below the level plane are written as 0. In these formats a horizon only serves to hide the sun. A horizon below
  the level plane hides no sun that is up.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from skugga.terrain.errors import InputError

if TYPE_CHECKING:
    from skugga.shadows.point.horizon import PointHorizon
    from skugga.shadows.point.place import PointPlace

Writer = Callable[["PointHorizon", "PointPlace"], str]
"""Function that returns the text of a horizon file, for a horizon profile and the place that it belongs to."""


@dataclass(frozen=True)
class HorizonFormat:
    """A file format of horizon profiles.

    Attributes
    ----------
    name
        Name of the format.
    suffix
        Suffix of its files, without a dot.
    media_type
        Media type of its files.
    azimuth_count
        Number of azimuths in a file; ``None`` writes all azimuths of the computed horizon.
    description
        Description for users.
    write
        Function that returns the text of a file.
    """

    name: str
    suffix: str
    media_type: str
    azimuth_count: int | None
    description: str
    write: Writer


def horizon_file(name: str, horizon: PointHorizon, place: PointPlace) -> str:
    """Return the text of a horizon file in the format ``name``. Raises ``InputError``.

    ``horizon`` must have the azimuths that ``azimuths_of_format`` returns for the format. They are evenly spaced and begin in the
    north. ``place`` is the point that the horizon belongs to.
    """
    return horizon_format(name).write(horizon, place)


def horizon_format(name: str) -> HorizonFormat:
    """Return a format by its name. Raises ``InputError``."""
    if name not in HORIZON_FORMATS:
        raise InputError("format", name, ", ".join(HORIZON_FORMATS))
    return HORIZON_FORMATS[name]


def azimuths_of_format(name: str) -> np.ndarray | None:
    """Return the azimuths (n,) of a format, degrees clockwise from north; ``None`` for all azimuths of the computed horizon."""
    count = horizon_format(name).azimuth_count
    return None if count is None else np.arange(count) * (360.0 / count)


def _heights_above_horizontal(horizon: PointHorizon) -> np.ndarray:
    """Return the horizon angles in degrees (n,), with 0 for angles below the level plane."""
    return np.maximum(horizon.elevation_deg, 0.0)


def _azimuths_from_south(horizon: PointHorizon) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths and horizon angles in degrees, by ascending azimuth from -180 (north): -90 is east, 0 south, 90 west."""
    azimuth = (horizon.azimuth_deg + 360.0) % 360.0 - 180.0
    order = np.argsort(azimuth)
    return azimuth[order], _heights_above_horizontal(horizon)[order]


def _place_lines(place: PointPlace) -> list[str]:
    """Return lines of text with the position and the elevation of a place."""
    if place.lon_deg is None:
        position_lines = [f"East of the centre (m): {place.x:.2f}", f"North of the centre (m): {place.y:.2f}"]
    else:
        position_lines = [f"Latitude (decimal degrees): {place.lat_deg:.6f}", f"Longitude (decimal degrees): {place.lon_deg:.6f}"]
    return [*position_lines, f"Elevation (m): {place.eye_elevation_m:.1f}"]


def _pvgis_csv(horizon: PointHorizon, place: PointPlace) -> str:
    """Return a horizon as PVGIS prints it: azimuth from the south and horizon angle, in columns that tabs separate."""
    azimuth, height = _azimuths_from_south(horizon)
    rows = [f"{a:.2f}\t\t{h:.2f}" for a, h in zip([*azimuth, 180.0], [*height, height[0]], strict=True)]
    notes = ["A_hor: Azimuth (0 = S, 90 = W, -90 = E), ascending from -180 (N)", "H_hor: Horizon height (degrees)"]
    return "\r\n".join([*_place_lines(place), "", "A_hor\t\tH_hor", *rows, "", *notes]) + "\r\n"


def _pvgis_json(horizon: PointHorizon, place: PointPlace) -> str:
    """Return a horizon as JSON with the keys of PVGIS's ``horizon_profile``."""
    azimuth, height = _azimuths_from_south(horizon)
    pairs = zip([*azimuth, 180.0], [*height, height[0]], strict=True)
    profile = [{"A": round(float(a), 3), "H_hor": round(float(h), 3)} for a, h in pairs]
    location = {"latitude": place.lat_deg, "longitude": place.lon_deg, "elevation": round(place.eye_elevation_m, 2)}
    variables = {"A": "azimuth in degrees, 0 = south, 90 = west, -90 = east", "H_hor": "horizon height in degrees"}
    value = {
        "inputs": {"location": location, "horizon_db": "Skugga"},
        "outputs": {"horizon_profile": profile},
        "meta": {"outputs": {"horizon_profile": {"type": "series", "variables": variables}}},
    }
    return json.dumps(value, indent=1) + "\n"


def _pvgis_upload(horizon: PointHorizon, place: PointPlace) -> str:
    """Return one horizon angle in each line, clockwise from north, for an upload to PVGIS."""
    return "".join(f"{height:.2f}\n" for height in _heights_above_horizontal(horizon))


def _forecast_solar(horizon: PointHorizon, place: PointPlace) -> str:
    """Return horizon angles that are separated by commas, clockwise from north."""
    return ",".join(f"{height:.1f}" for height in _heights_above_horizontal(horizon)) + "\n"


def _pvlib_csv(horizon: PointHorizon, place: PointPlace) -> str:
    """Return a CSV with azimuths clockwise from north and horizon angles, with the column names of pvlib."""
    rows = [f"{a:.6g},{h:.3f}" for a, h in zip(horizon.azimuth_deg, _heights_above_horizontal(horizon), strict=True)]
    return "\n".join(["horizon_azimuth,horizon_elevation", *rows]) + "\n"


def _hor_text(horizon: PointHorizon, place: PointPlace) -> str:
    """Return an azimuth from the south and a horizon angle in each line, as PVsyst and PV*SOL read them."""
    azimuth, height = _azimuths_from_south(horizon)
    return "".join(f"{a:.0f} {h:.2f}\n" for a, h in zip(azimuth, height, strict=True))


_FORMATS = (
    HorizonFormat(
        "pvgis-csv", "csv", "text/csv", None, "PVGIS, printed: A_hor (0 = south, 90 = west) and H_hor, with tabs", _pvgis_csv
    ),
    HorizonFormat(
        "pvgis-json", "json", "application/json", None, "PVGIS, horizon_profile: A (0 = south, 90 = west), H_hor", _pvgis_json
    ),
    HorizonFormat(
        "pvgis-upload", "txt", "text/plain", 360, "to upload to PVGIS: a height a line, clockwise from north", _pvgis_upload
    ),
    HorizonFormat(
        "forecast-solar", "txt", "text/plain", 72, "forecast.solar: heights with commas, clockwise from north", _forecast_solar
    ),
    HorizonFormat(
        "pvlib", "csv", "text/csv", None, "pvlib: horizon_azimuth (clockwise from north), horizon_elevation", _pvlib_csv
    ),
    HorizonFormat(
        "hor", "hor", "text/plain", 360, "PVsyst and PV*SOL: azimuth from -180 to 179 (0 = south) and height", _hor_text
    ),
)  # fmt: skip

HORIZON_FORMATS: dict[str, HorizonFormat] = {each.name: each for each in _FORMATS}
"""All formats by name."""
