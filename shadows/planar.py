"""`planar`: casters projected from a light onto level ground, drawn there once per pixel through the stencil.

**Projection.** Let h be a point's height above the plane, L the light in homogeneous coordinates (a direction for the sun, a
position for a lamp) and H the light's height. The point p = (x, y, z, 1) falls on

    p' = H p - h L

(J. Blinn, Me and My (Fake) Shadow, IEEE Computer Graphics and Applications 8(1), 1988). p' is linear in p. Triangles therefore
remain triangles, and alpha-tested texture keeps its place.

Points below the plane (h < 0) would fall in the wrong place. Points in the plane (the floor of a house, say) would fall on
themselves. A clip distance cuts both off, a float32 error above the plane. Points above a lamp get w < 0. In a map they lie outside
of the clip volume. In a camera they lie outside of it or above the horizon, where no ground is. The origin of coordinates is the
point of the plane below the eye, or in the middle of a map; float32 is precise enough there.

**Stencil.** Ground pixels become 1, all others are 0. A projected caster turns a 1 into a 2, in the pixels of the view itself. The
shadow thus ends at the ground's rim, and a pixel that is covered twice is as dark as one that is covered once.

The ground alone receives. Points on meshes and trees keep visibility 1 here; only attached shadow darkens them. Level ground itself
casts no shadow.

**Samples** of a perspective view's pixels (``skugga.terrain.gbuffer.antialias``) are pixels of a finer view of the same camera, and
are drawn as such.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from skugga.shadows.algorithm import MAP_SIZES_FOR_OTHER_CASTERS, AccuracyInputs, Algorithm, CostInputs, PlotMarker, SettingsSearch
from skugga.shadows.algorithm_settings import ResolvedSettings, SettingsRequest
from skugga.shadows.maps.windows import POSITION_ERROR
from skugga.shadows.passes import PassLog, PassRecord
from skugga.shadows.work import Work, Workload
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import caster_meshes, caster_trees
from skugga.terrain.casters.clip_space import camera_clip, map_clip
from skugga.terrain.facts.fact_types import Casting
from skugga.terrain.facts.probes import MIN_CAST_SHADOW_SHARE
from skugga.terrain.gbuffer.antialias import finer_view
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.id_buffer import NEAR_PLANE_M, set_uniforms, shader_source
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.tree_instances import QUAD_TRIANGLES, TreeInstances
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.gl.device import Device, device
from skugga.terrain.level.level import SUN, CasterKind
from skugga.terrain.scene import Scene
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, foliage

if TYPE_CHECKING:
    from moderngl import Framebuffer

PASSES = ("receivers", "projected casters")
"""Names of the passes that the algorithm runs, in order."""

NO_GROUND_VALUE, LIT_VALUE, SHADED_VALUE = 0, 1, 2
"""Values of the stencil."""


@dataclass(frozen=True, eq=False)
class Projection:
    """The casters and the light of a projection. Coordinates are metres along the axes of a frame, from ``origin_frame_m``.

    Attributes
    ----------
    origin_frame_m
        A point of the plane (3,), in the frame.
    light_m
        The light (4,), homogeneous: the sun's direction and 0, or a lamp's position and 1.
    meshes
        Vertices (n, 3) and triangles (m, 3) of each mesh.
    trees
        The casting trees, in the frame; ``None`` without any.
    """

    origin_frame_m: np.ndarray
    light_m: np.ndarray
    meshes: list[tuple[np.ndarray, np.ndarray]]
    trees: TreeInstances | None

    @property
    def reaches_ground(self) -> bool:
        """Whether the light is above the ground and there are casters."""
        return bool(self.light_m[2] > 0.0 and (self.meshes or (self.trees is not None and len(self.trees))))


def fill_visibility(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: None,
    log: PassLog,
) -> np.ndarray:
    """Return the visibility of a light (rows, cols), float32, 0 or 1, for the points of a buffer whose ground is level.

    It is 1 on everything but the ground. Raises ``GraphicsError``.
    """
    passes = log.pass_names(light, kinds, PASSES)
    projection = _make_projection(buffer, scene, light, kinds)
    view, ground = buffer.view, buffer.valid & (buffer.surface_kind == RELIEF)
    stencil = np.zeros(ground.shape, np.uint8)
    stencil[: view.rows] = _draw_stencil(scene.world, buffer.frame, view, ground[: view.rows], projection, passes, log)
    if buffer.sample_pixels is not None:
        assert isinstance(view, PerspectiveView)
        sample_view = finer_view(view)
        sample_mask = ground[view.rows :]
        pixels = tuple(index[sample_mask] for index in buffer.sample_pixels)
        receivers = np.zeros((sample_view.rows, sample_view.cols), bool)
        receivers[pixels] = True
        stencil[view.rows :][sample_mask] = _draw_stencil(
            scene.world, buffer.frame, sample_view, receivers, projection, passes, log
        )[pixels]
    log.keep_layer("stencil", light, stencil.copy)
    return np.where(stencil == SHADED_VALUE, np.float32(0.0), np.float32(1.0))


def plane_projection(light_m: np.ndarray) -> np.ndarray:
    """Return the projection (4, 4) of homogeneous points onto z = 0, away from the homogeneous light ``light_m`` (4,): p' / H.

    The light is above the plane.
    """
    return np.eye(4) - np.outer(light_m / light_m[2], [0.0, 0.0, 1.0, 0.0])


def clip_from_plane(world: World, frame: LocalFrame, view: MapView | PerspectiveView, origin_frame_m: np.ndarray) -> np.ndarray:
    """Return the matrix (4, 4) to clip coordinates from homogeneous points, in metres from ``origin_frame_m``.

    ``origin_frame_m`` (3,) is a point of the plane. The matrix is affine for the map of a flat world.
    """
    if isinstance(view, PerspectiveView):
        return camera_clip(view, frame, origin_frame_m, NEAR_PLANE_M)
    return map_clip(world, frame, view, origin_frame_m, (origin_frame_m[2] - 1.0, origin_frame_m[2] + 1.0))


def _make_projection(buffer: GeometryBuffer, scene: Scene, light: str, kinds: tuple[CasterKind, ...]) -> Projection:
    """Return the casters and the light, relative to a point of the plane.

    The point lies below the eye, or in the middle of a map.
    """
    view, frame = buffer.view, buffer.frame
    if isinstance(view, MapView):
        middle, _ = scene.world.points_at_zero_height(view.grid.crs, *view.centre)
    else:
        middle = view.eye_earth_m
    origin = frame.points_from_earth(middle)
    origin[2] = scene.height_range_m[0]
    if light == SUN:
        assert scene.sun is not None
        light_m = np.append(scene.sun.in_frame(frame), 0.0)
    else:
        light_m = np.append(scene.lamps[light].in_frame(frame).position_frame_m - origin, 1.0)
    meshes = caster_meshes(scene, buffer, ("meshes",)) if "meshes" in kinds else []  # flat ground casts no shadow
    return Projection(
        origin, light_m, [(vertices - origin, triangles) for vertices, triangles in meshes], caster_trees(buffer, kinds)
    )


def _draw_stencil(
    world: World,
    frame: LocalFrame,
    view: MapView | PerspectiveView,
    receivers: np.ndarray,
    projection: Projection,
    passes: list[str],
    log: PassLog,
) -> np.ndarray:
    """Return the stencil (rows, cols) uint8 of a view after casters are projected onto its ground pixels ``receivers`` (mask).

    ``passes`` are the names of the algorithm's passes for the light and the kinds. ``projection`` holds the casters and the light.
    """
    if not (receivers.any() and projection.reaches_ground):
        for name in passes:
            with log.record_pass(name):
                pass
        return np.where(receivers, np.uint8(LIT_VALUE), np.uint8(NO_GROUND_VALUE))
    gl = device()
    target = gl.stencil.target(view.cols, view.rows)
    with log.record_pass(passes[0]) as record:
        program = gl.program(shader_source("shadows/pixels.vert"), shader_source("shadows/planar_receivers.frag"))
        texture = gl.texture(receivers)
        texture.use(0)
        program["receivers"] = 0
        with gl.stencil.increment_once_pass(target, NO_GROUND_VALUE):
            gl.draw_pixels(program, target)
        texture.release()
        record.bytes = max(record.bytes, 9 * receivers.size)
    with log.record_pass(passes[1]) as record:
        clip_from_caster = clip_from_plane(world, frame, view, projection.origin_frame_m) @ plane_projection(projection.light_m)
        _draw_casters(gl, target, clip_from_caster, projection, record)
        return gl.stencil.read(target)


def _draw_casters(
    gl: Device, target: Framebuffer, clip_from_caster: np.ndarray, projection: Projection, record: PassRecord
) -> None:
    """Draw the projected casters into the stencil: ground pixels that they cover change from lit to shaded.

    ``clip_from_caster`` (4, 4) maps homogeneous points of casters, in metres from ``Projection.origin_frame_m``, to clip
    coordinates.
    """
    uniforms = {"clip_from_caster": tuple(clip_from_caster.T.ravel()), "position_error": POSITION_ERROR}
    with gl.stencil.increment_once_pass(target, LIT_VALUE, clip_distances=1):
        if projection.meshes:
            program = gl.program(
                shader_source("shadows/planar", "shadows/planar_mesh.vert"), shader_source("shadows/maps/depth.frag")
            )
            set_uniforms(program, uniforms)
            for vertices, triangles in projection.meshes:
                record.triangles += gl.draw_triangles(program, vertices, triangles)
        if projection.trees is not None:
            vertex = shader_source("shadows/planar", "terrain/gbuffer/tree", "shadows/planar_tree.vert")
            program = gl.program(vertex, shader_source("shadows/planar_tree.frag"))
            set_uniforms(program, {**uniforms, "foliage": 0, "threshold": ALPHA_THRESHOLD, "curvature": 0.0})
            instances = projection.trees
            gl.srgb_texture_array(foliage().mip_levels).use(0)
            base, variant = (
                instances.base_frame_m - projection.origin_frame_m,
                np.concatenate([instances.yaw_cos_sin, instances.variant[:, None]], axis=1),
            )
            record.triangles += gl.draw_instances(
                program, QUAD_TRIANGLES, [("base", base), ("shape", instances.quad_sizes_m), ("look", variant)]
            )


def _resolve(request: SettingsRequest) -> ResolvedSettings:
    """Return no settings, since the algorithm has none, and the reason why a requested filter has no effect."""
    return None, request.ignored_filter_reasons("planar")


def _work(workload: Workload, settings: None) -> Work:
    """Return the counts of work by name (blocks, pixels, triangles, trees), under the name of the algorithm's only part."""
    caster_counts = {
        "triangles": workload.picture_count * workload.triangle_count("meshes"),
        "trees": workload.picture_count * workload.tree_count,
    }
    return {"planar": {"blocks": 1.0, "pixels": workload.picture_pixel_count, **caster_counts}}


def _wrong_share(casting: Casting) -> float:
    """Return the share of visible surfaces in shadow that are meshes or trees: this algorithm leaves them lit.

    If it is unknown, return the share of the whole cast shadow.
    """
    return casting.share if casting.on_bodies is None else max(casting.on_bodies, MIN_CAST_SHADOW_SHARE)


ALGORITHM = Algorithm(
    name="planar",
    needs_view_pixels=True,
    description="casters projected onto level ground through the stencil; no shadows of casters on casters",
    plural_name="planar",
    fill_visibility=fill_visibility,
    passes=PASSES,
    refusals={
        "uneven": "the ground is not flat: planar projects casters onto one plane",
        "area light": "planar projects casters from one point, into a stencil that is dark or not: it has hard edges only",
    },
    layers=("stencil",),
    resolve_settings=_resolve,
    search=SettingsSearch(map_sizes_for_other_casters=MAP_SIZES_FOR_OTHER_CASTERS),
    cost=CostInputs(_work),
    accuracy=AccuracyInputs(wrong_share=_wrong_share),
    marker=PlotMarker("wedge", "purple"),
)
