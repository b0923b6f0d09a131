"""The horizon profile of a point by all casters, and the objects that hide the sun from it.

A point is lit if two conditions hold. Its ray towards the centre of the sun's disc meets nothing, and the sun is above the
horizontal plane through the eye. With a sun below that plane no point is lit (``Scene.sun_is_up``), because the terrain beyond the
edge of a level's data is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from skugga.shadows.point.directions import Directions, sort_directions
from skugga.shadows.point.horizon_walk import ReliefHorizon, is_ground_occluded, relief_horizon, relief_tangents
from skugga.shadows.point.leaf_sight import VisibleTrees, highest_leaves, nearest_leaves, visible_trees
from skugga.shadows.point.place import PointPlace
from skugga.shadows.point.solid_sight import Sighting, empty_sighting, highest_solids, nearest_solids
from skugga.shadows.point.terms import CasterType
from skugga.terrain.compiled import map_on_cores
from skugga.terrain.gbuffer.tree_instances import tree_instances_in_map
from skugga.terrain.geo.world import geodetic
from skugga.terrain.scene import Scene

HORIZON_DIRECTIONS = 720
"""Default number of directions of a horizon: every half degree."""

GROUND, SOLIDS, LEAVES = range(3)
"""Groups of casters: the ground, buildings and meshes, and trees."""

TREE_PIXEL_M = 1e-3
"""Pixel size in metres for which the tree instances of a map are requested: so small that no tree is dropped as invisible."""


@dataclass(frozen=True)
class SunCaster:
    """An object that hides the sun, or forms the horizon.

    Attributes
    ----------
    kind
        The kind of caster.
    distance_m
        Distance along the ground, metres.
    azimuth_deg
        Azimuth, clockwise from true north.
    elevation_deg
        Elevation angle above the horizontal plane through the eye.
    height_m
        Height of the highest point of the caster in this azimuth, metres.
    lon_deg, lat_deg
        Longitude and latitude of this point; ``None`` in a flat world.
    """

    kind: CasterType
    distance_m: float
    azimuth_deg: float
    elevation_deg: float
    height_m: float
    lon_deg: float | None
    lat_deg: float | None


@dataclass(frozen=True, eq=False)
class PointHorizon:
    """The horizon profile around a point: elevation angles above the horizontal plane through the eye, in degrees.

    Attributes
    ----------
    azimuth_deg
        (n,), clockwise from true north.
    relief_deg
        (n,): elevation angle of the ground; -90 without any.
    solids_deg
        (n,): elevation angle of buildings and meshes; -90 without any.
    forest_deg
        (n,): elevation angle of leaves; -90 without any.
    """

    azimuth_deg: np.ndarray
    relief_deg: np.ndarray
    solids_deg: np.ndarray
    forest_deg: np.ndarray

    @property
    def elevation_deg(self) -> np.ndarray:
        """The elevation angle of the horizon by all casters, degrees (n,)."""
        return np.maximum(np.maximum(self.relief_deg, self.solids_deg), self.forest_deg)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A place and the casters around it.

    Attributes
    ----------
    scene
        The scene.
    place
        The place.
    point_enu_m
        (k, 3) metres: vertices of meshes, east, north and up from the eye.
    triangles
        int (m, 3): triangles of these vertices.
    is_building
        bool (m,): triangles that belong to buildings.
    trees
        The trees; ``None`` without any.
    """

    scene: Scene
    place: PointPlace
    point_enu_m: np.ndarray
    triangles: np.ndarray
    is_building: np.ndarray
    trees: VisibleTrees | None


def load_surroundings(scene: Scene, place: PointPlace) -> Surroundings:
    """Return the casters around a place. Raises the errors of reading a level's meshes and trees."""
    points, triangles, is_building = np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros(0, bool)
    solids, placement = scene.objects.solids, scene.objects.placement
    if solids is not None and placement is not None:
        points, triangles = place.in_enu(solids.caster_vertices_earth_m), solids.caster_triangles
        counts = [len(placed.body.triangles) for placed in placement.casting_bodies]
        is_building = np.repeat(np.array(placement.is_casting_body_building, bool), counts)
    return Surroundings(scene, place, points, triangles, is_building, _trees_around(scene, place))


def horizon_profile(surroundings: Surroundings, azimuth_deg: np.ndarray | None = None) -> PointHorizon:
    """Return the horizon of a place towards azimuths (n,); by default ``HORIZON_DIRECTIONS`` from north on."""
    if azimuth_deg is None:
        azimuth_deg = np.arange(HORIZON_DIRECTIONS) * (360.0 / HORIZON_DIRECTIONS)
    ground = relief_horizon(surroundings.scene, surroundings.place, azimuth_deg)
    solids, leaves = _highest_objects(surroundings, sort_directions(azimuth_deg))
    return PointHorizon(
        np.asarray(azimuth_deg, np.float64),
        _degrees_of_tangent(ground.tangent),
        _degrees_of_tangent(solids.tangent),
        _degrees_of_tangent(leaves.tangent),
    )


def horizon_angles(scene: Scene, places: Sequence[PointPlace], azimuth_deg: np.ndarray) -> np.ndarray:
    """Return the horizons of places (p,) by all casters: elevation angles (p, n) in degrees, towards azimuths (n,) in degrees.

    They are those of ``horizon_profile``. The places are divided among all cores. Raises the errors of reading meshes and trees.
    """
    angle_deg = _degrees_of_tangent(relief_tangents(scene, places, azimuth_deg))
    if scene.objects.solids is None and scene.objects.trees is None:
        return angle_deg
    directions = sort_directions(azimuth_deg)

    def raise_to_objects(n: int) -> None:
        for sighting in _highest_objects(load_surroundings(scene, places[n]), directions):
            angle_deg[n] = np.maximum(angle_deg[n], _degrees_of_tangent(sighting.tangent))

    map_on_cores(raise_to_objects, range(len(places)))
    return angle_deg


def sees_sun(surroundings: Surroundings, azimuth_deg: np.ndarray, altitude_deg: np.ndarray) -> np.ndarray:
    """Return whether rays towards suns at azimuths and altitudes (n,) meet no caster: bool (n,).

    The result is False for suns with an altitude of at most 0.
    """
    azimuth, altitude = (np.asarray(v, np.float64) for v in (azimuth_deg, altitude_deg))
    lit = altitude > 0.0
    up = np.flatnonzero(lit)
    lit[up] = ~is_ground_occluded(surroundings.scene, surroundings.place, azimuth[up], _tangent_of_altitude(altitude[up]))
    left = np.flatnonzero(lit)
    lit[left] = is_clear_of_objects(surroundings, azimuth[left], altitude[left])
    return lit


def is_clear_of_objects(surroundings: Surroundings, azimuth_deg: np.ndarray, altitude_deg: np.ndarray) -> np.ndarray:
    """Return whether rays towards azimuths and altitudes (n,) meet neither meshes nor leaves: bool (n,)."""
    free = np.ones(len(azimuth_deg), bool)
    for kind in ("meshes", "forest"):
        left = np.flatnonzero(free)
        (sighted,) = _nearest_occluders(surroundings, azimuth_deg[left], _tangent_of_altitude(altitude_deg[left]), (kind,))
        free[left] = sighted.object_index < 0
    return free


def sun_occluders(surroundings: Surroundings, azimuth_deg: np.ndarray, altitude_deg: np.ndarray) -> list[SunCaster | None]:
    """Return the caster that hides each of n suns; ``None`` for a sun that is not hidden, or not up.

    If ground, a solid and leaves hide the same sun, the one with the largest elevation angle in this azimuth is returned. The
    position of the result is the caster's highest point in this azimuth.
    """
    azimuth, altitude = (np.atleast_1d(np.asarray(v, np.float64)) for v in (azimuth_deg, altitude_deg))
    hiding = _hiding_casters(surroundings, azimuth, altitude)
    occluders: list[SunCaster | None] = []
    for n, group in enumerate(hiding.group):
        if group < 0:
            occluders.append(None)
        elif group == GROUND:
            occluders.append(_ground_caster(surroundings.place, hiding.ground, n))
        else:
            sighting = hiding.solids if group == SOLIDS else hiding.leaves
            kind = _solid_kind(surroundings, int(sighting.object_index[n])) if group == SOLIDS else "forest"
            occluders.append(_object_caster(surroundings.place, kind, azimuth[n], sighting, n))
    return occluders


def sun_occluder_groups(surroundings: Surroundings, azimuth_deg: np.ndarray, altitude_deg: np.ndarray) -> np.ndarray:
    """Return the group of the caster that hides each of n suns: ``GROUND``, ``SOLIDS``, ``LEAVES``, or -1 for none.

    The casters are those of ``sun_occluders``; this is faster for many suns.
    """
    azimuth, altitude = (np.asarray(v, np.float64) for v in (azimuth_deg, altitude_deg))
    return _hiding_casters(surroundings, azimuth, altitude).group


@dataclass(frozen=True, eq=False)
class _HidingCasters:
    """The casters that hide n suns.

    Attributes
    ----------
    group
        int (n,): the group of the caster that hides each sun; -1 for none.
    ground, solids, leaves
        The highest casters of each group in the suns' azimuths. Solids and leaves are known only where an object hides the sun.
    """

    group: np.ndarray
    ground: ReliefHorizon
    solids: Sighting
    leaves: Sighting


def _hiding_casters(surroundings: Surroundings, azimuth_deg: np.ndarray, altitude_deg: np.ndarray) -> _HidingCasters:
    """Return the casters that hide suns at azimuths and altitudes (n,), by the rule of ``sun_occluders``."""
    ground = relief_horizon(surroundings.scene, surroundings.place, azimuth_deg)
    sun_tangent, is_up = _tangent_of_altitude(altitude_deg), altitude_deg > 0.0
    nearest = _nearest_occluders(surroundings, azimuth_deg, sun_tangent)
    is_hidden = np.stack([sun_tangent <= ground.tangent, *(near.object_index >= 0 for near in nearest)]) & is_up
    by_object = np.flatnonzero(is_hidden[SOLIDS] | is_hidden[LEAVES])
    for near, top in zip(nearest, _highest_objects(surroundings, sort_directions(azimuth_deg[by_object])), strict=True):
        is_seen = top.object_index >= 0
        for values, highest in zip(near, top, strict=True):
            values[by_object[is_seen]] = highest[is_seen]
    solids, leaves = nearest
    tangent = np.where(is_hidden, np.stack([ground.tangent, solids.tangent, leaves.tangent]), -np.inf)
    group = np.where(is_hidden.any(axis=0), np.argmax(tangent, axis=0), -1)
    return _HidingCasters(group, ground, solids, leaves)


def _trees_around(scene: Scene, place: PointPlace) -> VisibleTrees | None:
    """Return the trees that are visible from a place; ``None`` without any."""
    if scene.objects.trees is None:
        return None
    frame = scene.world.frame_near_earth(place.eye_earth_m)
    instances = tree_instances_in_map(scene.objects, frame, TREE_PIXEL_M)
    if instances is None:
        return None
    enu_from_frame = place.earth_from_enu.T @ frame.frame_from_earth.T
    return visible_trees(instances, enu_from_frame, frame.points_from_earth(place.eye_earth_m))


def _highest_objects(surroundings: Surroundings, directions: Directions) -> tuple[Sighting, Sighting]:
    """Return the solids and the leaves with the largest elevation angles towards directions.

    The results have the order of the azimuths before they were sorted.
    """
    count = len(directions.azimuth_deg)
    solids, leaves = empty_sighting(count), empty_sighting(count)
    highest_solids(surroundings.point_enu_m, surroundings.triangles, directions, solids)
    if surroundings.trees is not None:
        highest_leaves(surroundings.trees, directions, leaves)
    return _in_input_order(solids, directions), _in_input_order(leaves, directions)


def _nearest_occluders(
    surroundings: Surroundings, azimuth_deg: np.ndarray, tangent: np.ndarray, kinds: tuple[str, ...] = ("meshes", "forest")
) -> list[Sighting]:
    """Return, for each kind of objects, the nearest one that each ray meets.

    A ray has an azimuth in degrees and the tangent of its elevation angle, (n,) each. The results have the order of the rays.
    """
    directions = sort_directions(azimuth_deg)
    ordered, sightings = tangent[directions.input_index], []
    for kind in kinds:
        sighted = empty_sighting(len(ordered))
        if kind == "meshes":
            nearest_solids(surroundings.point_enu_m, surroundings.triangles, directions, ordered, sighted)
        elif surroundings.trees is not None:
            nearest_leaves(surroundings.trees, directions, ordered, sighted)
        sightings.append(_in_input_order(sighted, directions))
    return sightings


def _in_input_order(sighting: Sighting, directions: Directions) -> Sighting:
    """Return a sighting in the order of the azimuths before they were sorted."""
    out = empty_sighting(len(directions.input_index))
    for target, ordered in zip(out, sighting, strict=True):
        target[directions.input_index] = ordered
    return out


def _solid_kind(surroundings: Surroundings, triangle: int) -> CasterType:
    """Return the kind of the solid to which a triangle belongs."""
    return "building" if surroundings.is_building[triangle] else "mesh"


def _ground_caster(place: PointPlace, ground: ReliefHorizon, n: int) -> SunCaster:
    """Return the ground that forms the horizon in the direction with index ``n`` of ``ground`` as a caster."""
    azimuth, distance = float(ground.azimuth_deg[n]), float(ground.distance_m[n])
    lon = lat = None
    if place.lon_deg is not None:
        lon, lat, _ = place.ellipsoid.fwd(place.lon_deg, place.lat_deg, azimuth, distance)
    return SunCaster(
        "relief", distance, azimuth, float(_degrees_of_tangent(ground.tangent[n])), float(ground.height_m[n]), lon, lat
    )


def _object_caster(place: PointPlace, kind: CasterType, azimuth_deg: float, sighting: Sighting, n: int) -> SunCaster:
    """Return the object seen in the direction with index ``n`` of ``sighting`` as a caster.

    ``azimuth_deg`` is the azimuth of this direction.
    """
    azimuth, distance = np.radians(azimuth_deg), float(sighting.distance_m[n])
    enu = np.array([distance * np.sin(azimuth), distance * np.cos(azimuth), distance * float(sighting.tangent[n])])
    point = place.eye_earth_m + place.earth_from_enu @ enu
    lon = lat = None
    height = float(point[2])
    if place.lon_deg is not None:
        lon, lat, height = (float(v) for v in geodetic(point, place.ellipsoid))
    return SunCaster(kind, distance, float(azimuth_deg), float(_degrees_of_tangent(sighting.tangent[n])), height, lon, lat)


def _tangent_of_altitude(altitude_deg: np.ndarray) -> np.ndarray:
    """Return the tangents of altitudes in degrees."""
    return np.tan(np.radians(np.minimum(altitude_deg, 90.0 - 1e-9)))


def _degrees_of_tangent(tangent: np.ndarray) -> np.ndarray:
    """Return the angles, degrees, whose tangents are ``tangent``."""
    return np.degrees(np.arctan(tangent))
