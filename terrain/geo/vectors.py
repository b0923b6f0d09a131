"""Points, lines and polygons from any vector file that GDAL reads, in the CRS they are wanted in."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from terrain.errors import SourceError
from terrain.geo.axes import axes_of
from terrain.geo.world import AxesTransformer, transformer
from terrain.level.data_files import check_geodata
from terrain.level.linked_files import is_remote

LONGEST_EDGE = {True: 0.01, False: 1000.0}
"""Edges longer than this are divided before they are projected, since straight lines do not stay straight: degrees in
geographic CRS, units in others. What is left of their bend is a few centimetres."""

FARTHEST = {True: 540.0, False: 1e9}
"""Coordinates beyond this are none: degrees in geographic CRS, units in others."""

MOST_COORDINATES = 50_000_000
"""Points of a file's lines and outlines when long edges are divided: some gigabytes."""

MOST_CROSSINGS = 200_000
"""Of the edges of a file's invalid polygons: mending them takes some ten seconds."""

_EDGES_AT_ONCE = 64

_POINT, _POLYGON = 0, 3  # shapely's type ids


@dataclass(frozen=True, eq=False)
class Features:
    """The features of a file's first layer.

    ``geometry`` holds n two-dimensional shapely geometries, none of them empty, polygons all valid; ``attributes`` the
    asked ones, (n,) each. ``dropped`` counts features left out for want of a geometry.
    """

    name: str
    geometry: np.ndarray
    attributes: dict[str, np.ndarray]
    dropped: int = 0


def read_features(source: str, crs: CRS, attributes: Sequence[str] = (), usual: Sequence[str] = ()) -> Features:
    """Read the first layer of a vector file into ``crs``, x before y, with some of its attributes, and the ``usual`` ones it has.

    Where ``crs`` is an engineering CRS, files in another one of its unit, or in none, are taken to be in it.

    Raises ``SourceError`` where the file is missing, no vector file, without features or a CRS, lacks an attribute, or has
    coordinates that cannot be transformed.
    """
    check_geodata(source)
    import pyogrio  # here: where pandas is installed it imports that, half a second of every start
    from pyogrio.errors import DataLayerError, DataSourceError

    wanted = list(dict.fromkeys([*attributes, *usual]))
    try:
        with _quiet():
            # Without a look at its attributes first: large GeoJSON is read from end to end whatever is asked.
            meta, _, wkb, columns = pyogrio.raw.read(source, layer=0, columns=wanted, force_2d=True)
        geometry = shapely.from_wkb(wkb if wkb is not None else np.empty(0, object))
    except (DataSourceError, DataLayerError, shapely.errors.GEOSException, ValueError) as error:
        attribute_names(source)  # says it better where there is no such file, or no vectors in it
        raise SourceError(source, _reason(error, source), "an undamaged vector file") from None
    for name in attributes:
        if name not in meta["fields"]:
            known = attribute_names(source)
            raise SourceError(source, f"no attribute '{name}'", f"one of {', '.join(known)}" if known else "a file with attributes")
    geometry[shapely.is_missing(geometry)] = shapely.Point()
    if shapely.is_empty(geometry).all():
        raise SourceError(source, "no feature with a geometry", "points or polygons")
    own = _crs(source, meta["crs"], crs)
    axes = axes_of(own)
    if not axes.are_standard:
        geometry = shapely.transform(geometry, axes.xy, interleaved=False)
    _check_places(source, own, crs, shapely.get_coordinates(geometry))
    # Mended before, since long edges are divided rightly in valid polygons alone, and after, since a projection may fold them.
    geometry = _mended(source, geometry)
    if not same_coordinates(own, crs):
        geometry = _mended(source, _projected(source, geometry, own, crs))
    kept = np.flatnonzero(~shapely.is_empty(geometry))
    if not len(kept):
        raise SourceError(source, "only polygons without an area", "points or polygons")
    values = dict(zip(meta["fields"], columns, strict=True))
    return Features(source, geometry[kept], {name: v[kept] for name, v in values.items()}, len(geometry) - len(kept))


def attribute_names(source: str) -> tuple[str, ...]:
    """Names of the attributes of a vector file's first layer. Raises ``SourceError``."""
    import pyogrio
    from pyogrio.errors import DataLayerError, DataSourceError

    check_geodata(source)
    if not is_remote(source) and not Path(source).exists():
        raise SourceError(source, "no such file", "a vector file that GDAL reads")
    try:
        with _quiet():
            return tuple(str(name) for name in pyogrio.read_info(source, layer=0)["fields"])
    except DataLayerError:
        raise SourceError(source, "no layer", "a vector file with features") from None
    except (DataSourceError, UnicodeDecodeError) as error:
        raise SourceError(source, _reason(error, source), "a vector file that GDAL reads") from None


def numbers(features: Features, attribute: str) -> np.ndarray:
    """An attribute as float64 (n,), NaN where it is not given. Raises ``SourceError`` where it holds text that is no number."""
    values = features.attributes[attribute]
    if values.dtype.kind in "iufb":
        return values.astype(np.float64)
    if values.dtype.kind != "O":
        raise SourceError(features.name, f"{attribute} = {values[0]}", f"numbers in the attribute '{attribute}'")
    result = np.full(len(values), np.nan)
    for i, value in enumerate(values):
        if value is None or (isinstance(value, str) and not value.strip()):
            continue
        try:
            result[i] = float(value)
        except (TypeError, ValueError):
            raise SourceError(features.name, f"{attribute} = {value}", f"numbers in the attribute '{attribute}'") from None
    return result


def between(source: str, own: CRS, crs: CRS, back: bool = False) -> Transformer | AxesTransformer:
    """The transformation from a file's own CRS to another one, or ``back``. Raises ``SourceError`` where there is none."""
    try:
        return transformer(crs, own) if back else transformer(own, crs)
    except ProjError:
        raise SourceError(source, f"its CRS '{own.name}'", f"a CRS that can be transformed into '{crs.name}'") from None


def same_coordinates(own: CRS, crs: CRS) -> bool:
    """Whether coordinates mean the same in both, x before y: engineering CRS of one unit count from one origin."""
    if own.is_engineering and crs.is_engineering:
        return own.axis_info[0].unit_conversion_factor == crs.axis_info[0].unit_conversion_factor
    return own.equals(crs, ignore_axis_order=True)


def _crs(source: str, text: str | None, wanted: CRS) -> CRS:
    try:
        if text:
            return CRS.from_user_input(text)
    except CRSError:
        raise SourceError(source, "a CRS that PROJ does not understand", "a vector file with a CRS") from None
    if wanted.is_engineering:
        return wanted
    beside = " (its .prj file is missing)" if source.lower().endswith(".shp") else ""
    raise SourceError(source, f"no coordinate reference system{beside}", "a vector file with a CRS")


def _projected(source: str, geometry: np.ndarray, own: CRS, crs: CRS) -> np.ndarray:
    edged = shapely.get_dimensions(geometry) > 0
    check_divided(source, geometry[edged], LONGEST_EDGE[own.is_geographic])
    geometry[edged] = shapely.segmentize(geometry[edged], LONGEST_EDGE[own.is_geographic])
    before = shapely.get_coordinates(geometry)
    after = np.column_stack(between(source, own, crs).transform(before[:, 0], before[:, 1]))
    _check_places(source, own, crs, before, after)
    if len(before) == len(geometry) and (shapely.get_type_id(geometry) == _POINT).all():
        return shapely.points(after)  # a million points in a fifth of the time
    return shapely.set_coordinates(geometry, after)


def _check_places(source: str, own: CRS, crs: CRS, before: np.ndarray, after: np.ndarray | None = None) -> None:
    """Raise ``SourceError`` where coordinates have no place in a CRS."""
    known = np.abs(before) <= FARTHEST[own.is_geographic] if after is None else np.isfinite(after)
    bad = ~known.all(axis=1)
    if bad.any():
        place = ", ".join(f"{v:.10g}" for v in before[bad][0])
        raise SourceError(
            source, f"the coordinates {place}", f"coordinates of '{own.name}' that can be transformed into '{crs.name}'"
        )


def check_divided(source: str, geometry: np.ndarray, longest: float) -> None:
    """Raise ``SourceError`` for lines and outlines that are too many points when edges longer than ``longest`` are divided."""
    count = float(np.sum(shapely.get_num_coordinates(geometry) + np.ceil(shapely.length(geometry) / longest)))
    if count > MOST_COORDINATES:
        raise SourceError(source, f"lines of {count:.3g} points {longest:g} units apart", f"at most {MOST_COORDINATES:.3g}")


def _check_crossings(source: str, polygons: np.ndarray) -> None:
    """Raise ``SourceError`` for polygons whose edges cross too often: mending takes time for each crossing."""
    count = 0
    for polygon in polygons:
        xy, ring = shapely.get_coordinates(shapely.get_rings(shapely.get_parts(polygon)), return_index=True)
        along = ring[1:] == ring[:-1]
        edges = shapely.linestrings(np.stack([xy[:-1][along], xy[1:][along]], axis=1))
        tree = shapely.STRtree(edges)
        for first in range(0, len(edges), _EDGES_AT_ONCE):
            count += tree.query(edges[first : first + _EDGES_AT_ONCE], predicate="crosses").shape[1] / 2
            if count > MOST_CROSSINGS:
                raise SourceError(source, f"polygons that cross themselves more than {MOST_CROSSINGS} times", "valid polygons")


def _mended(source: str, geometry: np.ndarray) -> np.ndarray:
    """Geometries with invalid polygons made valid; empty where no area is left of them. Raises ``SourceError``."""
    with_area = shapely.get_dimensions(geometry) == 2
    invalid = np.flatnonzero(with_area & ~shapely.is_valid(geometry))
    _check_crossings(source, geometry[invalid])
    for i in invalid:
        # By its structure: by lines alone it takes a hundred times as long where a polygon crosses itself often.
        whole = shapely.make_valid(geometry[i], method="structure", keep_collapsed=False)
        parts = shapely.get_parts(shapely.get_parts(whole))  # of a collection's multi-polygons
        geometry[i] = shapely.union_all(parts[shapely.get_type_id(parts) == _POLYGON])
    return geometry


@contextmanager
def _quiet() -> Iterator[None]:
    """Without GDAL's remarks on a file: what matters comes as an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


def _reason(error: Exception, source: str) -> str:
    """What GDAL says, without its lists of drivers and the path once more."""
    text = str(error).split(";")[0].replace(f"'{source}'", "the file").replace(source, "the file").strip().rstrip(".")
    return text or "it cannot be opened"
