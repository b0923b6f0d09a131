"""Read points, lines and polygons from vector files with GDAL, in a requested CRS."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from skugga.terrain.errors import SourceError
from skugga.terrain.geo.axes import axes_of
from skugga.terrain.geo.world import AxesTransformer, transformer
from skugga.terrain.level.data_files import check_geodata
from skugga.terrain.level.linked_files import is_remote

MAX_EDGE_LENGTH_BY_IS_GEOGRAPHIC = {True: 0.01, False: 1000.0}
"""Maximum length of an edge before it is transformed: for a geographic CRS (``True``) in degrees, for others in CRS units.

Longer edges are divided first, since a transformation bends straight lines. The remaining bend is a few centimetres.
"""

MAX_COORDINATE_BY_IS_GEOGRAPHIC = {True: 540.0, False: 1e9}
"""Maximum absolute value of a valid coordinate: for a geographic CRS (``True``) in degrees, for others in CRS units."""

MAX_LATITUDE = 90.0 + 1e-6
"""Maximum latitude in degrees, with a tolerance for rounding in files."""

MAX_COORDINATE_COUNT = 50_000_000
"""Maximum number of points of a file's lines and outlines after long edges are divided: some gigabytes."""

MAX_CROSSINGS = 200_000
"""Maximum number of crossings of edges in a file's invalid polygons. Repairing so many takes some ten seconds."""

_EDGE_BATCH_SIZE = 64

_TABLE_REMEDY = "Use columns lon and lat in degrees, or a format with a CRS such as GeoPackage"

_POINT, _POLYGON = 0, 3  # shapely's type ids


SINGLE_LAYER_SUFFIXES = (".geojson", ".shp", ".fgb")
"""Suffixes of files with one layer. Listing the layers of a large GeoJSON takes as long as reading it."""

INSPECTED_FEATURE_COUNT, MAX_INSPECTED_LAYERS = 100, 100
"""Number of features that show a layer's kinds of geometry, and the maximum number of layers that are inspected."""

TEXT_TABLE_SUFFIXES = (".csv", ".tsv", ".psv")
"""Suffixes of GDAL's driver for text tables."""

TABLE_COORDINATE_COLUMNS = (
    (("lon", "longitude", "lng", "long"), ("lat", "latitude"), "EPSG:4326"),
    (("x", "easting"), ("y", "northing"), None),
)
"""Columns of a text table that hold points: the names of x, those of y, and the CRS. Case does not matter."""

HOLE_OUTSIDE_MESSAGE = "Hole lies outside shell"
"""Start of GEOS's message for a polygon with a hole outside of it. The hole's coordinates follow."""


@dataclass(frozen=True, eq=False)
class Features:
    """The features of a layer of a file.

    Attributes
    ----------
    name
        The file.
    geometry
        (n,) two-dimensional shapely geometries. None is empty, and all polygons are valid.
    attributes
        (n,) values of each requested attribute, by name.
    number_in_layer
        int (n,), the number of each feature in the layer, from 1.
    layer_feature_count
        Number of features in the layer, omitted ones included.
    fid
        int (n,), GDAL's identifiers.
    """

    name: str
    geometry: np.ndarray
    attributes: dict[str, np.ndarray]
    number_in_layer: np.ndarray
    layer_feature_count: int
    fid: np.ndarray

    def __getitem__(self, rows: np.ndarray) -> Features:
        """Return the features with the indices ``rows``, which may repeat."""
        attributes = {name: values[rows] for name, values in self.attributes.items()}
        return Features(
            self.name, self.geometry[rows], attributes, self.number_in_layer[rows], self.layer_feature_count, self.fid[rows]
        )

    def label(self, row: int | np.integer) -> str:
        """Return a text that names a feature by its number, and by GDAL's identifier if it does not count from 0 or 1."""
        number, fid = int(self.number_in_layer[row]), int(self.fid[row])
        return f"feature {number} of {self.layer_feature_count}" + ("" if fid in (number, number - 1) else f" (fid {fid})")

    @property
    def omitted_count(self) -> int:
        """Number of features that were omitted because they have no geometry."""
        return self.layer_feature_count - len(np.unique(self.number_in_layer))


@dataclass(frozen=True)
class VectorLayer:
    """A layer of a file.

    Attributes
    ----------
    name
        The layer's name; ``None`` for the only layer.
    other_layers
        The other layers with geometries of the same kind.
    """

    name: str | None = None
    other_layers: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Texts that tell the user which of several layers was chosen; empty for a file with one layer."""
        if not self.other_layers:
            return () if self.name is None else (f"layer '{self.name}'",)
        return (f"layer '{self.name}', not {', '.join(self.other_layers)} (the key layer selects another one)",)


def vector_layer(
    source: str,
    dimensions: Sequence[int],
    name: str | None = None,
    accepts_attributes: Callable[[tuple[str, ...]], bool] | None = None,
) -> VectorLayer:
    """Return the layer called ``name``; without a name, the first layer with geometries of one of the ``dimensions``.

    Dimensions are 0 for points, 1 for lines and 2 for polygons. If several layers have such geometries, the first one whose
    attribute names ``accepts_attributes`` accepts is preferred. Raises ``SourceError``.
    """
    check_geodata(source)
    if name is None and source.lower().endswith(SINGLE_LAYER_SUFFIXES):
        return VectorLayer()
    with _gdal_errors(source):
        import pyogrio

        names = [str(row[0]) for row in pyogrio.list_layers(source)]
        if name is not None:
            if name not in names:
                remedy = f"Use one of {', '.join(names)}" if names else "Use a file with layers"
                raise SourceError(source, f"no layer '{name}'", remedy)
            return VectorLayer(name)
        if len(names) < 2:
            return VectorLayer()
        dimensions_by_layer = {layer_name: _dimensions_of(source, layer_name) for layer_name in names[:MAX_INSPECTED_LAYERS]}
    candidates = [layer_name for layer_name in dimensions_by_layer if dimensions_by_layer[layer_name] & set(dimensions)]
    if not candidates:  # reading the layer reports its geometries
        return VectorLayer(next((layer_name for layer_name in dimensions_by_layer if dimensions_by_layer[layer_name]), names[0]))
    chosen = candidates[0]
    if accepts_attributes is not None and len(candidates) > 1:
        chosen = next((layer_name for layer_name in candidates if accepts_attributes(attribute_names(source, layer_name))), chosen)
    return VectorLayer(chosen, tuple(layer_name for layer_name in candidates if layer_name != chosen))


def _dimensions_of(source: str, layer: str) -> set[int]:
    """Return the dimensions of a layer's first geometries (0: points, 1: lines, 2: polygons); empty if it has none."""
    import pyogrio

    _, _, wkb, _ = pyogrio.raw.read(source, layer=layer, columns=[], force_2d=True, max_features=INSPECTED_FEATURE_COUNT)
    geometry = shapely.from_wkb(wkb if wkb is not None else np.empty(0, object), on_invalid="ignore")
    return set(shapely.get_dimensions(geometry[~(shapely.is_missing(geometry) | shapely.is_empty(geometry))]).tolist())


def read_features(
    source: str, crs: CRS, attributes: Sequence[str] = (), optional_attributes: Sequence[str] = (), layer: VectorLayer | None = None
) -> Features:
    """Read a layer of a vector file into ``crs``, with x before y.

    Attributes that are times become text in ISO 8601, booleans the text "true" or "false". A list of one value counts as the
    value. Points of a text table come from the columns ``TABLE_COORDINATE_COLUMNS``, unless the table has a column WKT.

    If ``crs`` is an engineering CRS, files without a CRS or in another engineering CRS with the same unit count as files in
    ``crs``.

    Parameters
    ----------
    source
        The file.
    crs
        The CRS of the result.
    attributes
        Names of attributes that the layer must have.
    optional_attributes
        Names of attributes that are read if the layer has them.
    layer
        The layer. Default: the first one.

    Raises
    ------
    SourceError
        The file is missing, is no vector file, or has no features or no CRS. Or it lacks an attribute. Or it has geometries that
        are damaged or cannot be transformed; the error names the feature.
    """
    check_geodata(source)
    import pyogrio  # imported here: it imports pandas if that is installed, which takes 0.5 s
    from pyogrio.errors import DataLayerError, DataSourceError

    names, layer_name = (
        list(dict.fromkeys([*attributes, *optional_attributes])),
        0 if layer is None or layer.name is None else layer.name,
    )
    is_table = source.lower().endswith(TEXT_TABLE_SUFFIXES)
    options, table_crs = _table_coordinates(attribute_names(source, layer_name)) if is_table else ({}, None)
    try:
        with _without_warnings():
            # Attributes are not checked first, since any query reads a large GeoJSON from end to end.
            meta, fid, wkb, columns = pyogrio.raw.read(
                source, layer=layer_name, columns=names, force_2d=True, return_fids=True, datetime_as_string=True, **options
            )
            geometry = shapely.from_wkb(wkb if wkb is not None else np.empty(0, object), on_invalid="ignore")
    except (DataSourceError, DataLayerError, shapely.errors.GEOSException, ValueError) as error:
        attribute_names(source, layer_name)  # raises a clearer error if the file is missing or has no vectors
        raise SourceError(source, _gdal_message(error, source), "Use an undamaged vector file") from None
    for name in attributes:
        if name not in meta["fields"]:
            available = attribute_names(source, layer_name)
            remedy = f"Use one of {', '.join(available)}" if available else "Use a file with attributes"
            raise SourceError(source, f"no attribute '{name}'", remedy)
    values = {
        name: _boolean_texts(column) if kind == "bool" else _unpacked_values(column)
        for name, kind, column in zip(meta["fields"], meta["dtypes"], columns, strict=True)
    }
    features = Features(source, geometry, values, np.arange(1, len(geometry) + 1), len(geometry), fid)
    missing = shapely.is_missing(geometry)
    for row in np.flatnonzero(missing):
        if wkb[row] is not None:
            raise SourceError(source, f"{features.label(row)}: {_wkb_problem(wkb[row])}", "Use undamaged geometries")
    geometry[missing] = shapely.Point()
    if shapely.is_empty(geometry).all():
        problem = "no feature with a geometry" if len(fid) else "no features"
        raise SourceError(source, problem, _TABLE_REMEDY if is_table else "Use points or polygons")
    # A column WKT goes before the other columns, and then the geometry type is unknown.
    file_crs = _layer_crs(source, meta["crs"] or (table_crs if meta["geometry_type"] == "Point" else None), crs)
    axes = axes_of(file_crs)
    if not axes.are_standard:
        geometry[:] = shapely.transform(geometry, axes.xy, interleaved=False)
    _check_coordinates(features, file_crs, crs, *shapely.get_coordinates(geometry, return_index=True))
    _check_holes(features)
    # Polygons are repaired twice: before the projection, since edges are divided correctly only in valid ones, and after it, since
    # it may fold them.
    geometry[:] = _repaired_polygons(source, geometry)
    if not same_coordinates(file_crs, crs):
        geometry[:] = _repaired_polygons(source, _transformed_geometry(features, file_crs, crs))
    nonempty = np.flatnonzero(~shapely.is_empty(geometry))
    if not len(nonempty):
        raise SourceError(source, "only polygons without an area", "Use points or polygons with an area")
    return features[nonempty]


def _table_coordinates(names: Sequence[str]) -> tuple[dict[str, str], str | None]:
    """Return GDAL's options for reading points from the columns ``names`` of a text table, and the CRS of the points."""
    for x_names, y_names, crs in TABLE_COORDINATE_COLUMNS:
        x, y = ([name for name in names if name.strip().lower() in recognised] for recognised in (x_names, y_names))
        if x and y:
            return {"X_POSSIBLE_NAMES": x[0], "Y_POSSIBLE_NAMES": y[0]}, crs
    return {}, None


def _boolean_texts(values: np.ndarray) -> np.ndarray:
    """Return booleans as texts, object (n,). Missing values are ``None``."""
    return np.array([None if value != value else "true" if value else "false" for value in values.tolist()], object)


def _unpacked_values(values: np.ndarray) -> np.ndarray:
    """Return values (n,), with lists of one value replaced by the value.

    GDAL makes lists of all values of a GeoJSON attribute if some features have lists.
    """
    if values.dtype != object or not any(isinstance(value, np.ndarray) for value in values):
        return values
    unpacked = np.empty(len(values), object)
    for row, value in enumerate(values):
        unpacked[row] = value[0] if isinstance(value, np.ndarray) and value.size == 1 else value
    return unpacked


def attribute_names(source: str, layer: str | int = 0) -> tuple[str, ...]:
    """Return the names of the attributes of a layer of a vector file. Raises ``SourceError``."""
    check_geodata(source)
    with _gdal_errors(source):
        import pyogrio

        return tuple(str(name) for name in pyogrio.read_info(source, layer=layer)["fields"])


def numeric_attribute(features: Features, attribute: str, number_of: Callable[[str], float] = float) -> np.ndarray:
    """Return an attribute as float64 (n,), NaN where it is missing.

    ``number_of`` parses text and raises ``ValueError``. Raises ``SourceError``, which names the feature, for text that is no
    number.
    """
    values = features.attributes[attribute]
    if values.dtype.kind in "iufb":
        return values.astype(np.float64)
    result = np.full(len(values), np.nan)
    for row, value in enumerate(values):
        if value is None or (isinstance(value, str) and not value.strip()):
            continue
        try:
            result[row] = number_of(value) if isinstance(value, str) else float(value)
        except (TypeError, ValueError):
            problem = f"{attribute} = {value} at {features.label(row)} is no number"
            raise SourceError(features.name, problem, f"Use numbers in the attribute '{attribute}'") from None
    return result


def transformer_between(source: str, file_crs: CRS, crs: CRS, inverse: bool = False) -> Transformer | AxesTransformer:
    """Return the transformation from a file's CRS to another one, or the reverse one with ``inverse``.

    Raises ``SourceError`` if none exists.
    """
    try:
        return transformer(crs, file_crs) if inverse else transformer(file_crs, crs)
    except ProjError:
        problem = f"its CRS '{file_crs.name}' cannot be transformed into '{crs.name}'"
        raise SourceError(source, problem, "Use a file in another CRS") from None


def same_coordinates(file_crs: CRS, crs: CRS) -> bool:
    """Return whether coordinates, x before y, have the same meaning in both CRSs.

    Engineering CRSs with the same unit count as having the same origin.
    """
    if file_crs.is_engineering and crs.is_engineering:
        return file_crs.axis_info[0].unit_conversion_factor == crs.axis_info[0].unit_conversion_factor
    return file_crs.equals(crs, ignore_axis_order=True)


def _layer_crs(source: str, crs_text: str | None, target: CRS) -> CRS:
    """Return the CRS of a layer from the text that GDAL reports (``None`` without a CRS), or else an engineering CRS ``target``.

    Raises ``SourceError`` if the layer has no CRS and ``target`` is no engineering CRS, or if PROJ does not know its CRS.
    ``source`` is the file's name, for the message.
    """
    try:
        if crs_text:
            return CRS.from_user_input(crs_text)
    except CRSError:
        raise SourceError(source, "a CRS that PROJ does not understand", "Use a vector file with a CRS that PROJ knows") from None
    if target.is_engineering:
        return target
    hint = " (its .prj file is missing)" if source.lower().endswith(".shp") else ""
    remedy = _TABLE_REMEDY if source.lower().endswith(TEXT_TABLE_SUFFIXES) else "Use a vector file with a CRS"
    raise SourceError(source, f"no coordinate reference system{hint}", remedy)


def _transformed_geometry(features: Features, file_crs: CRS, crs: CRS) -> np.ndarray:
    """Return the geometries (n,) of features in the CRS ``crs``. Long edges are divided first.

    Raises ``SourceError`` for coordinates that cannot be transformed.
    """
    source, geometry = features.name, features.geometry
    edged = shapely.get_dimensions(geometry) > 0
    check_divided_size(source, geometry[edged], MAX_EDGE_LENGTH_BY_IS_GEOGRAPHIC[file_crs.is_geographic])
    geometry[edged] = shapely.segmentize(geometry[edged], MAX_EDGE_LENGTH_BY_IS_GEOGRAPHIC[file_crs.is_geographic])
    before, index = shapely.get_coordinates(geometry, return_index=True)
    after = np.column_stack(transformer_between(source, file_crs, crs).transform(before[:, 0], before[:, 1]))
    _check_coordinates(features, file_crs, crs, before, index, after)
    if len(before) == len(geometry) and (shapely.get_type_id(geometry) == _POINT).all():
        return shapely.points(after)  # five times as fast as ``set_coordinates``
    return shapely.set_coordinates(geometry, after)


def _check_coordinates(
    features: Features,
    file_crs: CRS,
    crs: CRS,
    file_coordinates: np.ndarray,
    feature_rows: np.ndarray,
    transformed_coordinates: np.ndarray | None = None,
) -> None:
    """Raise ``SourceError`` for coordinates that cannot be transformed from ``file_crs`` into ``crs``.

    ``file_coordinates`` (n, 2) are the file's coordinates, ``feature_rows`` (n,) the row in ``features`` that each belongs to, and
    ``transformed_coordinates`` (n, 2) the transformed ones. Without ``transformed_coordinates`` only the range of
    ``file_coordinates`` is checked.
    """
    in_degrees = file_crs.is_geographic and file_crs.axis_info[0].unit_name == "degree"
    limits = (
        MAX_COORDINATE_BY_IS_GEOGRAPHIC[file_crs.is_geographic],
        MAX_LATITUDE if in_degrees else MAX_COORDINATE_BY_IS_GEOGRAPHIC[file_crs.is_geographic],
    )
    valid = np.abs(file_coordinates) <= limits if transformed_coordinates is None else np.isfinite(transformed_coordinates)
    invalid_rows = np.flatnonzero(~valid.all(axis=1))
    if len(invalid_rows):
        coordinates_text = ", ".join(f"{v:.10g}" for v in file_coordinates[invalid_rows[0]])
        raise SourceError(
            features.name,
            f"{features.label(feature_rows[invalid_rows[0]])}: the coordinates {coordinates_text} of '{file_crs.name}' cannot be "
            f"transformed into '{crs.name}'",
            "Correct the coordinates or the file's CRS",
        )  # fmt: skip


def check_divided_size(source: str, geometry: np.ndarray, max_edge_length: float) -> None:
    """Raise ``SourceError`` for lines and outlines with too many points after edges longer than ``max_edge_length`` are divided."""
    count = float(np.sum(shapely.get_num_coordinates(geometry) + np.ceil(shapely.length(geometry) / max_edge_length)))
    if count > MAX_COORDINATE_COUNT:
        excess_text, limit = f"lines of {count:.3g} points {max_edge_length:g} units apart", f"{MAX_COORDINATE_COUNT:.3g}"
        raise SourceError.over_limit(source, excess_text, limit, "Use shorter lines")


def _check_crossings(source: str, polygons: np.ndarray) -> None:
    """Raise ``SourceError`` for polygons whose edges cross too often. Repairing takes time for each crossing."""
    count = 0
    for polygon in polygons:
        xy, ring = shapely.get_coordinates(shapely.get_rings(shapely.get_parts(polygon)), return_index=True)
        is_edge = ring[1:] == ring[:-1]
        edges = shapely.linestrings(np.stack([xy[:-1][is_edge], xy[1:][is_edge]], axis=1))
        tree = shapely.STRtree(edges)
        for first in range(0, len(edges), _EDGE_BATCH_SIZE):
            count += tree.query(edges[first : first + _EDGE_BATCH_SIZE], predicate="crosses").shape[1] / 2
            if count > MAX_CROSSINGS:
                problem = f"polygons that cross themselves more than {MAX_CROSSINGS} times"
                raise SourceError(source, problem, "Use valid polygons")


def _check_holes(features: Features) -> None:
    """Raise ``SourceError`` for a polygon with a hole outside of it. Repairing would turn the hole into a second polygon."""
    invalid = np.flatnonzero((shapely.get_dimensions(features.geometry) == 2) & ~shapely.is_valid(features.geometry))
    for row, reason in zip(invalid, shapely.is_valid_reason(features.geometry[invalid]), strict=True):
        if reason.startswith(HOLE_OUTSIDE_MESSAGE):
            place = ", ".join(reason.removeprefix(HOLE_OUTSIDE_MESSAGE).strip("[]").split())
            problem = f"{features.label(row)}: a hole outside of its polygon, at {place}"
            raise SourceError(
                features.name, problem, "Keep holes within their polygons, and use a multi-polygon for several buildings"
            )


def _repaired_polygons(source: str, geometry: np.ndarray) -> np.ndarray:
    """Return the geometries, with invalid polygons repaired in place; a polygon becomes empty if no area is left.

    Raises ``SourceError`` if repairing would take too long.
    """
    with_area = shapely.get_dimensions(geometry) == 2
    invalid = np.flatnonzero(with_area & ~shapely.is_valid(geometry))
    _check_crossings(source, geometry[invalid])
    for i in invalid:
        # The method "linework" takes a hundred times as long for polygons with many crossings.
        valid = shapely.make_valid(geometry[i], method="structure", keep_collapsed=False)
        parts = shapely.get_parts(shapely.get_parts(valid))  # of a collection's multi-polygons
        geometry[i] = shapely.union_all(parts[shapely.get_type_id(parts) == _POLYGON])
    return geometry


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Suppress GDAL's warnings on a file. Problems that matter are raised as errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        yield


@contextmanager
def _gdal_errors(source: str) -> Iterator[None]:
    """Turn GDAL's errors on a file into one ``SourceError``."""
    from pyogrio.errors import DataLayerError, DataSourceError

    if not is_remote(source) and not Path(source).exists():
        raise SourceError(source, "no such file", "Use a vector file that GDAL reads")
    try:
        with _without_warnings():
            yield
    except DataLayerError:
        raise SourceError(source, "no layer", "Use a vector file with features") from None
    except (DataSourceError, UnicodeDecodeError) as error:
        raise SourceError(source, _gdal_message(error, source), "Use a vector file that GDAL reads") from None


def _wkb_problem(wkb: bytes) -> str:
    """Return a phrase that describes why a geometry (WKB) cannot be parsed."""
    try:
        shapely.from_wkb(wkb)
    except shapely.errors.GEOSException as error:
        return str(error).partition(": ")[2].strip() or "a damaged geometry"
    return "a damaged geometry"


def _gdal_message(error: Exception, source: str) -> str:
    """Return GDAL's message without its lists of drivers and without the path."""
    text = str(error).split(";")[0].replace(f"'{source}'", "the file").replace(source, "the file").strip().rstrip(".")
    return text or "it cannot be opened"
