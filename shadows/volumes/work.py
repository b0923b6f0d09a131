"""Count the work of shadow volumes: finding silhouettes, and counting faces in the stencil."""

from __future__ import annotations

import numpy as np

from skugga.shadows.area_light import scale_work
from skugga.shadows.volumes.settings import StencilSettings, VolumeSettings
from skugga.shadows.volumes.tiles import CULLING_TILE_PX, MIN_RECTANGLE_COST, RECTANGLE_COST
from skugga.shadows.work import Counts, Work, Workload
from skugga.terrain.casters.caster_types import PATCH_QUADS
from skugga.terrain.casters.clip_space import AFFINE_PART_PX
from skugga.terrain.level.level import SUN

MARKED_LAYER_COST_RATIO = 50.0
"""Number of layers over the whole picture that take as long as one layer that is counted in marked pixels only.

A layer over the whole picture covers many rectangles, where it is not drawn. Few layers cover a rectangle of marked pixels.
"""

FACES_THAT_HALVE_LAYERS = 30_000.0
"""Number of faces at which a layer takes half of the time that it takes with very many.

Few faces are large. They cover whole rectangles, where they are counted without being drawn: the thesis's street with 800 faces
takes the same time at 0.4 layers as at 4.6.
"""

GROUND_SIDES_PER_TRIANGLE = 0.6
"""Number of sides of volumes for each casting triangle of the ground, one for each edge of its silhouette.

In 12 perspective views of rasters there were 0.35 to 0.9.
"""

TRIANGLES_PER_PATCH = 2 * PATCH_QUADS**2
"""Triangles of a patch of ground outside of a map's block."""


def volume_work(workload: Workload, settings: VolumeSettings) -> Work:
    """Return the work of shadow volumes over the whole picture."""
    counts = silhouette_work(workload) | {workload.part_name_in_view("counting"): stencil_counts(workload, settings)}
    return scale_work(counts, settings.light_points) if settings.filter == "sun" else counts


def silhouette_work(workload: Workload) -> Work:
    """Return the work of finding silhouettes: the edges between faces towards the light and others. Cached volumes have none."""
    if workload.is_cached("volumes"):
        return {}
    return {
        workload.part_name_in_view("silhouettes"): {
            "blocks": 1.0, "triangles": workload.triangle_count("meshes"), "edges": float(_mesh_edges(workload)),
            "ground": workload.ground_triangle_count,
        }
    }  # fmt: skip


def _mesh_edges(workload: Workload) -> int:
    """Return the number of silhouette edges of meshes; 0 if the step does not serve them."""
    return workload.facts.silhouette_edges if workload.caster_facts("meshes") else 0


def volume_faces(workload: Workload) -> tuple[float, float, float]:
    """Return three numbers of faces: sides and caps of the volumes of meshes, and caps of the volumes of the ground.

    Under a lamp there are twice as many.
    """
    end_count = 1.0 if workload.light == SUN else 2.0
    closed = getattr(workload.caster_facts("meshes"), "closed_share", 0.0)
    caps = workload.triangle_count("meshes") * (1.0 - closed / 2.0)
    ground = (workload.triangle_count("relief") + workload.outside_triangle_count) * workload.ground_casting_share
    return end_count * _mesh_edges(workload), end_count * caps, end_count * ground


def stencil_counts(workload: Workload, settings: StencilSettings, marked_share: float | None = None) -> Counts:
    """Return the counts of counting volumes in the stencil, over the whole picture or in marked tiles only.

    ``marked_share`` is the share of the picture's tiles with a marked pixel; ``None``: the whole picture. Sides reach across the
    picture, into as many rectangles as lie along it; caps are small. Layers that cover a rectangle are not drawn. More layers cover
    more rectangles, so time grows far slower than their number. The growth was measured.
    """
    edges, caps, ground = volume_faces(workload)
    edges += GROUND_SIDES_PER_TRIANGLE * ground
    faces = edges + caps + ground
    rectangle_tiles = (2.0 * max(RECTANGLE_COST / max(faces, 1.0), MIN_RECTANGLE_COST)) ** 2
    rectangles = max(workload.pixel_count / CULLING_TILE_PX**2 / rectangle_tiles, 1.0)
    sides = 2.0 if settings.stencil == "two_pass" else 1.0
    faces_drawn = edges * np.sqrt(rectangles) + caps + ground
    layers = sides * workload.facts.volume_layers if workload.caster_facts("meshes") else 0.0
    counts = {"blocks": 1.0, "pixels": workload.pixel_count}
    if marked_share is None:
        counts |= {
            "faces drawn": sides * faces_drawn,
            "facing": workload.facing_pixel_count,
            "layers": workload.facing_pixel_count * np.sqrt(np.log1p(layers)) * faces / (faces + FACES_THAT_HALVE_LAYERS),
        }
    else:
        layer_cost = np.log1p(MARKED_LAYER_COST_RATIO * layers * marked_share)
        counts |= {
            "faces beside marks": sides * faces_drawn * marked_share**0.25,
            "layers beside marks": workload.facing_pixel_count * layer_cost,
        }
    if workload.is_map_view:
        # On a globe a map is drawn in parts, and the ground that receives shadows is drawn into each (``affine_parts``).
        is_curved = not workload.descriptor.flat_world
        parts = (
            np.ceil(workload.descriptor.rows / AFFINE_PART_PX) * np.ceil(workload.descriptor.cols / AFFINE_PART_PX)
            if is_curved
            else 1.0
        )
        counts["receiver nodes"] = workload.node_count if is_curved else 0.0
        relief = 1.0 + workload.outside_triangle_count / TRIANGLES_PER_PATCH if workload.caster_facts("relief") else 0.0
        counts["sheets"] = parts * (relief + (workload.caster_facts("meshes") is not None))
    return counts
