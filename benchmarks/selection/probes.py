"""Record the measurements of probes in a view, once for every row. Any policy can then be replayed with any model."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import astuple
from typing import Any

from skugga.selector.candidates import name_of
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.measure.probing import ErrorMeasurement
from skugga.selector.measure.scene_prober import (
    DRAW_REPEATS,
    MAX_LATTICE_DOUBLINGS,
    MAX_REPEATED_MS,
    ProbedPictures,
    SceneProber,
    draw_count,
    is_warm,
)
from skugga.selector.options import LightOptions
from skugga.selector.planner.planner import planner_of
from skugga.selector.predict import plan_options
from skugga.terrain.describe import describe
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene

Figures = dict[str, Any]
"""A record of probes, or a row of it, by key."""


def record_probes(scene: Scene, view: MapView | PerspectiveView, name: str, light: str, profile: DeviceProfile) -> Figures:
    """Record the measurements of probes for all options of a light. ``name`` is the name of the view.

    The result is empty if no object casts shadows from the light. ``start_s`` is the time of work that is done once, whatever is
    drawn. ``points_s`` is the time of ray-traced truth on all lattices of points up to each step. Each row has the milliseconds of
    a probe's drawing, and its errors (``proofs``) with 1, 2, 4, 8 and 16 lattices of points.
    """
    descriptor, level = describe(scene, view, name, "points"), scene.loaded.level
    options = plan_options(planner_of(descriptor, level), profile)
    if light not in options.lights:
        return {}
    light_options = options.lights[light]
    effects = options.planner.plan({light: light_options.options[0].choice}, {}).effect_names
    start = time.perf_counter()
    pictures = ProbedPictures(scene, view, effects)
    prober = SceneProber(pictures, options.planner, light, light_options, MAX_REPEATED_MS)
    assert pictures.blocks
    start_s = time.perf_counter() - start
    rows: dict[str, Figures] = {}
    drawn_options: list[tuple[int, str]] = []
    for which, option in enumerate(light_options.options):
        start = time.perf_counter()
        ms = prober.draw(which)
        if ms is not None:
            row = name_of(options.planner.plan({light: option.choice}, {}), light)
            rows[row] = {"ms": ms, "draw_s": time.perf_counter() - start, "proofs": []}
            drawn_options.append((which, row))
    points_s: list[float] = []
    for step in range(MAX_LATTICE_DOUBLINGS + 1):
        if step:
            prober.add_points()
        start = time.perf_counter()
        for number, (which, row) in enumerate(drawn_options):
            rows[row]["proofs"].append(list(astuple(prober.measurement(which))))
            if number == 0:  # the first draw pays for the points
                points_s.append(time.perf_counter() - start + (points_s[-1] if points_s else 0.0))
    return {"start_s": start_s, "points_s": points_s, "rows": rows}


class RecordedProber:
    """A ``skugga.selector.measure.probing.OptionProber`` that replays a view's record.

    ``record`` is the result of ``record_probes``. ``rows`` names the row of each option. Options are identified by their indices in
    ``options.options``, the parameter ``which`` of the methods. Recorded drawings were repeated up to ``MAX_REPEATED_MS``. Where a
    probe would not repeat one, a replay takes that share of its time. Its milliseconds remain the least of all drawings.
    """

    def __init__(self, record: Figures, rows: Sequence[str], options: LightOptions) -> None:
        self._record, self._rows, self._options = record, rows, options
        self._drawn: set[int] = set()
        self._elapsed_s = record["start_s"]
        self._step: int | None = None

    def elapsed_s(self) -> float:
        """Return the simulated seconds since the probe began."""
        return self._elapsed_s

    def draw(self, which: int) -> float | None:
        """Return the recorded milliseconds of an option; ``None`` if it was refused."""
        row = self._record["rows"].get(self._rows[which])
        if row is None:
            return None
        recorded_count = DRAW_REPEATS if row["ms"] < MAX_REPEATED_MS else 1
        self._elapsed_s += row["draw_s"] * draw_count(row["ms"], is_warm(self._options, which, self._drawn)) / recorded_count
        self._drawn.add(which)
        return row["ms"]

    def draw_s(self, which: int, ms: float) -> float:
        """Return the seconds that a probe needs to draw an option of which one drawing takes ``ms`` milliseconds."""
        return draw_count(ms, is_warm(self._options, which, self._drawn)) * ms / 1000.0

    def measurement(self, which: int) -> ErrorMeasurement:
        """Return the recorded errors of an option at the sample points of truth that have been added so far."""
        if self._step is None:
            self._step = 0
            self._elapsed_s += self._record["points_s"][0]
        return ErrorMeasurement(*self._record["rows"][self._rows[which]]["proofs"][self._step])

    def add_points_s(self) -> float | None:
        """Return the seconds of ray tracing for the points that the record's next set adds; ``None`` if this is the last set."""
        points_s, step = self._record["points_s"], self._step or 0
        return None if step + 1 == len(points_s) else points_s[step + 1] - points_s[step]

    def add_points(self) -> None:
        """Advance to the record's next set of sample points, which has twice as many lattices of points."""
        more_s = self.add_points_s()
        assert more_s is not None and self._step is not None
        self._elapsed_s += more_s
        self._step += 1


def recorded_options(options: LightOptions, names: Sequence[str], record: Figures) -> LightOptions:
    """Return a light's options, where options without a record count as refused. ``names`` are the names of the options' rows."""
    missing = {which for which, name in enumerate(names) if name not in record["rows"]}
    return LightOptions(options.options, options.error, options.interior, options.time, refused=frozenset(missing))
