"""Cost of frames of perspective views, compared with a minimal renderer of the same scene and with another commit.

    python -m benchmarks.frames [--base FOLDER] [--pictures SpatialAce valley ...] [--repeats 15] [--json FILE] [--markdown FILE]

All sides draw in turns, each in a process of its own: this checkout; ``--base``, a clone of another commit; and the yardstick
(``benchmarks/yardstick.py``). The yardstick is a forward renderer with the same ground, meshes and trees, camera and sun, with
Lambert's cosine and one colour of sky. It draws without shadows, and with a depth map of 512 x 512 texels of 16 bits. The map is
drawn again for each frame, and compared in one texel or in 3 x 3. All its data is uploaded before, and each picture is read back
within the timed section. Ratios are medians of the ratios of successive frames, by wall time and by the CPU time of all threads.
Only ratios of one run are comparable. The target is a ratio to the yardstick with one tap, because the plan also uses one tap.
Lines that begin with "beside" give figures without a target.

There are several pictures. The SpatialAce level's view ``main`` is drawn at 800 x 600 as planned, by ``shadow_map`` alone, and
without cast shadows. The views ``valley`` and ``village`` of the wooded level are drawn at 1280 x 1024 as planned. The last
picture shows 10 x 10 km under a million trees from 60 m above the ground, at 800 x 600 as planned. On request, a street at 800
x 600 as planned, which reads no file of vectors. Plans follow the fixed rules for a device without a calibration, as in
``skugga render``. Plans are made once, outside the timed section, for the level's own view and sun, as for a film. The report
lists the cost of a plan for another view below the frames.

Changes from one frame to the next:

``new``
    The sun moves by 1.5 or 2.5 degrees and the camera by 1.1 or 1.9 m, to new positions. Caches hold only data of the level: its
    nodes, meshes, trees, leaves, programs.
``sun``, ``camera``
    One of them moves. Data of the other one may be cached from the previous frame, on the device and in the caches of
    ``skugga.terrain.cache`` with the lifetimes ``light`` (invalid when the sun moves) and ``scene``.
``resting``
    Nothing changes: the same frame again.
``all new``
    The caches with the lifetimes ``light`` and ``scene`` are emptied before the same frame, so data of the level's files is
    computed again.

With ``--base``, each frame's colours and visibilities are compared with those of the other commit, bit by bit. For the last frame,
the report shows the number of differing pixels, and the number of pixels that are lit in one picture only.

A first frame is that of a new process with a full numba cache: load the level, make the plan, draw the frame. The process then
plans and draws five new views. The target applies to the frame without its plan. Peak memory is that of a whole process that plans
and draws new frames of the million trees.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from benchmarks.frame_tables import (
    BASE_SIDE,
    NOW_SIDE,
    TABLES_BEGIN,
    YARDSTICK_SIDE,
    FrameKey,
    Row,
    RowsBySide,
    format_report,
    frame_targets,
    replace_between_marks,
)
from benchmarks.scenes import write_wooded_hills

ROOT = Path(__file__).resolve().parents[1]
WORKER_FILE = Path(__file__).with_name("frame_worker.py")

MILLION_TREES = "a million trees"
"""Name of the picture of the generated level with a million trees, which ``--trees`` may change."""
STREET = "street"
"""Name of the picture that reads neither rasters nor vectors. It is drawn only on request."""
YARDSTICK_VARIANTS = {"unshadowed": (0, 1), "512, 1 tap": (512, 1), "512, 3 x 3 taps": (512, 3)}
"""Texels a side of the yardstick's depth map (0: no shadows) and taps a side of its filter, by name of the variant."""

ALL_CHANGES = ("new", "sun", "camera", "resting", "all new")
"""Names of the changes between frames; the module's docstring explains them."""
FIRST_FRAME_REPEATS, WARM_FRAMES = 3, 5
"""Number of new processes whose first frame is measured, and number of frames that each draws after the first."""


@dataclass(frozen=True)
class MeasuredPicture:
    """A view to draw.

    Attributes
    ----------
    level, view, size
        Name of the level, name of its view, and (width, height) in pixels.
    plans
        Overrides of a level's ``shadows``, by name of the plan.
    changes
        Changes between frames to measure, by name of the plan.
    turn_share
        Number of turns (repeats) divided by that of the SpatialAce level.
    measures_first_frames
        Whether the first frames of new processes are measured too.
    """

    level: str
    view: str
    size: tuple[int, int]
    plans: dict[str, dict[str, Any]] = field(default_factory=lambda: {"planned": {}})
    changes: dict[str, tuple[str, ...]] = field(default_factory=lambda: {"planned": ALL_CHANGES})
    turn_share: float = 1.0
    measures_first_frames: bool = False


PICTURES = {
    "SpatialAce": MeasuredPicture(
        "spatialace", "main", (800, 600),
        {"planned": {}, "shadow_map": {"algorithm": "shadow_map"}, "none": {"algorithm": "none"}},
        {"planned": ALL_CHANGES, "shadow_map": ("new", "resting"), "none": ("new", "resting")},
        measures_first_frames=True,
    ),
    "valley": MeasuredPicture("jacksboro_wooded", "valley", (1280, 1024), turn_share=0.5, measures_first_frames=True),
    "village": MeasuredPicture("jacksboro_wooded", "village", (1280, 1024), turn_share=0.5),
    MILLION_TREES: MeasuredPicture("", "low", (800, 600), changes={"planned": ("new",)}, turn_share=0.5),
    STREET: MeasuredPicture("thesis_street_sun", "main", (800, 600)),
}  # fmt: skip


class FrameProcess:
    """A process that draws frames of one picture with the code in a folder."""

    def __init__(self, process: subprocess.Popen[str], stderr: IO[bytes]) -> None:
        self._process, self._stderr = process, stderr
        self.ready = self._read_answer()

    def request(self, operation: str, **parameters: Any) -> Row:
        """Send a request to the process, and return the costs that it reports. Raises ``RuntimeError`` if the process fails.

        ``operation`` and ``parameters`` are those of ``benchmarks.frame_worker``.
        """
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"do": operation, **parameters}) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass
        return self._read_answer()

    def _read_answer(self) -> Row:
        """Return the next line of the process as a JSON object. Raises ``RuntimeError`` with its errors if it has ended."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            self._process.wait()
            self._stderr.seek(0)
            raise RuntimeError(f"{self._process.args}: {self._stderr.read().decode(errors='replace')[-4000:]}")
        return json.loads(line)


@contextmanager
def frame_process(folder: Path, picture: MeasuredPicture, level: str) -> Iterator[FrameProcess]:
    """Run the process of a side (this checkout, the other commit, or the yardstick) as a context manager.

    ``folder`` is the side's checkout. ``level`` is a bundled level's name or a level file.
    """
    size = f"{picture.size[0]}x{picture.size[1]}"
    command = [sys.executable, "-P", str(WORKER_FILE), level, picture.view, size, json.dumps(picture.plans)]
    with tempfile.TemporaryFile() as stderr:
        process = subprocess.Popen(
            command, cwd=folder, env={**os.environ, "PYTHONPATH": str(folder)}, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr,
        )  # fmt: skip
        try:
            yield FrameProcess(process, stderr)
        finally:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.close()
            process.stdout.close()
            process.wait(60)


@dataclass
class FrameMeasurements:
    """Measurements of all pictures. Sides are this checkout, the other commit, and the yardstick.

    Attributes
    ----------
    frames
        Rows of costs, by kind of frame and side.
    plans
        Costs of plans, by picture and side.
    first_frames
        Rows of costs of first frames, by picture and side.
    differences
        Differences from the other commit's pictures, by kind of frame.
    renderer
        Name of the OpenGL renderer.
    load
        The highest one-minute load average of the machine.
    """

    frames: dict[FrameKey, RowsBySide] = field(default_factory=dict)
    plans: dict[str, dict[str, Any]] = field(default_factory=dict)
    first_frames: dict[str, RowsBySide] = field(default_factory=dict)
    differences: dict[FrameKey, Row] = field(default_factory=dict)
    renderer: str = ""
    load: float = 0.0


def measure_interleaved(
    name: str, picture: MeasuredPicture, level: str, folders: dict[str, Path], turns: int, measurements: FrameMeasurements
) -> None:
    """Draw a picture's frames in turns. In each turn every side draws every kind of frame, in alternating order.

    ``name`` is a key of ``PICTURES``, ``level`` a bundled level's name or a level file. ``folders`` are the checkouts by side.
    ``turns`` is the number of timed turns, after one that is not timed. The results are added to ``measurements``.
    """
    with ExitStack() as stack:
        sides = {side_name: stack.enter_context(frame_process(folder, picture, level)) for side_name, folder in folders.items()}
        drawing_processes = {side_name: process for side_name, process in sides.items() if side_name != YARDSTICK_SIDE}
        for side_name, process in drawing_processes.items():
            planned = process.request("plan")
            measurements.renderer = planned["renderer"]
            measurements.plans.setdefault(name, {})[side_name] = planned
        number, sun, camera = 0, 0, 0
        pictures = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        for turn_number in range(turns + 1):
            order = list(drawing_processes.items())[:: 1 if turn_number % 2 else -1]
            for plan, moves in picture.changes.items():
                for move in moves:
                    if move in ("new", "sun", "camera"):
                        number += 1
                    sun, camera = _position_numbers(move, number, (sun, camera))
                    clear = ["light", "scene"] if move == "all new" else []
                    for side_name, process in order:
                        row = process.request("frame", plan=plan, sun=sun, camera=camera, clear=clear)
                        _add_row(measurements, FrameKey(name, plan, move), side_name, row, turn_number)
                    if turn_number == turns and BASE_SIDE in drawing_processes:
                        key = FrameKey(name, plan, move)
                        measurements.differences[key] = _difference(measurements.frames[key], drawing_processes, pictures)
            if YARDSTICK_SIDE in sides:
                for yardstick_name, (map_size, taps) in YARDSTICK_VARIANTS.items():
                    row = sides[YARDSTICK_SIDE].request("yardstick", map_size=map_size, taps=taps, sun=number, camera=number)
                    _add_row(measurements, FrameKey(name, "yardstick", yardstick_name), YARDSTICK_SIDE, row, turn_number)
        for repeat in range(3):
            for side_name, process in drawing_processes.items():
                row = process.request("plan", plans=["planned"], sun=number + 1 + repeat, camera=number + 1 + repeat)
                measurements.plans[name][side_name].setdefault("new_view_ms", []).append(row["ms"])
                measurements.plans[name][side_name].setdefault("new_view_cpu_ms", []).append(row["cpu_ms"])


def _difference(rows: RowsBySide, drawing_processes: dict[str, FrameProcess], folder: Path) -> Row:
    """Return the number of frames with equal colours and with equal visibilities on both sides, and how the last frame differs.

    ``rows`` are the costs of one kind of frame. The pictures are saved in ``folder``. ``most`` is the largest difference of a
    colour, of 255. ``classes`` is the number of pixels that are lit on one side only.
    """
    equal_counts = {
        quantity: sum(row[quantity] == other[quantity] for row, other in zip(rows[NOW_SIDE], rows[BASE_SIDE], strict=True))
        for quantity in ("color", "visibility")
    }
    saved = []
    for side_name, process in drawing_processes.items():
        process.request("save", path=str(folder / f"{side_name}.npz"))
        saved.append(np.load(folder / f"{side_name}.npz"))
    steps = np.abs(np.subtract(*(arrays["color"].astype(np.int16) for arrays in saved))).max(axis=2)
    lit = [arrays["visibility"] >= 0.5 for arrays in saved]
    counts = {"pixels": int((steps > 0).sum()), "most": int(steps.max()), "classes": int((lit[0] != lit[1]).any(axis=0).sum())}
    return {"frames": len(rows[NOW_SIDE]), **equal_counts, **counts}


def _position_numbers(change: str, number: int, previous_numbers: tuple[int, int]) -> tuple[int, int]:
    """Return the numbers of the sun's and the camera's positions in the next frame.

    ``change`` is the change between the frames. ``previous_numbers`` are those of the previous frame. ``number`` is a new number.
    """
    return number if change in ("new", "sun") else previous_numbers[0], number if change in ("new", "camera") else previous_numbers[
        1
    ]


def _add_row(measurements: FrameMeasurements, key: FrameKey, side_name: str, row: Row, turn_number: int) -> None:
    """Add a frame's costs to ``measurements``, except those of the first turn (number 0)."""
    if turn_number:  # the first turn compiles and allocates
        measurements.frames.setdefault(key, {}).setdefault(side_name, []).append(row)


def measure_first_frames(
    name: str, picture: MeasuredPicture, level: str, folders: dict[str, Path], measurements: FrameMeasurements
) -> None:
    """Measure the first frames of new processes, one side after the other. Parameters are those of ``measure_interleaved``."""
    for _ in range(FIRST_FRAME_REPEATS):
        for side_name, folder in folders.items():
            with frame_process(folder, picture, level) as process:
                answers = []
                for number in range(WARM_FRAMES + 1):
                    plan = process.request("plan", plans=["planned"], sun=number, camera=number)
                    row = process.request("frame", plan="planned", sun=number, camera=number)
                    answer_times = {f"{clock}answer_ms": plan[f"{clock}ms"] + row[f"{clock}ms"] for clock in ("", "cpu_")}
                    answers.append({**row, **answer_times, "plan_ms": plan["ms"]})
                clocks = ("ms", "cpu_ms", "plan_ms", "answer_ms", "cpu_answer_ms")
                warm = {clock: statistics.median(answer[clock] for answer in answers[1:]) for clock in clocks}
                measurements.first_frames.setdefault(name, {}).setdefault(side_name, []).append(
                    {**process.ready, "first": answers[0], "warm": warm}
                )


def measure(args: argparse.Namespace) -> FrameMeasurements:
    """Measure all requested pictures."""
    measurements = FrameMeasurements()
    folders = {NOW_SIDE: ROOT} | ({BASE_SIDE: args.base.resolve()} if args.base else {})
    with tempfile.TemporaryDirectory() as folder:
        for name in args.pictures:
            picture = PICTURES[name]
            width, height = picture.size
            picture = MeasuredPicture(**{**vars(picture), "size": (round(width * args.scale), round(height * args.scale))})
            level = str(write_wooded_hills(Path(folder), args.trees)) if name == MILLION_TREES else picture.level
            turn_count = max(round(args.repeats * picture.turn_share), 1)
            measure_interleaved(name, picture, level, {**folders, YARDSTICK_SIDE: ROOT}, turn_count, measurements)
            if picture.measures_first_frames and not args.no_first:
                measure_first_frames(name, picture, level, folders, measurements)
            measurements.load = max(measurements.load, os.getloadavg()[0])
            print(f"{name}: measured; load average {os.getloadavg()[0]:.1f}", file=sys.stderr, flush=True)
    return measurements


def _commit_description(folder: Path) -> str:
    """Return hash and date of the commit that is checked out in ``folder``, or "unknown"."""
    command = ["git", "log", "-1", "--format=%h of %cs"]
    try:
        process = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    except OSError:  # a machine without git
        return "unknown"
    return process.stdout.strip() or "unknown"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--base", type=Path, help="a clone of another commit")
    parser.add_argument("--pictures", nargs="+", choices=tuple(PICTURES), default=[name for name in PICTURES if name != STREET])
    parser.add_argument("--repeats", type=int, default=15, help="turns of SpatialAce's frames; half as many for the other pictures")
    parser.add_argument("--trees", type=int, default=1_000_000)
    parser.add_argument("--scale", type=float, default=1.0, help="factor of the pictures' sides, for a quick trial")
    parser.add_argument("--no-first", action="store_true", help="leave out the first frames of fresh processes")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path, help="a page with marks, between which the tables are written, or a new file")
    args = parser.parse_args(arguments)
    if args.base is not None and not (args.base / "terrain").is_dir():
        parser.error(f"--base: {args.base} has no folder terrain. Name a clone of this repository.")
    if args.repeats < 1 or not 0.0 < args.scale <= 1.0:
        parser.error(f"--repeats {args.repeats} --scale {args.scale:g}: use at least 1 repeat and a scale in (0, 1].")
    measurements = measure(args)
    result = {
        "renderer": measurements.renderer, "cpus": os.cpu_count(), "load": measurements.load, "repeats": args.repeats,
        "now": _commit_description(ROOT), "base": _commit_description(args.base) if args.base else None,
        "plans": measurements.plans,
        "firsts": measurements.first_frames,
        "frames": [
            {
                "picture": key.picture, "plan": key.plan, "move": key.change, "rows": sides,
                "differs": measurements.differences.get(key),
            }
            for key, sides in measurements.frames.items()
        ],
        "targets": [
            {
                "what": target.description, "most": target.upper_bound, "wall": target.value, "cpu": target.cpu_value,
                "unit": target.unit, "counts": target.is_required, "met": target.is_met,
            }
            for target in frame_targets(measurements.frames, measurements.first_frames)
        ],
    }  # fmt: skip
    table = format_report(result, measurements.frames, measurements.first_frames, measurements.differences)
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    if args.markdown:
        page = args.markdown.read_text(encoding="utf-8") if args.markdown.exists() else ""
        args.markdown.write_text(replace_between_marks(page, table) if TABLES_BEGIN in page else table, encoding="utf-8")
    print(table)
    for target in frame_targets(measurements.frames, measurements.first_frames):
        print(target.summary)


if __name__ == "__main__":
    main()
