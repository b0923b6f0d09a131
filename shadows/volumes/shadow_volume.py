"""`shadow_volume`: the shadow volumes of casters, counted in the stencil. They are exact to the pixel at any resolution.

``skugga.shadows.volumes.volumes`` builds the volumes, ``skugga.shadows.volumes.drawing`` counts them.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.algorithm import MAP_SIZES_FOR_OTHER_CASTERS, Algorithm, CostInputs, PlotMarker, SettingsSearch
from skugga.shadows.area_light import mean_visibility_of_area_light
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassLog
from skugga.shadows.requirements import BENT_MAP_REASON, Requirement
from skugga.shadows.volumes.drawing import count_faces_in_front, count_volumes, visible_silhouettes
from skugga.shadows.volumes.settings import VolumeSettings, resolve_volumes
from skugga.shadows.volumes.volumes import volumes_of
from skugga.shadows.volumes.work import volume_work
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene

PASSES = ("silhouettes", "stencil")
"""Names of the passes that the algorithm runs, in order."""


def fill_visibility(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: VolumeSettings,
    log: PassLog,
) -> np.ndarray:
    """Return a light's visibility at a buffer's points where only some kinds of casters block it, float32 (rows, cols).

    It is 0 or 1, and in between for an area light. The value has no meaning off the surface and where the surface faces away from
    the light. Raises ``GraphicsError``.
    """
    if settings.filter == "sun":
        return mean_visibility_of_area_light(fill_visibility, buffer, scene, light, kinds, casters, settings, log, filter=1)
    silhouettes_pass, stencil_pass = log.pass_names(light, kinds, PASSES)
    light_in_frame = np.array(scene.light_position(light, buffer.frame))
    with log.record_pass(silhouettes_pass) as record:
        volumes = volumes_of(buffer, scene, light_in_frame, kinds, casters, record)
    log.keep_layer("silhouettes", light, visible_silhouettes, buffer, scene, volumes)
    log.keep_layer("volumes", light, count_faces_in_front, buffer, scene, volumes)
    with log.record_pass(stencil_pass) as record:
        receiver_mask = buffer.valid & ~attached_shadow_mask(buffer, scene, light)
        counts = count_volumes(buffer, scene, light_in_frame, volumes, settings, receiver_mask, False, record)
    log.keep_layer("stencil", light, counts.copy)
    return np.where(counts > 0, np.float32(0.0), np.float32(1.0))


MAX_GROUND_TRIANGLES = 2**18
"""Upper bound of the triangles of ground for which volumes are a candidate.

Above it they were measured to take ten to twenty times as long as a sweep, without better results.
"""


GROUND_EXCLUSION_REASON = (
    f"not tried: the ground has more than {MAX_GROUND_TRIANGLES:,} triangles, and its volumes would take ten to twenty times as "
    "long as a sweep"
)
"""The reason why the selector does not try volumes of large ground."""


def has_too_much_ground(descriptor: Descriptor, kind: CasterKind) -> bool:
    """Return whether casters are ground with too many triangles for shadow volumes (``MAX_GROUND_TRIANGLES``)."""
    relief_facts = (caster_facts for caster_facts in descriptor.stands if caster_facts.kind == kind == "relief")
    return sum(caster_facts.triangles + caster_facts.outside_triangles for caster_facts in relief_facts) > MAX_GROUND_TRIANGLES


VOLUME_REFUSALS: dict[Requirement, str] = {
    "forest": "shadow volumes ignore textures: every tree picture would cast a full rectangle",
    "bent map": BENT_MAP_REASON,
}
"""Requirements that no volume can serve, and the reasons."""

VOLUME_CACHES = (
    "skugga.shadows.volumes.volumes",
    "skugga.shadows.volumes.volumes._mesh_structure",
)
"""Caches of volumes."""

ALGORITHM = Algorithm(
    name="shadow_volume",
    needs_view_pixels=True,
    description="shadow volumes, counted in the stencil: exact to the pixel",
    plural_name="shadow volumes",
    fill_visibility=fill_visibility,
    passes=PASSES,
    refusals=VOLUME_REFUSALS,
    layers=("stencil", "silhouettes", "volumes"),
    settings_types=(VolumeSettings,),
    resolve_settings=resolve_volumes,
    cache_names=VOLUME_CACHES,
    search=SettingsSearch(
        map_sizes_for_other_casters=MAP_SIZES_FOR_OTHER_CASTERS,
        is_excluded=has_too_much_ground,
        exclusion_reason=GROUND_EXCLUSION_REASON,
        other_variants=({"stencil": "two_pass"}, {"counting": "z_fail"}),
    ),
    cost=CostInputs(volume_work, pass_of_part={"silhouettes": "silhouettes", "counting": "stencil"}),
    marker=PlotMarker("square", "vermilion"),
)
