"""`planar`: casters projected from a light onto the planes that a view shows, drawn once per pixel through the stencil.

**Projection.** Let h be a point's height above a plane, L the light in homogeneous coordinates (a direction for the sun, a
position for a lamp) and H the light's height above the plane. The point p = (x, y, z, 1) falls on

    p' = H p - h L

(J. Blinn, Me and My (Fake) Shadow, IEEE Computer Graphics and Applications 8(1), 1988). p' is linear in p. Triangles therefore
remain triangles, and alpha-tested texture keeps its place.

Points behind the plane (h < 0) would fall in the wrong place. Points in the plane (the floor of a house, or the plane's own facets)
would fall on themselves. A clip distance cuts both off, a float32 error above the plane. Points above a lamp get w < 0. In a map
they lie outside of the clip volume. In a camera they lie outside of it or beyond the plane's horizon, where no point of the plane
is. The origin of coordinates is a point of the plane: below the eye or the middle of a map for the ground, else a corner of the
largest facet. float32 is precise enough there.

**Planes.** Ground that is level, or a raster of constant slope, is one plane. The visible facets of meshes are grouped by plane
(``skugga.terrain.gbuffer.facet_planes``). Of many planes, those that most pixels show receive (``PlanarSettings``). A plane that
faces away from the light needs no casters: it lies in attached shadow. Each other plane gets the casters before it whose bounding
boxes meet the way of the light to its facets.

**Stencil.** Points of a plane become 1, all others are 0. A projected caster turns a 1 into a 2, in the pixels of its plane
and of the view itself. The shadow thus ends at the plane's rim, and a pixel that is covered twice is as dark as one that is covered
once. A texture holds the number of each pixel's plane. Where there are several, casters skip the pixels of all other planes.

Leaves, curved bodies and further planes keep visibility 1 here; only attached shadow darkens them. Ground in a plane that faces the
light casts no shadow.

**Samples** of a perspective view's pixels (``skugga.terrain.gbuffer.antialias``) are pixels of a finer view of the same camera, and
are drawn as such.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from skugga.shadows.algorithm import MAP_SIZES_FOR_OTHER_CASTERS, AccuracyInputs, Algorithm, CostInputs, PlotMarker, SettingsSearch
from skugga.shadows.algorithm_settings import AlgorithmSettings, NamedReason, ResolvedSettings, SettingsRequest
from skugga.shadows.maps.windows import POSITION_ERROR
from skugga.shadows.passes import PassLog, PassRecord
from skugga.shadows.planar_receivers import GROUND_NUMBER, ReceiverPlane, Receivers, caster_boxes, find_receivers
from skugga.shadows.requirements import MAX_RECEIVER_PLANES, has_few_planes
from skugga.shadows.work import Work, Workload
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import VerticesAndTriangles, caster_meshes, caster_trees
from skugga.terrain.casters.clip_space import camera_clip, map_clip
from skugga.terrain.facts.fact_types import Casting
from skugga.terrain.facts.probes import MIN_CAST_SHADOW_SHARE
from skugga.terrain.gbuffer.antialias import finer_view
from skugga.terrain.gbuffer.facet_planes import MAX_PLANES
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.id_buffer import NEAR_PLANE_M, set_uniforms, shader_source
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
"""Values of the stencil: no plane that receives, and a plane in light and in shadow."""

LEVEL_PLANE = (0.0, 0.0, 1.0, 0.0)
"""The plane z = 0: the dot product with a homogeneous point is its height."""


class PlanarSettings(AlgorithmSettings):
    """Settings of planar shadows: which planes receive besides the ground.

    ``planes``: all planes of visible bodies that are not curved. ``largest``: the ``MAX_RECEIVER_PLANES`` of them that most
    pixels show. Without settings the ground alone receives.
    """

    receivers: Literal["planes", "largest"] = Field(
        default="planes",
        description="No key: the view decides. Where at most 64 planes are visible, all receive (`planes`). Of more, in "
        "perspective, the ground and the 64 that most pixels show do (`largest`). In a map the ground alone does, "
        "since neighbouring tiles would choose other planes. Of curved bodies (over 64 planes) only planes with 5 "
        "% of the body's area receive; the rest, and leaves, stay lit. On a slope all visible surfaces have to "
        "lie in at most 64 planes.",
    )


def max_mesh_planes(settings: PlanarSettings | None) -> int:
    """Return the upper bound of the number of meshes' planes that receive."""
    if settings is None:
        return 0
    return MAX_RECEIVER_PLANES if settings.receivers == "largest" else MAX_PLANES - 1


@dataclass(frozen=True, eq=False)
class Projection:
    """The casters, the light and the plane of a projection. Coordinates are metres along a frame's axes, from ``origin_frame_m``.

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
    plane
        The plane (4,): its unit normal and 0.
    number
        The number of the plane (``Receivers.plane_of_point``).
    error_m
        Upper bound of the distance of the receivers from the plane, metres.
    """

    origin_frame_m: np.ndarray
    light_m: np.ndarray
    meshes: list[tuple[np.ndarray, np.ndarray]]
    trees: TreeInstances | None
    plane: np.ndarray
    number: int
    error_m: float

    @property
    def reaches_plane(self) -> bool:
        """Whether the light is above the plane and there are casters."""
        has_casters = any(len(triangles) for _, triangles in self.meshes) or (self.trees is not None and len(self.trees) > 0)
        return bool(self.plane @ self.light_m > 0.0) and has_casters


def fill_visibility(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: PlanarSettings | None,
    log: PassLog,
) -> np.ndarray:
    """Return the visibility of a light (rows, cols), float32, 0 or 1, for the points of a buffer whose ground is a plane.

    It is 1 on everything that lies in no receiving plane. Raises ``GraphicsError``.
    """
    passes = log.pass_names(light, kinds, PASSES)
    receivers = find_receivers(buffer, scene, max_mesh_planes(settings))
    projections = _make_projections(buffer, scene, light, kinds, receivers)
    view, plane_of_point = buffer.view, receivers.plane_of_point
    stencil = np.zeros(plane_of_point.shape, np.uint8)
    stencil[: view.rows] = _draw_stencil(scene.world, buffer.frame, view, plane_of_point[: view.rows], projections, passes, log)
    if buffer.sample_pixels is not None:
        assert isinstance(view, PerspectiveView)
        sample_view = finer_view(view)
        samples = plane_of_point[view.rows :]
        sample_mask = samples > 0
        pixels = tuple(index[sample_mask] for index in buffer.sample_pixels)
        sample_planes = np.zeros((sample_view.rows, sample_view.cols), np.uint8)
        sample_planes[pixels] = samples[sample_mask]
        stencil[view.rows :][sample_mask] = _draw_stencil(
            scene.world, buffer.frame, sample_view, sample_planes, projections, passes, log
        )[pixels]
    log.keep_layer("stencil", light, stencil.copy)
    return np.where(stencil == SHADED_VALUE, np.float32(0.0), np.float32(1.0))


def plane_projection(light_m: np.ndarray, plane: Sequence[float] | np.ndarray = LEVEL_PLANE) -> np.ndarray:
    """Return the projection (4, 4) of homogeneous points onto a plane, away from the homogeneous light ``light_m`` (4,): p' / H.

    The light is above the plane (4,), whose dot product with a homogeneous point is the point's height.
    """
    return np.eye(4) - np.outer(light_m / (plane @ light_m), plane)


def clip_from_plane(world: World, frame: LocalFrame, view: MapView | PerspectiveView, origin_frame_m: np.ndarray) -> np.ndarray:
    """Return the matrix (4, 4) to clip coordinates from homogeneous points, in metres from ``origin_frame_m``.

    ``origin_frame_m`` (3,) is a point of the plane. The matrix is affine for the map of a flat world. Points of a map have depth 0,
    so that no height is clipped.
    """
    if isinstance(view, PerspectiveView):
        return camera_clip(view, frame, origin_frame_m, NEAR_PLANE_M)
    clip = map_clip(world, frame, view, origin_frame_m, (origin_frame_m[2] - 1.0, origin_frame_m[2] + 1.0))
    clip[2] = 0.0
    return clip


def _make_projections(
    buffer: GeometryBuffer, scene: Scene, light: str, kinds: tuple[CasterKind, ...], receivers: Receivers
) -> list[Projection]:
    """Return a projection for each receiving plane that casters may shade."""
    light_frame = np.array(scene.light_position(light, buffer.frame))
    ground, *planes = receivers.planes
    trees = caster_trees(buffer, kinds)
    meshes = caster_meshes(scene, buffer, ("meshes",)) if "meshes" in kinds else []  # a plane casts no shadow on itself
    projections = [_make_projection(buffer.frame, scene, light, ground, meshes, trees)]
    if planes:
        boxes = caster_boxes(meshes + (receivers.ground_casters(light_frame) if "relief" in kinds else []), light_frame)
        for plane in planes:
            if (light_frame[:3] - light_frame[3] * plane.origin_frame_m) @ plane.normal_frame > 0.0:
                plane_trees = None if trees is None else boxes.trees_before(plane, trees)
                plane_meshes = [boxes.triangles_before(plane)]
                projections.append(_make_projection(buffer.frame, scene, light, plane, plane_meshes, plane_trees))
    return [projection for projection in projections if projection.reaches_plane]


def _make_projection(
    frame: LocalFrame,
    scene: Scene,
    light: str,
    plane: ReceiverPlane,
    meshes: list[VerticesAndTriangles],
    trees: TreeInstances | None,
) -> Projection:
    """Return the casters and the light relative to a plane's origin. ``meshes`` and ``trees`` are in the frame."""
    origin = plane.origin_frame_m
    if light == SUN:
        assert scene.sun is not None
        light_m = np.append(scene.sun.in_frame(frame), 0.0)
    else:
        light_m = np.append(scene.lamps[light].in_frame(frame).position_frame_m - origin, 1.0)
    return Projection(
        origin, light_m, [(vertices - origin, triangles) for vertices, triangles in meshes], trees,
        np.append(plane.normal_frame, 0.0), plane.number, plane.error_m,
    )  # fmt: skip


def _draw_stencil(
    world: World,
    frame: LocalFrame,
    view: MapView | PerspectiveView,
    receivers: np.ndarray,
    projections: list[Projection],
    passes: list[str],
    log: PassLog,
) -> np.ndarray:
    """Return the stencil (rows, cols) uint8 of a view after casters are projected onto its planes.

    ``receivers`` (rows, cols) uint8 are the numbers of the pixels' planes. ``passes`` are the names of the algorithm's passes for
    the light and the kinds. ``projections`` hold the casters and the light of each plane.
    """
    if not (receivers.any() and projections):
        for name in passes:
            with log.record_pass(name):
                pass
        return np.where(receivers > 0, np.uint8(LIT_VALUE), np.uint8(NO_GROUND_VALUE))
    gl = device()
    target = gl.stencil.target(view.cols, view.rows)
    texture = gl.texture(receivers)
    try:
        with log.record_pass(passes[0]) as record:
            program = gl.program(shader_source("shadows/pixels.vert"), shader_source("shadows/planar_receivers.frag"))
            texture.use(0)
            program["receivers"] = 0
            with gl.stencil.increment_once_pass(target, NO_GROUND_VALUE):
                gl.draw_pixels(program, target)
            record.bytes = max(record.bytes, 9 * receivers.size)
        with log.record_pass(passes[1]) as record:
            rectangles = _plane_rectangles(receivers)
            texture.use(1)
            for projection in projections:
                if projection.number in rectangles:
                    clip_from_caster = clip_from_plane(world, frame, view, projection.origin_frame_m) @ plane_projection(
                        projection.light_m, projection.plane
                    )
                    target.scissor = rectangles[projection.number]
                    _draw_casters(gl, target, clip_from_caster, projection, len(rectangles) > 1, record)
            return gl.stencil.read(target)
    finally:
        target.scissor = None  # type: ignore[assignment]  # the stubs do not allow None, which ends clipping
        texture.release()


def _plane_rectangles(receivers: np.ndarray) -> dict[int, tuple[int, int, int, int]]:
    """Return the rectangle of pixels of each plane: first column and row, columns and rows.

    ``receivers`` (rows, cols) uint8 are the numbers of the pixels' planes.
    """
    if receivers.max() <= GROUND_NUMBER:
        return {GROUND_NUMBER: (0, 0, receivers.shape[1], receivers.shape[0])}
    from scipy.ndimage import find_objects

    return {
        number: (part[1].start, part[0].start, part[1].stop - part[1].start, part[0].stop - part[0].start)
        for number, part in enumerate(find_objects(receivers), 1)
        if part is not None
    }


def _draw_casters(
    gl: Device,
    target: Framebuffer,
    clip_from_caster: np.ndarray,
    projection: Projection,
    has_other_planes: bool,
    record: PassRecord,
) -> None:
    """Draw the projected casters into the stencil: pixels of the plane that they cover change from lit to shaded.

    ``clip_from_caster`` (4, 4) maps homogeneous points of casters, in metres from ``Projection.origin_frame_m``, to clip
    coordinates. With ``has_other_planes`` the picture shows other planes, too, which the casters skip by the texture of numbers in
    unit 1.
    """
    uniforms = {
        "clip_from_caster": tuple(clip_from_caster.T.ravel()), "position_error": POSITION_ERROR,
        "plane": tuple(projection.plane), "plane_error_m": projection.error_m,
    }  # fmt: skip
    plane_uniforms = {"receivers": 1, "number": float(projection.number)}
    with gl.stencil.increment_once_pass(target, LIT_VALUE, clip_distances=1):
        if projection.meshes:
            fragment = shader_source("shadows/planar_mesh.frag" if has_other_planes else "shadows/maps/depth.frag")
            program = gl.program(shader_source("shadows/planar", "shadows/planar_mesh.vert"), fragment)
            set_uniforms(program, {**uniforms, **(plane_uniforms if has_other_planes else {})})
            for vertices, triangles in projection.meshes:
                record.triangles += gl.draw_triangles(program, vertices, triangles)
        if projection.trees is not None:
            vertex = shader_source("shadows/planar", "terrain/gbuffer/tree", "shadows/planar_tree.vert")
            program = gl.program(vertex, shader_source("shadows/planar_tree.frag"))
            set_uniforms(program, {**uniforms, **plane_uniforms, "foliage": 0, "threshold": ALPHA_THRESHOLD, "curvature": 0.0})
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
    """Return the settings, ``None`` if the ground alone receives, and the reasons.

    The reasons are those for the receiving planes and for a requested filter without effect.
    """
    reasons = request.ignored_filter_reasons("planar")
    count = request.descriptor.receiver_planes
    if count is None or count <= GROUND_NUMBER:
        return None, reasons
    if has_few_planes(request.descriptor):
        return PlanarSettings(), [NamedReason(name="receivers planes", reason=f"{count} planes are visible"), *reasons]
    many = f"more than {MAX_RECEIVER_PLANES} planes are visible, and casters are drawn once for each"
    if request.descriptor.view_kind == "map":
        reason = f"{many}; neighbouring tiles would choose other planes"
        return None, [NamedReason(name="receivers ground", reason=reason), *reasons]
    return PlanarSettings(receivers="largest"), [NamedReason(name="receivers largest", reason=many), *reasons]


def _work(workload: Workload, settings: PlanarSettings | None) -> Work:
    """Return the counts of work by name (blocks, pixels, triangles, trees), under the name of the algorithm's only part.

    Casters count once for each receiving plane: an upper bound, since planes that face away need none, and others need fewer.
    """
    planes = 1 if settings is None else min(workload.descriptor.receiver_planes or 1, MAX_RECEIVER_PLANES + 1)
    draws = workload.picture_count * planes
    caster_counts = {"triangles": draws * workload.triangle_count("meshes"), "trees": draws * workload.tree_count}
    return {"planar": {"blocks": 1.0, "pixels": workload.picture_pixel_count, **caster_counts}}


def _wrong_share(casting: Casting) -> float:
    """Return the share of visible surfaces in shadow that are meshes or trees: this algorithm may leave them lit.

    It is an upper bound where planes of meshes receive. If it is unknown, return the share of the whole cast shadow.
    """
    return casting.share if casting.on_bodies is None else max(casting.on_bodies, MIN_CAST_SHADOW_SHARE)


ALGORITHM = Algorithm(
    name="planar",
    needs_view_pixels=True,
    description="casters projected onto the ground and onto few planes of meshes through the stencil; no shadows on leaves",
    plural_name="planar",
    fill_visibility=fill_visibility,
    passes=PASSES,
    refusals={
        "uneven": f"the ground is not flat: planar projects onto at most {MAX_RECEIVER_PLANES} planes, and not onto leaves",
        "area light": "planar projects casters from one point, into a stencil that is dark or not: it has hard edges only",
    },
    layers=("stencil",),
    settings_types=(PlanarSettings,),
    resolve_settings=_resolve,
    search=SettingsSearch(map_sizes_for_other_casters=MAP_SIZES_FOR_OTHER_CASTERS),
    cost=CostInputs(_work),
    accuracy=AccuracyInputs(wrong_share=_wrong_share),
    marker=PlotMarker("wedge", "purple"),
)
