"""A level's meshes set on its ground: buildings, models and generated bodies as one set of triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrain.errors import LevelError
from terrain.geo.world import World
from terrain.ground.elevation import Elevation
from terrain.ground.geolocate import Geolocator
from terrain.level.level import LoadedLevel
from terrain.level.parts import MapPosition, MeshSpec
from terrain.meshes.body import Body, PlacedBody, srgb_albedo, transformed, turn_about_up
from terrain.meshes.buildings import bounds_text, buildings
from terrain.meshes.models import is_model, read_model
from terrain.meshes.solids import Solids

MODEL_KEYS = ("at", "scale", "turn", "caster", "motion")
"""Keys of a mesh that footprints, which stand where their file says, have no use for."""

FOOTPRINT_KEYS = ("height", "surface", "ground", "roof")
"""Keys of a mesh that anything but footprints has no use for."""


@dataclass(frozen=True, eq=False)
class Placement:
    """All bodies of a level where they stand: those that are seen, and those that cast (the same, or stand-ins).

    ``casting_buildings`` says of each that casts whether it is a building: a footprint that was extruded.
    """

    seen: tuple[PlacedBody, ...]
    casting: tuple[PlacedBody, ...]
    casting_buildings: tuple[bool, ...] = ()


@dataclass(frozen=True, eq=False)
class _Spot:
    """A point on the ground, earth-fixed, and the rotation (3, 3) from east, north, up there to earth-fixed axes."""

    point_earth_m: np.ndarray
    earth_from_enu: np.ndarray


def place_meshes(loaded: LoadedLevel, world: World, elevation: Elevation) -> Placement:
    """What a level's meshes are and where they stand, whatever its clock says.

    Raises ``LevelError`` for a key that does not fit or a place off the terrain, ``SourceError`` for a file that cannot be used.
    """
    seen: list[PlacedBody] = []
    casting: list[PlacedBody] = []
    are_buildings: list[bool] = []
    for number, spec in enumerate(loaded.level.meshes):
        where = f"{loaded.path}: meshes.{number}"
        from_footprints = spec.source is not None and not is_model(spec.source)
        if from_footprints:
            _refuse(spec, MODEL_KEYS, where, "no such key for footprints, which stand where their file says")
            standing = stand_ins = buildings(spec, where, loaded, world, elevation)
        else:
            _refuse(spec, FOOTPRINT_KEYS, where, "no such key but for footprints")
            places: Sequence[MapPosition | None] = spec.places or [None]
            spots = [_spot(position, where, world, elevation) for position in places]
            standing = stand_ins = _stood(_bodies(spec, loaded), spec, spots)
            if spec.caster is not None:
                stand_ins = _stood([read_model(loaded.resolve(spec.caster))], spec, spots)
        seen += standing
        casting += stand_ins
        are_buildings += [from_footprints] * len(stand_ins)
    visible_bodies = tuple(seen)
    casting_bodies = visible_bodies if all(spec.caster is None for spec in loaded.level.meshes) else tuple(casting)
    return Placement(visible_bodies, casting_bodies, tuple(are_buildings))


def solids(placement: Placement, seconds: float) -> Solids:
    """The triangles of placed bodies at a second of the clock."""
    seen, turned = placement.seen, [_earth_from_body(placed, seconds) for placed in placement.seen]
    vertices, triangles = _gathered(seen, seconds)
    same = placement.casting is seen
    caster_vertices, caster_triangles = (vertices, triangles) if same else _gathered(placement.casting, seconds)
    counts = [len(placed.body.triangles) for placed in seen]
    normals = [placed.body.corner_normals() @ axes.T.astype(np.float32) for placed, axes in zip(seen, turned, strict=True)]
    return Solids(
        vertices_earth_m=vertices,
        triangles=triangles,
        albedo=np.concatenate([np.empty((0, 3), np.float32), *(placed.body.albedo for placed in seen)]),
        corner_normals_earth=np.concatenate([np.empty((0, 3, 3), np.float32), *normals]),
        body=np.repeat(np.arange(len(seen), dtype=np.int32), counts),
        closed=tuple(placed.body.closed for placed in seen),
        caster_vertices_earth_m=caster_vertices,
        caster_triangles=caster_triangles,
        moving=any(placed.spin_deg_per_s != 0.0 for placed in (*seen, *placement.casting)),
    )


def _gathered(bodies: Sequence[PlacedBody], seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Earth-fixed vertices (n, 3) and triangles (m, 3) int32 of all bodies."""
    first = np.cumsum([0, *(len(placed.body.vertices_m) for placed in bodies)])
    vertices = [placed.origin_earth_m + placed.body.vertices_m @ _earth_from_body(placed, seconds).T for placed in bodies]
    triangles = [placed.body.triangles + np.int32(first_vertex) for placed, first_vertex in zip(bodies, first, strict=False)]
    return np.concatenate([np.empty((0, 3)), *vertices]), np.concatenate([np.empty((0, 3), np.int32), *triangles])


def _earth_from_body(placed: PlacedBody, seconds: float) -> np.ndarray:
    return placed.earth_from_body @ turn_about_up(placed.spin_deg_per_s * seconds)


def _bodies(spec: MeshSpec, loaded: LoadedLevel) -> list[Body]:
    if spec.generate is None:
        assert spec.source is not None
        bodies = [read_model(loaded.resolve(spec.source))]
    else:
        from terrain.meshes.generators import GENERATORS

        bodies = GENERATORS[spec.generate]()
    if spec.color is None:
        return bodies
    return [Body(body.vertices_m, body.triangles, srgb_albedo(spec.color)) for body in bodies]


def _stood(bodies: list[Body], spec: MeshSpec, spots: list[_Spot]) -> list[PlacedBody]:
    """The bodies at every spot; one body at several spots is one value."""
    spin = spec.motion.spin if spec.motion is not None else 0.0
    turned = [transformed(body, turn_deg=spec.turn, scale=spec.scale) for body in bodies]
    return [PlacedBody(body, spot.point_earth_m, spot.earth_from_enu, spin) for spot in spots for body in turned]


def _spot(at: MapPosition | None, where: str, world: World, elevation: Elevation) -> _Spot:
    """The ground at a place of a level, without one at the anchor. Raises ``LevelError`` off the terrain."""
    x, y = (world.anchor_x, world.anchor_y) if at is None else Geolocator(world, elevation).xy(at)
    height = float(elevation.filled_ground_m(x, y)) if np.isfinite([x, y]).all() else np.nan
    if not np.isfinite(height):
        raise LevelError(
            f"{where}.at", "nothing" if at is None else at, f"a position on the terrain: within {_extent(world, elevation)}"
        )
    point, up = world.ground(elevation.crs, np.float64(x), np.float64(y))
    return _Spot(point + height * up, world.earth_from_enu(point, up))


def _extent(world: World, elevation: Elevation) -> str:
    """The terrain's bounds in the terms of ``at``."""
    bounds = np.array(elevation.bounds)
    if world.flat:
        bounds = (bounds - np.tile([world.anchor_x, world.anchor_y], 2)) * world.metres_per_unit
    return bounds_text(bounds, elevation.crs)


def _refuse(spec: MeshSpec, keys: tuple[str, ...], where: str, allowed: str) -> None:
    for key in keys:
        if key in spec.model_fields_set:
            raise LevelError(f"{where}.{key}", getattr(spec, key), allowed)
