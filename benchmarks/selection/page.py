"""The measured tables of docs/selection.md, from the table that is kept in the repository."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.selection.fit import cases_of
from benchmarks.selection.judge import GOALS, GoalInstance, PolicyScore, instances_of, marginal
from benchmarks.selection.policies import Split, errors_of_time, lateness, policy_score, splits
from selector.cost.device_profile import DeviceProfile
from selector.formatting import format_percent
from shadows.registry import selectable_algorithms

Figures = dict[str, Any]

START, END = "<!-- measured -->\n", "<!-- end of measured -->\n"
"""What the tables stand between, in the page."""

TARGETS = {
    "predict": {"met": "95 %", "gap": "0.80 / 0.60", "mean": "0.10", "p95": "0.25", "unclean": "0.5 %"},
    "measure": {"met": "98 %", "gap": "0.90 / 0.90", "mean": "0.05", "p95": "0.15", "unclean": "none"},
}  # fmt: skip

ALGORITHM_TITLES = {each.name: each.plural for each in selectable_algorithms()}


def page(views: Sequence[Figures], device: DeviceProfile) -> str:
    """All tables, as Markdown."""
    made = splits(views, device)
    parts = [
        _what(views),
        *(_policies(views, each) for each in made),
        _parts(views, made[0]),
        _worst(views, made),
        _marginal(views),
        _times(views, device),
    ]
    return "\n".join(parts)


def with_tables(text: str, tables: str) -> str:
    """A page with its tables replaced."""
    before, rest = text.split(START)
    _, after = rest.split(END)
    return before + START + tables + END + after


def _what(views: Sequence[Figures]) -> str:
    families: dict[str, list[Figures]] = {}
    for view in views:
        families.setdefault(view["family"], []).append(view)
    rows = [
        [
            family,
            len(family_views),
            len({view["terrain"] for view in family_views}),
            sum(len(view["rows"]) for view in family_views),
        ]
        for family, family_views in families.items()
    ]
    total_row = ["all", len(views), len({view["terrain"] for view in views}), sum(len(view["rows"]) for view in views)]
    goals = ", ".join(goal.name for goal in GOALS)
    text = (
        f"\nEach view counts once with each of {len(GOALS)} targets ({goals}): {len(GOALS) * len(views)} instances, measured on\n"
        f"{views[0]['renderer']}."
    )
    late = lateness(views)
    if late.size:
        kept, most = format_percent(float(np.mean(late <= 1.0))), format_percent(max(float(late.max()) - 1.0, 0.0))
        text += (
            " `measure` is judged without the time limit: it chose in another hour than that in\n"
            "which the plans were timed, and the machine's speed changes. By the plans' times its choices\n"
            f"kept to the limit in {kept} of the views, and were {most} late at most."
        )
    text += "\n\n"
    return text + markdown_table(["family", "views", "terrains", "plans measured"], [*rows, total_row])


def _policies(views: Sequence[Figures], made: Split) -> str:
    found = {policy: policy_score(views, made, policy) for policy in made.taken}
    planned = {policy: policy_score(views, made, policy, with_plans=True) for policy in made.taken if policy != "measure"}
    first = next(iter(found.values()))
    best = max(made.best, key=made.best.__getitem__)
    heads = ["quantity", "single best", *found, "target: predict", "target: measure"]

    def row(name: str, key: str, of: Any, single: str = "") -> list[str]:
        targets = [TARGETS[policy].get(key, "") for policy in ("predict", "measure")]
        return [name, single, *map(of, found.values()), *targets]

    def ratio(value: float) -> str:
        return f"{value:.2f}"

    rows = [
        row("target met", "met", lambda its: format_percent(its.met), format_percent(first.single_met)),
        row("gap closed", "gap", _gap),
        row("relative regret, mean", "mean", lambda its: ratio(its.regret), ratio(first.single - 1.0)),
        row("relative regret, p95", "p95", lambda its: ratio(its.regret_p95)),
        row("of the choices that met their target: mean", "", lambda its: ratio(its.regret_met)),
        row("p95", "", lambda its: ratio(its.regret_met_p95)),
        row("interior error though a clean row met the target", "unclean", lambda its: format_percent(its.unclean)),
    ]
    own = [ratio(planned[policy].regret) if policy in planned else "" for policy in found]
    rows.append(["relative regret with the time of planning, mean", "", *own, "", ""])
    often = f"`{best}` in {made.best[best]} of {sum(made.best.values())} parts"
    return f"\n**{made.name[0].upper()}{made.name[1:]}.** The single best is {often}.\n\n" + markdown_table(heads, rows)


def _parts(views: Sequence[Figures], made: Split) -> str:
    """Targets met of those that can be, by target and by family; families without the limit of time."""
    able = [one for one in instances_of(views) if any(map(one.meets, one.rows))]
    parts = {goal.name: [one for one in able if one.goal.name == goal.name] for goal in GOALS}
    for one in able:
        if one.max_ms is None:
            parts.setdefault(one.view["family"], []).append(one)

    def met(policy: str, part: Sequence[GoalInstance]) -> str:
        taken = made.taken[policy]
        rows = [(one, taken[key]) for one in part if (key := (one.view["name"], one.goal.name)) in taken]
        return f"{sum(one.meets(row) for one, row in rows)} of {len(rows)}" if rows else ""

    rows = [[name, *(met(policy, part) for policy in made.taken)] for name, part in parts.items()]
    text = "\nTargets met of those that some plan meets (held-out views), by target, and by family without the limit of time:\n\n"
    return text + markdown_table(["target or family", *made.taken], rows)


def _gap(its: PolicyScore) -> str:
    return "no gap to speak of" if its.gap_closed is None else f"{its.gap_closed:.2f}"


def _worst(views: Sequence[Figures], made: Sequence[Split]) -> str:
    rows = [
        [policy, view, goal, f"`{row_name}`", f"{regret:.1f}"]
        for policy in made[0].taken
        for view, goal, row_name, regret in policy_score(views, made[0], policy).worst
    ]
    heads = ["policy", "view", "target", "taken", "relative regret"]
    return "\nThe worst choices (held-out views):\n\n" + markdown_table(heads, rows)


def _marginal(views: Sequence[Figures]) -> str:
    instances = instances_of(views)
    rows = []
    for name, (gain, share) in marginal(instances, list(ALGORITHM_TITLES)).items():
        wins = [one for one in instances if name in one.rows[min(one.losses(), key=one.losses().__getitem__)]["algorithms"]]
        where = f"{wins[0].view['name']}, {wins[0].goal.name}" if wins else "nowhere"
        rows.append([ALGORITHM_TITLES[name], f"{gain:.3f}", format_percent(share), where])
    return "\nWhat each algorithm adds to the virtual best:\n\n" + markdown_table(
        ["algorithm", "mean loss more without it", "takes part in the best", "for example"], rows
    )


def _times(views: Sequence[Figures], device: DeviceProfile) -> str:
    cases, rows = [case for view in views for case in cases_of(view)], []
    for name in ALGORITHM_TITLES:
        off = errors_of_time(cases, device, lambda case, name=name: name in case.algorithms)
        rows.append(
            [ALGORITHM_TITLES[name], len(off), format_percent(float(np.median(np.abs(off)))), f"{100.0 * np.median(off):+.0f} %"]
        )
    off = errors_of_time(cases, device)
    rows.append(["all", len(off), format_percent(float(np.median(np.abs(off)))), f"{100.0 * np.median(off):+.0f} %"])
    plan_ms = [view["plan_ms"] for view in views]
    text = "\nExpected times against those measured; none of these scenes is among those that the device is calibrated with:\n\n"
    text += markdown_table(["plans with", "number", "median error", "median bias"], rows)
    return text + (
        f"\nDescribing a warm scene and choosing takes {np.median(plan_ms):.0f} ms in the median,"
        f"\n{np.quantile(plan_ms, 0.9):.0f} ms in nine of ten views and {max(plan_ms):.0f} ms at most.\n\n"
    )


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table in Markdown, lines ended."""
    lines = [list(map(str, heads)), ["---"] * len(heads), *(list(map(str, row)) for row in rows)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
