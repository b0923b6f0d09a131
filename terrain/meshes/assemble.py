"""Place a level's meshes on its ground: buildings, models and generated bodies as one set of triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skugga.terrain.errors import LevelError, Problem
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.geolocate import Geolocator
from skugga.terrain.ground.ground_path import path_over_ground
from skugga.terrain.level.level import LoadedLevel
from skugga.terrain.level.model import MapPosition
from skugga.terrain.level.parts import MeshSpec
from skugga.terrain.meshes.body import Body, BodyMotion, PlacedBody, srgb_albedo, transformed, turn_about_up
from skugga.terrain.meshes.buildings import buildings
from skugga.terrain.meshes.models import is_model, read_model
from skugga.terrain.meshes.solids import Solids

MODEL_KEYS = ("at", "scale", "turn", "caster", "motion")
"""Keys of a mesh that do not apply to footprints, whose file holds their positions."""

FOOTPRINT_KEYS = ("height", "surface", "ground", "roof", "layer")
"""Keys of a mesh that apply to footprints only."""


@dataclass(frozen=True, eq=False)
class Placement:
    """All placed bodies of a level.

    Attributes
    ----------
    seen
        The visible bodies.
    casting
        The casting bodies: the visible ones, or their stand-ins.
    casting_buildings
        For each casting body whether it is a building, which is an extruded footprint.
    notes
        Data read from the files of footprints, in words.
    warnings
        Data of these files that was not used, in words.
    """

    seen: tuple[PlacedBody, ...]
    casting: tuple[PlacedBody, ...]
    casting_buildings: tuple[bool, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class _Pose:
    """An earth-fixed point, and a rotation (3, 3) from local east, north, up, or from a body's axes, to earth-fixed axes."""

    point_earth_m: np.ndarray
    earth_from_enu: np.ndarray


def place_meshes(loaded: LoadedLevel, world: World, elevation: Elevation) -> Placement:
    """Return a level's meshes and their positions, independent of its clock.

    Raises ``LevelError`` for a key that does not apply, a position off the terrain or a path under the ground, ``SourceError`` for
    an unusable file.
    """
    seen: list[PlacedBody] = []
    casting: list[PlacedBody] = []
    are_buildings: list[bool] = []
    notes: list[str] = []
    warnings: list[str] = []
    place = Geolocator(world, elevation)
    for number, spec in enumerate(loaded.level.meshes):
        where = f"{loaded.path}: meshes.{number}"
        from_footprints = spec.source is not None and not is_model(spec.source)
        if from_footprints:
            _reject_keys(spec, MODEL_KEYS, where, "does not apply to footprints, whose file holds their positions")
            placed_buildings = buildings(spec, where, loaded, world, elevation)
            placed = stand_ins = placed_buildings.bodies
            notes += [f"{spec.source}: {note}" for note in placed_buildings.notes]
            warnings += [f"{spec.source}: {warning}" for warning in placed_buildings.warnings]
        else:
            _reject_keys(spec, FOOTPRINT_KEYS, where, "applies to footprints only")
            motion = _motion(spec, where, place)
            poses = _poses(spec, motion, where, place)
            placed = stand_ins = _place_bodies(_bodies(spec, loaded), spec, poses, motion)
            if spec.caster is not None:
                stand_ins = _place_bodies([read_model(loaded.resolve(spec.caster))], spec, poses, motion)
        seen += placed
        casting += stand_ins
        are_buildings += [from_footprints] * len(stand_ins)
    visible_bodies = tuple(seen)
    casting_bodies = visible_bodies if all(spec.caster is None for spec in loaded.level.meshes) else tuple(casting)
    return Placement(visible_bodies, casting_bodies, tuple(are_buildings), tuple(notes), tuple(warnings))


def solids(placement: Placement, seconds: float) -> Solids:
    """Return the triangles of placed bodies at a time of the clock."""
    pose_cache: dict[int, _Pose] = {}
    seen = [_pose(placed, seconds, pose_cache) for placed in placement.seen]
    vertices, triangles = _concatenate(seen)
    shares_casters = placement.casting is placement.seen
    casting = seen if shares_casters else [_pose(placed, seconds, pose_cache) for placed in placement.casting]
    caster_vertices, caster_triangles = (vertices, triangles) if shares_casters else _concatenate(casting)
    counts = [len(body.triangles) for body, _ in seen]
    normals = [body.corner_normals() @ pose.earth_from_enu.T.astype(np.float32) for body, pose in seen]
    return Solids(
        vertices_earth_m=vertices,
        triangles=triangles,
        albedo=np.concatenate([np.empty((0, 3), np.float32), *(body.albedo for body, _ in seen)]),
        corner_normals_earth=np.concatenate([np.empty((0, 3, 3), np.float32), *normals]),
        body=np.repeat(np.arange(len(seen), dtype=np.int32), counts),
        closed=tuple(body.closed for body, _ in seen),
        caster_vertices_earth_m=caster_vertices,
        caster_triangles=caster_triangles,
    )


def _concatenate(bodies: Sequence[tuple[Body, _Pose]]) -> tuple[np.ndarray, np.ndarray]:
    """Return earth-fixed vertices (n, 3) and triangles (m, 3) int32 of all bodies."""
    first = np.cumsum([0, *(len(body.vertices_m) for body, _ in bodies)])
    vertices = [pose.point_earth_m + body.vertices_m @ pose.earth_from_enu.T for body, pose in bodies]
    triangles = [body.triangles + np.int32(first_vertex) for (body, _), first_vertex in zip(bodies, first, strict=False)]
    return np.concatenate([np.empty((0, 3)), *vertices]), np.concatenate([np.empty((0, 3), np.int32), *triangles])


def _pose(placed: PlacedBody, seconds: float, pose_cache: dict[int, _Pose]) -> tuple[Body, _Pose]:
    """Return a body with its origin and rotation at a time of the clock. ``pose_cache`` caches them by the id of the motion."""
    motion = placed.motion
    if motion is None:
        return placed.body, _Pose(placed.origin_earth_m, placed.earth_from_body)
    if motion.path is None:
        return placed.body, _Pose(placed.origin_earth_m, placed.earth_from_body @ turn_about_up(motion.turn_deg(seconds)))
    pose = pose_cache.get(id(motion))
    if pose is None:
        point, up, _ = motion.path.at_second(seconds)
        axes = motion.path.place.world.earth_from_enu(point, up) @ turn_about_up(motion.turn_deg(seconds))
        pose = pose_cache[id(motion)] = _Pose(point, axes)
    return placed.body, pose


def _bodies(spec: MeshSpec, loaded: LoadedLevel) -> list[Body]:
    if spec.generate is None:
        assert spec.source is not None
        bodies = [read_model(loaded.resolve(spec.source))]
    else:
        from skugga.terrain.meshes.generators import GENERATORS

        bodies = GENERATORS[spec.generate]()
    if spec.color is None:
        return bodies
    return [Body(body.vertices_m, body.triangles, srgb_albedo(spec.color)) for body in bodies]


def _place_bodies(bodies: list[Body], spec: MeshSpec, poses: list[_Pose], motion: BodyMotion | None) -> list[PlacedBody]:
    """Return the bodies placed at every spot. All copies of a body share one ``Body``."""
    turned = [transformed(body, turn_deg=spec.turn, scale=spec.scale) for body in bodies]
    return [PlacedBody(body, pose.point_earth_m, pose.earth_from_enu, motion) for pose in poses for body in turned]


def _motion(spec: MeshSpec, where: str, place: Geolocator) -> BodyMotion | None:
    """Return the motion of a level's mesh, if any. Raises ``LevelError`` for a path off the terrain or under the ground."""
    motion = spec.motion
    if motion is None or not motion.moves:
        return None
    if motion.path is None:
        return BodyMotion(motion.spin)
    name = f"{where}.motion.path"
    path = path_over_ground([(key.seconds, key.place) for key in motion.path], motion.loop, motion.above, place, name, "position")
    path.check(name)
    return BodyMotion(motion.spin, path, motion.face == "along")


def _poses(spec: MeshSpec, motion: BodyMotion | None, where: str, place: Geolocator) -> list[_Pose]:
    """Return the spots of a level's mesh before it moves; for a mesh on a path, that of its first key."""
    if motion is None or motion.path is None:
        places: Sequence[MapPosition | None] = spec.places or [None]
        return [_ground_pose(position, where, place) for position in places]
    point, up, _ = motion.path.at_second(float(motion.path.plan.times_s[0]))
    return [_Pose(point, place.world.earth_from_enu(point, up))]


def _ground_pose(at: MapPosition | None, where: str, place: Geolocator) -> _Pose:
    """Return the ground at a position of a level (``None``: the anchor). Raises ``LevelError`` off the terrain."""
    world, elevation = place.world, place.elevation
    x, y = (world.anchor_x, world.anchor_y) if at is None else place.xy(at)
    height = float(elevation.filled_ground_m(x, y)) if np.isfinite([x, y]).all() else np.nan
    if not np.isfinite(height):
        if at is None:
            raise LevelError.missing(f"{where}.at", f"Set a position on the terrain: within {place.extent}")
        raise LevelError(f"{where}.at", at, f"a position on the terrain: within {place.extent}")
    point, up = world.ground(elevation.crs, np.float64(x), np.float64(y))
    return _Pose(point + height * up, world.earth_from_enu(point, up))


def _reject_keys(spec: MeshSpec, keys: tuple[str, ...], where: str, problem: str) -> None:
    for key in keys:
        if key in spec.model_fields_set:
            raise LevelError(f"{where}.{key}", Problem(problem), "Remove this key")
