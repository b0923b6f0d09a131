"""``render_frame``: execute a plan on a scene and a view by deferred shading: geometry, then visibility, then shading."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from skugga.shadows.block_casters import find_outside_casters
from skugga.shadows.block_normals import with_generalised_normals, with_locally_lit_normals
from skugga.shadows.executed_effects import executed_effects
from skugga.shadows.layer_collector import LayerCollector
from skugga.shadows.map_edges import anti_alias_block
from skugga.shadows.passes import ATTACHED_PASS, CASTERS_PASS, GEOMETRY_PASS, PassLayer, PassLog, PassRecord
from skugga.shadows.plan import Plan
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.sky_light.sky_light import block_sky_light
from skugga.shadows.supersampling import Supersampling, mean_visibilities, supersampling
from skugga.shadows.view_edges import smooth_shadow_edges
from skugga.shadows.visibility import visibilities_at, with_apparent_sun
from skugga.terrain.casters.caster_types import NO_CASTERS, Casters, Reach
from skugga.terrain.casters.reach import find_casters, find_reach
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.effects import EFFECTS
from skugga.terrain.effects.effect import STAGES_BEFORE_SHADING, ShadingBlock, Stage
from skugga.terrain.errors import InputError, RenderError, UnsupportedError
from skugga.terrain.gbuffer.antialias import MultisampledBuffer, picture_buffer
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.subsampled import subsampled_points
from skugga.terrain.gbuffer.supersampling import PixelSampling
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView, blocks_of, overlap_windows
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.level.level import SUN, EffectName
from skugga.terrain.scene import Scene
from skugga.terrain.shading import albedo_of, encode_srgb, shade, slope_sky_view_factor
from skugga.terrain.sky import sky_pixel_colors

RENDERER_VERSION = 9
"""Version of the renderer. Increment it by hand with every change of any picture: older tile pyramids are redrawn."""

SHADING_PASS = "shading"
"""Name of the pass that shades the surface and the sky."""

REFRACTION_PASS = "refraction"
"""Name of the effect that uses the sun's apparent position, and of its pass."""

MAX_FRAME_PIXELS = 64_000_000
"""Largest frame: about 1.3 GB of layers."""

REACH_STRIDE_PX = 4
"""Stride, pixels, of the points from which casters are searched in a perspective view without casters."""

BAND_PIXELS = 2**21
"""Pixels of a perspective view that are processed at a time: about 0.5 GB."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A rendered view. Arrays are (rows, cols, ...). Row 0 is the upper row; in a map it is the northern row.

    Attributes
    ----------
    view, plan
        The view, and the plan that was executed.
    color
        uint8 (rows, cols, 3), sRGB.
    visibilities
        Light -> float32 (rows, cols) in [0, 1], NaN off the surface.
    shown_visibilities
        Light -> the same visibility with a map's edges anti-aliased, as ``color`` shows it.
    height_m
        float32 (rows, cols), metres, NaN off the surface.
    position_frame_m
        float64 (rows, cols, 3), metres in ``frame``, of a perspective view; ``None`` in a map.
    frame
        The local frame of a perspective view; ``None`` in a map.
    passes
        The passes that ran.
    reach
        The distance to which casters were searched.
    layers
        The requested intermediate pictures, by layer and light (``skugga.shadows.passes``).
    """

    view: MapView | PerspectiveView
    plan: Plan
    color: np.ndarray
    visibilities: dict[str, np.ndarray]
    shown_visibilities: dict[str, np.ndarray]
    height_m: np.ndarray
    position_frame_m: np.ndarray | None
    frame: LocalFrame | None
    passes: tuple[PassRecord, ...]
    reach: Reach
    layers: dict[PassLayer, dict[str, np.ndarray]] = field(default_factory=dict)

    @property
    def visibility(self) -> np.ndarray:
        """The visibility of the first light: the sun, if the view has it."""
        return next(iter(self.visibilities.values()))

    @property
    def opacity(self) -> np.ndarray:
        """The opacity (rows, cols) uint8 of the first light's shadow as it is shown; 0 off the surface."""
        shown_visibility = next(iter(self.shown_visibilities.values()))
        return np.rint(255.0 * (1.0 - np.where(self.valid, shown_visibility, 1.0))).astype(np.uint8)

    @cached_property
    def position_earth_m(self) -> np.ndarray | None:
        """Earth-fixed points (rows, cols, 3) float64 of a perspective view, NaN in the sky; ``None`` in a map."""
        if self.position_frame_m is None or self.frame is None:
            return None
        return self.frame.points_to_earth(self.position_frame_m)

    @property
    def effects(self) -> frozenset[EffectName]:
        """The effects that ran, derived from the record of the passes."""
        return executed_effects(self.passes)

    @property
    def valid(self) -> np.ndarray:
        """The valid mask: bool (rows, cols), where the view shows a surface."""
        return ~np.isnan(self.height_m)

    @property
    def opaque_mask(self) -> np.ndarray:
        """Where the colour is valid, bool (rows, cols): on the surface, and in the sky of a perspective view."""
        return self.valid if isinstance(self.view, MapView) else np.ones(self.valid.shape, bool)

    def with_light_first(self, light: str | None) -> Frame:
        """Return the frame with a light's visibility as the first one. ``None`` returns the frame unchanged.

        Raises ``InputError`` for a light that does not reach the view.
        """
        if light is None:
            return self
        if light not in self.visibilities:
            raise InputError("light", light, f"{', '.join(self.visibilities)} (the lights that reach the view)")
        visibilities, shown_visibilities = (
            {light: values[light], **values} for values in (self.visibilities, self.shown_visibilities)
        )
        return replace(self, visibilities=visibilities, shown_visibilities=shown_visibilities)


def check_pixel_count(view: MapView | PerspectiveView) -> None:
    """Raise ``InputError`` for a view with more pixels than a frame may have."""
    if view.rows * view.cols > MAX_FRAME_PIXELS:
        raise InputError("size", f"{view.cols}x{view.rows}", f"at most {MAX_FRAME_PIXELS} pixels")


def pass_names_of(effects: Collection[str], shadow_passes: list[str]) -> list[str]:
    """Return the names of a frame's passes in order, given its effects and the passes of its shadow algorithms.

    ``effects`` and ``shadow_passes`` hold their names.
    """

    def effect_names(stage: Stage) -> list[str]:
        return [name for name, effect in EFFECTS.items() if effect.stage == stage and name in effects]

    refraction_passes, caster_passes = (
        [name for name in (pass_name,) if name in effects] for pass_name in (REFRACTION_PASS, CASTERS_PASS)
    )
    effect_passes = [name for stage in STAGES_BEFORE_SHADING for name in effect_names(stage)]
    return [
        *refraction_passes,
        GEOMETRY_PASS,
        *caster_passes,
        *shadow_passes,
        ATTACHED_PASS,
        *effect_passes,
        SHADING_PASS,
        *effect_names("color"),
    ]


def render_frame(
    scene: Scene,
    view: MapView | PerspectiveView,
    plan: Plan,
    on_block: Callable[[int, int], None] | None = None,
    layers: frozenset[PassLayer] = frozenset(),
    pixel_sampling: PixelSampling = "means",
) -> Frame:
    """Execute a plan on a scene and a view.

    Pixels of a coarse map show means of the ground that they cover (``skugga.shadows.supersampling``). Edges in other maps are
    anti-aliased (``skugga.shadows.map_edges``).

    Parameters
    ----------
    scene, view, plan
        The scene, the view, and the plan for both.
    on_block
        Function that is called with the numbers of finished and of all blocks, after each block.
    layers
        The intermediate pictures to keep.
    pixel_sampling
        ``means`` over the ground that a pixel covers, or ``points``: the pixels' own points, by which accuracy is measured.

    Returns
    -------
    Frame
        The rendered view.

    Raises
    ------
    InputError
        The view has more pixels than a frame may have, or a layer too many texels.
    UnsupportedError
        No algorithm of the plan has a requested layer.
    RenderError
        The work fails, or other passes ran than the plan lists.
    """
    _check_layers(plan, layers)
    check_pixel_count(view)
    size = view.rows, view.cols
    log, reach, collector = PassLog(requested_layers=layers), Reach(0.0, 0.0, False), LayerCollector(size)
    scene = apply_refraction(scene, plan, log)
    parts: Sequence[tuple[MapView | PerspectiveView, int, int]] = blocks_of(view) if isinstance(view, MapView) else bands_of(view)
    frame = None
    for completed, (part, row, col) in enumerate(parts, start=1):
        block = render_block(scene, part, plan, log, pixel_sampling)
        reach = worse_reach(reach, block.reach)
        frame_window, block_window = overlap_windows(view, part, row, col)
        if frame is None:  # a single part provides the arrays of the whole view
            frame = block if len(parts) == 1 and block.valid.shape == size else _empty_frame(view, plan, block)
        if frame is not block:
            frame.color[frame_window], frame.height_m[frame_window] = block.color[block_window], block.height_m[block_window]
            for light in plan.lights:
                frame.visibilities[light][frame_window] = block.visibilities[light][block_window]
                frame.shown_visibilities[light][frame_window] = block.shown_visibilities[light][block_window]
            if frame.position_frame_m is not None and block.position_frame_m is not None:
                frame.position_frame_m[frame_window] = block.position_frame_m[block_window]
        collector.add_block(log.take_layers(), frame_window, block_window)
        if on_block is not None:
            on_block(completed, len(parts))
    if log.names != plan.passes:
        raise RenderError(f"the passes that ran ({', '.join(log.names)}) differ from those of the plan ({', '.join(plan.passes)})")
    assert frame is not None
    return replace(frame, view=view, passes=tuple(log.records.values()), reach=reach, layers=collector.assembled_pictures)


def _reach_points(own_pixels: GeometryBuffer, plan: Plan) -> GeometryBuffer:
    """Return the points from which casters are searched.

    They are fewer in a perspective view in which nothing casts, since only the report of the casters' reach needs them there.
    ``own_pixels`` is the buffer of the view's own pixels.
    """
    if plan.casts_shadows or isinstance(own_pixels.view, MapView):
        return own_pixels
    return subsampled_points(own_pixels, REACH_STRIDE_PX)


def _empty_frame(view: MapView | PerspectiveView, plan: Plan, part: Frame) -> Frame:
    """Return the frame of a view before any part is drawn. It has the same arrays as the frame of a part."""
    size = view.rows, view.cols
    visibilities, shown_visibilities = ({light: np.full(size, np.nan, np.float32) for light in plan.lights} for _ in range(2))
    position = None if part.position_frame_m is None else np.full((*size, 3), np.nan)
    color, height = np.zeros((*size, 3), np.uint8), np.full(size, np.nan, np.float32)
    return Frame(view, plan, color, visibilities, shown_visibilities, height, position, part.frame, (), part.reach)


def _check_layers(plan: Plan, layers: frozenset[PassLayer]) -> None:
    """Raise ``UnsupportedError`` for a requested layer that no algorithm of a plan has."""
    available = {layer for step in plan.steps for layer in ALGORITHMS[step.algorithm].layers}
    for layer in sorted(layers - available):
        capable = ", ".join(name for name, algorithm in ALGORITHMS.items() if layer in algorithm.layers) or "nothing"
        raise UnsupportedError("layer", layer, f"{plan.algorithms_text} has no such layer; algorithms that have it: {capable}")


def bands_of(view: PerspectiveView) -> list[tuple[PerspectiveView, int, int]]:
    """Cut a perspective view into bands of whole rows, each with its first row and column. Bands bound the memory."""
    rows = max(BAND_PIXELS // view.cols, 1)
    return [(view.part(row, 0, min(rows, view.rows - row), view.cols), row, 0) for row in range(0, view.rows, rows)]


def apply_refraction(scene: Scene, plan: Plan, log: PassLog) -> Scene:
    """Return the scene with the sun's apparent position if the plan has refraction, or with its true one.

    Refraction is recorded as a pass of its own.
    """
    if REFRACTION_PASS not in plan.effect_names:
        return with_apparent_sun(scene, plan.effect_names)
    with log.record_pass(REFRACTION_PASS):
        return with_apparent_sun(scene, plan.effect_names)


def sun_visibility(scene: Scene, view: MapView, plan: Plan) -> np.ndarray:
    """Return the sun's visibility that ``render_frame`` computes for a map, without the work for its colours and shown edges.

    Parameters
    ----------
    scene, view, plan
        The scene with a sun, the map, and the plan for both.

    Returns
    -------
    np.ndarray
        Values in [0, 1], float32 (rows, cols), NaN off the surface; ``Frame.visibilities`` has the same ones.

    Raises
    ------
    InputError
        The view has more pixels than a frame may have.
    RenderError
        The work fails.
    """
    check_pixel_count(view)
    log = PassLog()
    scene = apply_refraction(scene, plan, log)
    out = np.full((view.rows, view.cols), np.nan, np.float32)
    for block, row, col in blocks_of(view):
        picture, _, _, visibilities = _visibilities_of_block(scene, block, plan, log, "means", reports_reach=False)
        window, block_window = overlap_windows(view, block, row, col)
        out[window] = np.where(picture.pixel_buffer.valid, visibilities[SUN], np.float32(np.nan))[block_window]
    return out


def _visibilities_of_block(
    scene: Scene,
    view: MapView | PerspectiveView,
    plan: Plan,
    log: PassLog,
    pixel_sampling: PixelSampling,
    reports_reach: bool = True,
) -> tuple[MultisampledBuffer, Casters, Supersampling | None, dict[str, np.ndarray]]:
    """Return a block's or a band's geometry, its casters, its supersampling, and each light's visibility (rows, cols).

    The supersampling is ``None`` if the visibilities are those of the pixels' own points. Without ``reports_reach`` the reach of
    the casters may be missing. The other arguments are those of ``render_block``.
    """
    reach = None if reports_reach else NO_CASTERS.reach
    searches_casters = CASTERS_PASS in plan.effect_names
    with log.record_pass(GEOMETRY_PASS):
        picture = picture_buffer(scene, view)
        own_pixels = picture.pixel_buffer
        if not searches_casters and reach is None:
            reach = find_reach(scene, _reach_points(own_pixels, plan))
    if searches_casters or reach is None:
        casters = find_outside_casters(scene, plan, own_pixels, lambda: find_casters(scene, own_pixels), log)
    else:
        casters = Casters((), reach)
    pixels = supersampling(scene, view, plan) if pixel_sampling == "means" else None
    if pixels is None:
        visibilities = visibilities_at(scene, plan, picture.buffer, casters, log)
    else:
        visibilities = mean_visibilities(pixels, own_pixels, log)
    return picture, casters, pixels, visibilities


def render_block(
    scene: Scene, view: MapView | PerspectiveView, plan: Plan, log: PassLog, pixel_sampling: PixelSampling = "means"
) -> Frame:
    """Render a block of a map, or a band of a perspective view. The scene is one that ``apply_refraction`` returned.

    Raises the errors of ``render_frame``. ``pixel_sampling`` is that of ``render_frame``.
    """
    picture, casters, pixels, visibilities = _visibilities_of_block(scene, view, plan, log, pixel_sampling)
    own_pixels = picture.pixel_buffer
    shading_visibilities = visibilities
    if isinstance(view, MapView) and pixels is None and pixel_sampling == "means":
        picture, shading_visibilities = anti_alias_block(scene, plan, own_pixels, visibilities, log)
    if isinstance(view, PerspectiveView) and pixel_sampling == "means":
        shading_visibilities = smooth_shadow_edges(scene, plan, picture, visibilities, casters, log)
    block = ShadingBlock(scene, view, picture.buffer, shading_visibilities, picture, block_sky_light)
    linear, block = _shade_block(block, plan, log)
    if not isinstance(view, MapView):
        _draw_sky(scene, view, picture, plan, linear, log)
    _run_effects("color", {"color": linear}, block, plan, log)
    with log.record_pass(SHADING_PASS):
        color = encode_srgb(picture.average_samples(linear))
        valid, nodata = own_pixels.valid, np.float32(np.nan)
        visibilities = {light: np.where(valid, values[: view.rows], nodata) for light, values in visibilities.items()}
        shown_visibilities = {light: np.where(valid, values[: view.rows], nodata) for light, values in shading_visibilities.items()}
        if isinstance(view, MapView):
            means = {light: picture.average_samples(values[..., None])[..., 0] for light, values in shading_visibilities.items()}
            shown_visibilities = {light: np.where(valid, values, nodata) for light, values in means.items()}
    position, frame = (None, None) if isinstance(view, MapView) else (own_pixels.position_frame_m, own_pixels.frame)
    return Frame(view, plan, color, visibilities, shown_visibilities, own_pixels.height_m, position, frame, (), casters.reach)


def _shade_block(block: ShadingBlock, plan: Plan, log: PassLog) -> tuple[np.ndarray, ShadingBlock]:
    """Return the linear display colour (rows, cols, 3) of a block's surface, and the block with its final shading normals."""
    light: dict[Stage, np.ndarray] = {}
    with log.record_pass(GEOMETRY_PASS):
        shaded_block = with_generalised_normals(block)
    if shaded_block is not block:  # the open sky above a slope is that of the true ground
        light["skylight"], block = _initial_values(block, "skylight"), shaded_block
    for stage in STAGES_BEFORE_SHADING:
        _run_effects(stage, light, block, plan, log)
        if stage == "normal" and stage in light:
            block = replace(block, buffer=replace(block.buffer, shading_normal_frame=light[stage]))
    with log.record_pass(SHADING_PASS):
        sunlight = light["sunlight"] if "sunlight" in light else _initial_values(block, "sunlight")
        arrays = (light.get(stage) for stage in ("albedo", "skylight", "lamplight", "gloss"))
        return shade(with_locally_lit_normals(block).buffer, block.scene, sunlight, *arrays), block


def _initial_values(block: ShadingBlock, stage: Stage) -> np.ndarray:
    """Return the array with which the first effect of a stage starts."""
    shape = block.buffer.valid.shape
    if stage == "normal":
        return block.buffer.shading_normal_frame.copy()
    if stage == "gloss":
        return np.zeros((*shape, 4), np.float32)
    if stage == "albedo":
        return albedo_of(block.buffer, block.scene)
    if stage == "sunlight":
        return block.visibilities[SUN].copy() if SUN in block.visibilities else np.zeros(shape, np.float32)
    if stage == "skylight":
        return slope_sky_view_factor(block.buffer, block.scene)
    return np.zeros((*shape, 3), np.float32)


def _run_effects(stage: Stage, values: dict[Stage, np.ndarray], block: ShadingBlock, plan: Plan, log: PassLog) -> None:
    """Run the plan's effects of one stage on the array ``values[stage]``, each as a pass of its own."""
    for name, effect in EFFECTS.items():
        if effect.stage == stage and effect.apply is not None and name in plan.effect_names:
            with log.record_pass(name):
                if stage not in values:
                    values[stage] = _initial_values(block, stage)
                effect.apply(values[stage], block)


def _draw_sky(
    scene: Scene, view: PerspectiveView, picture: MultisampledBuffer, plan: Plan, linear: np.ndarray, log: PassLog
) -> None:
    """Write the sky's colour to the pixels and samples without a surface, within the pass of the effect that draws the sky.

    ``linear`` (rows, cols, 3) is the linear colour of the buffer's points, which is changed in place.
    """
    sky_colors: Callable[[Scene, PerspectiveView, np.ndarray, np.ndarray], np.ndarray] = sky_pixel_colors
    pass_name = SHADING_PASS
    for name, effect in EFFECTS.items():
        if effect.sky_colors is not None and name in plan.effect_names:
            sky_colors, pass_name = effect.sky_colors, name
    with log.record_pass(pass_name):
        row, col = np.nonzero(~picture.buffer.valid)
        pixel_row, pixel_col = picture.pixels_of_points(row, col)
        colors = sky_colors(scene, view, pixel_row, pixel_col)
        run_in_chunks(len(row), _copy_colors, row * linear.shape[1] + col, colors, linear.reshape(-1, 3))


@compiled
def _copy_colors(first, last, point_indices, colors, linear):
    """Copy ``colors[first:last]`` to the rows ``point_indices[first:last]`` of ``linear`` (n, 3)."""
    for n in range(first, last):
        for k in range(3):
            linear[point_indices[n], k] = colors[n, k]


def worse_reach(first: Reach, second: Reach) -> Reach:
    """Return the reach to report for two blocks: a clipped one before an unclipped one, then the farther one."""
    return max(first, second, key=lambda reach: (reach.clipped, reach.needed_m, -reach.used_m))
