"""Hours of sun: the duration, the first and last time, and the number of days of direct sun at the cells of a map's block.

The sun is sampled in even time steps, and at its rise and set. If no step is requested, each block's ground determines it
(``skugga.shadows.sun_hours.steps``). For ground without objects the line sweep (``skugga.shadows.sweep``) gives the clearance, the
margin by which each cell sees the sun. The times at which clearances change their signs are derived from it
(``skugga.shadows.sun_hours.spells``). With steps longer than ``MIN_REFINED_TIME_STEP_MINUTES``, walks along lines of sight refine
these times. If buildings or models stand on the ground, rays to the sun find their shadows
(``skugga.shadows.sun_hours.solid_shadows``). If trees do, or if the ground is upright columns, or if cells are coarser than the
raster's, a plan's algorithms give the visible share of the sun. A cell has sun if at least half of it is visible.

The sweep uses a sun-aligned grid, rotated and mirrored so that the sun stands before row 0. Results stay in the order of the
sun-aligned grid from step to step. It changes only three or four times a day, when the sun's direction passes a diagonal or an axis
of the grid.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from skugga.shadows.plan import Plan
from skugga.shadows.render import sun_visibility
from skugga.shadows.sun_hours.marched_clearances import MARGIN_TANGENT, MarchedGround, clearance_tangents, marched_ground
from skugga.shadows.sun_hours.quadratics import quadratic_fit
from skugga.shadows.sun_hours.sight_walks import WalkedGround, sun_track, walked_ground
from skugga.shadows.sun_hours.solid_shadows import SolidShadows, rays_find_all_shadows
from skugga.shadows.sun_hours.spells import (
    ClearanceSample,
    ClockReading,
    SunSpells,
    WalkInput,
    add_sun_between,
    compute_clearances,
    empty_spells,
    end_day,
    end_spells,
    sun_aligned_copy,
    sun_aligned_spells,
)
from skugga.shadows.sun_hours.steps import IDENTITY_ORIENTATION, LONG_STEP_MINUTES, sampling_step_minutes
from skugga.shadows.sun_hours.suns import SunSpan, WindowSun, block_sample_positions, sun_spans
from skugga.shadows.sweep.orientation import GridOrientation
from skugga.shadows.sweep.sweep import NodeClearance, clearance_of_nodes
from skugga.terrain.casters.caster_types import Patch
from skugga.terrain.casters.ground_extent import holds_all_ground
from skugga.terrain.casters.reach import find_sun_casters
from skugga.terrain.compiled import CORES
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.bare_nodes import BareNodes, bare_nodes
from skugga.terrain.gbuffer.supersampling import is_terrain_only
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.sun import Sun
from skugga.terrain.scene import Scene

LINES_PER_COLUMN, LONG_STEP_LINES_PER_COLUMN = 8, 4
"""Sweep lines per column of nodes (``skugga.shadows.sweep.lines``), and those with the long step or longer ones.

With four lines, errors on surfaces of trees are doubled. In mountains, which bear long steps, they stay as they are.
"""

CASTER_SEARCH_STEP_MINUTES = 15.0
"""Minutes between two searches for ground beside a block that casts shadows on it.

Ground that hides the sun only between two searches is missed. Such ground is at least about fifteen times as far away as the block
is wide.
"""

OBJECTS_STEP_MINUTES = 2.0
"""Default minutes between two samples if objects stand on the ground."""

STEPS_PER_DAY = 24
"""Number of steps of a day whose ends are reported as progress."""

MIN_SHADED_CLEARANCE = np.float32(1e-3)
"""Minimum amount, metres, of a clearance in the shadow of a building or a model. It is negative there."""

MIN_REFINED_TIME_STEP_MINUTES = 3.0
"""Time step, minutes, beyond which walks along lines of sight refine the time of a change between sun and shade."""


@dataclass(frozen=True)
class SunRules:
    """The definition of direct sun.

    Attributes
    ----------
    step_minutes
        Minutes between two samples; ``None``: each block's ground determines it.
    threshold_h
        Minimum hours of sun of a day that counts in ``SunHours.days``.
    min_altitude_deg
        Minimum apparent altitude of the sun at a cell. A lower sun does not count.
    height_m
        Height above the ground for which sun is computed, metres.
    """

    step_minutes: float | None = None
    threshold_h: float = 2.0
    min_altitude_deg: float = 0.0
    height_m: float = 0.0


@dataclass(frozen=True, eq=False)
class SunHours:
    """The direct sun at a block's cells, float32 (rows, cols) each; NaN at cells without a surface.

    Attributes
    ----------
    hours
        Mean hours of sun per date.
    first, last
        Earliest and latest time of sun on any date, minutes from midnight by the clock of the windows; NaN without sun.
    longest
        Longest unbroken interval of sun on any date, hours.
    days
        Number of dates with at least ``SunRules.threshold_h``.
    """

    hours: np.ndarray
    first: np.ndarray
    last: np.ndarray
    longest: np.ndarray
    days: np.ndarray


def sun_hours(
    scene: Scene,
    view: MapView,
    days: Sequence[WindowSun],
    rules: SunRules,
    plan_of: Callable[[Scene], Plan],
    on_step: Callable[[], None] | None = None,
) -> SunHours:
    """Compute the hours of direct sun at the cells of a map's block over several days. Clouds are ignored.

    Parameters
    ----------
    scene
        The scene.
    view
        The block, whose pixels are the cells.
    days
        The path of the sun during the window of time of each day.
    rules
        The definition of direct sun.
    plan_of
        Function that returns the plan (algorithms and settings) for a scene. It is called only if pictures of the shadows are
        needed (``_RenderedBlock``).
    on_step
        Function to call ``STEPS_PER_DAY`` times for each day, at even steps of its window of time.

    Returns
    -------
    SunHours
        The sun of the cells.

    Raises
    ------
    InputError
        ``rules.height_m`` is not 0 although objects stand on the ground.
    UnsupportedError, RenderError
        The errors of the algorithms.
    """
    scene = under_clear_sky(scene)
    if is_terrain_only(scene) and view.is_on_nodes:
        block: _TerrainBlock | _RenderedBlock = _TerrainBlock(scene, bare_nodes(scene, view, 1), rules)
    elif rules.height_m:
        raise InputError("height", rules.height_m, "0, where objects stand on the ground")
    elif view.is_on_nodes and rays_find_all_shadows(scene, view):
        block = _SolidsBlock(scene, bare_nodes(scene, view, 1), rules)
    else:
        block = _RenderedBlock(scene, view, plan_of)
    valid = block.valid()
    block_spells = _BlockSpells(view, IDENTITY_ORIENTATION, empty_spells((view.rows, view.cols)))
    if valid.any():
        step_minutes = rules.step_minutes or block.step_minutes(days[len(days) // 2])
        lines = LINES_PER_COLUMN if step_minutes < LONG_STEP_MINUTES else LONG_STEP_LINES_PER_COLUMN
        for day in days:
            progress = _DayProgress(day.window.length_min, on_step)
            clock = ClockReading(day.window.start_clock_min, day.window.minutes_to_change, day.window.clock_advance_min)
            for span in sun_spans(day, view, scene.world, rules.min_altitude_deg, step_minutes):
                block_spells = _add_span(block_spells, block, day, span, clock, lines, progress.advance_to)
            end_day(block_spells.spells, rules.threshold_h * 60.0)
            progress.advance_to(day.window.length_min)
    spells = sun_aligned_spells(block_spells.spells, block_spells.orientation, IDENTITY_ORIENTATION)

    def mask_invalid(values: np.ndarray) -> np.ndarray:
        return np.where(valid, values, np.float32(np.nan))

    hours = spells.total_minutes / np.float32(60.0 * max(len(days), 1))
    return SunHours(
        mask_invalid(hours),
        mask_invalid(spells.first_minutes),
        mask_invalid(spells.last_minutes),
        mask_invalid(spells.longest_minutes / np.float32(60.0)),
        mask_invalid(spells.day_count),
    )


class _DayProgress:
    """Calls ``on_step`` after each of ``STEPS_PER_DAY`` equal parts of a day's window of ``length_min`` minutes."""

    def __init__(self, length_min: float, on_step: Callable[[], None] | None) -> None:
        self._length_min, self._on_step, self._reported_count = length_min, on_step, 0

    def advance_to(self, minutes: float) -> None:
        """Report the parts that end before a time, minutes after the window's start."""
        finished_count = min(int(STEPS_PER_DAY * minutes / self._length_min), STEPS_PER_DAY)
        for _ in range(finished_count - self._reported_count):
            if self._on_step is not None:
                self._on_step()
        self._reported_count = max(finished_count, self._reported_count)


@dataclass(frozen=True, eq=False)
class _BlockSpells:
    """The sun at a block's cells up to a moment, in the order of a sun-aligned grid.

    Attributes
    ----------
    view
        The block.
    orientation
        How the grid is turned to become the sun-aligned grid.
    spells
        The intervals of sun so far, (n, m) in the order of the sun-aligned grid.
    """

    view: MapView
    orientation: GridOrientation
    spells: SunSpells

    def reoriented(self, orientation: GridOrientation) -> _BlockSpells:
        """Return the sun at the cells in the order of another orientation."""
        return (
            self
            if orientation == self.orientation
            else _BlockSpells(self.view, orientation, sun_aligned_spells(self.spells, self.orientation, orientation))
        )

    @property
    def fit_matrix(self) -> np.ndarray:
        """The ``quadratic_fit`` for values at ``block_sample_positions``, in the order of the sun-aligned grid."""
        row, col = block_sample_positions(self.view)
        i, j = self.orientation.to_sun_aligned(row.ravel(), col.ravel(), self.view.rows, self.view.cols)
        return quadratic_fit(i, j, self.spells.day_minutes.shape)


def _add_span(
    block_spells: _BlockSpells,
    block: _TerrainBlock | _RenderedBlock,
    day: WindowSun,
    span: SunSpan,
    clock: ClockReading,
    lines: int,
    on_moment: Callable[[float], None],
) -> _BlockSpells:
    """Return the sun at a block's cells after a span, an interval of a day with the sun up.

    ``block_spells`` is the sun before it, and ``lines`` the sweep lines per column. ``on_moment`` is called with the minutes after
    the window's start of each moment that was computed.
    """
    moments: list[ClearanceSample] = []
    is_first_step = True

    def add_step(four_moments: tuple[ClearanceSample, ClearanceSample, ClearanceSample, ClearanceSample]) -> None:
        time_range = four_moments[1].minutes, four_moments[2].minutes
        walk_input = block.walk_input(day, time_range, block_spells.orientation)
        bulge = block.sun_tangent_bulge(day, time_range)
        add_sun_between(block_spells.spells, four_moments, clock, block_spells.fit_matrix, is_first_step, walk_input, bulge, CORES)

    def add_clearance_tangent(after: ClearanceSample | None) -> None:
        """Add the clearance tangents of the last moment, while its cells are in the order of its own sun."""
        here = moments[-1]
        around = moments[-2] if len(moments) >= 2 else here, here, here if after is None else after
        moments[-1] = replace(here, marched_tangent=block.clearance_tangents(day, around, block_spells.orientation))

    for number, (orientation, clearance) in enumerate(block.clearances(day, span, lines)):
        sample = ClearanceSample(float(span.samples_minutes[number]), clearance, span.above_floor_sine[number].ravel())
        if moments:
            add_clearance_tangent(_reoriented(sample, orientation, block_spells.orientation))
        if orientation != block_spells.orientation:
            moments = [_reoriented(moment, block_spells.orientation, orientation) for moment in moments]
            block_spells = block_spells.reoriented(orientation)
        moments.append(sample)
        on_moment(sample.minutes)
        if number >= 2:
            start_moment, end_moment, after = moments[-3:]
            add_step((moments[-4] if number >= 3 else start_moment, start_moment, end_moment, after))
            is_first_step = False
        del moments[:-3]
    add_clearance_tangent(None)
    start_moment, end_moment = moments[-2:]
    add_step((moments[-3] if len(moments) >= 3 else start_moment, start_moment, end_moment, end_moment))
    end_spells(block_spells.spells, float(span.samples_minutes[-1]), clock)
    return block_spells


def _reoriented(sample: ClearanceSample, before: GridOrientation, after: GridOrientation) -> ClearanceSample:
    """Return the clearances of cells of the grid turned by ``before`` in the order of the grid turned by ``after``."""
    if before == after:
        return sample
    tangent = sample.marched_tangent
    return replace(
        sample,
        clearance=sun_aligned_copy(sample.clearance, before, after),
        marched_tangent=None if tangent is None else sun_aligned_copy(tangent, before, after),
    )


class _TerrainBlock:
    """A block of ground without objects, with clearances (margins by which cells see the sun) in metres by the line sweep."""

    def __init__(self, scene: Scene, nodes: BareNodes, rules: SunRules) -> None:
        self._scene, self._nodes, self._rules, self._height_m = scene, nodes, rules, rules.height_m
        self._has_all_ground = holds_all_ground(scene, nodes.view)
        self._recent_patches: deque[tuple[Patch, ...]] = deque(maxlen=3)  # the patches of the last three moments
        self._ground: tuple[tuple[Patch, ...], WalkedGround] | None = None
        self._marched: tuple[WalkedGround, MarchedGround] | None = None

    def valid(self) -> np.ndarray:
        """Return the valid mask: cells (rows, cols) that show ground."""
        return self._nodes.shows_ground

    def step_minutes(self, day: WindowSun) -> float:
        """Return the minutes between two samples that are accurate enough on a representative day."""
        return sampling_step_minutes(self._scene, self._nodes, day, self._rules.min_altitude_deg, self._height_m)

    def clearances(self, day: WindowSun, span: SunSpan, lines: int) -> Iterator[tuple[GridOrientation, np.ndarray]]:
        """Yield, for each moment of a span, how the grid is turned and the clearances (n, m) of its cells.

        ``lines`` are the sweep lines per column. An array is overwritten four moments later.
        """
        arrays: list[np.ndarray] = []
        for minutes, patches in self._casters_by_moment(day, span):
            self._recent_patches.append(patches)
            node_clearance = clearance_of_nodes(self._nodes, self._scene_at(day, minutes), patches, lines)
            spare = arrays.pop(0) if len(arrays) == 4 else None
            if spare is None or spare.shape != node_clearance.ray_height_m.shape:
                spare = np.empty(node_clearance.ray_height_m.shape, np.float32)
            arrays.append(
                compute_clearances(
                    node_clearance.ray_height_m,
                    node_clearance.shadow_ray_height_m,
                    self._height_m * node_clearance.ray_height_per_metre,
                    spare,
                    CORES,
                )
            )
            self._add_objects(day, minutes, node_clearance, arrays[-1])
            yield node_clearance.orientation, arrays[-1]

    def _add_objects(self, day: WindowSun, minutes: float, node_clearance: NodeClearance, clearance: np.ndarray) -> None:
        """Change the clearances (n, m) of a moment, in place, where objects stand or cast shadows. Here none do."""

    def clearance_tangents(
        self, day: WindowSun, moments: tuple[ClearanceSample, ClearanceSample, ClearanceSample], orientation: GridOrientation
    ) -> np.ndarray | None:
        """Return the clearance tangents of cells at the second of three moments, where sun and shade change before or after it.

        The result is ``None`` if coarser ground beside the block may cast shadows on it, or if the moments are so close that
        clearances in metres serve. ``orientation`` is that of the second moment's sun, and of the cells. At the ends of a span the
        first moment equals the second one, or the third one does.
        """
        before, here, after = moments
        longest_minutes = max(here.minutes - before.minutes, after.minutes - here.minutes)
        if longest_minutes <= MIN_REFINED_TIME_STEP_MINUTES:
            return None
        ground = self._walked_ground()
        if len(ground.grid_layouts) > 1:
            return None
        if self._marched is None or self._marched[0] is not ground or self._marched[1].orientation != orientation:
            self._marched = None  # free the memory before the next one is made
            self._marched = ground, marched_ground(self._nodes, ground, orientation)
        track = sun_track(day, self._nodes, self._scene.world, orientation, (here.minutes, here.minutes + 1.0))
        tangents = [self._sun_tangent(day, moment.minutes) for moment in moments]
        margin = MARGIN_TANGENT + max(abs(tangents[1] - tangents[0]), abs(tangents[2] - tangents[1]))
        clearances = before.clearance, here.clearance, after.clearance
        return clearance_tangents(self._marched[1], track, clearances, self._height_m, margin, CORES)

    def sun_tangent_bulge(self, day: WindowSun, time_range_minutes: tuple[float, float]) -> float:
        """Return the tangent of the sun's altitude midway between two moments, less the mean of those at the two."""
        begin, end = time_range_minutes
        begin_tangent, tangent, end_tangent = (self._sun_tangent(day, minutes) for minutes in (begin, 0.5 * (begin + end), end))
        return tangent - 0.5 * (begin_tangent + end_tangent)

    def _sun_tangent(self, day: WindowSun, minutes: float) -> float:
        """Return the tangent of the sun's altitude at the level's anchor at a moment of a day."""
        return float(np.tan(np.radians(day.sun_at(minutes, self._scene.world).altitude_deg)))

    def walk_input(self, day: WindowSun, time_range_minutes: tuple[float, float], orientation: GridOrientation) -> WalkInput | None:
        """Return the input of walks between two moments, or ``None`` if the moments are so close that walks are not needed.

        ``time_range_minutes`` holds the moments, minutes after the window's start. ``orientation`` is that of the cells'
        sun-aligned grid.
        """
        if time_range_minutes[1] - time_range_minutes[0] <= MIN_REFINED_TIME_STEP_MINUTES:
            return None
        return WalkInput(
            self._walked_ground(), sun_track(day, self._nodes, self._scene.world, orientation, time_range_minutes), self._height_m
        )

    def _walked_ground(self) -> WalkedGround:
        """Return the ground that casts shadows at the last three moments."""
        patches = tuple(dict.fromkeys(patch for recent in self._recent_patches for patch in recent))
        if self._ground is None or self._ground[0] != patches:
            self._ground = self._marched = None  # free the memory before the next one is made
            self._ground = patches, walked_ground(self._scene, self._nodes, patches)
        return self._ground[1]

    def _scene_at(self, day: WindowSun, minutes: float) -> Scene:
        """Return the scene with the sun at a moment of a day.

        ``minutes`` counts from the start of the day's window of time.
        """
        return replace(self._scene, sun=day.sun_at(minutes, self._scene.world))

    def _casters_by_moment(self, day: WindowSun, span: SunSpan) -> Iterator[tuple[float, tuple[Patch, ...]]]:
        """Yield each moment of a span in minutes, with the patches of ground that may cast shadows on the block at that moment."""
        first, last = span.sample_minutes(0), span.sample_minutes(len(span.samples_minutes) - 1)
        end = -np.inf
        before: tuple[Patch, ...] = ()
        after: tuple[Patch, ...] = ()
        for number in range(len(span.samples_minutes)):
            minutes = span.sample_minutes(number)
            if not self._has_all_ground and minutes >= end:
                begin = np.floor(minutes / CASTER_SEARCH_STEP_MINUTES) * CASTER_SEARCH_STEP_MINUTES
                before = after if begin == end else self._patches(day, float(np.clip(begin, first, last)))
                end = begin + CASTER_SEARCH_STEP_MINUTES
                after = self._patches(day, float(np.clip(end, first, last)))
            yield minutes, tuple(dict.fromkeys((*before, *after)))

    def _patches(self, day: WindowSun, minutes: float) -> tuple[Patch, ...]:
        """Return the ground beside the block that may shade it at a moment.

        ``minutes`` counts from the start of the day's window of time.
        """
        return find_sun_casters(self._scene_at(day, minutes), self._nodes)


class _SolidsBlock(_TerrainBlock):
    """A block of ground with buildings and models, without trees.

    The clearance is that of the ground, or of the roof above it. It is negative where rays to the sun meet a building or a model.
    """

    def __init__(self, scene: Scene, nodes: BareNodes, rules: SunRules) -> None:
        super().__init__(scene, nodes, rules)
        self._solids = SolidShadows(scene, nodes)

    def valid(self) -> np.ndarray:
        """Return the valid mask: cells (rows, cols) that show ground, a building or a model."""
        return self._solids.valid

    def step_minutes(self, day: WindowSun) -> float:
        """Return the minutes between two samples, which are the same for all days."""
        return OBJECTS_STEP_MINUTES

    def clearance_tangents(
        self, day: WindowSun, moments: tuple[ClearanceSample, ClearanceSample, ClearanceSample], orientation: GridOrientation
    ) -> None:
        """Return ``None``: rays to the sun give no angle."""
        return None

    def sun_tangent_bulge(self, day: WindowSun, time_range_minutes: tuple[float, float]) -> float:
        """Return 0: without clearance tangents the sun's path is not needed."""
        return 0.0

    def walk_input(self, day: WindowSun, time_range_minutes: tuple[float, float], orientation: GridOrientation) -> None:
        """Return ``None``: walks meet no buildings."""

    def _add_objects(self, day: WindowSun, minutes: float, node_clearance: NodeClearance, clearance: np.ndarray) -> None:
        """Raise the clearances (n, m) on roofs, and make them negative in the shadows of buildings and models."""
        orientation = node_clearance.orientation
        above_ground_m = orientation.sun_aligned_view(self._solids.above_ground_m)
        clearance += np.float32(node_clearance.ray_height_per_metre) * above_ground_m
        shaded = self._solids.is_shaded(day.sun_at(minutes, self._scene.world), orientation.grid_order_view(clearance) >= 0.0)
        is_shaded = orientation.sun_aligned_view(shaded)
        clearance[is_shaded] = -np.maximum(clearance[is_shaded], MIN_SHADED_CLEARANCE)


class _RenderedBlock:
    """A block whose shadows a plan's algorithms render, such as one with trees.

    The clearance of a cell is the visible share of the sun less 0.5.
    """

    def __init__(self, scene: Scene, view: MapView, plan_of: Callable[[Scene], Plan]) -> None:
        self._scene, self._view, self._plan_of = scene, view, plan_of

    def valid(self) -> np.ndarray:
        """Return the valid mask: cells (rows, cols) that show a surface."""
        return ~np.isnan(self._visibility(Sun(0.0, 90.0, self._scene.world.earth_from_anchor[:, 2])))

    def step_minutes(self, day: WindowSun) -> float:
        """Return the minutes between two samples, which are the same for all days."""
        return OBJECTS_STEP_MINUTES

    def clearances(self, day: WindowSun, span: SunSpan, lines: int) -> Iterator[tuple[GridOrientation, np.ndarray]]:
        """Yield, for each moment of a span, ``IDENTITY_ORIENTATION`` and the clearances (rows, cols) of the cells."""
        for number in range(len(span.samples_minutes)):
            sun = day.sun_at(span.sample_minutes(number), self._scene.world)
            yield IDENTITY_ORIENTATION, self._visibility(sun) - np.float32(0.5)

    def clearance_tangents(
        self, day: WindowSun, moments: tuple[ClearanceSample, ClearanceSample, ClearanceSample], orientation: GridOrientation
    ) -> None:
        """Return ``None``: the visible share of the sun has no angle."""
        return None

    def sun_tangent_bulge(self, day: WindowSun, time_range_minutes: tuple[float, float]) -> float:
        """Return 0: without clearance tangents the sun's path is not needed."""
        return 0.0

    def walk_input(self, day: WindowSun, time_range_minutes: tuple[float, float], orientation: GridOrientation) -> None:
        """Return ``None``: rendered shadows are not refined by walks."""

    def _visibility(self, sun: Sun) -> np.ndarray:
        """Return the visible share (rows, cols) of a sun at the block's cells, NaN without a surface."""
        scene = replace(self._scene, sun=sun)
        return sun_visibility(scene, self._view, self._plan_of(scene))


def under_clear_sky(scene: Scene) -> Scene:
    """Return the scene, with the cloud cover set to 0 if it is overcast."""
    level = scene.loaded.level
    if not level.weather.is_overcast:
        return scene
    clear = level.model_copy(update={"weather": level.weather.model_copy(update={"cloud_cover": 0.0})})
    return replace(scene, loaded=scene.loaded.model_copy(update={"level": clear}))
