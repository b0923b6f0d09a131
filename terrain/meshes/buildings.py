"""Buildings: footprints extruded to closed blocks, with flat or sloped roofs.

- The height of a flat roof, or of the ridge (``skugga.terrain.meshes.sloped_blocks``), is the mean ground height along the
  footprint's outline plus the building's height. Heights measured in a surface raster count from the same mean, so the roof lies
  at the surface.
- Walls extend to ``WALL_DEPTH_BELOW_GROUND_M`` below the lowest ground of the outline, which avoids gaps on slopes. A floor closes
  the block.
- A building that begins above the ground, such as a bridge or the storeys over a passage, has its floor at the mean ground plus
  its base height.
- Roofs and floors are level along the vertical at every corner, so a long building follows the earth's curvature.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import shapely
from pyproj import CRS
from pyproj.exceptions import ProjError

from skugga.terrain.errors import LevelError, SourceError
from skugga.terrain.geo.vectors import Features, VectorLayer, attribute_names, check_divided_size, read_features, vector_layer
from skugga.terrain.geo.world import World, transformer
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.geolocate import bounds_text
from skugga.terrain.ground.length_attributes import matching_attribute
from skugga.terrain.level.bundled import BUNDLED
from skugga.terrain.level.level import LoadedLevel
from skugga.terrain.level.parts import MeshSpec
from skugga.terrain.meshes.body import PlacedBody
from skugga.terrain.meshes.extrusion import Blocks, extrude
from skugga.terrain.meshes.footprint_heights import base_attributes, footprint_heights, height_attributes

WALL_DEPTH_BELOW_GROUND_M = 0.5
"""Depth of walls below the lowest ground of their outline."""

MAX_BUILDING_HEIGHT_M = 1000.0
"""Maximum height of a building. A larger number is an error, perhaps of the unit."""

OUTLINE_TOLERANCE_M = 0.001
"""Tolerance for simplifying outlines."""

MAX_FOOTPRINT_CORNERS = 20_000
"""Maximum number of corners of a footprint with its courtyards. Its roof then takes up to some ten seconds."""

MAX_FILE_CORNERS = 3_000_000
"""Maximum number of corners of all footprints of a file: twelve million triangles."""

METRES_PER_DEGREE = 111_320.0

ROOF_PERCENTILE = 90.0
"""Percentile of the surface's heights in a footprint that counts as the height of its roof.

It is below chimneys and overhanging crowns, and above light wells and blurred eaves.
"""

MIN_MEASURED_HEIGHT_M = 1.5
"""Minimum height of a building in a surface raster. Lower ones are noise, a terrace, or demolished since."""

MIN_VALID_GROUND_SHARE = 0.5
"""Minimum share of a footprint that must have valid ground, or a valid surface if its height is measured."""

MAX_WRONG_FLOOR_SHARE = 0.5
"""Maximum share of a file's floors not below their roofs that counts as single errors of the data.

If more floors are wrong, all heights of floors are ignored.
"""

MAX_SAMPLES_PER_SIDE = 256
"""Maximum number of cells of a surface raster that are sampled along one side of a footprint."""

Transform = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function from coordinates (x, y) in one CRS to those in another."""

_POLYGON_TYPE_ID = 3  # shapely's type id

_POLYGON_DIMENSIONS = 2  # dimensions


@dataclass(frozen=True, eq=False)
class Buildings:
    """Blocks (extruded footprints) of a file.

    ``notes`` say which data of the file was used, ``warnings`` which data was ignored.
    """

    bodies: list[PlacedBody]
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def buildings(spec: MeshSpec, key_path: str, loaded: LoadedLevel, world: World, elevation: Elevation) -> Buildings:
    """Return closed blocks over the footprints of ``spec.source`` that lie on the terrain, one per polygon.

    Heights come from the first of these sources:

    - ``spec.height``: metres, or the name of an attribute.
    - The heights of the raster ``spec.surface`` above the raster ``spec.ground``.
    - The attributes that ``height_attributes`` recognises.

    A footprint is omitted if most of it has no ground, or if its height is unknown, not above 0, or not above its floor. It is also
    omitted if its height is measured in a raster and below ``MIN_MEASURED_HEIGHT_M``. ``key_path`` is the path of the mesh's key in
    the level file, for messages.

    Raises ``SourceError`` for an unusable file, ``LevelError`` if no source of heights exists.
    """
    assert spec.source is not None
    source = loaded.resolve(spec.source)
    layer = vector_layer(source, (_POLYGON_DIMENSIONS,), spec.layer, lambda names: bool(height_attributes(names)))
    tops, bases = _height_attributes(spec, key_path, source, layer, elevation.crs)
    features = read_features(source, elevation.crs, (*tops, *bases), layer=layer)
    polygons, feature = _outlines(features, world)
    attribute_heights = footprint_heights(features, tops, bases)
    if tops:
        height = attribute_heights.top_m[feature]
    elif spec.height is not None:
        height = np.full(len(polygons), float(spec.height))
    else:
        height = _surface_heights(polygons, elevation.crs, _open_raster(loaded, spec.surface), _open_raster(loaded, spec.ground))
    for i in np.flatnonzero(height > MAX_BUILDING_HEIGHT_M)[:1]:
        raise SourceError.over_limit(
            source,
            f"a height of {height[i]:.6g} m at {features.label(feature[i])}",
            f"{MAX_BUILDING_HEIGHT_M:.0f} m",
            "Check its unit",
        )
    with np.errstate(invalid="ignore"):
        has_height = height >= MIN_MEASURED_HEIGHT_M if spec.surface else height > 0.0
    if not has_height.any():
        named = " or ".join(f"'{name}'" for name in tops)
        required_height = f"a height above 0 in the attribute {named}"
        if spec.surface:
            required_height = f"{MIN_MEASURED_HEIGHT_M} m of {spec.surface} above {spec.ground}"
        raise SourceError(source, f"no footprint with {required_height}", "Check the heights and their unit")
    base, floor_warnings = _floor_heights(np.where(has_height, attribute_heights.base_m[feature], 0.0), height, features, feature)
    selected = has_height & ~(height <= base)
    key = shapely.get_coordinates(shapely.centroid(features.geometry))[feature[selected]]
    mean_m, lowest_m = _ground_heights_along(polygons[selected], elevation)
    on_terrain = np.isfinite(mean_m)
    if not on_terrain.any():
        spans = [bounds_text(bounds, elevation.crs) for bounds in (shapely.total_bounds(features.geometry), elevation.bounds)]
        raise SourceError(source, f"footprints within {spans[0]}", f"Use footprints on the terrain: within {spans[1]}")
    floor_m = np.where(base[selected] > 0.0, mean_m + base[selected], lowest_m - WALL_DEPTH_BELOW_GROUND_M)
    blocks = Blocks(
        polygons[selected][on_terrain], key[on_terrain], (mean_m + height[selected])[on_terrain], floor_m[on_terrain],
        (height - base)[selected][on_terrain],
    )  # fmt: skip
    extruded = extrude(blocks, world, elevation, spec)
    omitted_counts = {
        "without a height": np.count_nonzero(~has_height), "off the terrain": np.count_nonzero(~on_terrain),
        "without a geometry": features.omitted_count,
    }  # fmt: skip
    notes = [
        *layer.notes,
        *attribute_heights.notes,
        *(f"{count} footprints left out: {reason}" for reason, count in omitted_counts.items() if count),
    ]
    return Buildings(extruded.bodies, tuple(notes), (*attribute_heights.warnings, *floor_warnings, *extruded.warnings))


def _floor_heights(
    base: np.ndarray, height: np.ndarray, features: Features, feature_rows: np.ndarray
) -> tuple[np.ndarray, list[str]]:
    """Return the heights (n,) of floors above the ground, metres, and warnings about floors that are not below their roofs.

    If the share of such floors is above ``MAX_WRONG_FLOOR_SHARE``, all heights are 0. They then count from another reference, such
    as the sea.
    """
    wrong_rows = np.flatnonzero((base > 0.0) & (height <= base))
    if not len(wrong_rows):
        return base, []
    first, count = features.label(feature_rows[wrong_rows[0]]), np.count_nonzero(base)
    if len(wrong_rows) > MAX_WRONG_FLOOR_SHARE * count:
        problem = f"{len(wrong_rows)} of {count} floors are not below their roofs, such as that of {first}"
        return np.zeros_like(base), [f"{problem}. All heights of floors are ignored, and the buildings stand on the ground"]
    more_text = f", and {len(wrong_rows) - 1} more" if len(wrong_rows) > 1 else ""
    return base, [f"{first}{more_text} left out: the floor is not below the roof"]


def _height_attributes(
    spec: MeshSpec, key_path: str, source: str, layer: VectorLayer, crs: CRS
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the attributes of building heights, and of those of the heights at which buildings start.

    Both are heights above the ground. There are no names of building heights if these have another source.
    """
    if spec.surface is not None and spec.height is not None:
        raise LevelError.conflict(f"{key_path}.height", "surface and ground", "Use either height, or surface and ground")
    available_names = attribute_names(source, layer.name or 0)
    bases = base_attributes(available_names)
    if isinstance(spec.height, str):
        return (matching_attribute(spec.height, available_names),), bases
    if spec.height is not None or spec.surface is not None:
        return (), bases
    tops = height_attributes(available_names)
    if tops:
        return tops, bases
    read_features(source, crs, layer=layer)  # raises the error of a file without footprints
    attributes = f"an attribute of {source} ({', '.join(available_names) or 'it has none'})"
    raise LevelError.missing(f"{key_path}.height", f"Set it to metres or to {attributes}, or set surface and ground rasters")


def _open_raster(loaded: LoadedLevel, source: str | None) -> Elevation:
    """Return the raster that a mesh's key ``surface`` or ``ground`` names. ``source`` must not be ``None``."""
    assert source is not None
    return Elevation(source if source in BUNDLED else loaded.resolve(source))


def _outlines(features: Features, world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return the simplified polygons (n,) of all features, exterior rings counter-clockwise, and the feature's row (n,) of each."""
    parts, feature = shapely.get_parts(features.geometry, return_index=True)
    parts, part = shapely.get_parts(parts, return_index=True)  # multi-polygons inside collections
    is_polygon = shapely.get_type_id(parts) == _POLYGON_TYPE_ID
    if not is_polygon.any():
        kind = parts[0].geom_type
        raise SourceError(features.name, f"{kind} geometries", "Use polygons, or a model: .obj, .ply, .glb or .gltf")
    parts, feature = parts[is_polygon], feature[part[is_polygon]]
    unit_m = METRES_PER_DEGREE if world.crs.is_geographic else world.metres_per_unit
    # Normalized rings begin at an outermost point, which is a corner. Simplifying keeps the first point.
    parts = shapely.simplify(shapely.normalize(parts), OUTLINE_TOLERANCE_M / unit_m)
    corners = shapely.get_num_coordinates(parts)
    for count, limit, subject in (
        (corners.max(), MAX_FOOTPRINT_CORNERS, "a footprint"),
        (corners.sum(), MAX_FILE_CORNERS, "footprints"),
    ):
        if count > limit:
            raise SourceError.over_limit(features.name, f"{subject} of {count} corners", str(limit), "Simplify the outlines")
    has_area = shapely.area(parts) > (OUTLINE_TOLERANCE_M / unit_m) ** 2
    if not has_area.any():
        raise SourceError(features.name, "only polygons without an area", "Use footprints with an area")
    return shapely.orient_polygons(parts[has_area], exterior_cw=False), feature[has_area]


def _surface_heights(polygons: np.ndarray, crs: CRS, surface: Elevation, ground: Elevation) -> np.ndarray:
    """Return the height (n,) of each polygon's surface above the mean ground along its outline, metres.

    The height of the surface is the percentile ``ROOF_PERCENTILE`` of its cells in the polygon. It is NaN if the polygon is off the
    rasters.
    """
    with closing(surface), closing(ground):
        to_surface = _transform(crs, surface)
        top = np.full(len(polygons), np.nan)
        for i, polygon in enumerate(polygons):
            sampled_heights = surface.ground_m(*_sample_cells(polygon, surface, to_surface))
            if np.isfinite(sampled_heights).mean() >= MIN_VALID_GROUND_SHARE:
                top[i] = np.nanpercentile(sampled_heights, ROOF_PERCENTILE)
        outlines = shapely.transform(polygons, _transform(crs, ground), interleaved=False)
        valid = np.isfinite(top) & np.isfinite(shapely.bounds(outlines)).all(axis=1)
        heights = np.full(len(polygons), np.nan)
        heights[valid] = top[valid] - _ground_heights_along(outlines[valid], ground)[0]
        return heights


def _sample_cells(polygon: shapely.Polygon, raster: Elevation, to_raster: Transform) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates x, y (n,), in a raster's CRS, of the centres of the cells that sample a polygon.

    The cells are those with centres at least half a cell inside. Narrow buildings use all cells with centres inside, tiny ones a
    point inside. Cells may lie off the raster. Coordinates are NaN if the polygon cannot be transformed into that CRS.
    """
    cells = shapely.transform(polygon, lambda x, y: raster.cell_of(*to_raster(x, y)), interleaved=False)
    if not np.isfinite(cells.bounds).all():
        return np.array([np.nan]), np.array([np.nan])
    return raster.xy(*_cells_inside(cells))


def _cells_inside(polygon: shapely.Polygon) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns (n,) of the cells that sample a polygon in (row, col) coordinates."""
    low, high = np.ceil(polygon.bounds[:2]), np.floor(polygon.bounds[2:])
    step = np.maximum(np.ceil((high - low + 1) / MAX_SAMPLES_PER_SIDE), 1)
    row, col = (v.ravel() for v in np.meshgrid(*(np.arange(*ends) for ends in zip(low, high + 1, step, strict=True))))
    for area in (polygon.buffer(-0.5), polygon):
        inside = shapely.contains_xy(area, row, col)
        if inside.any():
            return row[inside], col[inside]
    point = polygon.representative_point()
    return np.array([point.x]), np.array([point.y])


def _transform(crs: CRS, raster: Elevation) -> Transform:
    """Return the transformation from ``crs`` to the raster's CRS. Raises ``SourceError`` if PROJ has none."""
    if raster.crs == crs or (raster.crs.is_engineering and crs.is_engineering):
        return _identity
    try:
        return transformer(crs, raster.crs).transform
    except ProjError:
        problem = f"'{crs.name}' cannot be transformed into its CRS '{raster.crs.name}'"
        raise SourceError(raster.name, problem, "Use a raster in another CRS") from None


def _identity(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates unchanged: the ``Transform`` from a CRS to itself."""
    return x, y


def _ground_heights_along(polygons: np.ndarray, elevation: Elevation) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and the lowest ground height (n,) along each polygon's outer ring, metres.

    The mean is NaN if most of the polygon has no valid ground.
    """
    corner, next_cell = elevation.xy(0, 0), elevation.xy(0, 1)
    cell = float(np.hypot(corner[0] - next_cell[0], corner[1] - next_cell[1]))
    check_divided_size(elevation.name, polygons, cell)
    outer = shapely.segmentize(shapely.get_exterior_ring(polygons), cell)
    xy, ring = shapely.get_coordinates(outer, return_index=True)
    ground = elevation.filled_ground_m(xy[:, 0], xy[:, 1])
    middle, length = (ground[1:] + ground[:-1]) / 2, np.hypot(*np.diff(xy, axis=0).T)
    valid = (ring[1:] == ring[:-1]) & np.isfinite(middle)
    total, total_length = (
        np.bincount(ring[1:][valid], weights=w[valid], minlength=len(polygons)) for w in (middle * length, length)
    )
    mean = np.divide(total, total_length, out=np.full(len(polygons), np.nan), where=total_length > 0)
    for i in np.unique(ring[np.isnan(ground) & np.isfinite(mean[ring])]):  # polygons whose outline leaves the valid ground
        if (
            np.isfinite(elevation.filled_ground_m(*_sample_cells(polygons[i], elevation, _identity))).mean()
            < MIN_VALID_GROUND_SHARE
        ):
            mean[i] = np.nan
    return mean, np.fmin.reduceat(ground, np.searchsorted(ring, np.arange(len(polygons))))
