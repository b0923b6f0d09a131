"""`reconstructed_volume`: shadow volumes that are rebuilt from depth maps, and counted in the stencil.

Source: M. McCool, Shadow Volume Reconstruction from Depth Maps, ACM Transactions on Graphics 19(1), 2000.

A depth map is drawn from the light and read back (``skugga.shadows.maps``). The surface that it shows becomes polygons
(``skugga.shadows.reconstruction.surface``, ``polygons``), and the volume behind it is counted at the view's pixels as other volumes
are (``skugga.shadows.volumes.drawing``). Any caster that a depth map takes has a volume, trees too. The surface has one depth along
each ray of the light, so a point lies in one volume or in none: one bit of parity would do.

Policies do not search it: it takes longer than the map that it is made from, and its edges are those of the map's texels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from skugga.shadows.algorithm import AccuracyInputs, Algorithm, CostInputs, PlotMarker, SettingsSearch
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps.drawing import draw_ahead, draw_map, read_depths
from skugga.shadows.maps.edge_samples import maps_for_samples
from skugga.shadows.maps.relevant_trees import with_relevant_trees
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.shadows.maps.windows import DepthMap, lamp_map, sun_maps
from skugga.shadows.passes import PassLog
from skugga.shadows.reconstruction.light_volumes import face_depths, linked_slope, rebuild_volume
from skugga.shadows.reconstruction.settings import ReconstructionSettings, resolve_reconstruction
from skugga.shadows.reconstruction.work import reconstruction_work, texel_m, texel_px
from skugga.shadows.volumes.drawing import count_faces_in_front, count_volumes
from skugga.shadows.volumes.volumes import Volumes
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import caster_trees, has_casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import SUN, CasterKind
from skugga.terrain.scene import Scene

if TYPE_CHECKING:
    from moderngl import Framebuffer

PASSES = ("depth map", "polygons", "stencil")
"""Names of the passes that the algorithm runs, in order."""


def fill_visibility(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: ReconstructionSettings,
    log: PassLog,
) -> np.ndarray:
    """Return a light's visibility at a buffer's points where only some kinds of casters block it, float32 (rows, cols), 0 or 1.

    The value is undefined off the surface and in attached shadow. Samples of a view's pixels are counted in the volumes of the
    sun's maps of these pixels, and are NaN outside of them. Raises ``GraphicsError``.
    """
    depth_pass, polygons_pass, stencil_pass = log.pass_names(light, kinds, PASSES)
    receivers = buffer.valid & ~attached_shadow_mask(buffer, scene, light)
    unserved = np.zeros_like(receivers)
    with log.record_pass(depth_pass):  # fitting a map is part of making it
        if buffer.first_sample_row == 0 and light == SUN and (light, kinds) in log.fitted_maps:
            maps, unserved = maps_for_samples(log.fitted_maps[light, kinds], buffer, scene)
        else:
            maps = _fit_maps(buffer, scene, light, kinds, settings, log) if has_casters(scene, buffer, kinds) else []
    with log.record_pass(polygons_pass), log.record_pass(stencil_pass):
        counts = np.zeros(receivers.shape, np.uint8)
    max_slope = linked_slope(scene.sun.altitude_deg if light == SUN and scene.sun is not None else None)
    light_in_frame, gl = np.array(scene.light_position(light, buffer.frame)), device()
    all_volumes: list[Volumes] = []

    def draw(depth_map: DepthMap) -> Framebuffer:
        with log.record_pass(depth_pass) as record:
            return draw_map(gl, depth_map, buffer, scene, kinds, casters, settings.map, record)

    for depth_map, target in draw_ahead(maps, draw):
        log.keep_layer("shadow-map", light, read_depths, gl, depth_map, target)
        with log.record_pass(depth_pass) as record:
            texels = gl.read(target, -1, "f4", size=depth_map.texture_size)
            record.bytes = max(record.bytes, depth_map.nbytes + texels.nbytes)
        served = np.zeros(receivers.size, bool)
        served[slice(None) if depth_map.point_indices is None else depth_map.point_indices] = True
        served_receivers = receivers & served.reshape(receivers.shape)
        face_numbers = _face_numbers(depth_map, buffer.position_frame_m)
        for number, (face, depths) in enumerate(face_depths(depth_map, texels)):
            face_receivers = served_receivers if face_numbers is None else served_receivers & (face_numbers == number)
            if not face_receivers.any():
                continue
            with log.record_pass(polygons_pass) as record:
                volume = rebuild_volume(depth_map, face, depths, max_slope)
                if volume is None:
                    continue
                if "volumes" in log.requested_layers:
                    all_volumes.append(volume)
                record.triangles += len(volume.faces)
                record.bytes = max(record.bytes, volume.nbytes)
            with log.record_pass(stencil_pass) as record:
                counts += count_volumes(buffer, scene, light_in_frame, [volume], settings, face_receivers, False, record)
    log.keep_layer("stencil", light, counts.copy)
    log.keep_layer("volumes", light, count_faces_in_front, buffer, scene, all_volumes)
    visibility = np.where(counts > 0, np.float32(0.0), np.float32(1.0))
    visibility[unserved] = np.nan
    return visibility


def _fit_maps(
    buffer: GeometryBuffer, scene: Scene, light: str, kinds: tuple[CasterKind, ...], settings: ReconstructionSettings, log: PassLog
) -> list[DepthMap]:
    """Return the maps of a light, fitted to a buffer's points. Those of the sun are kept in ``log`` for samples of the pixels."""
    trees, map_settings = caster_trees(buffer, kinds), settings.map
    if isinstance(map_settings, ShadowMapSettings):
        maps = [with_relevant_trees(fitted, buffer, False) for fitted in sun_maps(buffer, scene, map_settings, trees)]
        log.fitted_maps[light, kinds] = maps
        return maps
    depth_map = lamp_map(buffer, scene.lamps[light], map_settings, trees)
    return [] if depth_map is None else [depth_map]


def _face_numbers(depth_map: DepthMap, points: np.ndarray) -> np.ndarray | None:
    """Return the number of the face that each of some points (rows, cols, 3) lies in front of; ``None`` for one face."""
    if len(depth_map.face_rotations) == 1:
        return None
    rotation = np.array(depth_map.uniforms["light_from_frame"]).reshape(3, 3).T
    in_light = points @ rotation.T + np.array(depth_map.uniforms["light_offset_m"])
    ahead = np.stack([in_light @ face[2] for face in depth_map.face_rotations])
    return np.where(np.isfinite(ahead[0]), np.nan_to_num(ahead).argmax(axis=0), -1)


ALGORITHM = Algorithm(
    name="reconstructed_volume",
    needs_view_pixels=True,
    description="shadow volumes rebuilt from a depth map, for any caster",
    plural_name="reconstructed volumes",
    fill_visibility=fill_visibility,
    passes=PASSES,
    refusals={
        "map": "a map view's texels are looked up as they are: volumes rebuilt from them add nothing but time",
        "bent map": "a map view's texels are looked up as they are: volumes rebuilt from them add nothing but time",
        "area light": "its edges are hard, and the maps of many points of the light would all be rebuilt",
    },
    layers=("shadow-map", "stencil", "volumes"),
    settings_types=(ReconstructionSettings,),
    resolve_settings=resolve_reconstruction,
    cache_names=("skugga.terrain.gl.depth_targets",),
    search=SettingsSearch(
        is_excluded=lambda descriptor, kind: True,
        exclusion_reason="policies try shadow_map instead: the same texels, looked up in less time",
        resolution_variants=({"map_size": 512}, {"map_size": 2048}),
    ),
    cost=CostInputs(reconstruction_work),
    accuracy=AccuracyInputs(texel_px=texel_px, texel_m=texel_m),
    marker=PlotMarker("pentagon", "brown"),
)
