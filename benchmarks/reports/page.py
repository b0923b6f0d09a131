"""The measured part of docs/comparisons.md, from the stored figures."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from benchmarks.selection.judge import GOALS, Goal, GoalInstance
from benchmarks.selection.page import markdown_table
from skugga.selector.formatting import format_duration, format_list, format_percent

Figures = dict[str, Any]

TARGETS = [goal for goal in GOALS if goal.within is None]
"""Goals without a time limit."""


def comparisons(records: Mapping[str, Figures]) -> str:
    """Format all tables, and the findings of each scene, as Markdown."""
    first = next(iter(records.values()))
    devices = list(dict.fromkeys(f"{each['device']}, {each['processors']} processors" for each in records.values()))
    parts = [
        f"\nMeasured on {format_list(devices)}; Skugga {first['Skugga']}.\n",
        "\n## The scenes\n",
        markdown_table(
            ["report", "view", "light", "pixels", "in cast shadow", "noise floor", "rows judged"],
            [[_link(name, each), *_scene(each)] for name, each in records.items()],
        ),
        "\n## The cheapest row that reaches an error\n",
        markdown_table(
            ["scene", "error", *(f"{goal.name} or less" for goal in TARGETS)],
            [[name, f"`{each['error']}`", *(_cheapest(each, goal) for goal in TARGETS)] for name, each in records.items()],
        ),
        "\n## What is taken where nothing is asked\n",
        markdown_table(
            ["scene", "default row", "error", "`soft_error`", "time", "its place"],
            [[name, *_default(each)] for name, each in records.items()],
        ),
        *(_section(name, each) for name, each in records.items()),
    ]
    return "\n".join(parts) + "\n"


def commands(each: Figures) -> list[str]:
    """Return the command that measures each variant that was left out."""
    return [f"{each['command']} --only {shlex.quote(name)}" for name in each["left_out"]]


def _link(name: str, each: Figures) -> str:
    return f"[{name}](compare/{name}.html): {each['title'][:1].lower()}{each['title'][1:]}"


def _scene(each: Figures) -> list[str]:
    view = f"`{each['level'].partition(':')[0]}`, {each['view']}"
    shares = [format_percent(each["cast"]), format_percent(each["noise_floor"])]
    return [view, each["light"], each["size"].removesuffix(" pixels"), *shares, _judged(each)]


def _judged(each: Figures) -> str:
    return f"{len(each['rows'])} of {len(each['rows']) + len(each['left_out'])}" if each["left_out"] else str(len(each["rows"]))


def _cheapest(each: Figures, goal: Goal) -> str:
    row = GoalInstance(each, goal, None).cheapest
    return "none" if row is None else f"`{row}`, {_time(each['rows'][row])}"


def _default(each: Figures) -> list[str]:
    row = each["rows"].get(each["default"])
    if row is None:
        return ["none casts", "", "", "", ""]
    figures = [format_percent(row[each["error"]]), format_percent(row["soft_error"]), _time(row)]
    return [f"`{each['default']}`", *figures, _place(each, row)]


def _place(each: Figures, row: Figures) -> str:
    """Describe the fronts of the default, or a row that is at least as fast and as accurate by both errors, or by one of them."""
    fronts = [f"`{by}`" for front, by in (("pareto", each["error"]), ("pareto_soft", "soft_error")) if row[front]]
    if fronts:
        return f"on the front by {format_list(fronts)}: no row dominates it"
    rivals = [(name, f) for name, f in each["rows"].items() if f is not row and f["ms"] <= row["ms"]]
    for errors in ((each["error"], "soft_error"), (each["error"],)):
        better = [(f[each["error"]], f["ms"], name) for name, f in rivals if all(f[by] <= row[by] for by in errors)]
        if better:
            by = format_list([f"`{error}`" for error in errors])
            return f"dominated by `{min(better)[2]}` (time and {by})"
    return "on no front"


def _time(row: Figures) -> str:
    return f"{format_duration(row['ms'])}{'?' if row['cold'] else ''}"


def _section(name: str, each: Figures) -> str:
    lines = [
        f"\n## {each['title']}",
        "",
        f"![Error against time: {name}](images/compare-{name}.svg)",
        "",
        f"[The report](compare/{name}.html), which `{each['command']} --time-limit {each['time_limit_s']:g} -o DIR` makes, too. "
        f"Data: {each['data']}. Made {each['made']} in {each['took_s']} s; load average before: {each['load']}.",
        "",
        *(f"* {sentence}" for sentence in _marked(each)),
    ]
    if each["left_out"]:
        lines += ["", f"Left out for want of time: {len(each['left_out'])}. Each is measured by:", ""]
        lines += ["```sh", *commands(each), "```"]
    else:
        lines += ["", "No variant was left out."]
    return "\n".join(lines)


def _marked(each: Figures) -> list[str]:
    """Return the sentences of the report, with names of rows as code, since `_` and `*` have a meaning in Markdown."""
    names = sorted([*each["rows"], *each["left_out"]], key=len, reverse=True)
    return [_with_code(sentence, names) for sentence in [*each["summary"], *each["remarks"]]]


def _with_code(sentence: str, names: list[str]) -> str:
    """Format every name of a row in a sentence as code; a longer name before one that is a part of it."""
    for name in names:
        before, found, after = sentence.partition(name)
        if found:
            return f"{_with_code(before, names)}`{name}`{_with_code(after, names)}"
    return sentence
