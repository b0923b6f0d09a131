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
from skugga.terrain.meshes.body import Body, BodyMotion, PlacedBody, rotation_about_up, srgb_albedo, transformed
from skugga.terrain.meshes.buildings import buildings
from skugga.terrain.meshes.models import is_model, read_model
from skugga.terrain.meshes.solids import Solids
from skugga.terrain.meshes.surface import Surface, concatenate_surfaces

MODEL_KEYS = ("at", "scale", "turn", "caster", "motion")
"""Keys of a mesh that do not apply to footprints, whose file holds their positions."""

FOOTPRINT_KEYS = ("height", "surface", "ground", "roof", "eaves_m", "layer")
"""Keys of a mesh that apply to footprints only."""


@dataclass(frozen=True, eq=False)
class Placement:
    """All placed bodies of a level.

    Attributes
    ----------
    visible_bodies
        The visible bodies.
    casting_bodies
        The bodies that cast shadows: the visible ones, or simpler models (stand-ins) that the level's key ``caster`` names.
    is_casting_body_building
        For each body in ``casting_bodies`` whether it is a building (an extruded footprint).
    notes
        Sentences on the data that was read from the files of footprints.
    warnings
        Sentences on data of the files of footprints and models that was ignored.
    surface
        Textures and materials of the triangles of all visible bodies, in order; ``None`` if all have one colour.
    """

    visible_bodies: tuple[PlacedBody, ...]
    casting_bodies: tuple[PlacedBody, ...]
    is_casting_body_building: tuple[bool, ...] = ()
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    surface: Surface | None = None


@dataclass(frozen=True, eq=False)
class _Pose:
    """Position and orientation of a body: an earth-fixed point, and the rotation (3, 3) from the body's to earth-fixed axes.

    Before its motion a body's axes are local east, north and up, except for buildings.
    """

    point_earth_m: np.ndarray
    earth_from_enu: np.ndarray


def place_meshes(loaded: LoadedLevel, world: World, elevation: Elevation) -> Placement:
    """Return a level's meshes at the positions that they have before they move.

    The result holds for every time of the level's clock (simulated time): ``solids`` moves the bodies. Raises ``LevelError`` for a
    key that does not apply, a position off the terrain, or a mesh whose path goes under the ground. Raises ``SourceError`` for an
    unusable file.
    """
    visible: list[PlacedBody] = []
    casting: list[PlacedBody] = []
    are_buildings: list[bool] = []
    notes: list[str] = []
    warnings: list[str] = []
    geolocator = Geolocator(world, elevation)
    for number, spec in enumerate(loaded.level.meshes):
        key_path = f"{loaded.path}: meshes.{number}"
        from_footprints = spec.source is not None and not is_model(spec.source)
        if from_footprints:
            _reject_keys(spec, MODEL_KEYS, key_path, "does not apply to footprints, whose file holds their positions")
            placed_buildings = buildings(spec, key_path, loaded, world, elevation)
            placed = stand_ins = placed_buildings.bodies
            notes += [f"{spec.source}: {note}" for note in placed_buildings.notes]
            warnings += [f"{spec.source}: {warning}" for warning in placed_buildings.warnings]
        else:
            _reject_keys(spec, FOOTPRINT_KEYS, key_path, "applies to footprints only")
            motion = _motion(spec, key_path, geolocator)
            poses = _poses(spec, motion, key_path, geolocator)
            bodies = _bodies(spec, loaded)
            warnings += [f"{spec.source}: {warning}" for body in bodies for warning in body.warnings]
            placed = stand_ins = _place_bodies(bodies, spec, poses, motion)
            if spec.caster is not None:
                stand_ins = _place_bodies([read_model(loaded.resolve(spec.caster))], spec, poses, motion)
        visible += placed
        casting += stand_ins
        are_buildings += [from_footprints] * len(stand_ins)
    visible_bodies = tuple(visible)
    casting_bodies = visible_bodies if all(spec.caster is None for spec in loaded.level.meshes) else tuple(casting)
    surface = concatenate_surfaces(
        [placed.body.surface for placed in visible_bodies], [len(placed.body.triangles) for placed in visible_bodies]
    )
    return Placement(visible_bodies, casting_bodies, tuple(are_buildings), tuple(notes), tuple(warnings), surface)


def solids(placement: Placement, seconds: float) -> Solids:
    """Return the triangles of placed bodies at a second of the level's clock."""
    pose_cache: dict[int, _Pose] = {}
    visible = [_pose(placed, seconds, pose_cache) for placed in placement.visible_bodies]
    vertices, triangles = _concatenate(visible)
    shares_casters = placement.casting_bodies is placement.visible_bodies
    casting = visible if shares_casters else [_pose(placed, seconds, pose_cache) for placed in placement.casting_bodies]
    caster_vertices, caster_triangles = (vertices, triangles) if shares_casters else _concatenate(casting)
    counts = [len(body.triangles) for body, _ in visible]
    normals = [body.corner_normals() @ pose.earth_from_enu.T.astype(np.float32) for body, pose in visible]
    return Solids(
        vertices_earth_m=vertices,
        triangles=triangles,
        albedo=np.concatenate([np.empty((0, 3), np.float32), *(body.albedo for body, _ in visible)]),
        corner_normals_earth=np.concatenate([np.empty((0, 3, 3), np.float32), *normals]),
        body_index=np.repeat(np.arange(len(visible), dtype=np.int32), counts),
        is_closed=tuple(body.is_closed for body, _ in visible),
        caster_vertices_earth_m=caster_vertices,
        caster_triangles=caster_triangles,
    )


def spheres_with_surfaces(placement: Placement, seconds: float) -> list[tuple[Body, np.ndarray, float]]:
    """Return the visible bodies that have a ``Surface``, each with the centre (3,) of a sphere around it and its radius, metres."""
    pose_cache: dict[int, _Pose] = {}
    out = []
    for placed in placement.visible_bodies:
        if placed.body.surface_bounds and len(placed.body.triangles):
            body, pose = _pose(placed, seconds, pose_cache)
            centre, radius = body.bounding_sphere
            out.append((body, pose.point_earth_m + pose.earth_from_enu @ centre, radius))
    return out


def _concatenate(bodies: Sequence[tuple[Body, _Pose]]) -> tuple[np.ndarray, np.ndarray]:
    """Return earth-fixed vertices (n, 3) and triangles (m, 3) int32 of all bodies."""
    first = np.cumsum([0, *(len(body.vertices_m) for body, _ in bodies)])
    vertices = [pose.point_earth_m + body.vertices_m @ pose.earth_from_enu.T for body, pose in bodies]
    triangles = [body.triangles + np.int32(first_vertex) for (body, _), first_vertex in zip(bodies, first, strict=False)]
    return np.concatenate([np.empty((0, 3)), *vertices]), np.concatenate([np.empty((0, 3), np.int32), *triangles])


def _pose(placed: PlacedBody, seconds: float, pose_cache: dict[int, _Pose]) -> tuple[Body, _Pose]:
    """Return a body with its position and orientation at a second of the level's clock.

    ``pose_cache`` caches the poses on paths by the ``id`` of their ``BodyMotion``, which several bodies may share.
    """
    motion = placed.motion
    if motion is None:
        return placed.body, _Pose(placed.origin_earth_m, placed.earth_from_body)
    if motion.path is None:
        return placed.body, _Pose(placed.origin_earth_m, placed.earth_from_body @ rotation_about_up(motion.yaw_deg(seconds)))
    pose = pose_cache.get(id(motion))
    if pose is None:
        point, up, _ = motion.path.at_second(seconds)
        axes = motion.path.geolocator.world.earth_from_enu(point, up) @ rotation_about_up(motion.yaw_deg(seconds))
        pose = pose_cache[id(motion)] = _Pose(point, axes)
    return placed.body, pose


def _bodies(spec: MeshSpec, loaded: LoadedLevel) -> list[Body]:
    """Return the bodies of a mesh that a file or a generator makes, in their own coordinates.

    ``spec.color`` replaces their colours.
    """
    if spec.generate is None:
        assert spec.source is not None
        bodies = [read_model(loaded.resolve(spec.source))]
    else:
        from skugga.terrain.meshes.generators import GENERATORS

        bodies = GENERATORS[spec.generate]()
    if spec.color is None:
        return bodies
    return [Body(body.vertices_m, body.triangles, srgb_albedo(spec.color), warnings=body.warnings) for body in bodies]


def _place_bodies(bodies: list[Body], spec: MeshSpec, poses: list[_Pose], motion: BodyMotion | None) -> list[PlacedBody]:
    """Return the bodies placed at every pose. All copies of a body share one ``Body``."""
    rotated_bodies = [transformed(body, yaw_deg=spec.turn, scale=spec.scale) for body in bodies]
    return [PlacedBody(body, pose.point_earth_m, pose.earth_from_enu, motion) for pose in poses for body in rotated_bodies]


def _motion(spec: MeshSpec, key_path: str, geolocator: Geolocator) -> BodyMotion | None:
    """Return the motion of a level's mesh, if any. Raises ``LevelError`` for a path off the terrain or under the ground."""
    motion = spec.motion
    if motion is None or not motion.moves:
        return None
    if motion.path is None:
        return BodyMotion(motion.spin)
    name = f"{key_path}.motion.path"
    path = path_over_ground(
        [(key.seconds, key.position_3d) for key in motion.path], motion.loop, motion.above, geolocator, name, "position"
    )
    path.check(name)
    return BodyMotion(motion.spin, path, motion.face == "along")


def _poses(spec: MeshSpec, motion: BodyMotion | None, key_path: str, geolocator: Geolocator) -> list[_Pose]:
    """Return the poses of a level's mesh before it moves. A mesh on a path has the pose of its first keyframe."""
    if motion is None or motion.path is None:
        positions: Sequence[MapPosition | None] = spec.positions or [None]
        return [_ground_pose(position, key_path, geolocator) for position in positions]
    point, up, _ = motion.path.at_second(float(motion.path.horizontal_curve.times_s[0]))
    return [_Pose(point, geolocator.world.earth_from_enu(point, up))]


def _ground_pose(position: MapPosition | None, key_path: str, geolocator: Geolocator) -> _Pose:
    """Return the pose of an upright body on the ground at a position of a level (``None``: at the anchor).

    Raises ``LevelError`` for a position off the terrain.
    """
    world, elevation = geolocator.world, geolocator.elevation
    x, y = (world.anchor_x, world.anchor_y) if position is None else geolocator.xy(position)
    height = float(elevation.filled_ground_m(x, y)) if np.isfinite([x, y]).all() else np.nan
    if not np.isfinite(height):
        if position is None:
            raise LevelError.missing(f"{key_path}.at", f"Set a position on the terrain: within {geolocator.extent_text}")
        raise LevelError(f"{key_path}.at", position, f"a position on the terrain: within {geolocator.extent_text}")
    point, up = world.points_at_zero_height(elevation.crs, np.float64(x), np.float64(y))
    return _Pose(point + height * up, world.earth_from_enu(point, up))


def _reject_keys(spec: MeshSpec, keys: tuple[str, ...], key_path: str, problem: str) -> None:
    """Raise ``LevelError`` if a level's mesh sets one of ``keys``, which do not apply to it.

    ``key_path`` is the path of the mesh's key in the level file, ``problem`` the reason for the message.
    """
    for key in keys:
        if key in spec.model_fields_set:
            raise LevelError(f"{key_path}.{key}", Problem(problem), "Remove this key")
