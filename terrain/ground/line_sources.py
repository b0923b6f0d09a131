"""Read a level's roads and rivers from vector files, and drape them over its ground."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import shapely

from skugga.terrain.errors import LevelError, Problem, SourceError
from skugga.terrain.geo.vectors import attribute_names, read_features, vector_layer
from skugga.terrain.geo.world import World
from skugga.terrain.ground.draped_lines import ASPHALT, GRAVEL, RIVER, DrapedLines, line_index
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.length_attributes import attribute_lengths, check_lengths, matching_attribute
from skugga.terrain.level.level import LoadedLevel
from skugga.terrain.level.parts import LineSpec

ROAD_WIDTHS_M = {
    "motorway": 22.0, "trunk": 14.0, "primary": 9.0, "secondary": 7.5, "tertiary": 6.5, "unclassified": 5.5, "residential": 5.5,
    "living_street": 5.0, "pedestrian": 6.0, "service": 4.0, "track": 3.0, "cycleway": 2.5, "bridleway": 2.0, "footway": 1.8,
    "steps": 1.8, "path": 1.2,
}  # fmt: skip
"""Widths of roads in metres by OpenStreetMap's tag ``highway``. Links (``primary_link``) are ``DEFAULT_ROAD_WIDTH_M`` wide."""

RIVER_WIDTHS_M = {"river": 15.0, "canal": 12.0, "stream": 3.0, "brook": 3.0, "ditch": 1.5, "drain": 1.5}
"""Widths of watercourses in metres by OpenStreetMap's tag ``waterway``."""

DEFAULT_ROAD_WIDTH_M, DEFAULT_RIVER_WIDTH_M = 6.0, 5.0

GRAVEL_ROADS = ("track", "bridleway", "footway", "path")
"""Values of the tag ``highway`` whose surface is gravel or earth. Other roads narrower than ``MIN_ASPHALT_WIDTH_M`` are, too."""

MIN_ASPHALT_WIDTH_M = 3.5

MAX_SEGMENT_M = 200.0
"""Longer segments are divided, so that they follow the curved earth."""

MAX_SEGMENTS = 4_000_000


def read_lines(loaded: LoadedLevel, world: World, elevation: Elevation) -> DrapedLines:
    """Return the roads and rivers of a level on its ground.

    Raises ``SourceError`` for a faulty file, and ``LevelError`` if none of its lines lies on the terrain.
    """
    ends, widths, kinds = [], [], []
    notes: list[str] = []
    warnings: list[str] = []
    groups: tuple[tuple[Literal["roads", "rivers"], tuple[LineSpec, ...]], ...] = (
        ("roads", loaded.level.roads), ("rivers", loaded.level.rivers),
    )  # fmt: skip
    for key, specs in groups:
        for number, spec in enumerate(specs):
            part = _read_source(key, spec, loaded.resolve(spec.source), world, elevation)
            if not len(part.ends_earth_m):
                problem = Problem(f"no line of '{spec.source}' lies on the terrain")
                raise LevelError(f"{loaded.path}: {key}.{number}", problem, "Use lines on the terrain")
            ends.append(part.ends_earth_m)
            widths.append(part.width_m)
            kinds.append(part.kind)
            notes += [f"{spec.source}: {text}" for text in part.notes]
            warnings += [f"{spec.source}: {text}" for text in part.warnings]
    ends_earth_m = np.concatenate(ends)
    if len(ends_earth_m) > MAX_SEGMENTS:
        problem = Problem(f"the roads and rivers have {len(ends_earth_m)} segments, more than {MAX_SEGMENTS}")
        raise LevelError(f"{loaded.path}: roads", problem, "Use fewer or simpler lines")
    in_anchor = (ends_earth_m - world.anchor_earth_m) @ world.earth_from_anchor
    width_m = np.concatenate(widths)
    order = np.argsort(-width_m, kind="stable")  # the wider of two lines covers their crossing
    index = line_index(in_anchor[order, :, :2].reshape(-1, 4), width_m[order], np.concatenate(kinds)[order])
    return DrapedLines(ends_earth_m[order], index, tuple(notes), tuple(warnings))


class _SourceLines(NamedTuple):
    """Segments of a file: their ends (n, 2, 3), widths (n,) and kinds (n,), with notes and warnings."""

    ends_earth_m: np.ndarray
    width_m: np.ndarray
    kind: np.ndarray
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def _read_source(key: Literal["roads", "rivers"], spec: LineSpec, source: str, world: World, elevation: Elevation) -> _SourceLines:
    """Return the segments of a file that lie on the terrain."""
    layer = vector_layer(source, (1,), spec.layer)
    names, tag = attribute_names(source, layer.name or 0), "highway" if key == "roads" else "waterway"
    width_name = matching_attribute(spec.width, names) if isinstance(spec.width, str) else None
    required = () if width_name is None else (width_name,)
    features = read_features(source, elevation.crs, required, (tag,), layer)
    parts, row = shapely.get_parts(features.geometry, return_index=True)
    if (shapely.get_dimensions(parts) != 1).any():
        raise SourceError(source, "geometries that are not lines", f"Use lines for {key}")
    tags = [str(value).removesuffix("_link") for value in features.attributes.get(tag, np.full(len(features.geometry), ""))]
    tag_widths, default_m = (ROAD_WIDTHS_M, DEFAULT_ROAD_WIDTH_M) if key == "roads" else (RIVER_WIDTHS_M, DEFAULT_RIVER_WIDTH_M)
    width_m = np.array([tag_widths.get(value, default_m) for value in tags])
    notes: tuple[str, ...] = layer.notes
    warnings: tuple[str, ...] = ()
    if width_name is not None:
        lengths = attribute_lengths(features, (width_name,), {}, "widths", "lines")
        check_lengths(source, lengths)
        width_m = np.where(np.isnan(lengths.values_m), width_m, lengths.values_m)
        notes, warnings = (*notes, *lengths.notes), lengths.warnings
    elif spec.width is not None:
        width_m[:] = spec.width
    kind = np.full(len(width_m), RIVER, np.uint8)
    if key == "roads":
        kind[:] = np.where(np.isin(tags, GRAVEL_ROADS) | (width_m < MIN_ASPHALT_WIDTH_M), GRAVEL, ASPHALT)
    xy, part = shapely.get_coordinates(parts, return_index=True)
    height_m = elevation.filled_ground_m(xy[:, 0], xy[:, 1])
    point, up = world.points_at_zero_height(elevation.crs, xy[:, 0], xy[:, 1])
    point = point + height_m[:, None] * up
    start = np.flatnonzero((part[1:] == part[:-1]) & np.isfinite(point[1:] + point[:-1]).all(axis=1))
    pieces = np.ceil(np.linalg.norm(point[start + 1] - point[start], axis=1) / MAX_SEGMENT_M).astype(int)
    start, pieces = start[pieces > 0], pieces[pieces > 0]
    if (count := int(pieces.sum())) > MAX_SEGMENTS:
        raise SourceError(source, f"lines of {count} segments, more than {MAX_SEGMENTS}", "Use fewer or simpler lines")
    number, segment = np.arange(count) - np.repeat(np.cumsum(pieces) - pieces, pieces), np.repeat(start, pieces)
    shares = np.stack([number, number + 1], axis=1) / np.repeat(pieces, pieces)[:, None]
    shares_xy = xy[segment, None] + shares[..., None] * (xy[segment + 1] - xy[segment])[:, None]
    point, up = world.points_at_zero_height(elevation.crs, shares_xy[..., 0], shares_xy[..., 1])
    ground_m = elevation.filled_ground_m(shares_xy[..., 0].ravel(), shares_xy[..., 1].ravel()).reshape(shares.shape)
    ends_m = point + ground_m[..., None] * up
    on_ground = np.isfinite(ends_m).all(axis=(1, 2))
    line = row[part[segment]][on_ground]
    return _SourceLines(ends_m[on_ground], width_m[line], kind[line], notes, warnings)
