"""Weather files for tests, written from the clear sky of a place or from given values."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pvlib import atmosphere, clearsky, irradiance

from skugga.shadows.irradiation.weather_sun import as_index, without_pvlib_warnings
from skugga.terrain.geo.sun_path import sun_path

PIECES_PER_RECORD = 6

SOURCE_YEARS = (2018, 2007, 2009, 2013, 2008, 2006, 2011, 2010, 2020, 2006, 2007, 2016)
"""The years of a typical year's months."""

TMY3_HEADER = "Date (MM/DD/YYYY),Time (HH:MM),ETR (W/m^2),ETRN (W/m^2),GHI (W/m^2),DNI (W/m^2),DHI (W/m^2)"


class Place(NamedTuple):
    """A place with its standard time."""

    lon_deg: float
    lat_deg: float
    zone_hours: float


PLACES = {
    "alps": Place(8.0, 45.0, 1.0), "rockies": Place(-105.2, 40.0, -7.0), "delhi": Place(77.2, 28.6, 5.5),
    "sydney": Place(151.2, -33.9, 10.0),
}  # fmt: skip


def hours_of_year(year: int = 2001) -> np.ndarray:
    """Return the starts of the hours of a year, datetime64[us]."""
    return np.arange(f"{year}-01-01", f"{year + 1}-01-01", dtype="datetime64[h]").astype("datetime64[us]")


@cache
def _clear_sky(place: Place, first_min: float, length_min: float) -> np.ndarray:
    """Return GHI, DNI and DHI (3, 8760) of hours in UTC: means of intervals of a length that start ``first_min`` after each."""
    pieces = (np.arange(PIECES_PER_RECORD) + 0.5) / PIECES_PER_RECORD if length_min else np.zeros(1)
    minutes = first_min + length_min * pieces
    moments = (hours_of_year()[:, None] + (minutes * 60e6).astype("timedelta64[us]")).ravel()
    path = sun_path(moments, place.lon_deg, place.lat_deg)
    is_up = path.altitude_deg > 0.0
    zenith = 90.0 - path.altitude_deg[is_up]
    with without_pvlib_warnings():
        extra = np.asarray(irradiance.get_extra_radiation(as_index(moments[is_up])))
        airmass = atmosphere.get_absolute_airmass(atmosphere.get_relative_airmass(zenith))
        sky = clearsky.ineichen(zenith, airmass, 3.0, dni_extra=extra)
    powers = np.zeros((3, len(moments)))
    powers[:, is_up] = [sky[part] for part in ("ghi", "dni", "dhi")]
    return powers.reshape(3, len(hours_of_year()), -1).mean(axis=2)


def clear_sky_hours(place: Place, first_min: float = 0.0) -> np.ndarray:
    """Return GHI, DNI and DHI (3, 8760), means of hours that start ``first_min`` after those of UTC."""
    return _clear_sky(place, first_min, 60.0)


def clear_sky_moments(place: Place, first_min: float) -> np.ndarray:
    """Return GHI, DNI and DHI (3, 8760) of moments ``first_min`` after the hours of UTC."""
    return _clear_sky(place, first_min, 0.0)


def rolled(powers: np.ndarray, zone_hours: float) -> np.ndarray:
    """Return powers by the hours of UTC as powers by those of a whole-hour zone."""
    return np.roll(powers, round(zone_hours), axis=-1)


def local_hours(place: Place) -> np.ndarray:
    """Return GHI, DNI and DHI (3, 8760) as means of the hours of a place's standard time."""
    whole = np.floor(place.zone_hours)
    return rolled(clear_sky_hours(place, -60.0 * (place.zone_hours - whole)), whole)


def write_epw(
    path: Path, place: Place, powers: np.ndarray, data_source: str = "TMY", city: str = "M\u00fcnchen", comment: str = ""
) -> Path:
    """Write an EPW file whose hours 1 to 24 have powers (3, 8760)."""
    lines = [
        f"LOCATION,{city},-,DEU,{data_source},108660,{place.lat_deg:.3f},{place.lon_deg:.3f},{place.zone_hours},250.0",
        "DESIGN CONDITIONS,0", "TYPICAL/EXTREME PERIODS,0", "GROUND TEMPERATURES,0", "HOLIDAYS/DAYLIGHT SAVINGS,No,0,0,0",
        "COMMENTS 1,test", f"COMMENTS 2{comment}", "DATA PERIODS,1,1,Data,Sunday, 1/ 1,12/31",
    ]  # fmt: skip
    for start, (ghi, dni, dhi) in zip(hours_of_year().tolist(), powers.T.tolist(), strict=True):
        head = f"{SOURCE_YEARS[start.month - 1]},{start.month},{start.day},{start.hour + 1},60,?0,5.0,1.0,80,101325,9999,9999,300"
        lines.append(f"{head},{ghi:.3f},{dni:.3f},{dhi:.3f},0,0,0,0,180,1,5,5,20,9999,9,0,10,0.1,0,88,0.2,0,1")
    path.write_bytes("\n".join(lines).encode("latin-1"))
    return path


def write_tmy3(path: Path, place: Place, powers: np.ndarray) -> Path:
    """Write a TMY3 file whose hours that end at 01:00 to 24:00 have powers (3, 8760)."""
    lines = [f'725650,"DENVER",CO,{place.zone_hours},{place.lat_deg},{place.lon_deg},1650', TMY3_HEADER]
    for start, (ghi, dni, dhi) in zip(hours_of_year().tolist(), powers.T.tolist(), strict=True):
        day = f"{start.month:02d}/{start.day:02d}/{SOURCE_YEARS[start.month - 1]}"
        lines.append(f"{day},{start.hour + 1:02d}:00,0,0,{ghi:.3f},{dni:.3f},{dhi:.3f}")
    path.write_text("\n".join(lines))
    return path


def _pvgis_times() -> list[str]:
    """Return the stamps of a TMY of PVGIS."""
    return [f"{SOURCE_YEARS[start.month - 1]}{start:%m%d:%H00}" for start in hours_of_year().tolist()]


def write_pvgis_csv(path: Path, place: Place, powers: np.ndarray, offset_hours: float | None) -> Path:
    """Write a TMY of PVGIS as CSV whose hours of UTC have powers (3, 8760)."""
    lines = [
        f"Latitude (decimal degrees): {place.lat_deg}",
        f"Longitude (decimal degrees): {place.lon_deg}",
        "Elevation (m): 250.0",
    ]
    lines += [] if offset_hours is None else [f"Irradiance Time Offset (h): {offset_hours}"]
    lines += ["month,year", *(f"{month},{year}" for month, year in enumerate(SOURCE_YEARS, 1))]
    lines.append("time(UTC),T2m,RH,G(h),Gb(n),Gd(h),IR(h),WS10m,WD10m,SP")
    for time, (ghi, dni, dhi) in zip(_pvgis_times(), powers.T.tolist(), strict=True):
        lines.append(f"{time},2.0,94.0,{ghi:.2f},{dni:.2f},{dhi:.2f},283.0,0.7,257.0,99870.0")
    path.write_text("\r\n".join([*lines, "", "T2m: 2-m air temperature (degree Celsius)", ""]))
    return path


def write_pvgis_json(path: Path, place: Place, powers: np.ndarray, offset_hours: float | None) -> Path:
    """Write a TMY of PVGIS as JSON whose hours of UTC have powers (3, 8760)."""
    position = {"latitude": place.lat_deg, "longitude": place.lon_deg, "elevation": 250.0}
    if offset_hours is not None:
        position["irradiance_time_offset"] = offset_hours
    rows = [
        {"time(UTC)": time, "T2m": 2.0, "G(h)": ghi, "Gb(n)": dni, "Gd(h)": dhi}
        for time, (ghi, dni, dhi) in zip(_pvgis_times(), powers.round(2).T.tolist(), strict=True)
    ]
    months = [{"month": month, "year": year} for month, year in enumerate(SOURCE_YEARS, 1)]
    content = {"inputs": {"location": position}, "outputs": {"months_selected": months, "tmy_hourly": rows}, "meta": {"inputs": {}}}
    path.write_text(json.dumps(content))
    return path


def write_csv(path: Path, header: Sequence[str], times: Sequence[str], *values: np.ndarray, separator: str = ",") -> Path:
    """Write a CSV of times and values (n,) each."""
    rows = [[time, *(f"{value:.6g}" for value in row)] for time, row in zip(times, np.transpose(values).tolist(), strict=True)]
    if separator == ";":
        rows = [[value.replace(".", ",") for value in row] for row in rows]
    path.write_text("\n".join(separator.join(row) for row in [list(header), *rows]))
    return path
