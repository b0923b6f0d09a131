"""Format results of ``benchmarks.frames``: whether targets are met, and Markdown tables."""

from __future__ import annotations

import re
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

Row = dict[str, Any]
"""A frame's costs as ``benchmarks.frame_worker`` reports them."""

RowsBySide = dict[str, list[Row]]
"""Rows of costs by side, one for each turn. Rows at the same index were drawn one after the other."""

NOW_SIDE, BASE_SIDE, YARDSTICK_SIDE = "now", "before", "yardstick"
"""Names of the sides: this checkout, the other commit, and the program of ``benchmarks.yardstick``."""

CHANGE_TEXTS = {
    "new": "sun and camera",
    "sun": "the sun",
    "camera": "the camera",
    "resting": "nothing",
    "all new": "all is new",
}
"""Changes since the previous frame, by the names of the measurements."""

TABLES_BEGIN, TABLES_END = "<!-- frames: what follows is written by python -m benchmarks.frames -->", "<!-- frames: up to here -->"


class FrameKey(NamedTuple):
    """A kind of frame.

    ``picture`` is a key of ``benchmarks.frames.PICTURES``. ``plan`` is the name of its plan, and ``change`` the change since the
    previous frame, a key of ``CHANGE_TEXTS``. For the yardstick they are "yardstick" and a key of ``YARDSTICK_VARIANTS``.
    """

    picture: str
    plan: str
    change: str


class Target(NamedTuple):
    """A target and its measured figure.

    Attributes
    ----------
    description
        Description of the figure.
    upper_bound
        Upper bound of ``value``.
    value
        The measured figure; times are wall times.
    cpu_value
        The same figure by CPU time; ``None`` without one.
    unit
        Unit of the figure.
    is_required
        Whether the target must be met. If not, the figure is only reported.
    """

    description: str
    upper_bound: float
    value: float
    cpu_value: float | None = None
    unit: str = ""
    is_required: bool = True

    @property
    def is_met(self) -> bool:
        """Whether ``value`` meets the target."""
        return self.value <= self.upper_bound

    @property
    def summary(self) -> str:
        """The target, its figure and whether it is met, as one line of text."""
        cpu = "" if self.cpu_value is None else f" (CPU time {self.cpu_value:.2f})"
        status = "beside" if not self.is_required else "met   " if self.is_met else "MISSED"
        return f"{status} {self.description}: {self.value:.2f}{self.unit}{cpu}, at most {self.upper_bound:g}{self.unit}"


def paired_ratio(rows: Sequence[Row], base_rows: Sequence[Row], quantity: str = "ms") -> float:
    """Return the median ratio of a quantity (a key of rows) in two lists of rows that were drawn in turns."""
    return statistics.median(row[quantity] / other[quantity] for row, other in zip(rows, base_rows, strict=True))


def median_of(rows: Sequence[Row], quantity: str) -> float:
    """Return the median of a quantity (a key of rows) over rows."""
    return float(statistics.median(row[quantity] for row in rows))


def median_passes(rows: Sequence[Row]) -> dict[str, float]:
    """Return the median milliseconds of each pass, in the order of the first frame."""
    names = list(dict.fromkeys(name for row in rows for name in row["passes_ms"]))
    return {name: statistics.median(row["passes_ms"].get(name, 0.0) for row in rows) for name in names}


def frame_targets(frames: dict[FrameKey, RowsBySide], first_frames: dict[str, RowsBySide]) -> list[Target]:
    """Return the targets whose figures were measured. Keys of ``first_frames`` are names of pictures."""
    result: list[Target] = []

    def add_target(
        target_name: str,
        upper_bound: float,
        rows_now: Sequence[Row] | None,
        base_rows: Sequence[Row] | None,
        is_required: bool = True,
    ) -> None:
        if rows_now and base_rows:
            wall, cpu = (paired_ratio(rows_now, base_rows, value) for value in ("ms", "cpu_ms"))
            result.append(Target(target_name, upper_bound, wall, cpu, is_required=is_required))

    def rows_of(picture: str, change: str, side: str = NOW_SIDE, plan: str = "planned") -> list[Row] | None:
        return frames.get(FrameKey(picture, plan, change), {}).get(side)

    for move in ("new", "resting"):
        label = f"SpatialAce as planned, {CHANGE_TEXTS[move]} moved"
        for name, taps in (("512, 1 tap", "1 tap"), ("512, 3 x 3 taps", "3 x 3 taps")):
            yardstick_rows = rows_of("SpatialAce", name, YARDSTICK_SIDE, "yardstick")
            is_required = move == "new" and taps == "1 tap"
            add_target(f"{label} / yardstick, 512 map, {taps}", 3.0, rows_of("SpatialAce", move), yardstick_rows, is_required)
        add_target(f"{label} / before", 0.35, rows_of("SpatialAce", move), rows_of("SpatialAce", move, BASE_SIDE), move == "new")
    for picture in ("valley", "village"):
        for move in ("new", "resting"):
            label = f"wooded {picture} as planned, {CHANGE_TEXTS[move]} moved / before"
            add_target(label, 0.4, rows_of(picture, move), rows_of(picture, move, BASE_SIDE), move == "new")
    for picture, sides in first_frames.items():
        rows_now = sides[NOW_SIDE]
        for value, label in (("ms", "frame"), ("answer_ms", "frame with its plan")):
            ratio = statistics.median(row["first"][value] / row["warm"][value] for row in rows_now)
            cpu = statistics.median(row["first"][f"cpu_{value}"] / row["warm"][f"cpu_{value}"] for row in rows_now)
            result.append(Target(f"{picture}: first {label} after start / a warm one", 2.0, ratio, cpu, is_required=value == "ms"))
    for picture in ("SpatialAce", "valley", "village"):
        add_target(f"{picture}: the sun moves / sun and camera do", 0.6, rows_of(picture, "sun"), rows_of(picture, "new"))
        add_target(f"{picture}: the camera moves / sun and camera do", 0.7, rows_of(picture, "camera"), rows_of(picture, "new"))
    million = rows_of("a million trees", "new")
    add_target("a million trees / before", 0.5, million, rows_of("a million trees", "new", BASE_SIDE))
    if million:
        result.append(Target("a million trees: peak memory", 1.2, max(row["peak_gb"] for row in million), unit=" GB"))
    return result


def format_report(
    result: dict[str, Any],
    frames: dict[FrameKey, RowsBySide],
    first_frames: dict[str, RowsBySide],
    differences: dict[FrameKey, Row],
) -> str:
    """Format all tables as Markdown.

    ``result`` is the content of the JSON file. Keys of ``first_frames`` are names of pictures. ``differences`` holds the comparison
    with the other commit's pictures by kind of frame.
    """
    parts = [
        f"{result['renderer']}, {result['cpus']} CPU cores, load {result['load']:.1f}, {result['repeats']} turns; before: "
        f"{result['base'] or 'not measured'}.",
        _target_table(frame_targets(frames, first_frames)),
        _frame_table(frames, differences),
        _plan_lines(result["plans"]),
        _first_table(first_frames) if first_frames else "",
        *(_pass_table(key, sides) for key, sides in frames.items() if key.change == "new"),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def replace_between_marks(text: str, table: str) -> str:
    """Replace the text between the marks of a page. Raises ``ValueError`` if the page has no marks."""
    pattern = re.compile(re.escape(TABLES_BEGIN) + ".*?" + re.escape(TABLES_END), re.DOTALL)
    if not pattern.search(text):
        raise ValueError(f"no marks: {TABLES_BEGIN} ... {TABLES_END}")
    return pattern.sub(lambda _: f"{TABLES_BEGIN}\n\n{table.strip()}\n\n{TABLES_END}", text, count=1)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table from its column heads and the cells of its rows."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _target_table(targets: Sequence[Target]) -> str:
    """Format the targets with their figures, a row for each."""
    rows = [
        [target.description, f"{target.value:.2f}{target.unit}", "" if target.cpu_value is None else f"{target.cpu_value:.2f}",
         f"{target.upper_bound:g}{target.unit}", "" if not target.is_required else "yes" if target.is_met else "**no**"]
        for target in targets
    ]  # fmt: skip
    return _table(["what", "measured", "by CPU time", "at most", "met"], rows)


def _plan_lines(plans: dict[str, dict[str, Any]]) -> str:
    """Format the algorithms of each picture's plan and the time of planning. ``plans`` has costs by picture and side."""
    lines = []
    for picture, by_side in plans.items():
        headlines = {side: planned["plans"]["planned"]["algorithms"].replace(",", ", ") for side, planned in by_side.items()}
        descriptions = [headlines[NOW_SIDE], *(f"{text} before" for side, text in headlines.items() if text != headlines[NOW_SIDE])]
        new_ms = " to ".join(
            f"{statistics.median(by_side[side]['new_view_ms']):.0f}" for side in (BASE_SIDE, NOW_SIDE) if side in by_side
        )
        lines.append(f"* {picture} is planned as {'; '.join(descriptions)}. A new view's plan: {new_ms} ms.")
    return "\n".join(lines)


def _frame_table(frames: dict[FrameKey, RowsBySide], differences: dict[FrameKey, Row]) -> str:
    """Format times and counts of all kinds of frames, and whether their pictures equal those of the other commit."""
    head = ["picture", "plan", "moved", "before, ms", "now, ms", "ratio", "CPU before", "CPU now", "ratio", "of the yardstick",
            "read-backs", "draws", "same picture", "same shadow"]  # fmt: skip
    table_rows = []
    for key, sides in frames.items():
        rows_now, base_rows = sides.get(NOW_SIDE) or sides[YARDSTICK_SIDE], sides.get(BASE_SIDE)
        yardstick_rows = frames.get(FrameKey(key.picture, "yardstick", "512, 1 tap"), {}).get(YARDSTICK_SIDE)

        def format_before_and_now(
            value: Callable[[Sequence[Row]], str], rows_now: Sequence[Row] = rows_now, base_rows: Sequence[Row] | None = base_rows
        ) -> str:
            return (
                value(rows_now)
                if base_rows is None or value(base_rows) == value(rows_now)
                else f"{value(base_rows)} to {value(rows_now)}"
            )

        table_rows.append([
            key.picture, key.plan, CHANGE_TEXTS.get(key.change, key.change),
            "" if base_rows is None else f"{median_of(base_rows, 'ms'):.1f}", f"{median_of(rows_now, 'ms'):.1f}",
            "" if base_rows is None else f"{paired_ratio(rows_now, base_rows):.2f}",
            "" if base_rows is None else f"{median_of(base_rows, 'cpu_ms'):.1f}", f"{median_of(rows_now, 'cpu_ms'):.1f}",
            "" if base_rows is None else f"{paired_ratio(rows_now, base_rows, 'cpu_ms'):.2f}",
            "" if yardstick_rows is None else f"{paired_ratio(rows_now, yardstick_rows):.1f}",
            format_before_and_now(lambda rows: f"{median_of(rows, 'reads'):.0f} ({median_of(rows, 'read_mib'):.0f} MiB)"),
            format_before_and_now(lambda rows: f"{median_of(rows, 'draws'):.0f}"),
            *_equality_cells(differences.get(key)),
        ])  # fmt: skip
    return _table(head, table_rows)


def _equality_cells(difference: Row | None) -> list[str]:
    """Return two table cells: the number of frames with equal colours, and with equal visibilities, on both sides.

    If frames differ, the cells also contain the difference of the last frame.
    """
    if difference is None:
        return ["", ""]
    color = f"; {difference['pixels']} pixels differ, by up to {difference['most']}" if difference["most"] else ""
    classes = f"; {difference['classes']} pixels of another class" if difference["classes"] else ""
    count = difference["frames"]
    return [f"{difference['color']} of {count}{color}", f"{difference['visibility']} of {count}{classes}"]


def _first_table(first_frames: dict[str, RowsBySide]) -> str:
    """Format the times of first frames by picture and side, in seconds."""
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


def _pass_table(key: FrameKey, sides: RowsBySide) -> str:
    """Format the median milliseconds of each pass of one kind of frame on both sides."""
    passes_by_side = {side: median_passes(sides[side]) for side in (BASE_SIDE, NOW_SIDE) if side in sides}
    names = list(dict.fromkeys(name for passes in passes_by_side.values() for name in passes))
    rows = [[name, *(f"{passes[name]:.1f}" if name in passes else "" for passes in passes_by_side.values())] for name in names]
    return f"{key.picture}, {key.plan}, {CHANGE_TEXTS[key.change]} moved:\n\n" + _table(
        ["pass", *(f"{side}, ms" for side in passes_by_side)], rows
    )
