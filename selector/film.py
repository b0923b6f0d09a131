"""Draw films frame by frame: with a moving sun, a moving camera, or both.

- The sun, the clock of moving objects and the camera share one time axis. Frame ``n`` shows the scene ``n`` time steps after the
  first frame.
- A ``Replanner`` makes the plan (algorithms and settings) of each frame. It keeps the algorithms of the frame before as long as
  they are good enough. A switch to others is a transition over several frames, which mix two pictures.
- Outside of transitions, a frame equals the picture that ``render_frame`` draws for its time and plan. Frames of terrain alone are
  drawn faster (``skugga.shadows.draw``).
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from functools import partial

import numpy as np

from skugga.selector.film_request import MAX_FRAMES, FilmRequest
from skugga.selector.formatting import format_list
from skugga.selector.replanning import PlanTransition, Replanner, casting_kinds, choices_from_plan, mix_pictures
from skugga.shadows.draw import can_draw_from_heights, draw
from skugga.shadows.picture import Needs, Picture
from skugga.shadows.plan import Plan
from skugga.shadows.render import render_frame
from skugga.terrain.camera_path import camera_path
from skugga.terrain.describe import describe
from skugga.terrain.errors import InputError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import MAX_PERSPECTIVE_SIDE_PX, Scene

COLOR_NEEDS: Needs = frozenset({"color"})
"""The products that a film needs of each picture: its colours alone."""

log = logging.getLogger("skugga")


@dataclass(frozen=True, eq=False)
class FrameMoment:
    """The time and the view of one frame of a film.

    Attributes
    ----------
    number
        Index of the frame, from 0.
    elapsed_s
        Seconds since the first frame.
    time
        Date and time of the sun. ``None`` keeps the scene's sun.
    second
        Clock of moving objects, seconds.
    view
        The view of the frame.
    """

    number: int
    elapsed_s: float
    time: datetime | None
    second: float
    view: MapView | PerspectiveView

    @property
    def label(self) -> str:
        """The frame's number, counted from 1, and its time, for messages."""
        time_text = f"{self.elapsed_s:g} s" if self.time is None else self.time.isoformat()
        return f"frame {self.number + 1} ({time_text})"

    def scene(self, scene: Scene) -> Scene:
        """Return the scene with its sun and its moving objects at this frame's time."""
        return scene.with_sun(None if self.time is None else SunSpec(time=self.time)).at_second(self.second)


@dataclass(frozen=True)
class PlanSwitch:
    """A change of algorithms or settings between two frames.

    Attributes
    ----------
    number
        Index of the first frame with the new algorithms or settings.
    before
        The previous algorithms and settings, in words.
    after
        The new algorithms and settings, in words.
    reason
        The reason for the change.
    """

    number: int
    before: str
    after: str
    reason: str


@dataclass(frozen=True, eq=False)
class FilmFrame:
    """One frame of a film.

    Attributes
    ----------
    moment
        Time and view of the frame.
    color
        Picture, uint8 (rows, cols, 3). Row 0 is the top row.
    plan
        Plan of the frame.
    transition
        The transition from another plan of which this frame is part; ``None`` outside of transitions.
    switch
        The change of algorithms or settings that begins with this frame; ``None`` without a change.
    """

    moment: FrameMoment
    color: np.ndarray
    plan: Plan
    transition: PlanTransition | None = None
    switch: PlanSwitch | None = None


def frame_moments(
    scene: Scene, request: FilmRequest, max_frames: int = MAX_FRAMES, only_frame: int | None = None
) -> list[FrameMoment]:
    """Return the times and views of all frames of a film, checked before any frame is drawn.

    ``only_frame`` limits the result to the frame with this index.

    Raises ``InputError`` for more than ``max_frames`` frames. It also raises ``InputError``, with the frame in the message, if the
    camera leaves the data or goes under the ground.
    """
    span = request.span
    if not 1 <= span.frames <= max_frames:
        raise InputError("frames", span.frames, f"1 to {max_frames} frames")
    if span.start is not None:
        scene.with_sun(SunSpec(time=span.start))  # raises an error in a flat world, which has no dates
    first_second = scene.clock_seconds if span.first_second is None else span.first_second
    path = None if request.path is None else camera_path(request.path, scene.geolocator, span.start)
    resting = None if path is not None else scene.view(request.view, request.bounds, request.crs, request.size)
    moments: list[FrameMoment] = []
    for number in range(span.frames) if only_frame is None else (only_frame,):
        elapsed_s = number * span.step_s
        try:
            view = resting if path is None else path.view_at(elapsed_s, *reversed(_size(request)))
        except InputError as error:
            frame_text = FrameMoment(number, elapsed_s, span.frame_time(number), 0.0, None).label  # type: ignore[arg-type]
            raise error.renamed(f"path, {frame_text}: {error.name}") from None
        assert view is not None
        moments.append(FrameMoment(number, elapsed_s, span.frame_time(number), first_second + elapsed_s, view))
    return moments


def _size(request: FilmRequest) -> tuple[int, int]:
    """Return the width and height in pixels of a film along a camera path. Raises ``InputError`` if they are too large."""
    assert request.path is not None
    width, height = request.size or request.path.size
    if max(width, height) > MAX_PERSPECTIVE_SIDE_PX:
        raise InputError("size", f"{width}x{height}", f"at most {MAX_PERSPECTIVE_SIDE_PX} a side in a perspective view")
    return width, height


def describe_frame(scene: Scene, request: FilmRequest, moment: FrameMoment) -> Descriptor:
    """Return the facts of one frame of a film, which tell whether the camera moves. ``scene`` is the scene at its moment."""
    descriptor = describe(scene, moment.view, request.view_name)
    return descriptor.model_copy(update={"camera_moves": request.camera_moves})


def film_frames(
    scene: Scene,
    request: FilmRequest,
    moments: Sequence[FrameMoment],
    replanner: Replanner | None = None,
    max_frames_ahead: int = 0,
) -> Iterator[FilmFrame]:
    """Yield the frames of a film. Each frame is drawn on demand.

    ``moments`` is the result of ``frame_moments``. Their sun and time replace those of ``scene``. ``replanner`` makes the plans in
    the order of the frames. Up to ``max_frames_ahead`` further frames are drawn in other threads at the same time, if they need no
    OpenGL. Raises the errors of ``render_frame`` and ``Replanner.plan``.
    """
    replanner = replanner or Replanner()
    if max_frames_ahead == 0:
        yield from (frame() for frame in _frame_makers(scene, request, moments, replanner, None))
        return
    with ThreadPoolExecutor(max_frames_ahead, "skugga-frames") as threads:
        waiting: deque[Callable[[], FilmFrame]] = deque()
        try:
            for number, frame in enumerate(_frame_makers(scene, request, moments, replanner, threads)):
                waiting.append(frame)
                if number == 0 or len(waiting) > max_frames_ahead:  # the first frame fills caches that all frames share
                    yield waiting.popleft()()
            while waiting:
                yield waiting.popleft()()
        finally:
            threads.shutdown(cancel_futures=True)


def _frame_makers(
    scene: Scene, request: FilmRequest, moments: Sequence[FrameMoment], replanner: Replanner, threads: ThreadPoolExecutor | None
) -> Iterator[Callable[[], FilmFrame]]:
    """Yield, for each frame, a function that returns the drawn frame.

    If the frame is drawn by one of ``threads``, the function waits for the result. Otherwise it draws the frame when it is called.
    ``moments`` and ``replanner`` are those of ``film_frames``.
    """
    level, overrides = scene.loaded.level, dict(request.overrides)
    before = None if replanner.state is None else replanner.state.plan
    for moment in moments:
        frame_scene = moment.scene(scene)
        plan = replanner.plan(describe_frame(frame_scene, request, moment), level, overrides)
        switch = None if before is None else _switch(moment, before, plan, replanner.reason)
        if switch is not None:
            log.info("%s: %s instead of %s: %s", moment.label, switch.after, switch.before, switch.reason)
        before = plan
        if replanner.transition is not None:
            new, previous = (render_frame(frame_scene, moment.view, shown_plan) for shown_plan in (plan, replanner.transition.plan))
            color = mix_pictures(previous.color, new.color, replanner.share(previous.visibilities, new.visibilities))
            yield partial(FilmFrame, moment, color, plan, replanner.transition, switch)
            continue
        draw_picture: Callable[[], Picture] = partial(draw, frame_scene, moment.view, plan, COLOR_NEEDS)
        if threads is not None and moment.number > 0 and can_draw_from_heights(frame_scene, moment.view, plan, COLOR_NEEDS):
            draw_picture = threads.submit(draw_picture).result
        yield partial(_film_frame, moment, draw_picture, plan, switch)


def _film_frame(moment: FrameMoment, draw_picture: Callable[[], Picture], plan: Plan, switch: PlanSwitch | None) -> FilmFrame:
    """Return a frame of a film outside of a transition, with the colours of the picture that ``draw_picture`` draws.

    ``plan`` is the frame's plan, and ``switch`` the change of algorithms or settings that begins with it.
    """
    color = draw_picture().color
    assert color is not None
    return FilmFrame(moment, color, plan, None, switch)


def _switch(moment: FrameMoment, before: Plan, after: Plan, reason: str | None) -> PlanSwitch | None:
    """Return the change of algorithms or settings between the plans of two successive frames; ``None`` without a change.

    ``reason`` is the replanner's reason for the change; ``None`` if the change follows from the view. ``before`` and ``after`` are
    these plans.
    """
    names = _choice_text(before), _choice_text(after)
    if names[0] == names[1]:
        return None
    return PlanSwitch(moment.number, *names, reason or _casting_changes_text(before, after))


def _choice_text(plan: Plan) -> str:
    """Return the algorithms of a plan by light, and its chosen settings, in words."""
    names = {light: choice.name or "none" for light, choice in choices_from_plan(plan).items()}
    if len(set(names.values())) <= 1:
        return next(iter(names.values()), "none")
    return ", ".join(f"{light}: {name}" for light, name in names.items())


def _casting_changes_text(before: Plan, after: Plan) -> str:
    """Describe how the kinds of casters that cast shadows differ between two plans."""
    casting_before, casting_after = (
        {(light, kind) for light, kinds in casting_kinds(plan).items() for kind in kinds} for plan in (before, after)
    )
    if not casting_after:
        return "nothing casts shadows now"
    if casting_before == casting_after:
        return "settings follow the view"
    changes = (casting_before - casting_after, "shadows of {} ended"), (casting_after - casting_before, "shadows of {} began")
    return "; ".join(words.format(format_list(sorted({kind for _, kind in kinds}))) for kinds, words in changes if kinds)
