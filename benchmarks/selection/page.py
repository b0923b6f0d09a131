"""The measured tables of docs/selection.md, from the table that is kept in the repository."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.selection.fit import cases_of
from benchmarks.selection.judge import GOALS, Instance, Verdict, instances_of, marginal
from benchmarks.selection.policies import Split, errors_of_time, lateness, splits, verdict
from selector.cost.device_profile import DeviceProfile
from selector.words import percent

Figures = dict[str, Any]

START, END = "<!-- measured -->\n", "<!-- end of measured -->\n"
"""What the tables stand between, in the page."""

TARGETS = {
    "predict": {"met": "95 %", "gap": "0.80 / 0.60", "mean": "0.10", "p95": "0.25", "unclean": "0.5 %"},
    "measure": {"met": "98 %", "gap": "0.90 / 0.90", "mean": "0.05", "p95": "0.15", "unclean": "none"},
}  # fmt: skip

WORDS = {
    "shadow_map": "shadow maps", "perspective_shadow_map": "perspective shadow maps", "shadow_volume": "shadow volumes",
    "hybrid": "hybrid", "planar": "planar", "sweep": "sweep",
}  # fmt: skip


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
        [family, len(its), len({view["terrain"] for view in its}), sum(len(view["rows"]) for view in its)]
        for family, its in families.items()
    ]
    whole = ["all", len(views), len({view["terrain"] for view in views}), sum(len(view["rows"]) for view in views)]
    goals = ", ".join(goal.name for goal in GOALS)
    text = (
        f"\nEach view counts once with each of {len(GOALS)} targets ({goals}): {len(GOALS) * len(views)} instances, measured on\n"
        f"{views[0]['renderer']}."
    )
    late = lateness(views)
    if late.size:
        kept, most = percent(float(np.mean(late <= 1.0))), percent(max(float(late.max()) - 1.0, 0.0))
        text += (
            " `measure` is judged without the time limit: it chose in another hour than that in\n"
            "which the plans were timed, and the machine's speed changes. By the plans' times its choices\n"
            f"kept to the limit in {kept} of the views, and were {most} late at most."
        )
    text += "\n\n"
    return text + _table(["family", "views", "terrains", "plans measured"], [*rows, whole])


def _policies(views: Sequence[Figures], made: Split) -> str:
    found = {policy: verdict(views, made, policy) for policy in made.taken}
    planned = {policy: verdict(views, made, policy, with_plans=True) for policy in made.taken if policy != "measure"}
    first = next(iter(found.values()))
    best = max(made.best, key=made.best.__getitem__)
    heads = ["quantity", "single best", *found, "target: predict", "target: measure"]

    def row(name: str, key: str, of: Any, single: str = "") -> list[str]:
        targets = [TARGETS[policy].get(key, "") for policy in ("predict", "measure")]
        return [name, single, *map(of, found.values()), *targets]

    def ratio(value: float) -> str:
        return f"{value:.2f}"

    rows = [
        row("target met", "met", lambda its: percent(its.met), percent(first.single_met)),
        row("gap closed", "gap", _gap),
        row("relative regret, mean", "mean", lambda its: ratio(its.regret), ratio(first.single - 1.0)),
        row("relative regret, p95", "p95", lambda its: ratio(its.regret_p95)),
        row("of the picks that met their target: mean", "", lambda its: ratio(its.regret_met)),
        row("p95", "", lambda its: ratio(its.regret_met_p95)),
        row("interior error though a clean row met the target", "unclean", lambda its: percent(its.unclean)),
    ]
    own = [ratio(planned[policy].regret) if policy in planned else "" for policy in found]
    rows.append(["relative regret with the time of planning, mean", "", *own, "", ""])
    often = f"`{best}` in {made.best[best]} of {sum(made.best.values())} parts"
    return f"\n**{made.name[0].upper()}{made.name[1:]}.** The single best is {often}.\n\n" + _table(heads, rows)


def _parts(views: Sequence[Figures], made: Split) -> str:
    """Targets met of those that can be, by target and by family; families without the limit of time."""
    able = [one for one in instances_of(views) if any(map(one.meets, one.rows))]
    parts = {goal.name: [one for one in able if one.goal.name == goal.name] for goal in GOALS}
    for one in able:
        if one.max_ms is None:
            parts.setdefault(one.view["family"], []).append(one)

    def met(policy: str, part: Sequence[Instance]) -> str:
        its = made.taken[policy]
        rows = [(one, its[key]) for one in part if (key := (one.view["name"], one.goal.name)) in its]
        return f"{sum(one.meets(row) for one, row in rows)} of {len(rows)}" if rows else ""

    rows = [[name, *(met(policy, part) for policy in made.taken)] for name, part in parts.items()]
    text = "\nTargets met of those that some plan meets (held-out views), by target, and by family without the limit of time:\n\n"
    return text + _table(["target or family", *made.taken], rows)


def _gap(its: Verdict) -> str:
    return "no gap to speak of" if its.gap_closed is None else f"{its.gap_closed:.2f}"


def _worst(views: Sequence[Figures], made: Sequence[Split]) -> str:
    rows = [
        [policy, view, goal, f"`{taken}`", f"{regret:.1f}"]
        for policy in made[0].taken
        for view, goal, taken, regret in verdict(views, made[0], policy).worst
    ]
    return "\nThe worst picks (held-out views):\n\n" + _table(["policy", "view", "target", "taken", "relative regret"], rows)


def _marginal(views: Sequence[Figures]) -> str:
    instances = instances_of(views)
    rows = []
    for name, (gain, share) in marginal(instances, list(WORDS)).items():
        wins = [one for one in instances if name in one.rows[min(one.losses(), key=one.losses().__getitem__)]["algorithms"]]
        where = f"{wins[0].view['name']}, {wins[0].goal.name}" if wins else "nowhere"
        rows.append([WORDS[name], f"{gain:.3f}", percent(share), where])
    return "\nWhat each algorithm adds to the virtual best:\n\n" + _table(
        ["algorithm", "mean loss more without it", "takes part in the best", "for example"], rows
    )


def _times(views: Sequence[Figures], device: DeviceProfile) -> str:
    cases, rows = [case for view in views for case in cases_of(view)], []
    for name in WORDS:
        off = errors_of_time(cases, device, lambda case, name=name: name in case.algorithms)
        rows.append([WORDS[name], len(off), percent(float(np.median(np.abs(off)))), f"{100.0 * np.median(off):+.0f} %"])
    off = errors_of_time(cases, device)
    rows.append(["all", len(off), percent(float(np.median(np.abs(off)))), f"{100.0 * np.median(off):+.0f} %"])
    plan_ms = [view["plan_ms"] for view in views]
    text = "\nExpected times against those measured; none of these scenes is among those that the device is calibrated with:\n\n"
    text += _table(["plans with", "number", "median error", "median bias"], rows)
    return text + (
        f"\nDescribing a warm scene and choosing takes {np.median(plan_ms):.0f} ms in the median,"
        f"\n{np.quantile(plan_ms, 0.9):.0f} ms in nine of ten views and {max(plan_ms):.0f} ms at most.\n\n"
    )


def _table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    lines = [list(map(str, heads)), ["---"] * len(heads), *(list(map(str, row)) for row in rows)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
