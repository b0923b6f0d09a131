"""Read a level's land cover, and the polygons of its woods, from vector files."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from skugga.terrain.errors import LevelError, Problem, SourceError
from skugga.terrain.geo.vectors import Features, attribute_names, read_features, vector_layer
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.land_cover import (
    CROP,
    EARTH,
    FIELD_CLASSES,
    FOREST_FLOOR,
    ICE,
    MEADOW,
    ORCHARD,
    PAVED,
    PLOUGHED,
    RIPE_CROP,
    ROCK,
    SAND,
    SCREE,
    SCRUB,
    STUBBLE,
    WATER,
    WETLAND,
    YARD,
    LandCover,
    land_cover_index,
)
from skugga.terrain.ground.length_attributes import matching_attribute, recognised_attributes
from skugga.terrain.level.level import LoadedLevel
from skugga.terrain.level.parts import LandCoverSpec

FIELD = -1
"""Arable land without a statement on its crop: each polygon gets one of ``FIELD_CLASSES``."""

CLASS_WORDS = {
    MEADOW: "meadow grass grassland pasture village_green recreation_ground park greenfield golf_course pitch herbaceous fell",
    FIELD: "farmland farm field arable cropland crops agriculture", CROP: "crop greenhouse_horticulture", RIPE_CROP: "ripe_crop",
    STUBBLE: "stubble", PLOUGHED: "ploughed plowed", ORCHARD: "orchard vineyard plant_nursery nursery",
    FOREST_FLOOR: "forest wood woodland woods trees tree_cover tree_covered mangroves",
    SCRUB: "scrub heath shrubland shrub shrubs moss_and_lichen tundra",
    WETLAND: "wetland marsh bog swamp reedbed herbaceous_wetland",
    ROCK: "bare_rock rock rocks cliff", SCREE: "scree shingle stones boulders", SAND: "sand beach dune dunes",
    EARTH: "earth bare_soil mud quarry brownfield construction landfill bare sparse_vegetation bare_sparse_vegetation",
    YARD: "residential garden gardens allotments farmyard cemetery grass_urban",
    PAVED: "commercial industrial retail railway built_up built built_area urban garages parking",
    WATER: "water reservoir basin lake river pond permanent_water_bodies", ICE: "glacier ice snow snow_and_ice",
}  # fmt: skip
"""Classes, and values of attributes that mean them: those of OpenStreetMap's tags and the names of ESA WorldCover's classes."""

COVER_BY_WORD = {word: cover for cover, words in CLASS_WORDS.items() for word in words.split()}

COVER_BY_CODE = {
    10: FOREST_FLOOR, 20: SCRUB, 30: MEADOW, 40: FIELD, 50: PAVED, 60: EARTH, 70: ICE, 80: WATER, 90: WETLAND, 95: FOREST_FLOOR,
    100: SCRUB,
}  # fmt: skip
"""Classes by the codes of ESA WorldCover (product user manual v2.0, 2022)."""

CLASS_ATTRIBUTES = ("class", "land_cover", "landuse", "natural", "value", "fclass", "leisure", "cover", "code", "dn", "gridcode")
"""Attributes that may name the class. Each feature has that of the first one with a known value."""

MIN_WOOD_DENSITY_PER_HA = 30.0
"""Density of a level's trees from which on the ground below them counts as a forest's floor."""

MAX_EDGE_M, MAX_EDGES = 100.0, 8_000_000
"""Longer edges are divided, so that they follow the curved earth and lie in few cells. And their maximum number."""


@dataclass(frozen=True, eq=False)
class _Polygons:
    """Polygons (n,) in the elevation's CRS, their classes int (n,), and statements on what was read."""

    geometry: np.ndarray
    cover: np.ndarray
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def read_land_cover(loaded: LoadedLevel, world: World, elevation: Elevation) -> LandCover | None:
    """Return the land cover of a level, or ``None`` if it has neither land cover nor dense woods.

    The woods of the level cover the polygons of its land cover. Raises ``SourceError`` for a faulty file, and ``LevelError`` if no
    polygon of a file lies on the terrain.
    """
    parts: list[_Polygons] = []
    terrain = shapely.box(*elevation.bounds)
    for number, spec in enumerate(loaded.level.land_cover):
        part = _read_source(spec, loaded.resolve(spec.source), elevation)
        on_terrain = shapely.intersects(part.geometry, terrain)
        if not on_terrain.any():
            problem = Problem(f"no polygon of '{spec.source}' with a known class lies on the terrain")
            raise LevelError(f"{loaded.path}: land_cover.{number}", problem, "Use polygons of land cover on the terrain")
        notes = tuple(f"{spec.source}: {text}" for text in part.notes)
        warnings = tuple(f"{spec.source}: {text}" for text in part.warnings)
        parts.append(_Polygons(part.geometry[on_terrain], part.cover[on_terrain], notes, warnings))
    for stand in loaded.level.forest:
        if stand.density is not None and stand.density >= MIN_WOOD_DENSITY_PER_HA:
            source = loaded.resolve(stand.source)
            woods = read_features(source, elevation.crs, layer=vector_layer(source, (2,), stand.layer)).geometry
            woods = woods[shapely.intersects(woods, terrain)]
            parts.append(_Polygons(woods, np.full(len(woods), FOREST_FLOOR)))
    geometry = np.concatenate([part.geometry for part in parts]) if parts else np.zeros(0, object)
    if not len(geometry):
        return None
    cover = np.concatenate([part.cover for part in parts])
    geometry, cover = geometry[::-1], cover[::-1]  # the last one takes precedence
    fields = cover == FIELD
    cover[fields] = np.array(FIELD_CLASSES)[_draw_field_classes(geometry[fields])]
    edges_m, polygon = _edges_from_anchor(geometry, loaded, world, elevation)
    rows = _row_directions(geometry, edges_m, polygon)
    index = land_cover_index(edges_m, polygon, cover, rows)
    notes = tuple(text for part in parts for text in part.notes)
    warnings = tuple(text for part in parts for text in part.warnings)
    return LandCover(index, notes, warnings)


def _read_source(spec: LandCoverSpec, source: str, elevation: Elevation) -> _Polygons:
    """Return the polygons of a file that have a known class."""
    layer = vector_layer(source, (2,), spec.layer, lambda names: bool(recognised_attributes(names, CLASS_ATTRIBUTES)))
    names = attribute_names(source, layer.name or 0)
    attributes = (matching_attribute(spec.attribute, names),) if spec.attribute else recognised_attributes(names, CLASS_ATTRIBUTES)
    if not attributes:
        remedy = f"Name one of {', '.join(names)} by attribute" if names else "Use a file with attributes"
        raise SourceError(source, "no attribute that names the class of land cover", remedy)
    features = read_features(source, elevation.crs, attributes, layer=layer)
    if (shapely.get_dimensions(features.geometry) != 2).any():
        raise SourceError(source, "geometries that are not polygons", "Use polygons for land_cover")
    cover, warnings = _classes_of(features, attributes)
    known = np.array([value is not None for value in cover])
    classes = np.array([value for value in cover if value is not None], np.int64)
    return _Polygons(features.geometry[known], classes, layer.notes, warnings)


def _classes_of(features: Features, attributes: tuple[str, ...]) -> tuple[list[int | None], tuple[str, ...]]:
    """Return the class of each feature, ``None`` if it has none, and warnings of values that name no class."""
    classes: list[int | None] = [None] * len(features.geometry)
    unknown: dict[str, int] = {}
    for row in range(len(classes)):
        texts = []
        for attribute in attributes:
            value = features.attributes[attribute][row]
            classes[row] = class_of_value(value)
            if classes[row] is not None:
                break
            if value is not None and value == value and str(value).strip():
                texts.append(f"{attribute} = {value}")
        else:
            text = texts[0] if texts else "no class"
            unknown[text] = unknown.get(text, 0) + 1
    counts = ", ".join(f"{text} ({count} polygons)" if count > 1 else text for text, count in list(unknown.items())[:5])
    more = f", and {len(unknown) - 5} other values" if len(unknown) > 5 else ""
    return classes, (f"{counts}{more}: ignored, no known class of land cover",) if unknown else ()


def class_of_value(value: object) -> int | None:
    """Return the class of land cover (or ``FIELD``) that a value of an attribute means; ``None`` if it means none.

    A number is a code of ESA WorldCover. Case, punctuation and a final ``s`` of words do not matter.
    """
    if value is None or isinstance(value, bool | np.bool_):
        return None
    if isinstance(value, int | float | np.integer | np.floating):
        return COVER_BY_CODE.get(int(value)) if np.isfinite(value) and float(value).is_integer() else None
    word = "_".join("".join(letter if letter.isalnum() else " " for letter in str(value).lower()).split())
    if word.isdecimal():
        return COVER_BY_CODE.get(int(word[:9]))
    return COVER_BY_WORD.get(word, COVER_BY_WORD.get(word.removesuffix("s")))


def _draw_field_classes(geometry: np.ndarray) -> np.ndarray:
    """Return numbers int (n,) of ``FIELD_CLASSES``, drawn by the centres of polygons, so that a field keeps its crop."""
    points = shapely.centroid(geometry)
    centre = np.rint(1e5 * np.stack([shapely.get_x(points), shapely.get_y(points)], axis=-1))
    mixed = centre.astype(np.int64).astype(np.uint64) @ np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F], np.uint64)
    mixed ^= mixed >> np.uint64(29)
    return np.asarray((mixed * np.uint64(0xBF58476D1CE4E5B9) >> np.uint64(32)) % np.uint64(len(FIELD_CLASSES))).astype(np.int64)


def _edges_from_anchor(
    geometry: np.ndarray, loaded: LoadedLevel, world: World, elevation: Elevation
) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges (m, 4) of polygons in metres from the anchor, divided to ``MAX_EDGE_M``, and the polygon (m,) of each."""
    rings, ring_polygon = shapely.get_rings(geometry, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    point, _ = world.points_at_zero_height(elevation.crs, xy[:, 0], xy[:, 1])
    start = np.flatnonzero((ring[1:] == ring[:-1]) & np.isfinite(point[1:] + point[:-1]).all(axis=1))
    pieces = np.maximum(np.ceil(np.linalg.norm(point[start + 1] - point[start], axis=1) / MAX_EDGE_M).astype(int), 1)
    if (count := int(pieces.sum())) > MAX_EDGES:
        problem = Problem(f"the land cover has {count} edges, more than {MAX_EDGES}")
        raise LevelError(f"{loaded.path}: land_cover", problem, "Use fewer or simpler polygons")
    number, edge = np.arange(count) - np.repeat(np.cumsum(pieces) - pieces, pieces), np.repeat(start, pieces)
    shares = np.stack([number, number + 1], axis=1) / np.repeat(pieces, pieces)[:, None]
    shares_xy = xy[edge, None] + shares[..., None] * (xy[edge + 1] - xy[edge])[:, None]
    point, up = world.points_at_zero_height(elevation.crs, shares_xy[..., 0], shares_xy[..., 1])
    ground_m = elevation.filled_ground_m(shares_xy[..., 0].ravel(), shares_xy[..., 1].ravel()).reshape(shares.shape)
    mean_m = float(np.nanmean(ground_m)) if np.isfinite(ground_m).any() else 0.0
    point = point + np.where(np.isfinite(ground_m), ground_m, mean_m)[..., None] * up
    in_anchor = (point - world.anchor_earth_m) @ world.earth_from_anchor
    return in_anchor[..., :2].reshape(-1, 4), ring_polygon[ring[edge]]


def _row_directions(geometry: np.ndarray, edges_m: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Return the unit vector (n, 2) along the rows of each polygon: the direction in which its edges are longest in sum.

    The mean of doubled angles, weighted by lengths, makes opposite directions equal. Edges at right angles to the rows shorten the
    mean and do not turn it.
    """
    along = (edges_m[:, 2] - edges_m[:, 0]) + 1j * (edges_m[:, 3] - edges_m[:, 1])
    doubled = along**2 / np.maximum(np.abs(along), 1e-9)
    sums = np.bincount(polygon, doubled.real, len(geometry)) + 1j * np.bincount(polygon, doubled.imag, len(geometry))
    half = 0.5 * np.angle(sums)
    return np.stack([np.cos(half), np.sin(half)], axis=1)
