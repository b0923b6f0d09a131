"""Format results of ``benchmarks.frames``: whether targets are met, and Markdown tables."""

from __future__ import annotations

import re
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

Row = dict[str, Any]
"""A frame's costs as ``benchmarks.frame_worker`` reports them."""

Rows = dict[str, list[Row]]
"""Rows of costs by side, one for each turn. Rows at the same index were drawn one after the other."""

NOW, BASE, YARDSTICK = "now", "before", "yardstick"

MOVES = {
    "new": "sun and camera",
    "sun": "the sun",
    "camera": "the camera",
    "resting": "nothing",
    "all new": "all is new",
}
"""Changes since the previous frame, by the names of the measurements."""

BEGIN, END = "<!-- frames: what follows is written by python -m benchmarks.frames -->", "<!-- frames: up to here -->"


class FrameKey(NamedTuple):
    """A kind of frame: the picture, the plan's name, and the change since the previous frame."""

    picture: str
    plan: str
    move: str


class Target(NamedTuple):
    """A target and its measured figure.

    Attributes
    ----------
    what
        Description of the figure.
    most
        Upper bound of the figure.
    wall
        The figure by wall time, or another figure.
    cpu
        The figure by CPU time; ``None`` without one.
    unit
        Unit of the figure.
    counts
        Whether the target must be met; if not, the line is only printed beside one that must.
    """

    what: str
    most: float
    wall: float
    cpu: float | None = None
    unit: str = ""
    counts: bool = True

    @property
    def met(self) -> bool:
        """Whether the figure ``wall`` meets the target."""
        return self.wall <= self.most

    @property
    def line(self) -> str:
        """The target, its figure and whether it is met, as one line of text."""
        cpu = "" if self.cpu is None else f" (CPU time {self.cpu:.2f})"
        word = "beside" if not self.counts else "met   " if self.met else "MISSED"
        return f"{word} {self.what}: {self.wall:.2f}{self.unit}{cpu}, at most {self.most:g}{self.unit}"


def paired_ratio(rows: Sequence[Row], base_rows: Sequence[Row], value: str = "ms") -> float:
    """Return the median ratio of a value in two lists of rows that were drawn in turns. Other load affects both rows of a turn."""
    return statistics.median(row[value] / other[value] for row, other in zip(rows, base_rows, strict=True))


def median_of(rows: Sequence[Row], value: str) -> float:
    """Return the median of a value over rows."""
    return float(statistics.median(row[value] for row in rows))


def median_passes(rows: Sequence[Row]) -> dict[str, float]:
    """Return the median milliseconds of each pass, in the order of the first frame."""
    names = list(dict.fromkeys(name for row in rows for name in row["passes_ms"]))
    return {name: statistics.median(row["passes_ms"].get(name, 0.0) for row in rows) for name in names}


def frame_targets(frames: dict[FrameKey, Rows], first_frames: dict[str, Rows]) -> list[Target]:
    """Return the targets that have measurements."""
    result: list[Target] = []

    def add(
        target_name: str, limit: float, rows_now: Sequence[Row] | None, base_rows: Sequence[Row] | None, counts: bool = True
    ) -> None:
        if rows_now and base_rows:
            wall, cpu = (paired_ratio(rows_now, base_rows, value) for value in ("ms", "cpu_ms"))
            result.append(Target(target_name, limit, wall, cpu, counts=counts))

    def rows(picture: str, move: str, side: str = NOW, plan: str = "planned") -> list[Row] | None:
        return frames.get(FrameKey(picture, plan, move), {}).get(side)

    for move in ("new", "resting"):
        label = f"SpatialAce as planned, {MOVES[move]} moved"
        for name, taps in (("512, 1 tap", "1 tap"), ("512, 3 x 3 taps", "3 x 3 taps")):
            sticks = rows("SpatialAce", name, YARDSTICK, "yardstick")
            counts = move == "new" and taps == "1 tap"
            add(f"{label} / yardstick, 512 map, {taps}", 3.0, rows("SpatialAce", move), sticks, counts)
        add(f"{label} / before", 0.35, rows("SpatialAce", move), rows("SpatialAce", move, BASE), move == "new")
    for picture in ("valley", "village"):
        for move in ("new", "resting"):
            label = f"wooded {picture} as planned, {MOVES[move]} moved / before"
            add(label, 0.4, rows(picture, move), rows(picture, move, BASE), move == "new")
    for picture, sides in first_frames.items():
        rows_now = sides[NOW]
        for value, label in (("ms", "frame"), ("answer_ms", "frame with its plan")):
            ratio = statistics.median(row["first"][value] / row["warm"][value] for row in rows_now)
            cpu = statistics.median(row["first"][f"cpu_{value}"] / row["warm"][f"cpu_{value}"] for row in rows_now)
            result.append(Target(f"{picture}: first {label} after start / a warm one", 2.0, ratio, cpu, counts=value == "ms"))
    for picture in ("SpatialAce", "valley", "village"):
        add(f"{picture}: the sun moves / sun and camera do", 0.6, rows(picture, "sun"), rows(picture, "new"))
        add(f"{picture}: the camera moves / sun and camera do", 0.7, rows(picture, "camera"), rows(picture, "new"))
    million = rows("a million trees", "new")
    add("a million trees / before", 0.5, million, rows("a million trees", "new", BASE))
    if million:
        result.append(Target("a million trees: peak memory", 1.2, max(row["peak_gb"] for row in million), unit=" GB"))
    return result


def as_markdown(
    result: dict[str, Any], frames: dict[FrameKey, Rows], first_frames: dict[str, Rows], differences: dict[FrameKey, Row]
) -> str:
    """Format all tables. ``differences`` hold comparisons of pictures with those of the other commit."""
    parts = [
        f"{result['renderer']}, {result['cpus']} CPU cores, load {result['load']:.1f}, {result['repeats']} turns; before: "
        f"{result['base'] or 'not measured'}.",
        _target_table(frame_targets(frames, first_frames)),
        _frame_table(frames, differences),
        _plan_lines(result["plans"]),
        _first_table(first_frames) if first_frames else "",
        *(_pass_table(key, sides) for key, sides in frames.items() if key.move == "new"),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def replace_between_marks(text: str, table: str) -> str:
    """Replace the text between the marks of a page. Raises ``ValueError`` if the page has no marks."""
    pattern = re.compile(re.escape(BEGIN) + ".*?" + re.escape(END), re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"no marks: {BEGIN} ... {END}")
    return pattern.sub(lambda _: f"{BEGIN}\n\n{table.strip()}\n\n{END}", text, count=1)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _target_table(targets: Sequence[Target]) -> str:
    rows = [
        [target.what, f"{target.wall:.2f}{target.unit}", "" if target.cpu is None else f"{target.cpu:.2f}",
         f"{target.most:g}{target.unit}", "" if not target.counts else "yes" if target.met else "**no**"]
        for target in targets
    ]  # fmt: skip
    return _table(["what", "measured", "by CPU time", "at most", "met"], rows)


def _plan_lines(plans: dict[str, dict[str, Any]]) -> str:
    lines = []
    for picture, by_side in plans.items():
        headlines = {side: planned["plans"]["planned"]["algorithms"].replace(",", ", ") for side, planned in by_side.items()}
        descriptions = [headlines[NOW], *(f"{text} before" for side, text in headlines.items() if text != headlines[NOW])]
        new_ms = " to ".join(f"{statistics.median(by_side[side]['new_view_ms']):.0f}" for side in (BASE, NOW) if side in by_side)
        lines.append(f"* {picture} is planned as {'; '.join(descriptions)}. A new view's plan: {new_ms} ms.")
    return "\n".join(lines)


def _frame_table(frames: dict[FrameKey, Rows], differences: dict[FrameKey, Row]) -> str:
    head = ["picture", "plan", "moved", "before, ms", "now, ms", "ratio", "CPU before", "CPU now", "ratio", "of the yardstick",
            "read-backs", "draws", "same picture", "same shadow"]  # fmt: skip
    rows = []
    for key, sides in frames.items():
        rows_now, base = sides.get(NOW) or sides[YARDSTICK], sides.get(BASE)
        stick = frames.get(FrameKey(key.picture, "yardstick", "512, 1 tap"), {}).get(YARDSTICK)

        def format_both(
            value: Callable[[Sequence[Row]], str], rows_now: Sequence[Row] = rows_now, base: Sequence[Row] | None = base
        ) -> str:
            return value(rows_now) if base is None or value(base) == value(rows_now) else f"{value(base)} to {value(rows_now)}"

        rows.append([
            key.picture, key.plan, MOVES.get(key.move, key.move),
            "" if base is None else f"{median_of(base, 'ms'):.1f}", f"{median_of(rows_now, 'ms'):.1f}",
            "" if base is None else f"{paired_ratio(rows_now, base):.2f}",
            "" if base is None else f"{median_of(base, 'cpu_ms'):.1f}", f"{median_of(rows_now, 'cpu_ms'):.1f}",
            "" if base is None else f"{paired_ratio(rows_now, base, 'cpu_ms'):.2f}",
            "" if stick is None else f"{paired_ratio(rows_now, stick):.1f}",
            format_both(lambda rows: f"{median_of(rows, 'reads'):.0f} ({median_of(rows, 'read_mib'):.0f} MiB)"),
            format_both(lambda rows: f"{median_of(rows, 'draws'):.0f}"),
            *_format_equality(differences.get(key)),
        ])  # fmt: skip
    return _table(head, rows)


def _format_equality(differs: Row | None) -> list[str]:
    """Return two table cells: the number of frames with equal colours, and with equal visibilities, on both sides.

    If they differ, a cell also tells by how much the last frame differs.
    """
    if differs is None:
        return ["", ""]
    color = f"; {differs['pixels']} pixels differ, by up to {differs['most']}" if differs["most"] else ""
    classes = f"; {differs['classes']} pixels of another class" if differs["classes"] else ""
    count = differs["frames"]
    return [f"{differs['color']} of {count}{color}", f"{differs['visibility']} of {count}{classes}"]


def _first_table(first_frames: dict[str, Rows]) -> str:
    head = ["picture", "side", "imports, s", "scene, s", "plan, s", "first frame, s", "a new view's plan, s", "its frame, s"]
    rows = []
    for picture, sides in first_frames.items():
        for side, side_rows in sides.items():
            values = [
                [row["import_ms"] for row in side_rows], [row["scene_ms"] for row in side_rows],
                *([row[state][quantity] for row in side_rows] for state in ("first", "warm") for quantity in ("plan_ms", "ms")),
            ]  # fmt: skip
            rows.append([picture, side, *(f"{statistics.median(value) / 1000.0:.2f}" for value in values)])
    return _table(head, rows)


def _pass_table(key: FrameKey, sides: Rows) -> str:
    passes_by_side = {side: median_passes(sides[side]) for side in (BASE, NOW) if side in sides}
    names = list(dict.fromkeys(name for passes in passes_by_side.values() for name in passes))
    rows = [[name, *(f"{passes[name]:.1f}" if name in passes else "" for passes in passes_by_side.values())] for name in names]
    return f"{key.picture}, {key.plan}, {MOVES[key.move]} moved:\n\n" + _table(
        ["pass", *(f"{side}, ms" for side in passes_by_side)], rows
    )
