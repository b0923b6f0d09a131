"""Measure the effect of each light on a view: the surfaces that it illuminates, the occluders, and the edges of its shadows.

All facts are measured by ray casting. The probes are the points of a coarse view, or in a map the points that are visible from
above anywhere in the level. Rays go from each probe, and from places beside it, to the light (``skugga.terrain.facts.probes``).
Each kind of casters is measured independently: a point that several kinds shade counts for each of them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from skugga.terrain.facts.fact_types import CastBand, Casting, LightFacts
from skugga.terrain.facts.leaf_rays import first_leaf_hits, is_blocked_by_leaves
from skugga.terrain.facts.mesh_rays import first_mesh_hits, is_blocked_by_meshes
from skugga.terrain.facts.probes import MAX_PROBES, MAX_PROBES_AMONG_TREES, ProbeRays, Probes, rays_to_light, stratified_indices
from skugga.terrain.facts.relief_rays import is_blocked_by_relief, overview_probes
from skugga.terrain.facts.silhouette_facts import MAX_EYE_RAYS, mean_volume_layers, projected_edge_length, silhouette_edges_of
from skugga.terrain.gbuffer.ground_mesh import ground_mesh, ground_nodes, nodes_have_gaps
from skugga.terrain.gbuffer.resolve import FOREST, RELIEF
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import SUN, CasterKind
from skugga.terrain.lights import Lamp
from skugga.terrain.scene import Scene

MIN_EYE_DISTANCE_M = 1.0
"""Minimum distance from the eye. Closer probes count as this far away."""

MIN_INCIDENCE_SINE = 2.0**-20
"""Minimum sine of the angle between a light and a surface. A lower light counts as below the surface."""

EDGE_TEXEL_SIZE_COUNT = 6
"""Number of entries of ``TEXEL_SIZES_PX`` whose rays detect a shadow edge near a point.

The largest of these texels is 8 pixels wide, about the spacing of the points.
"""

CUBE_FACE_PARTS_PER_SIDE = 8
"""Subdivision of a side of each cube-map face of an omni light, for the estimate of the visible share of its sphere."""


BODY_RAY_OFFSET_M = 0.01
"""Offset of the start of a ray from the body that it starts on."""

MAX_FOLIAGE_PROBES = 160
"""Maximum number of probes whose rays are tested against foliage, the most expensive test."""


@dataclass(frozen=True, eq=False)
class LitProbes:
    """Probes that face a light and lie in its cone.

    Attributes
    ----------
    probes
        The n probes.
    direction_frame
        Unit directions to the light (n, 3).
    length_m
        Distances to the light (n,), metres; infinite for the sun.
    """

    probes: Probes
    direction_frame: np.ndarray
    length_m: np.ndarray


@dataclass(frozen=True, eq=False)
class ViewProbes:
    """The visible points of a view and its occluders.

    Attributes
    ----------
    scene
        The scene, which holds the relief and the meshes.
    camera
        The perspective view, or ``None`` for a map.
    probes
        Samples of the visible points.
    trees
        The trees as the view draws them, or ``None`` without trees.
    """

    scene: Scene
    camera: PerspectiveView | None
    probes: Probes
    trees: TreeInstances | None


def facts_of_lights(view_probes: ViewProbes, sun_area_share: float, lamps: Iterable[str]) -> dict[str, LightFacts]:
    """Return the facts of the sun and of some lamps by name. ``sun_area_share`` is the sun's ``LightFacts.area_share``."""
    facts: dict[str, LightFacts] = {}
    if view_probes.scene.sun is not None:
        facts[SUN] = _facts_of_light(view_probes, None, sun_area_share)
    for name in lamps:
        lamp = view_probes.scene.lamps[name]
        facts[name] = _facts_of_light(view_probes, lamp, area_share_of_lamp(lamp, view_probes.probes))
    return facts


def _facts_of_light(view_probes: ViewProbes, lamp: Lamp | None, area_share: float) -> LightFacts:
    """Return the facts of one light: of the sun if ``lamp`` is ``None``.

    ``area_share`` is the light's ``LightFacts.area_share``.
    """
    scene, camera, probes = view_probes.scene, view_probes.camera, view_probes.probes
    to_view = (
        None if camera is None or (lamp is not None and lamp.kind == "omni") else _light_view_angle_deg(scene, camera, lamp, probes)
    )
    eye_to_lamp_m = None if camera is None or lamp is None else float(np.linalg.norm(lamp.position_earth_m - camera.eye_earth_m))
    if not len(probes) or (lamp is None and not scene.sun_is_up):
        return LightFacts(to_view_deg=to_view, eye_to_lamp_m=eye_to_lamp_m, facing_share=0.0, area_share=area_share)
    lit_probes, facing_share = _find_lit_probes(
        scene, probes, lamp, MAX_PROBES if view_probes.trees is None else MAX_PROBES_AMONG_TREES
    )
    rays = rays_to_light(lit_probes.probes, lit_probes.direction_frame, lit_probes.length_m)
    blocked = (
        {kind: _find_blocked_rays(view_probes, kind, lit_probes.probes, rays) for kind in scene.objects.caster_kinds}
        if len(lit_probes.probes)
        else {}
    )
    shaded = (
        np.logical_or.reduce([blocked_rays.is_probe_occluded for blocked_rays in blocked.values()])
        if blocked
        else np.zeros(0, bool)
    )
    edge_m = [
        lit_probes.probes.distance_m[
            blocked_rays.offset_probe_indices[
                (
                    blocked_rays.is_offset_occluded[:EDGE_TEXEL_SIZE_COUNT]
                    != blocked_rays.is_probe_occluded[blocked_rays.offset_probe_indices]
                ).any(axis=0)
            ]
        ]
        for blocked_rays in blocked.values()
    ]
    nearest_m = min((float(distances.min()) for distances in edge_m if len(distances)), default=None)
    edges = {} if "meshes" not in scene.objects.caster_kinds else _silhouette_facts(scene, camera, probes, lamp)
    return LightFacts(
        to_view_deg=to_view, eye_to_lamp_m=eye_to_lamp_m, facing_share=facing_share,
        cast_share=facing_share * float(shaded.mean()) if len(shaded) else 0.0,
        area_share=area_share,
        nearest_edge_m=None if camera is None else nearest_m,
        ground_casting_share=None if camera is None else _ground_casting_share(scene, camera, lamp),
        casts={
            kind: _cast_shadows(lit_probes, blocked_rays, facing_share, camera is not None)
            for kind, blocked_rays in blocked.items()
        }, **edges,
    )  # fmt: skip


def _find_lit_probes(scene: Scene, probes: Probes, lamp: Lamp | None, max_count: int) -> tuple[LitProbes, float]:
    """Return at most ``max_count`` of the probes that face a light and lie in its cone, and the share of all probes that do."""
    frame = probes.frame
    if lamp is None:
        assert scene.sun is not None
        to_light = scene.sun.in_frame(frame)
        direction, length = np.broadcast_to(to_light, probes.point_frame_m.shape), np.full(len(probes), np.inf)
        facing, inside = np.einsum("ij,j->i", probes.normal_frame, to_light), np.ones(len(probes), bool)
    else:
        position, axis, _ = lamp.in_frame(frame)
        to_lamp = position - probes.point_frame_m
        length = np.sqrt(np.einsum("ij,ij->i", to_lamp, to_lamp))
        direction = to_lamp / np.maximum(length, 1e-12)[:, None]
        facing = np.einsum("ij,ij->i", probes.normal_frame, direction)
        inside = -np.einsum("ij,j->i", direction, axis) >= np.cos(np.radians(lamp.cutoff_deg))
    indices = np.flatnonzero((np.where(probes.surface_kind == FOREST, np.abs(facing), facing) > MIN_INCIDENCE_SINE) & inside)
    chosen = indices[stratified_indices(len(indices), max_count)]
    return LitProbes(probes.select(chosen), direction[chosen], length[chosen]), len(indices) / len(probes)


@dataclass(frozen=True, eq=False)
class RayOcclusion:
    """Rays that one kind of casters blocks.

    Attributes
    ----------
    is_probe_occluded
        Whether the ray from each of the n probes is blocked (n,), bool.
    is_offset_occluded
        Whether the rays from the k places beside each of the m probes ``offset_probe_indices`` are blocked (k, m), bool.
    offset_probe_indices
        Indices of the m probes that have rays from places beside them (m,).
    occluder_distance_m
        Distances from blocked probes to their occluders, metres; ``None`` if they are unknown.
    """

    is_probe_occluded: np.ndarray
    is_offset_occluded: np.ndarray
    offset_probe_indices: np.ndarray
    occluder_distance_m: np.ndarray | None = None


def _find_blocked_rays(view_probes: ViewProbes, kind: CasterKind, probes: Probes, rays: ProbeRays) -> RayOcclusion:
    """Return which rays the casters of one kind block.

    ``rays`` start at ``probes`` and at the places beside them. Trees are tested at places beside at most ``MAX_FOLIAGE_PROBES`` of
    the probes.
    """
    scene, all_probes = view_probes.scene, np.arange(len(probes))
    if kind == "forest" and view_probes.trees is not None and len(view_probes.trees):
        indices = stratified_indices(len(probes), MAX_FOLIAGE_PROBES)
        hit_m, _ = first_leaf_hits(view_probes.trees, *(np.ascontiguousarray(array[0]) for array in rays.arrays))
        is_probe_occluded = np.isfinite(hit_m)
        return RayOcclusion(
            is_probe_occluded,
            is_blocked_by_leaves(view_probes.trees, rays.select(slice(1, None), indices)),
            indices,
            hit_m[is_probe_occluded],
        )
    if kind == "meshes":
        is_blocked = is_blocked_by_meshes(scene.objects, probes, rays)
        start, direction, length = (array[0][is_blocked[0]] for array in rays.arrays)
        thrown_m, _ = first_mesh_hits(scene.objects, probes.frame, start + BODY_RAY_OFFSET_M * direction, direction, length)
        return RayOcclusion(is_blocked[0], is_blocked[1:], all_probes, thrown_m[np.isfinite(thrown_m)])
    elif kind == "relief" and np.ptp(scene.height_range_m) > 0.0:
        is_blocked = is_blocked_by_relief(
            scene.world, scene.elevation, overview_probes(scene.world, scene.elevation, probes), probes, rays
        )
    else:
        is_blocked = np.zeros(rays.length_m.shape, bool)
    return RayOcclusion(is_blocked[0], is_blocked[1:], all_probes)


def _cast_shadows(lit_probes: LitProbes, occlusion: RayOcclusion, facing_share: float, has_distance_bands: bool) -> Casting:
    """Return the cast shadows of one kind of casters on the visible surfaces.

    ``facing_share`` is the share of the visible surfaces that the lit probes represent.
    """
    probes, distance_m = lit_probes.probes, np.maximum(lit_probes.probes.distance_m, MIN_EYE_DISTANCE_M)
    octave, band_of_probe = np.unique(
        np.ceil(np.log2(distance_m)).astype(int) if has_distance_bands else np.zeros(len(probes), int), return_inverse=True
    )
    band_of_offset = band_of_probe[occlusion.offset_probe_indices]
    changed = occlusion.is_offset_occluded != occlusion.is_probe_occluded[occlusion.offset_probe_indices]

    def sums(values: np.ndarray, band: np.ndarray = band_of_probe) -> np.ndarray:
        return np.bincount(band, values, minlength=len(octave))

    count = np.bincount(band_of_probe)
    differs = (
        np.stack([sums(offset_changed, band_of_offset) for offset_changed in changed], axis=1)
        / np.maximum(np.bincount(band_of_offset, minlength=len(octave)), 1)[:, None]
    )
    cast, pixel_m = sums(occlusion.is_probe_occluded) / count, sums(probes.pixel_m) / count
    light_m = sums(lit_probes.length_m) / count
    bands = tuple(
        CastBand(
            near_m=2.0 ** (number - 1) if has_distance_bands else 0.0, far_m=2.0**number if has_distance_bands else None,
            share=facing_share * float(count[i] / len(probes)), cast=float(cast[i]), pixel_m=float(pixel_m[i]),
            light_m=float(light_m[i]) if np.isfinite(light_m[i]) else None, differs=tuple(differs[i].tolist()),
        )
        for i, number in enumerate(octave.tolist())
    )  # fmt: skip
    on_bodies = float((occlusion.is_probe_occluded & (probes.surface_kind != RELIEF)).mean())
    thrown_m = (
        float(np.median(occlusion.occluder_distance_m))
        if occlusion.occluder_distance_m is not None and len(occlusion.occluder_distance_m)
        else None
    )
    return Casting(
        share=facing_share * float(occlusion.is_probe_occluded.mean()),
        on_bodies=facing_share * on_bodies,
        bands=bands,
        thrown_m=thrown_m,
    )


def _ground_casting_share(scene: Scene, camera: PerspectiveView, lamp: Lamp | None) -> float:
    """Return ``LightFacts.ground_casting_share`` of a light: of the sun if ``lamp`` is ``None``."""
    if nodes_have_gaps(ground_nodes(scene).height_m):
        return 1.0
    ground, frame = ground_mesh(scene, camera), camera.frame(scene.world)
    if not len(ground.triangles):
        return 0.0
    if lamp is None:
        assert scene.sun is not None
        facing = ground.face_normal_frame @ scene.sun.in_frame(frame).astype(np.float32)
    else:
        to_lamp = lamp.in_frame(frame)[0] - ground.position_frame_m[ground.triangles[:, 0]]
        facing = np.einsum("ij,ij->i", ground.face_normal_frame, to_lamp)
    return float(np.mean(facing <= 0.0))


def _light_view_angle_deg(scene: Scene, camera: PerspectiveView, lamp: Lamp | None, probes: Probes) -> float:
    """Return the angle between the direction to a light and the view axis, degrees. The light is the sun if ``lamp`` is ``None``.

    The direction to a lamp is that from the median of the probes, or from the eye without probes.
    """
    if lamp is None:
        assert scene.sun is not None
        to_light = scene.sun.to_sun_earth
    else:
        middle = np.median(probes.point_earth_m, axis=0) if len(probes) else camera.eye_earth_m
        to_light = lamp.position_earth_m - middle
    cosine = float(to_light @ camera.earth_from_camera[:, 2]) / max(float(np.linalg.norm(to_light)), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def area_share_of_lamp(lamp: Lamp, probes: Probes) -> float:
    """Return the share of a lamp's shadow map that covers visible surfaces.

    For a spot it is the bounding rectangle of the probes relative to that of the cone. For an omni light it is the share of the
    subdivided cube-map faces that contain probes.
    """
    in_lamp = (probes.point_earth_m - lamp.position_earth_m) @ lamp.earth_from_lamp
    if lamp.kind == "omni":
        face = np.argmax(np.abs(in_lamp), axis=1)
        largest = np.take_along_axis(in_lamp, face[:, None], axis=1)
        tangential = np.take_along_axis(in_lamp, np.stack([(face + 1) % 3, (face + 2) % 3], axis=1), axis=1)
        cell = np.clip(
            ((tangential / np.abs(largest) + 1.0) / 2.0 * CUBE_FACE_PARTS_PER_SIDE).astype(int), 0, CUBE_FACE_PARTS_PER_SIDE - 1
        )
        number = ((2 * face + (largest[:, 0] > 0.0)) * CUBE_FACE_PARTS_PER_SIDE + cell[:, 0]) * CUBE_FACE_PARTS_PER_SIDE + cell[
            :, 1
        ]
        return len(np.unique(number)) / (6 * CUBE_FACE_PARTS_PER_SIDE**2)
    max_tangent = np.tan(np.radians(lamp.cutoff_deg))
    is_ahead = in_lamp[:, 2] > 0.0
    tangents = in_lamp[is_ahead, :2] / in_lamp[is_ahead, 2:]
    tangents = tangents[np.linalg.norm(tangents, axis=1) <= max_tangent]
    return float(min(np.prod(np.ptp(tangents, axis=0)) / (2.0 * max_tangent) ** 2, 1.0)) if len(tangents) else 0.0


def _silhouette_facts(scene: Scene, camera: PerspectiveView | None, probes: Probes, lamp: Lamp | None) -> dict[str, float]:
    """Return the silhouette facts of the meshes, as keyword arguments of ``LightFacts``."""
    if lamp is None:
        assert scene.sun is not None
        light, is_positional = scene.sun.to_sun_earth, False
    else:
        light, is_positional = lamp.position_earth_m, True
    ends = silhouette_edges_of(scene.objects, light, is_positional)
    if camera is None or not len(ends):
        return {"silhouette_edges": len(ends)}
    ends_camera = (ends - camera.eye_earth_m) @ camera.earth_from_camera
    first_px, count = np.array([camera.col0, camera.row0]), np.array([camera.cols, camera.rows])
    bounds = np.stack([first_px - 0.5 * camera.step_px, first_px + (count - 0.5) * camera.step_px]) / camera.focal_px
    from_eye = probes.select(stratified_indices(len(probes), MAX_EYE_RAYS)).point_earth_m - camera.eye_earth_m
    volume_layers = mean_volume_layers(ends, light, is_positional, np.broadcast_to(camera.eye_earth_m, from_eye.shape), from_eye)
    return {
        "silhouette_edges": len(ends),
        "silhouette_px": projected_edge_length(ends_camera, *bounds) / camera.pixel_tangent,
        "volume_layers": volume_layers,
    }
