"""Count the planes in which the visible surfaces lie: the ground, and the facets of meshes."""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.probes import Probes
from skugga.terrain.gbuffer.facet_planes import MAX_PLANES, FacetPlanes, curved_triangle_mask, group_facets, visible_facets
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.ground.ground_plane import ground_plane
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

PlaneFacts = tuple[int | None, float]
"""``receiver_planes`` and ``plane_share`` of a ``Descriptor``."""

MAX_GROUPED_FACETS = 20_000
"""Upper bound of the number of facets of a level whose planes are counted for maps. It bounds the time to tenths of a second."""

MIN_ROOF_COSINE = 1e-6
"""Least cosine of the angle to the vertical of a facet that faces up: a float32 error above that of a wall."""


def plane_facts(scene: Scene, coarse_view: CoarseView | None, probes: Probes) -> PlaneFacts:
    """Return the number of planes of the visible ground and meshes, and the share of the visible surfaces that lies in them.

    The number is ``None`` if visible ground is not known to lie in one plane. 256 stands for all numbers above 255.
    In perspective, facets that no sample shows are not counted. A map counts those of the whole level that face up. Curved bodies
    have no planes. In a map, no mesh counts as lying in planes if any body is curved.

    Parameters
    ----------
    scene
        The scene.
    coarse_view
        The coarse view of a perspective view; ``None`` for a map.
    probes
        The visible points: those of the perspective view, or those of the whole level.
    """
    planes: FacetPlanes | None
    shares = {kind: float((probes.surface_kind == kind).mean()) if len(probes) else 0.0 for kind in (RELIEF, MESHES, FOREST)}
    is_plane = shares[RELIEF] == 0.0 or is_ground_plane(scene)
    if coarse_view is None:
        planes = _roof_planes(scene.objects) if is_plane else None
        curved_share = shares[MESHES] if curved_triangle_mask(scene.objects).any() else 0.0
    else:
        planes, curved_share = _coarse_view_planes(coarse_view, scene.objects)
    count = None
    if is_plane:
        many = planes is None or not planes.is_complete
        count = MAX_PLANES + 1 if many or planes is None else len(planes) + int(shares[RELIEF] > 0.0)
    return count, max(1.0 - curved_share - shares[FOREST] - (0.0 if is_plane else shares[RELIEF]), 0.0)


def is_ground_plane(scene: Scene) -> bool:
    """Return whether a level's ground is known to lie in one plane: level ground of a flat world, or a raster of constant slope."""
    low, high = scene.height_range_m
    return (scene.world.is_flat and low == high) or ground_plane(scene.world, scene.elevation) is not None


@cached("scene", MIB)
def _coarse_view_planes(coarse_view: CoarseView, objects: SceneObjects) -> tuple[FacetPlanes, float]:
    """Return the planes of the meshes in a coarse view, and the share of its points that lie on curved bodies."""
    facets = visible_facets(coarse_view.buffer, objects)
    curved_share = facets.is_curved[facets.facet_of_pixel].sum() / max(len(coarse_view.points_frame_m), 1)
    return facets.group(), float(curved_share)


@cached("scene", MIB)
def _roof_planes(objects: SceneObjects) -> FacetPlanes | None:
    """Return the planes of all facets that a map may show: those of bodies that are not curved and that face up.

    ``None`` if there are more than ``MAX_GROUPED_FACETS``.
    """
    solids, world = objects.solids, objects.world
    frame = world.frame_near_earth(world.anchor_earth_m)
    corners = np.zeros((0, 3, 3))
    if solids is not None:
        corners = frame.points_from_earth(solids.vertices_earth_m)[solids.triangles[~curved_triangle_mask(objects)]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    is_up = normal[:, 2] > MIN_ROOF_COSINE * length
    if is_up.sum() > MAX_GROUPED_FACETS:
        return None
    return group_facets(corners[is_up], normal[is_up] / length[is_up, None], length[is_up])
