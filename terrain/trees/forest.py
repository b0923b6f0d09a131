"""The trees of a level: stands from polygons, points and canopy rasters, planted on its ground.

All about a tree but its place (height, crown, look ...) is drawn from a hash of the place, so that it is the same whatever
else is in the files.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import shapely
from pyproj import CRS
from pyproj.crs import GeographicCRS, ProjectedCRS
from pyproj.crs.coordinate_operation import LambertAzimuthalEqualAreaConversion
from pyproj.exceptions import ProjError

from terrain.errors import LevelError, SourceError
from terrain.geo.vectors import Features, attribute_names, numbers, read_features
from terrain.geo.world import World, longitude_latitude_of, transformer
from terrain.ground.elevation import Elevation
from terrain.level.level import LoadedLevel
from terrain.level.parts import ForestSpec, Species
from terrain.level.rasters import is_raster
from terrain.trees.canopy import MAX_CROWN_RATIO, TREETOP_WINDOW_M, Canopy, border_cells, room_m
from terrain.trees.foliage import TREE_VARIANTS
from terrain.trees.scatter import HECTARE_M2, Places, join_places, point_keys, scatter_trees, shares
from terrain.trees.thinning import thinning_ranks
from terrain.trees.trees import Trees

MAX_TREES = 5_000_000
"""Trees that a level may have."""

HEIGHT_M = (8.0, 18.0)
"""Heights where a stand names none."""

POINT_HEIGHT = "height"
"""The attribute that heights of points come from where they have it and the level names nothing else."""

USABLE_M = (0.1, 150.0)
"""Heights and crowns of trees; rows of a file beyond them are left out."""

CROWN_M: dict[str, tuple[float, float]] = {"conifer": (1.0, 0.2), "broadleaf": (1.0, 0.3)}
"""Crown's diameter: metres, and metres per metre of height. Lines along the curves of S. C. Popescu, R. H. Wynne (Seeing the
trees in the forest, 2004) for pines and deciduous trees of 8 to 25 m, which give saplings crowns wider than high."""

CROWN_SPREAD = 0.15
"""How far single crowns lie from the line, as a share of it."""

FARTHEST_M = 5e6
"""Terrain that reaches farther than this from the anchor has no outline in the level's equal-area map."""

_HEIGHT, _CROWN, _SPECIES, _LOOK, _TURN, _SPREAD = range(6)  # streams of shares


@dataclass(frozen=True, eq=False)
class Site:
    """Where trees are placed before they stand on the ground: a metric map of the level.

    On the globe it is an equal-area map about the anchor, so that a density means the same everywhere; a flat world is its
    own. ``unit_m`` is the metres of its unit.
    """

    world: World
    elevation: Elevation

    @cached_property
    def crs(self) -> CRS:
        """The map's CRS."""
        if self.world.flat:
            return self.elevation.crs
        centre = LambertAzimuthalEqualAreaConversion(self.world.anchor_lat_deg, self.world.anchor_lon_deg)
        return ProjectedCRS(centre, name="equal-area map of the level", geodetic_crs=self._geodetic_crs)

    @property
    def _geodetic_crs(self) -> CRS:
        return GeographicCRS() if self.world.on_earth else longitude_latitude_of(self.elevation.crs)

    @property
    def unit_m(self) -> float:
        """Metres of the map's unit."""
        return self.world.metres_per_unit if self.world.flat else 1.0

    @cached_property
    def outline(self) -> shapely.Polygon | None:
        """The terrain's outline with a small margin; ``None`` where it reaches too far round the globe to have one."""
        cells = border_cells(*self.elevation.shape)
        x, y = _moved(self.elevation.crs, self.crs, *self.elevation.xy(*cells))
        if not self.world.flat and not (np.hypot(x, y) < FARTHEST_M).all():
            return None
        border = shapely.Polygon(np.column_stack([x, y]))
        margin = 1e-3 * np.sqrt(border.area)  # more than the border bends between its points
        return border.buffer(margin) if border.is_valid else None

    def on_terrain(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates of the map in the elevation's CRS, NaN where there are none."""
        x, y = _moved(self.crs, self.elevation.crs, x, y)
        there = np.isfinite(x) & np.isfinite(y)
        return np.where(there, x, np.nan), np.where(there, y, np.nan)


@dataclass(frozen=True, eq=False)
class Stems:
    """Trees of a stand, one row each: places in the site's map, heights, and crowns (``None``: as usual for the height),
    ``room_m`` the most that a crown can be.
    """

    places: Places
    height_m: np.ndarray
    crown_m: np.ndarray | None
    room_m: np.ndarray | None = None

    def __getitem__(self, chosen: np.ndarray) -> Stems:
        p, crown, room = self.places, self.crown_m, self.room_m
        places = Places(p.x[chosen], p.y[chosen], p.key[chosen])
        return Stems(
            places, self.height_m[chosen], None if crown is None else crown[chosen], None if room is None else room[chosen]
        )


def plant_trees(loaded: LoadedLevel, world: World, elevation: Elevation) -> Trees | None:
    """All trees of a level, ``None`` where there are none.

    Trees stand on the ground's full resolution; those off the terrain, over holes or under water are left out. Stands of one
    density and seed share their places, so that neighbours never collide; stands that overlap need seeds of their own. Raises
    ``LevelError`` or ``SourceError`` where a stand's file or keys are wrong, a stand is wholly outside, or there are more than
    ``MAX_TREES``.
    """
    site, stands, count = Site(world, elevation), [], 0
    for number, spec in enumerate(loaded.level.forest):
        where = f"{loaded.path}: forest.{number}"
        stems = _stems(spec, loaded.resolve(spec.source), where, site, MAX_TREES - count)
        trees = _planted(stems, spec.species, where, site)
        count += len(trees.rank)
        stands.append(trees)
    if not count:
        return None
    trees = Trees(**{name: np.concatenate([getattr(s, name) for s in stands]) for name in Trees.__dataclass_fields__})
    east, north, _ = world.earth_from_anchor.T @ (trees.base_earth_m - world.anchor_earth_m).T
    return replace(trees, rank=thinning_ranks(east, north))


def _stems(spec: ForestSpec, source: str, where: str, site: Site, most: int) -> Stems:
    """The stems of a stand, by the kind of its file."""
    named = list(dict.fromkeys(name for name in (spec.height, spec.crown) if isinstance(name, str)))
    try:
        features = _parts(read_features(source, site.crs, named, [POINT_HEIGHT] if spec.height is None else []))
    except SourceError:
        if _is_vector(source):
            raise
        return _canopy_stems(spec, source, where, site, most)
    dimensions = shapely.get_dimensions(features.geometry)
    if (dimensions == 2).all():
        return _polygon_stems(spec, features, where, site, most)
    if (dimensions == 0).all():
        return _point_stems(spec, features, where, site, most)
    found = "lines" if (dimensions == 1).any() else "both polygons and points"
    raise SourceError(source, found, "only polygons, only points, or a raster of canopy heights")


def _is_vector(source: str) -> bool:
    """Whether GDAL reads vectors from a file. Raises ``SourceError`` if it reads no raster from it either."""
    try:
        attribute_names(source)
    except SourceError as error:
        if not is_raster(source):
            raise SourceError(source, error.value, "polygons, points or a raster of canopy heights that GDAL reads") from None
        return False
    return True


def _polygon_stems(spec: ForestSpec, features: Features, where: str, site: Site, most: int) -> Stems:
    if spec.density is None:
        raise LevelError(f"{where}.density", "nothing", "trees per hectare: the source has polygons")
    geometry, index = features.geometry, np.arange(len(features.geometry))
    if site.outline is not None:
        shapely.prepare(site.outline)
        near = shapely.intersects(site.outline, geometry)
        geometry, index = geometry[near], index[near]
        within = shapely.contains_properly(site.outline, geometry)
        geometry[~within] = shapely.intersection(geometry[~within], site.outline)
        if not len(geometry):
            raise _outside(where, shapely.total_bounds(features.geometry), site)
    expected = shapely.area(geometry).sum() * site.unit_m**2 / HECTARE_M2 * spec.density
    if expected > most:
        raise _too_many(where, round(expected), most)
    stands = [scatter_trees(area, spec.density, spec.seed, site.unit_m) for area in geometry]
    owner = np.repeat(index, [len(places) for places in stands])
    places, first = join_places(stands)
    owner = owner[first]
    height = _values(spec.height or HEIGHT_M, features, owner, places.key, _HEIGHT)
    crown = None if spec.crown is None else _values(spec.crown, features, owner, places.key, _CROWN)
    return _usable(Stems(places, height, crown))


def _point_stems(spec: ForestSpec, features: Features, where: str, site: Site, most: int) -> Stems:
    if spec.density is not None:
        raise LevelError(f"{where}.density", spec.density, "no density: the source has points, each a tree")
    x, y = shapely.get_x(features.geometry), shapely.get_y(features.geometry)
    on = np.flatnonzero(site.elevation.covers(*site.on_terrain(x, y)))
    if not len(on):
        raise _outside(where, shapely.total_bounds(features.geometry), site)
    key, first = np.unique(point_keys(spec.seed, x[on] * site.unit_m, y[on] * site.unit_m), return_index=True)
    first = on[first]
    if len(key) > most:
        raise _too_many(where, len(key), most)
    height_source = spec.height or (POINT_HEIGHT if POINT_HEIGHT in features.attributes else HEIGHT_M)
    height = _values(height_source, features, first, key, _HEIGHT)
    crown = None if spec.crown is None else _values(spec.crown, features, first, key, _CROWN)
    return _usable(Stems(Places(x[first], y[first], key), height, crown))


def _canopy_stems(spec: ForestSpec, source: str, where: str, site: Site, most: int) -> Stems:
    for name in ("density", "height"):
        if getattr(spec, name) is not None:
            raise LevelError(f"{where}.{name}", getattr(spec, name), f"no {name}: the source is a raster of canopy heights")
    if isinstance(spec.crown, str):
        raise LevelError(f"{where}.crown", spec.crown, "[least, most] in metres: a raster has no attributes")
    canopy, stands, count = Canopy(source), [], 0
    try:
        window = canopy.window(site.crs, site.outline)
        if window is None:
            raise _outside(where, shapely.total_bounds(shapely.MultiPoint(canopy.outline(site.crs))), site)
        base, slope = _line(CROWN_M, spec.species)
        window_m = _line(TREETOP_WINDOW_M, spec.species)
        for piece in canopy.trees(site.crs, site.unit_m, window, lambda h: base + slope * h, window_m, spec.seed):
            stands.append(piece)
            count += len(piece.places)
            if count > most:
                raise _too_many(where, count, most, "or more")
        if not count and not canopy.any_known():
            raise SourceError(source, "no height in any cell (all nodata)", "a raster with canopy heights")
    finally:
        canopy.close()
    places, first = join_places([piece.places for piece in stands])
    height = np.concatenate([piece.height_m for piece in stands] or [np.empty(0)])[first]
    crown = None if spec.crown is None else _values(spec.crown, None, first, places.key, _CROWN)
    return Stems(places, height, crown, MAX_CROWN_RATIO * room_m(places.x, places.y, site.unit_m))


def _planted(stems: Stems, species: Species, where: str, site: Site) -> Trees:
    """Stems on the ground, with all that is drawn from their hashes."""
    x, y = site.on_terrain(stems.places.x, stems.places.y)
    on = site.elevation.covers(x, y)
    if len(on) and not on.any():
        raise _outside(where, shapely.total_bounds(shapely.MultiPoint(np.column_stack([stems.places.x, stems.places.y]))), site)
    ground_m = site.elevation.ground_m(x, y)
    there = ground_m > site.elevation.water_m
    stems, x, y, ground_m = stems[there], x[there], y[there], ground_m[there]
    key = stems.places.key
    variant = _looks(key, species)
    if stems.crown_m is None:
        crown_m = _own_crown_m(stems.height_m, variant, shares(key, _SPREAD))
        crown_m = crown_m if stems.room_m is None else np.minimum(crown_m, stems.room_m)
    else:
        crown_m = stems.crown_m
    point, up = site.world.ground(site.elevation.crs, x, y)
    return Trees(
        base_earth_m=point + ground_m[:, None] * up,
        height_m=stems.height_m.astype(np.float32),
        crown_m=crown_m.astype(np.float32),
        turn_deg=(180.0 * shares(key, _TURN)).astype(np.float32) % np.float32(180.0),
        variant=variant,
        rank=np.zeros(len(key), np.float32),  # given to all stands together
    )


def _looks(key: np.ndarray, species: Species) -> np.ndarray:
    """Looks uint8 (n,) of a species; of ``mixed`` stands half the trees are conifers."""
    kinds = {
        kind: np.array([n for n, variant in enumerate(TREE_VARIANTS) if variant.species == kind], np.uint8) for kind in CROWN_M
    }
    share = shares(key, _LOOK)
    drawn = {kind: looks[(share * len(looks)).astype(int)] for kind, looks in kinds.items()}
    if species != "mixed":
        return drawn[species]
    return np.where(shares(key, _SPECIES) < 0.5, drawn["conifer"], drawn["broadleaf"])


def _line(lines: dict[str, tuple[float, float]], species: Species) -> tuple[float, float]:
    """Metres, and metres per metre of height, for a species (``mixed``: between both)."""
    of_species = list(lines.values()) if species == "mixed" else [lines[species]]
    base, slope = np.mean(of_species, axis=0).tolist()
    return base, slope


def _own_crown_m(height_m: np.ndarray, variant: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Diameters of single crowns: their species' usual ones, wider or narrower as the look is among its kin."""
    mean_ratio = {kind: np.mean([k.crown_to_height for k in TREE_VARIANTS if k.species == kind]) for kind in CROWN_M}
    base, slope, wide = np.array([(*CROWN_M[k.species], k.crown_to_height / mean_ratio[k.species]) for k in TREE_VARIANTS]).T[
        :, variant
    ]
    return (base + slope * height_m) * wide * (1.0 + CROWN_SPREAD * (2.0 * share - 1.0))


def _values(
    given: tuple[float, float] | str, features: Features | None, row: np.ndarray, key: np.ndarray, stream: int
) -> np.ndarray:
    """Metres float64 (n,): from a range by the trees' hashes, or an attribute of their features (NaN where not usable)."""
    if not isinstance(given, str):
        return given[0] + (given[1] - given[0]) * shares(key, stream)
    assert features is not None
    values = numbers(features, given)
    with np.errstate(invalid="ignore"):
        usable = (values >= USABLE_M[0]) & (values <= USABLE_M[1])
    if not usable.any():
        raise SourceError(features.name, f"{given} = {values[0]:g} ...", f"metres from {USABLE_M[0]} to {USABLE_M[1]:g}")
    return np.where(usable, values, np.nan)[row]


def _usable(stems: Stems) -> Stems:
    known = np.isfinite(stems.height_m)
    return stems[known if stems.crown_m is None else known & np.isfinite(stems.crown_m)]


def _parts(features: Features) -> Features:
    """The same features, collections and multi-parts taken apart."""
    geometry, row = features.geometry, np.arange(len(features.geometry))
    while (shapely.get_type_id(geometry) > 3).any():
        geometry, index = shapely.get_parts(geometry, return_index=True)
        row = row[index]
    there = ~shapely.is_empty(geometry)
    geometry, row = geometry[there], row[there]
    return Features(features.name, geometry, {name: values[row] for name, values in features.attributes.items()}, features.dropped)


def _moved(source: CRS, target: CRS, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (x, y) if source == target else transformer(source, target).transform(x, y)


def _too_many(where: str, count: int, most: int, more: str = "") -> LevelError:
    rest = "" if most == MAX_TREES else f", {most:,} of which are left for this stand"
    return LevelError(where, " ".join(f"{count:,} trees {more}".split()), f"at most {MAX_TREES:,} trees in a level{rest}")


def _outside(where: str, bounds: np.ndarray, site: Site) -> LevelError:
    """The error of a stand of which nothing is on the terrain; ``bounds`` in the site's map."""
    crs = site.elevation.crs
    if site.crs != crs:
        try:
            west, south, east, north = bounds
            bounds = np.array(transformer(site.crs, crs).transform_bounds(west, south, east, north, densify_pts=21))
        except ProjError:
            bounds = np.full(4, np.nan)
    stand, terrain = (", ".join(f"{v:.9g}" for v in b) for b in (bounds, site.elevation.bounds))
    return LevelError(
        f"{where}.source", f"trees at {stand}", f"trees on the terrain, at {terrain} (west, south, east, north; {crs.name})"
    )
