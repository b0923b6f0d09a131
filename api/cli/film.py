"""``skugga render`` of a film: options, rendering, the file, and progress messages."""

from __future__ import annotations

import json
import math
import time as clock
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer

from skugga.api.cli.outputs import check_output_files
from skugga.api.cli.progress import ProgressLines
from skugga.api.cli.snapshot import NO_STYLE_OVERRIDES, StyleOverrides, check_seconds, declare_view_loops
from skugga.api.cli.warnings import print_default_sun, print_warnings
from skugga.api.device_calibration import calibration_for
from skugga.api.film_files import check_film_path, film_files, write_film
from skugga.api.film_span import DEFAULT_FPS, film_span
from skugga.api.picture_cost import MAX_MS_OPTION, check_cost, limit_or_service_limit_ms
from skugga.api.request import PictureRequest
from skugga.selector.film import FilmFrame, FrameMoment, describe_frame, film_frames, frame_moments
from skugga.selector.film_request import FilmRequest
from skugga.selector.replanning import Replanner
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.compiled import CORES
from skugga.terrain.errors import InputError, Problem, printable
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.camera_file import load_camera_path
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

MAX_FRAMES_AHEAD = 4
"""Maximum number of frames that are rendered ahead of the frame that is written. Each takes some 100 MB."""

FRAMES_BEFORE_ESTIMATE, NEW_ESTIMATE_RATIO = 5, 1.5
"""Frames before the first estimate of a film's size and time, and the factor of change that prints a new estimate. The first
frames often show the night, which compresses well.
"""


@dataclass(frozen=True)
class FilmOptions:
    """The options of a film, as the user wrote them.

    Attributes
    ----------
    start, end, step
        First and last time (or clock reading) and the interval between frames.
    path
        Camera file.
    fps
        Frames per second of playback.
    lossless
        Whether a .webp film is compressed without loss.
    """

    start: str | None
    end: str | None
    step: str | None
    path: Path | None
    fps: float | None
    lossless: bool = False

    @property
    def used_option_names(self) -> list[str]:
        """Names of the options that were used."""
        values = {"--from": self.start, "--to": self.end, "--step": self.step, "--path": self.path, "--fps": self.fps}
        return [*(name for name, value in values.items() if value is not None), *(["--lossless"] if self.lossless else [])]


def render_film(
    level: LevelSource,
    output: Path,
    options: FilmOptions,
    view: str,
    layer: str,
    sun: SunSpec | None,
    overrides: dict[str, Any],
    size: tuple[int, int] | None = None,
    bounds: tuple[float, float, float, float] | None = None,
    crs: str | None = None,
    seconds: float | None = None,
    style_overrides: StyleOverrides = NO_STYLE_OVERRIDES,
    stats: Path | None = None,
    max_ms: float | None = None,
) -> None:
    """Render a film of a level to a file. All frames are checked before the first is rendered.

    ``layer`` names the product. ``overrides`` replace settings of the level's ``shadows``. ``size`` is (width, height) in
    pixels. ``bounds`` are west, south, east and north in units of ``crs``. ``seconds`` is the level's clock at the first
    frame of a film whose ends are dates. ``stats`` is a file for statistics of the frames, as JSON. Raises ``SkuggaError``
    and ``OSError``. The error is ``TooCostlyError`` if a frame, or a block of it, is expected to take longer than ``max_ms``,
    in milliseconds. Without ``max_ms`` the time limit of a service applies.
    """
    if layer != "color":
        raise InputError("--layer", layer, "color, the only layer of films")
    if options.lossless and output.suffix.lower() != ".webp":
        raise InputError("--lossless", Problem(f"{output} is no .webp film"), "Use .webp, or .png frames, which are lossless")
    if options.path is not None and view != "map":
        raise InputError.conflict("--view", "--path", "Leave out --view: the path sets the camera")
    check_output_files(level, [("--stats", stats)], options.path)
    check_seconds(seconds)
    path = None if options.path is None else load_camera_path(options.path)
    fps = DEFAULT_FPS if options.fps is None else options.fps
    span = film_span(options.start, options.end, options.step, fps, path, seconds)
    if sun is not None and span.start is not None:
        raise InputError.conflict("--time", "--from")
    loaded = load_level(level)
    declare_view_loops(loaded, view)
    scene = build_scene(loaded).with_sun(sun)
    try:
        print_warnings(scene)
        if sun is None and span.start is None:
            print_default_sun(scene)
        scene = PictureRequest(**style_overrides).applied_to(scene)
        request = FilmRequest(span, view, path, size, bounds, crs, overrides)
        moments = frame_moments(scene, request)
        check_film_path(output, len(moments), (moments[0].view.cols, moments[0].view.rows))
        existing_files = [file for file in film_files(output, len(moments)) if file.exists()]
        check_output_files(level, [("--output", file) for file in existing_files], options.path)
        device = calibration_for(scene.loaded.level.shadows, overrides, shows_times=max_ms is not None)
        _check_costs(scene, request, moments, device, max_ms)
        replanner = Replanner(device=device)
        with ProgressLines("Filming") as lines:
            progress = _FilmProgress(lines, len(moments))
            frames = film_frames(scene, request, moments, replanner, min(CORES, MAX_FRAMES_AHEAD))
            write_film(output, progress.recorded_colors(frames), len(moments), fps, options.lossless, progress.report_estimate)
        if stats is not None:
            write_atomically(stats, json.dumps({"level": scene.loaded.name, "fps": fps, **progress.statistics}, indent=2) + "\n")
    finally:
        scene.close()


def _check_costs(
    scene: Scene, request: FilmRequest, moments: Sequence[FrameMoment], device: DeviceProfile | None, max_ms: float | None
) -> None:
    """Raise ``TooCostlyError`` if the first, middle or last frame is expected to take longer than ``max_ms``, milliseconds.

    A day's first and last frames often have no sun, so that the middle one is the most costly. ``device`` is the calibration of the
    OpenGL device, if any. Without ``max_ms`` the time limit of a service applies.
    """
    for number in sorted({0, len(moments) // 2, len(moments) - 1}):
        moment = moments[number]
        descriptor = describe_frame(moment.scene(scene), request, moment)
        plan = Replanner(device=device).plan(descriptor, scene.loaded.level, dict(request.overrides))
        subject = f"a block of {moment.label}" if isinstance(moment.view, MapView) else moment.label
        check_cost(
            plan, subject, limit_or_service_limit_ms(max_ms), MAX_MS_OPTION, has_free_size=not isinstance(moment.view, MapView)
        )


class _FilmProgress:
    """Report the progress of a film, and collect statistics of its frames."""

    def __init__(self, lines: ProgressLines, frame_count: int) -> None:
        self._lines, self._frame_count, self._begin = lines, frame_count, clock.perf_counter()
        self._drawn_count = 0
        self._last_estimate: tuple[float, float] | None = None
        self.statistics: dict[str, list[dict[str, Any]]] = {"frames": [], "switches": []}

    def recorded_colors(self, frames: Iterator[FilmFrame]) -> Iterator[np.ndarray]:
        """Yield the colours of the frames, uint8 (rows, cols, 3); report and record each frame on its way to the encoder."""
        begin = clock.perf_counter()
        for frame in frames:
            drawn_s, moment = clock.perf_counter() - begin, frame.moment
            if frame.switch is not None:
                switch = frame.switch
                self._lines.print_line(printable(f"{moment.label}: {switch.after} instead of {switch.before}: {switch.reason}"))
            if not self._lines.is_terminal:
                typer.echo(
                    f"[{moment.number + 1}/{self._frame_count}] {moment.label}: {frame.plan.algorithms_text}, {drawn_s:.2f} s",
                    err=True,
                )
            self._record_statistics(frame, drawn_s)
            self._drawn_count += 1
            yield frame.color
            self._lines.advance(moment.number + 1, self._frame_count)
            begin = clock.perf_counter()

    def report_estimate(self, frames_written: int, file_bytes: int) -> None:
        """Print the expected size and remaining time of the film, extrapolated from the frames written so far.

        ``file_bytes`` is the size of these frames in the file. The first estimate follows ``FRAMES_BEFORE_ESTIMATE`` frames. A
        new one is printed if it changes by ``NEW_ESTIMATE_RATIO``.
        """
        if not FRAMES_BEFORE_ESTIMATE <= frames_written < self._frame_count or file_bytes == 0:
            return
        frame_s = (clock.perf_counter() - self._begin) / self._drawn_count
        expected = file_bytes * self._frame_count / frames_written, frame_s * self._frame_count
        change = max(
            (
                max(current / previous, previous / current)
                for current, previous in zip(expected, self._last_estimate or (), strict=False)
            ),
            default=math.inf,
        )
        if change > NEW_ESTIMATE_RATIO:
            self._last_estimate = expected
            remaining = _format_seconds(frame_s * (self._frame_count - self._drawn_count))
            self._lines.print_line(f"{self._frame_count} frames: about {_format_bytes(expected[0])} in total, {remaining} left")

    def _record_statistics(self, frame: FilmFrame, drawn_s: float) -> None:
        """Append a frame, and a switch of algorithms at this frame, to the statistics.

        ``drawn_s`` is its drawing time in seconds.
        """
        moment = frame.moment
        self.statistics["frames"].append({
            "frame": moment.number + 1,
            "time": None if moment.time is None else moment.time.isoformat(),
            "seconds": moment.second,
            "algorithm": frame.plan.algorithms_text,
            "share": 1.0 if frame.transition is None else frame.transition.share,
            "ms": 1000.0 * drawn_s,
        })  # fmt: skip
        if frame.switch is not None:
            switch = frame.switch
            record = {"frame": switch.number + 1, "before": switch.before, "after": switch.after, "why": switch.reason}
            self.statistics["switches"].append(record)


def _format_bytes(byte_count: float) -> str:
    """Return a number of bytes as text with two significant digits."""
    for unit, bytes_of in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if byte_count >= bytes_of:
            return f"{float(f'{byte_count / bytes_of:.2g}'):g} {unit}"
    return f"{byte_count:.0f} bytes"


def _format_seconds(seconds: float) -> str:
    """Return a duration in seconds as text."""
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} minutes"
