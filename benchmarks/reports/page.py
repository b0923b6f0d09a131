"""Format the measured part of docs/reports/comparisons.md from the stored figures."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from benchmarks.selection.judge import GOALS, Goal, GoalInstance
from benchmarks.selection.page import markdown_table
from skugga.selector.formatting import format_duration, format_list, format_percent

Figures = dict[str, Any]
"""Stored figures of a scene, or of a row (measured choice) of it, by key."""

ERROR_GOALS = [goal for goal in GOALS if goal.time_share is None]
"""Goals without a time limit."""


def format_comparisons(records: Mapping[str, Figures]) -> str:
    """Format all tables, and the findings in each scene, as Markdown. ``records`` has the stored figures by name of the scene."""
    first = next(iter(records.values()))
    devices = list(dict.fromkeys(f"{record['device']}, {record['processors']} processors" for record in records.values()))
    parts = [
        f"\nMeasured on {format_list(devices)}; Skugga {first['Skugga']}.\n",
        "\n## The scenes\n",
        markdown_table(
            ["report", "view", "light", "pixels", "in cast shadow", "noise floor", "rows judged"],
            [[_report_link(name, record), *_scene_cells(record)] for name, record in records.items()],
        ),
        "\n## The cheapest row that reaches an error\n",
        markdown_table(
            ["scene", "error", *(f"{goal.name} or less" for goal in ERROR_GOALS)],
            [
                [name, f"`{record['error']}`", *(_cheapest_row_text(record, goal) for goal in ERROR_GOALS)]
                for name, record in records.items()
            ],
        ),
        "\n## What is taken where nothing is asked\n",
        markdown_table(
            ["scene", "default row", "error", "`soft_error`", "time", "its place"],
            [[name, *_default_row_cells(record)] for name, record in records.items()],
        ),
        *(_section(name, record) for name, record in records.items()),
    ]
    return "\n".join(parts) + "\n"


def omitted_row_commands(record: Figures) -> list[str]:
    """Return the commands that measure the rows without a measurement, one for each row."""
    return [f"{record['command']} --only {shlex.quote(name)}" for name in record["left_out"]]


def _report_link(name: str, record: Figures) -> str:
    """Format a scene's title, with a link to its report."""
    return f"[{name}](../compare/{name}.html): {record['title'][:1].lower()}{record['title'][1:]}"


def _scene_cells(record: Figures) -> list[str]:
    """Return a scene's cells in the table of scenes, after the link."""
    view = f"`{record['level'].partition(':')[0]}`, {record['view']}"
    shares = [format_percent(record["cast"]), format_percent(record["noise_floor"])]
    return [view, record["light"], record["size"].removesuffix(" pixels"), *shares, _row_count(record)]


def _row_count(record: Figures) -> str:
    """Format the number of measured rows, and of all rows if some were left out."""
    return (
        f"{len(record['rows'])} of {len(record['rows']) + len(record['left_out'])}"
        if record["left_out"]
        else str(len(record["rows"]))
    )


def _cheapest_row_text(record: Figures, goal: Goal) -> str:
    """Format the name and time of the quickest row that meets a goal, or "none"."""
    row = GoalInstance(record, goal, None).cheapest
    return "none" if row is None else f"`{row}`, {_format_time(record['rows'][row])}"


def _default_row_cells(record: Figures) -> list[str]:
    """Return the cells of a scene's default choice: name, two errors, time, and place on the Pareto fronts."""
    row = record["rows"].get(record["default"])
    if row is None:
        return ["none casts", "", "", "", ""]
    figures = [format_percent(row[record["error"]]), format_percent(row["soft_error"]), _format_time(row)]
    return [f"`{record['default']}`", *figures, _pareto_text(record, row)]


def _pareto_text(record: Figures, row: Figures) -> str:
    """Describe on which Pareto fronts a row lies.

    If it is on none, name a row that dominates it: a row at least as fast and as accurate by both errors, or by one error.
    """
    fronts = [f"`{by}`" for front, by in (("pareto", record["error"]), ("pareto_soft", "soft_error")) if row[front]]
    if fronts:
        return f"on the front by {format_list(fronts)}: no row dominates it"
    rivals = [(name, f) for name, f in record["rows"].items() if f is not row and f["ms"] <= row["ms"]]
    for errors in ((record["error"], "soft_error"), (record["error"],)):
        better = [(f[record["error"]], f["ms"], name) for name, f in rivals if all(f[by] <= row[by] for by in errors)]
        if better:
            by = format_list([f"`{error}`" for error in errors])
            return f"dominated by `{min(better)[2]}` (time and {by})"
    return "on no front"


def _format_time(row: Figures) -> str:
    """Format the time of a row. "?" marks the time of a single run, which includes compilation."""
    return f"{format_duration(row['ms'])}{'?' if row['cold'] else ''}"


def _section(name: str, record: Figures) -> str:
    """Format the section of a scene: plot, origin, findings, and commands for rows that were left out."""
    lines = [
        f"\n## {record['title']}",
        "",
        f"![Error against time: {name}](../images/compare-{name}.svg)",
        "",
        f"[The report](../compare/{name}.html), which `{record['command']} --time-limit {record['time_limit_s']:g} -o DIR` makes, "
        f"too. Data: {record['data']}. Made {record['made']} in {record['took_s']} s; load average before: {record['load']}.",
        "",
        *(f"* {sentence}" for sentence in _sentences_with_code(record)),
    ]
    if record["left_out"]:
        lines += ["", f"Left out for want of time: {len(record['left_out'])}. Each is measured by:", ""]
        lines += ["```sh", *omitted_row_commands(record), "```"]
    else:
        lines += ["", "No variant was left out."]
    return "\n".join(lines)


def _sentences_with_code(record: Figures) -> list[str]:
    """Return the sentences of the report with names of rows as Markdown code, since `_` and `*` have a meaning in Markdown."""
    names = sorted([*record["rows"], *record["left_out"]], key=len, reverse=True)
    return [_with_code(sentence, names) for sentence in [*record["summary"], *record["remarks"]]]


def _with_code(sentence: str, names: list[str]) -> str:
    """Format every name of a row in a sentence as code. Longer names come before names that they contain."""
    for name in names:
        before, match, after = sentence.partition(name)
        if match:
            return f"{_with_code(before, names)}`{name}`{_with_code(after, names)}"
    return sentence
