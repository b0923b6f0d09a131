"""The trees of a level: stands from polygons, points and canopy rasters, planted on its ground.

A hash of a tree's position is the source of its random properties (height, crown, variant ...). These do not depend on other
features of the files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from pyproj.exceptions import ProjError

from skugga.terrain.errors import LevelError, Problem, SourceError
from skugga.terrain.geo.vectors import Features, attribute_names, read_features, vector_layer
from skugga.terrain.geo.world import World, transformer
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.length_attributes import (
    AttributeLengths,
    attribute_lengths,
    check_lengths,
    matching_attribute,
    recognised_attributes,
    with_unit_suffixes,
)
from skugga.terrain.level.level import LoadedLevel
from skugga.terrain.level.parts import ForestSpec, Species
from skugga.terrain.level.rasters import is_raster
from skugga.terrain.trees.canopy import (
    HEXAGONAL_CROWNS_PER_SQUARE,
    MAX_CROWN_RATIO,
    MAX_DETECTION_CELL_M,
    TREETOP_WINDOW_RADIUS_LINES,
    Canopy,
    CellWindow,
    growing_space_m,
)
from skugga.terrain.trees.canopy_sample import (
    MAX_SHRUBS,
    MIN_GIANT_HEIGHT_M,
    MIN_SHRUB_HEIGHT_M,
    MIN_TREE_HEIGHT_M,
    HeightClassShares,
    check_above_ground,
    height_class_shares,
)
from skugga.terrain.trees.crown_sizes import (
    CROWN_DIAMETER_LINES,
    CROWN_STREAM,
    HEIGHT_STREAM,
    SPREAD_STREAM,
    YAW_STREAM,
    random_crown_diameters_m,
    random_variants,
    species_line,
)
from skugga.terrain.trees.planting_map import PlantingMap
from skugga.terrain.trees.scatter import HECTARE_M2, TreePositions, join_positions, point_keys, scatter_trees, uniform_numbers
from skugga.terrain.trees.thinning import thinning_ranks
from skugga.terrain.trees.trees import Trees

MAX_TREES = 5_000_000
"""Maximum number of trees in a level."""

DEFAULT_HEIGHT_RANGE_M = (8.0, 18.0)
"""Default range of tree heights."""

HEIGHT_UNITS = with_unit_suffixes(("height", "tree_height", "measured_height", "est_height", "hauteur"))
"""Units of attributes with heights, which are searched in this order for the heights of points if the level names none."""

CROWN_UNITS = with_unit_suffixes(("crown", "crown_diameter", "crown_width", "diameter_crown"))
"""Units of attributes with diameters of crowns."""

VALID_SIZE_RANGE_M = (0.1, 150.0)
"""Range of valid heights and crown diameters. Features outside of it are left out."""

CANOPY_SAMPLES_PER_SIDE, GROUND_COMPARISON_SAMPLES_PER_SIDE = 1024, 64
"""Maximum side of a sample of canopy cells: for the shares of height classes, and for the comparison with the ground."""


@dataclass(frozen=True, eq=False)
class Stems:
    """The n trees of a stand before planting.

    Attributes
    ----------
    positions
        Positions (n,) in the planting map.
    height_m
        Heights float64 (n,), metres.
    crown_diameter_m
        Crown diameters float64 (n,), metres; ``None``: usual for the height.
    growing_space_m
        Upper bounds of crown diameters float64 (n,), metres, from the distance to neighbours; ``None``: no bounds.
    notes
        Notes on the file's content.
    omissions
        Texts on features or cells without trees.
    warnings
        Texts on probable mistakes in the file.
    off_terrain_count
        Number of trees of the file that are off the terrain. They are not among the stems.
    """

    positions: TreePositions
    height_m: np.ndarray
    crown_diameter_m: np.ndarray | None
    growing_space_m: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    omissions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    off_terrain_count: int = 0

    def __getitem__(self, chosen: np.ndarray) -> Stems:
        """Return the stems that indices or a mask select. Notes, omissions and warnings do not change."""
        p, crown, room = self.positions, self.crown_diameter_m, self.growing_space_m
        positions = TreePositions(p.x[chosen], p.y[chosen], p.key[chosen])
        return replace(
            self, positions=positions, height_m=self.height_m[chosen], crown_diameter_m=None if crown is None else crown[chosen],
            growing_space_m=None if room is None else room[chosen],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Planting:
    """The planted trees of a level, with notes and warnings.

    Attributes
    ----------
    trees
        The trees of a level; ``None`` without any.
    notes
        Texts on the content of the files.
    warnings
        Texts on probable mistakes in the files.
    """

    trees: Trees | None
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def plant_trees(loaded: LoadedLevel, world: World, elevation: Elevation) -> Planting:
    """Plant all trees of a level.

    Trees stand on the ground at full resolution. Trees off the terrain, over holes or under water are left out. Stands of the same
    density and seed share one lattice of positions, so that neighbouring stands never collide. Overlapping stands need different
    seeds.

    Parameters
    ----------
    loaded
        The level.
    world
        The level's world.
    elevation
        The level's elevation.

    Returns
    -------
    The trees, with notes and warnings.

    Raises
    ------
    LevelError
        If a stand's keys are wrong, a stand is entirely off the terrain, or the level has more than ``MAX_TREES`` trees.
    SourceError
        If a stand's file is wrong.
    """
    planting_map, planted_stands, count = PlantingMap(world, elevation, loaded.level.terrain.exaggeration), [], 0
    notes: list[str] = []
    warnings: list[str] = []
    for number, spec in enumerate(loaded.level.forest):
        key_path = f"{loaded.path}: forest.{number}"
        stems = _stems(spec, loaded.resolve(spec.source), key_path, planting_map, MAX_TREES - count)
        trees = _plant_stand(stems, spec.species, key_path, planting_map)
        count += len(trees.thinning_rank)
        planted_stands.append(trees)
        omission_text = _omission_text(stems, len(trees.thinning_rank))
        planting_note = f"{len(trees.thinning_rank)} trees planted" + (f"; left out: {omission_text}" if omission_text else "")
        notes += [f"{spec.source}: {note}" for note in (*stems.notes, planting_note)]
        warnings += [f"{spec.source}: {text}" for text in stems.warnings]
        if not len(trees.thinning_rank):
            warnings.append(f"{spec.source}: no tree is planted{f': {omission_text}' if omission_text else ''}")
    if not count:
        return Planting(None, tuple(notes), tuple(warnings))
    trees = Trees(**{name: np.concatenate([getattr(s, name) for s in planted_stands]) for name in Trees.__dataclass_fields__})
    east, north, _ = world.earth_from_anchor.T @ (trees.base_earth_m - world.anchor_earth_m).T
    return Planting(replace(trees, thinning_rank=thinning_ranks(east, north)), tuple(notes), tuple(warnings))


def _omission_text(stems: Stems, planted_count: int) -> str:
    """Return the text on the trees, features or cells of a stand that were left out; empty if there are none."""
    lost_count = stems.off_terrain_count + len(stems.positions) - planted_count
    lost_texts = [f"{lost_count} off the terrain, over its holes or under water"] if lost_count else []
    return "; ".join([*lost_texts, *stems.omissions])


@dataclass(frozen=True, eq=False)
class StandFeatures:
    """The polygons or points of a stand, with the values of their attributes.

    Attributes
    ----------
    features
        The n features. Their geometries have single parts.
    height_m, crown_diameter_m
        Heights of trees and diameters of crowns float64 (n,), metres, NaN where invalid; ``None`` without attributes of them.
    notes
        Attributes that were used, in words.
    warnings
        Values that were ignored, in words.
    """

    features: Features
    height_m: np.ndarray | None
    crown_diameter_m: np.ndarray | None
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def _stems(spec: ForestSpec, source: str, key_path: str, planting_map: PlantingMap, max_trees: int) -> Stems:
    """Return the stems of a stand from a file of polygons, points or canopy heights. The file's content decides which.

    ``source`` is the file that ``spec`` names, resolved. ``key_path`` is the path of the stand's key in the level file, for
    messages. ``max_trees`` is the number of trees that the level may still get; ``LevelError`` is raised if the stand has more.
    """
    try:
        layer = vector_layer(source, (0, 2), spec.layer)
        names = attribute_names(source, layer.name or 0)
        crowns = (matching_attribute(spec.crown, names),) if isinstance(spec.crown, str) else ()
        heights = (matching_attribute(spec.height, names),) if isinstance(spec.height, str) else ()
        point_heights = recognised_attributes(names, HEIGHT_UNITS) if spec.height is None else heights
        features = _single_parts(read_features(source, planting_map.crs, (*point_heights, *crowns), layer=layer))
    except SourceError:
        if _is_vector(source):
            raise
        return _canopy_stems(spec, source, key_path, planting_map, max_trees)
    if spec.least_height is not None:
        problem = Problem(f"'{spec.least_height}' needs a raster of canopy heights as the source")
        raise LevelError(f"{key_path}.least_height", problem, "Remove the key")
    dimensions = shapely.get_dimensions(features.geometry)
    if (dimensions == 2).all():
        stand = _stand_features(features, heights, crowns, spec.height is None, "the key height sets a range or an attribute")
        stems = _polygon_stems(spec, stand, key_path, planting_map, max_trees)
    elif (dimensions == 0).all():
        stand = _stand_features(features, point_heights, crowns, spec.height is None, "no attribute has them")
        stems = _point_stems(spec, stand, key_path, planting_map, max_trees)
    else:
        geometry_problem = "it has lines" if (dimensions == 1).any() else "it has both polygons and points"
        raise SourceError(source, geometry_problem, "Use only polygons, only points, or a raster of canopy heights")
    omissions = [f"{features.omitted_count} without a geometry"] if features.omitted_count else []
    return replace(stems, notes=(*layer.notes, *stand.notes), omissions=(*stems.omissions, *omissions), warnings=stand.warnings)


def _stand_features(
    features: Features,
    height_attributes: Sequence[str],
    crown_attributes: Sequence[str],
    has_default_heights: bool,
    default_reason: str,
) -> StandFeatures:
    """Return features with the values of their attributes ``height_attributes`` and ``crown_attributes``.

    If ``has_default_heights``, features without any value of ``height_attributes`` get heights of the default range.
    ``default_reason`` says why in the note. Raises ``SourceError`` if an attribute has no valid value.
    """
    height = attribute_lengths(features, height_attributes, HEIGHT_UNITS, "heights")
    crown = attribute_lengths(features, crown_attributes, CROWN_UNITS, "crowns")
    is_drawn = has_default_heights and not height.has_values
    low_m, high_m = DEFAULT_HEIGHT_RANGE_M
    drawn_notes = [f"heights: drawn at random from {low_m:g} m to {high_m:g} m ({default_reason})"] if is_drawn else []
    return StandFeatures(
        features, None if is_drawn or not height_attributes else _valid_lengths_m(features, height_attributes, height),
        _valid_lengths_m(features, crown_attributes, crown) if crown_attributes else None,
        (*drawn_notes, *height.notes, *crown.notes), (*height.warnings, *crown.warnings),
    )  # fmt: skip


def _valid_lengths_m(features: Features, attributes: Sequence[str], lengths: AttributeLengths) -> np.ndarray:
    """Return lengths float64 (n,), metres, NaN where they are not in ``VALID_SIZE_RANGE_M``.

    Raises ``SourceError`` if no length is valid.
    """
    check_lengths(features.name, lengths)
    with np.errstate(invalid="ignore"):
        valid = (lengths.values_m >= VALID_SIZE_RANGE_M[0]) & (lengths.values_m <= VALID_SIZE_RANGE_M[1])
    if not valid.any():
        first_value = features.attributes[attributes[0]][0]
        problem = f"the attribute {attributes[0]} has no valid value ({first_value} ...)"
        raise SourceError(features.name, problem, f"Use lengths from {VALID_SIZE_RANGE_M[0]} m to {VALID_SIZE_RANGE_M[1]:g} m")
    return np.where(valid, lengths.values_m, np.nan)


def _is_vector(source: str) -> bool:
    """Return whether GDAL reads a file as vectors. Raises ``SourceError`` if it reads neither vectors nor a raster."""
    try:
        attribute_names(source)
    except SourceError as error:
        if not is_raster(source):
            raise SourceError(source, error.value, "Use polygons, points or a raster of canopy heights that GDAL reads") from None
        return False
    return True


def _polygon_stems(spec: ForestSpec, stand: StandFeatures, key_path: str, planting_map: PlantingMap, max_trees: int) -> Stems:
    """Return the stems that are scattered in a stand's polygons. The other parameters are those of ``_stems``."""
    if spec.density is None:
        raise LevelError.missing(f"{key_path}.density", "Set the trees per hectare: the source has polygons")
    geometry = stand.features.geometry
    total_count, index = len(geometry), np.arange(len(geometry))
    if planting_map.outline is not None:
        shapely.prepare(planting_map.outline)
        is_near = shapely.intersects(planting_map.outline, geometry)
        geometry, index = geometry[is_near], index[is_near]
        is_within = shapely.contains_properly(planting_map.outline, geometry)
        geometry[~is_within] = shapely.intersection(geometry[~is_within], planting_map.outline)
        if not len(geometry):
            raise _off_terrain_error(key_path, shapely.total_bounds(stand.features.geometry), planting_map)
    expected = shapely.area(geometry).sum() * planting_map.unit_m**2 / HECTARE_M2 * spec.density
    if expected > max_trees:
        raise _too_many_trees_error(key_path, round(expected), max_trees)
    stand_positions = [scatter_trees(area, spec.density, spec.seed, planting_map.unit_m) for area in geometry]
    feature_row = np.repeat(index, [len(positions) for positions in stand_positions])
    positions, first = join_positions(stand_positions)
    feature_row = feature_row[first]
    off_terrain_count = total_count - len(geometry)
    omissions = (f"{off_terrain_count} polygons off the terrain",) if off_terrain_count else ()
    return _valid_stems(Stems(positions, *_sizes_m(spec, stand, feature_row, positions.key), omissions=omissions))


def _point_stems(spec: ForestSpec, stand: StandFeatures, key_path: str, planting_map: PlantingMap, max_trees: int) -> Stems:
    """Return the stems at a stand's points, one for each place. The other parameters are those of ``_stems``."""
    if spec.density is not None:
        problem = Problem(f"'{spec.density}' needs polygons, but the source has points, each a tree")
        raise LevelError(f"{key_path}.density", problem, "Remove the key")
    x, y = shapely.get_x(stand.features.geometry), shapely.get_y(stand.features.geometry)
    covered = np.flatnonzero(planting_map.elevation.covers(*planting_map.to_terrain_crs(x, y)))
    if not len(covered):
        raise _off_terrain_error(key_path, shapely.total_bounds(stand.features.geometry), planting_map)
    key, first = np.unique(
        point_keys(spec.seed, x[covered] * planting_map.unit_m, y[covered] * planting_map.unit_m), return_index=True
    )
    first = covered[first]
    if len(key) > max_trees:
        raise _too_many_trees_error(key_path, len(key), max_trees)
    duplicate_count = len(covered) - len(key)
    omissions = (f"{duplicate_count} at the same place as another",) if duplicate_count else ()
    sizes_m = _sizes_m(spec, stand, first, key)
    positions = TreePositions(x[first], y[first], key)
    return _valid_stems(Stems(positions, *sizes_m, omissions=omissions, off_terrain_count=len(x) - len(covered)))


def _sizes_m(
    spec: ForestSpec, stand: StandFeatures, feature_row: np.ndarray, key: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the heights of trees, and their crown diameters if the stand sets them, float64 (n,), metres.

    ``feature_row`` (n,) is the row of each tree's feature, and ``key`` (n,) is each tree's hash.
    """
    height_range_m = spec.height if isinstance(spec.height, tuple) else DEFAULT_HEIGHT_RANGE_M
    height_m = _random_lengths_m(height_range_m, key, HEIGHT_STREAM) if stand.height_m is None else stand.height_m[feature_row]
    if isinstance(spec.crown, tuple):
        return height_m, _random_lengths_m(spec.crown, key, CROWN_STREAM)
    return height_m, None if stand.crown_diameter_m is None else stand.crown_diameter_m[feature_row]


def _canopy_stems(spec: ForestSpec, source: str, key_path: str, planting_map: PlantingMap, max_trees: int) -> Stems:
    """Return the stems of a raster of canopy heights. The parameters are those of ``_stems``."""
    for name in ("density", "height", "layer"):
        if getattr(spec, name) is not None:
            problem = Problem(f"'{getattr(spec, name)}' does not apply to a raster of canopy heights")
            raise LevelError(f"{key_path}.{name}", problem, "Remove the key")
    if isinstance(spec.crown, str):
        raise LevelError(f"{key_path}.crown", spec.crown, "a range [min, max] in metres (a raster has no attributes)")
    canopy, parts, count = Canopy(source), [], 0
    try:
        window = canopy.window(planting_map.crs, planting_map.outline)
        if window is None:
            raise _off_terrain_error(
                key_path, shapely.total_bounds(shapely.MultiPoint(canopy.outline(planting_map.crs))), planting_map
            )
        base, slope = species_line(CROWN_DIAMETER_LINES, spec.species)
        radius_line = species_line(TREETOP_WINDOW_RADIUS_LINES, spec.species)
        cells = _check_canopy(canopy, window, planting_map)
        shrub_m2 = (base + slope * (MIN_SHRUB_HEIGHT_M + MIN_TREE_HEIGHT_M) / 2) ** 2 / HEXAGONAL_CROWNS_PER_SQUARE
        canopy.min_height_m = spec.least_height or _default_min_height_m(
            cells, window, canopy.cell_side_m(planting_map.crs, planting_map.unit_m, window), shrub_m2
        )
        for part in canopy.trees(planting_map.crs, planting_map.unit_m, window, lambda h: base + slope * h, radius_line, spec.seed):
            parts.append(part)
            count += len(part.positions)
            if count > max_trees:
                raise _too_many_trees_error(key_path, count, max_trees, "at least")
    finally:
        canopy.close()
    positions, first = join_positions([part.positions for part in parts])
    height = np.concatenate([part.height_m for part in parts] or [np.empty(0)])[first]
    crown = None if spec.crown is None else _random_lengths_m(spec.crown, positions.key, CROWN_STREAM)
    warnings = []
    if cells.is_mostly_giant:
        limit_m = f"{MIN_GIANT_HEIGHT_M:g} m"
        warnings.append(f"most of its cells with trees are higher than {limit_m}. Check the unit of its heights.")
    return Stems(
        positions, height, crown, MAX_CROWN_RATIO * growing_space_m(positions.x, positions.y, planting_map.unit_m),
        omissions=(f"of its cells {text}",) if (text := cells.omission_text(canopy.min_height_m)) else (), warnings=tuple(warnings),
    )  # fmt: skip


def _check_canopy(canopy: Canopy, window: CellWindow, planting_map: PlantingMap) -> HeightClassShares:
    """Check a canopy and return its cells' shares by height class.

    Raises ``SourceError`` if all cells are nodata, or if the heights are above sea level instead of above ground.
    """
    _, _, heights_m = canopy.sample_heights(window, CANOPY_SAMPLES_PER_SIDE)
    if np.isnan(heights_m).all():
        _, _, raster_heights_m = canopy.sample_heights(CellWindow(0, 0, canopy.rows, canopy.cols), CANOPY_SAMPLES_PER_SIDE)
        if np.isnan(raster_heights_m).all():
            raise SourceError(canopy.name, "no height in any cell (all nodata)", "Use a raster with canopy heights")
    row, col, sampled_heights_m = canopy.sample_heights(window, GROUND_COMPARISON_SAMPLES_PER_SIDE)
    ground_m = planting_map.elevation.ground_m(*planting_map.to_terrain_crs(*canopy.xy(planting_map.crs, row, col)))
    check_above_ground(canopy.name, sampled_heights_m, ground_m / planting_map.exaggeration)
    return height_class_shares(heights_m)


def _default_min_height_m(cells: HeightClassShares, window: CellWindow, cell_m: float, shrub_m2: float) -> float:
    """Return the default minimum height of trees, metres.

    Shrubs count if the canopy is mostly shrubs, its cells are fine enough, and there are at most ``MAX_SHRUBS``.
    """
    shrubs = cells.shrub_share * (window.row1 - window.row0) * (window.col1 - window.col0) * cell_m**2 / shrub_m2
    return (
        MIN_SHRUB_HEIGHT_M
        if cells.is_mostly_shrubs and cell_m <= MAX_DETECTION_CELL_M and shrubs <= MAX_SHRUBS
        else MIN_TREE_HEIGHT_M
    )


def _plant_stand(stems: Stems, species: Species, key_path: str, planting_map: PlantingMap) -> Trees:
    """Return the trees of a stand: put the stems on the ground, and derive random properties from their hashes.

    Trees over holes or under water are left out. Raises ``LevelError`` if all are off the terrain.
    """
    x, y = planting_map.to_terrain_crs(stems.positions.x, stems.positions.y)
    covered = planting_map.elevation.covers(x, y)
    if len(covered) and not covered.any():
        raise _off_terrain_error(
            key_path,
            shapely.total_bounds(shapely.MultiPoint(np.column_stack([stems.positions.x, stems.positions.y]))),
            planting_map,
        )
    ground_m = planting_map.elevation.ground_m(x, y)
    on_land = ground_m > planting_map.elevation.water_m
    stems, x, y, ground_m = stems[on_land], x[on_land], y[on_land], ground_m[on_land]
    key = stems.positions.key
    variant = random_variants(key, species)
    if stems.crown_diameter_m is None:
        crown_m = random_crown_diameters_m(stems.height_m, variant, uniform_numbers(key, SPREAD_STREAM))
        crown_m = crown_m if stems.growing_space_m is None else np.minimum(crown_m, stems.growing_space_m)
    else:
        crown_m = stems.crown_diameter_m
    point, up = planting_map.world.points_at_zero_height(planting_map.elevation.crs, x, y)
    return Trees(
        base_earth_m=point + ground_m[:, None] * up,
        height_m=stems.height_m.astype(np.float32),
        crown_diameter_m=crown_m.astype(np.float32),
        yaw_deg=(180.0 * uniform_numbers(key, YAW_STREAM)).astype(np.float32) % np.float32(180.0),
        variant=variant,
        thinning_rank=np.zeros(len(key), np.float32),  # set for all stands together
    )


def _random_lengths_m(range_m: tuple[float, float], key: np.ndarray, stream: int) -> np.ndarray:
    """Return random lengths float64 (n,) in a range, both in metres, from the hashes ``key`` (n,) of trees."""
    return range_m[0] + (range_m[1] - range_m[0]) * uniform_numbers(key, stream)


def _valid_stems(stems: Stems) -> Stems:
    """Return the stems with a height and, if crowns come from an attribute, with a crown."""
    valid = np.isfinite(stems.height_m)
    valid = valid if stems.crown_diameter_m is None else valid & np.isfinite(stems.crown_diameter_m)
    lost_count = np.count_nonzero(~valid)
    omissions = (f"{lost_count} without a usable height or crown",) if lost_count else ()
    return replace(stems[valid], omissions=(*stems.omissions, *omissions))


def _single_parts(features: Features) -> Features:
    """Split collections and multi-part geometries into single parts, without empty ones."""
    geometry, row = features.geometry, np.arange(len(features.geometry))
    while (shapely.get_type_id(geometry) > 3).any():
        geometry, index = shapely.get_parts(geometry, return_index=True)
        row = row[index]
    nonempty = ~shapely.is_empty(geometry)
    return replace(features[row[nonempty]], geometry=geometry[nonempty])


def _too_many_trees_error(key_path: str, count: int, max_trees: int, qualifier: str = "") -> LevelError:
    """Return the error of a stand with more trees than the level may still get.

    ``qualifier`` is a word before the number ``count``, such as "at least". The other parameters are those of ``_stems``.
    """
    remaining_text = "" if max_trees == MAX_TREES else f" ({max_trees:,} left for this stand)"
    limit = f"{MAX_TREES:,} trees in a level{remaining_text}"
    return LevelError.over_limit(key_path, " ".join(f"{qualifier} {count:,} trees".split()), limit, "Plant fewer trees")


def _off_terrain_error(key_path: str, bounds: np.ndarray, planting_map: PlantingMap) -> LevelError:
    """Return the error of a stand that is entirely off the terrain; ``bounds`` are those of the stand in the planting map."""
    crs = planting_map.elevation.crs
    if planting_map.crs != crs:
        try:
            west, south, east, north = bounds
            bounds = np.array(transformer(planting_map.crs, crs).transform_bounds(west, south, east, north, densify_pts=21))
        except ProjError:
            bounds = np.full(4, np.nan)
    stand_bounds, terrain_bounds = (", ".join(f"{v:.9g}" for v in b) for b in (bounds, planting_map.elevation.bounds))
    remedy = f"Use trees on the terrain, at {terrain_bounds} (west, south, east, north; {crs.name})"
    return LevelError(f"{key_path}.source", Problem(f"its trees are off the terrain, at {stand_bounds}"), remedy)
