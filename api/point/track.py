"""Points from files, tracks with times of arrival, and the sun at many points."""

from __future__ import annotations

import csv
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from skugga.api.point.report import point_surroundings, reported_sun, requested_clock, requested_day
from skugga.api.point.values import MAX_POINTS, PointQuery, PointRow, TrackPoint
from skugga.shadows.point.sun_angles import sun_directions
from skugga.shadows.point.sun_day import sampled_sun_hours
from skugga.terrain.errors import InputError, SourceError
from skugga.terrain.geo.sun import Sun
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, WGS84
from skugga.terrain.level.level import parse_sun
from skugga.terrain.scene import Scene

TIME_FIELDS, HEIGHT_FIELDS = ("time", "arrival", "datetime"), ("height", "height_m")
"""Names of columns or attributes for the time of a point and for its height above the ground, in order of preference."""
LON_FIELDS, LAT_FIELDS = ("lon", "longitude", "lng", "x"), ("lat", "latitude", "y")
"""Names of columns for longitude and latitude in degrees, in order of preference."""


def read_points(path: Path, height_m: float = 0.0) -> list[TrackPoint]:
    """Return the points of a file: a CSV with columns lon and lat, or any vector file that GDAL reads.

    The columns or attributes ``time`` and ``height`` are optional; ``height_m`` is the default height, metres.
    Raises ``SourceError`` or ``InputError``.
    """
    points = _csv_points(path, height_m) if path.suffix.lower() == ".csv" else _vector_points(path, height_m)
    if len(points) > MAX_POINTS:
        raise InputError.over_limit("--points", f"{len(points)} points", str(MAX_POINTS), "Split the file")
    return points


def read_track(path: Path, max_spacing_m: float, height_m: float = 0.0) -> list[TrackPoint]:
    """Return the points of a line: its vertices, and points between them at most ``max_spacing_m`` metres apart.

    Raises the errors of ``read_points``.
    """
    import shapely

    from skugga.terrain.geo.vectors import read_features, vector_layer

    features = read_features(str(path), LONGITUDE_LATITUDE, layer=vector_layer(str(path), (1,)))
    lines = [part for part in shapely.get_parts(features.geometry) if part.geom_type == "LineString"]
    if not lines:
        raise SourceError(str(path), f"has {features.geometry[0].geom_type} geometries and no line", "Give a file with a line")
    points: list[TrackPoint] = []
    for lon, lat in shapely.get_coordinates(np.array(lines, object)):
        if points:
            previous = points[-1]
            azimuth, _, distance_m = WGS84.inv(previous.lon_deg, previous.lat_deg, lon, lat)
            if distance_m == 0.0:
                continue
            count = int(np.ceil(distance_m / max_spacing_m))
            if len(points) + count > MAX_POINTS:
                raise InputError("--every", max_spacing_m, f"a distance that makes at most {MAX_POINTS} points")
            for n in range(1, count):
                position = WGS84.fwd(previous.lon_deg, previous.lat_deg, azimuth, distance_m * n / count)
                points.append(TrackPoint(float(position[0]), float(position[1]), height_m))
        points.append(TrackPoint(float(lon), float(lat), height_m))
    return points


def with_arrival_times(points: list[TrackPoint], start: datetime, speed_kmh: float) -> list[TrackPoint]:
    """Return the points of a line with times of arrival at a constant speed along the ground. Raises ``InputError``.

    ``start`` is the time at the first point, and ``speed_kmh`` is the speed in km/h.
    """
    if not speed_kmh > 0.0:
        raise InputError("--speed", speed_kmh, "more than 0 km/h")
    lon, lat = np.array([(point.lon_deg, point.lat_deg) for point in points]).T
    _, _, steps_m = WGS84.inv(lon[:-1], lat[:-1], lon[1:], lat[1:])
    distance_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    return [
        replace(point, time=start + timedelta(seconds=round(float(point_distance_m) / (speed_kmh / 3.6))))
        for point, point_distance_m in zip(points, distance_m, strict=True)
    ]


def sun_at_points(scene: Scene, points: list[TrackPoint], query: PointQuery, includes_hours: bool = True) -> list[PointRow]:
    """Return the elevation and the sun at many points and, if ``includes_hours``, the hours of direct sun on the query's date.

    A point with a time uses the sun of that time; others use the scene's sun. A point outside the level's data has only a remark.
    """
    suns = _suns_of(scene, points)
    rows = []
    for point, sun in zip(points, suns, strict=True):
        point_scene = scene if sun is None else replace(scene, sun=sun)
        point_query = query.model_copy(update={"lon": point.lon_deg, "lat": point.lat_deg, "height": point.height_m})
        try:
            surroundings = point_surroundings(point_scene, point_query)
        except InputError as error:
            rows.append(PointRow(None, None, None, str(error)))
            continue
        direct_h = None
        if includes_hours and scene.world.off_earth_reason is None:
            day = requested_day(point_scene, point_query, surroundings.place.lon_deg)
            direct_h = sampled_sun_hours(
                surroundings, day, requested_clock(point_scene, point_query, surroundings.place.lon_deg, day)
            )
        rows.append(PointRow(surroundings.place.ground_m, reported_sun(surroundings), direct_h, None))
    return rows


def _suns_of(scene: Scene, points: list[TrackPoint]) -> list[Sun | None]:
    """Return the suns of the points' times; ``None`` for points without a time."""
    timed_indices = [n for n, point in enumerate(points) if point.time is not None]
    suns: list[Sun | None] = [None] * len(points)
    if timed_indices:
        utc_s = np.array([point.time.timestamp() for point in points if point.time is not None])
        anchor = scene.world.earth_from_anchor
        for n, to_sun in zip(timed_indices, sun_directions(scene.world, utc_s), strict=True):
            east, north, up = to_sun @ anchor
            azimuth, altitude = np.degrees(np.arctan2(east, north)) % 360.0, np.degrees(np.arcsin(np.clip(up, -1.0, 1.0)))
            suns[n] = Sun(float(azimuth), float(altitude), to_sun, points[n].time)
    return suns


def _csv_points(path: Path, height_m: float) -> list[TrackPoint]:
    """Return the points of a CSV. ``height_m`` is the height above the ground of points without one. Raises ``SourceError``."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SourceError(
            str(path), getattr(error, "strerror", None) or str(error), "Give a CSV with columns lon and lat"
        ) from None
    names = {name.strip().lower(): name for name in reader.fieldnames or () if name}
    columns = [next((names[word] for word in words if word in names), None) for words in (LON_FIELDS, LAT_FIELDS)]
    if None in columns:
        raise SourceError(str(path), f"has no columns lon and lat, only {', '.join(names) or 'none'}", "Add both, in degrees")
    time, height = (next((names[word] for word in words if word in names), None) for words in (TIME_FIELDS, HEIGHT_FIELDS))
    points = []
    for number, row in enumerate(rows, 2):
        try:
            lon, lat = (float(row[column or ""]) for column in columns)
            point_height_m = float(row[height]) if height and row[height] else height_m
        except (TypeError, ValueError):
            words = f"line {number}: {','.join(str(v) for v in row.values())[:60]} has no valid coordinates or height"
            raise SourceError(str(path), words, "Give numbers") from None
        points.append(TrackPoint(lon, lat, point_height_m, _parse_moment(path, f"line {number}", row[time] if time else None)))
    return points


def _vector_points(path: Path, height_m: float) -> list[TrackPoint]:
    """Return the points of a vector file.

    ``height_m`` is the height above the ground of points without one. Raises ``SourceError``.
    """
    from skugga.terrain.geo.vectors import attribute_names, numeric_attribute, read_features, vector_layer
    from skugga.terrain.ground.length_text import length_m

    layer = vector_layer(str(path), (0,))
    names = {name.strip().lower(): name for name in attribute_names(str(path), layer.name or 0)}
    time, height = (next((names[word] for word in words if word in names), None) for words in (TIME_FIELDS, HEIGHT_FIELDS))
    attributes = [name for name in (time, height) if name is not None]
    features = read_features(str(path), LONGITUDE_LATITUDE, attributes, layer=layer)
    kinds = {geometry.geom_type for geometry in features.geometry}
    if kinds != {"Point"}:
        raise SourceError(str(path), f"has {', '.join(sorted(kinds))} geometries", "Give a file of points only")
    heights = np.full(len(features.geometry), height_m)
    if height is not None:
        heights = np.nan_to_num(numeric_attribute(features, height, length_m), nan=height_m)
    times = [None] * len(heights) if time is None else features.attributes[time]
    return [
        TrackPoint(float(point.x), float(point.y), float(point_height_m), _parse_moment(path, features.label(row), moment))
        for row, (point, point_height_m, moment) in enumerate(zip(features.geometry, heights, times, strict=True))
    ]


def _parse_moment(path: Path, location: str, value: object) -> datetime | None:
    """Convert a time attribute of a file; an empty one gives ``None``. Raises ``SourceError`` for a time without an offset.

    ``location`` names the row of the file in the error.
    """
    text = "" if value is None else str(value).strip()
    if text in ("", "NaT", "nan", "None"):
        return None
    try:
        spec = parse_sun(text, None, None)
    except InputError as error:
        raise SourceError(str(path), f"{location}: the time '{text}' is not allowed", f"Allowed: {error.allowed}") from None
    assert spec is not None
    return spec.time
