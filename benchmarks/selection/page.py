"""The measured tables of docs/selection.md, from the table in the repository."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.selection.fit import cases_of
from benchmarks.selection.judge import GOALS, GoalInstance, PolicyScore, instances_of, judged, marginal
from benchmarks.selection.policies import BUDGET_S, Split, errors_of_time, splits
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.formatting import format_percent
from skugga.shadows.registry import selectable_algorithms

Figures = dict[str, Any]

DENSE = "dense wood"
"""The family of views whose targets use coverage."""

START, END = "<!-- measured -->\n", "<!-- end of measured -->\n"
"""The marks of the tables in the page."""

TARGETS = {
    "rules": {"met": "90 %"},
    "predict": {"met": "95 %"},
    "probe": {"met": "96.5 %", "gap": "0.90", "mean": "0.60", "p95": "2.00"},
    "probe, no limit of time": {"met": "99 %", "mean": "0.10"},
}  # fmt: skip
"""The targets."""

ALGORITHM_TITLES = {each.name: each.plural for each in selectable_algorithms()}


def page(views: Sequence[Figures], device: DeviceProfile) -> str:
    """Format all tables as Markdown."""
    made = splits(views, device)
    parts = [
        _what(views),
        *(_policies(each) for each in made),
        _anytime(made),
        _parts(made[0]),
        _probes(made),
        _worst(made),
        _marginal(views),
        _times(views, device),
    ]
    return "\n".join(parts)


def with_tables(text: str, tables: str) -> str:
    """Replace the tables of a page."""
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
    instances = instances_of(views)
    told = [one for one in instances if one.tellable]
    text = (
        f"\nEach view counts once with each of {len(GOALS)} targets ({goals}): {len(instances)} instances, measured on\n"
        f"{views[0]['renderer']}. In {len(instances) - len(told)} of them the target lies under three noise floors of truth:\n"
        f"they are a class of their own. Of the other {len(told)}, some plan meets {sum(one.can_be_met for one in told)}.\n\n"
    )
    return text + markdown_table(["family", "views", "terrains", "plans measured"], [*rows, total_row])


def _policies(made: Split) -> str:
    """Format the scores of the policies: first of decidable instances, then by other rules of counting."""
    told = [one for one in made.instances if one.tellable]
    free = [one for one in told if one.max_ms is None]
    rows = []
    for policy in made.taken:
        rows.append(_score_row(policy, judged(told, made.taken[policy], made.single), TARGETS.get(policy, {})))
        name = f"{policy}, no limit of time"
        rows.append(_score_row(name, judged(free, made.taken[policy], made.single), TARGETS.get(name, {})))
    heads = [
        "policy", "targets met (95 % interval)", "gap closed", "relative regret: mean (95 % interval)", "median", "p95",
        "mean where met", "interior error though a clean row met the target", "aims: met, gap closed, mean, p95",
    ]  # fmt: skip
    text = f"\n**{made.name[0].upper()}{made.name[1:]}.** {len(told)} instances whose targets can be told.\n\n"
    return text + markdown_table(heads, rows) + "\n" + _counted_otherwise(made) + _singles(made)


def _score_row(name: str, its: PolicyScore, aims: Mapping[str, str]) -> list[str]:
    low, high = its.met_interval
    aim = ", ".join(aims.get(key, "-") for key in ("met", "gap", "mean", "p95")) if aims else ""
    return [
        name, f"{100.0 * its.met:.1f} % ({100.0 * low:.1f} to {100.0 * high:.1f})", _gap(its),
        f"{its.regret:.2f} ({its.regret_interval[0]:.2f} to {its.regret_interval[1]:.2f})", f"{its.regret_median:.2f}",
        f"{its.regret_p95:.2f}", f"{its.regret_met:.2f}", format_percent(its.unclean), aim,
    ]  # fmt: skip


def _counted_otherwise(made: Split) -> str:
    """Format the same choices by other rules of counting."""
    told = [one for one in made.instances if one.tellable]
    loose = list(made.instances)
    met = [one for one in told if one.can_be_met]

    def own_ms(one: GoalInstance, frames: int) -> float:
        return 1000.0 * made.probe_s[one.view["name"], one.goal.name] / frames

    rows = []
    for policy, taken in made.taken.items():
        strict = judged(told, taken, made.single, strict=True)
        able = judged(met, taken, made.single)
        everything = judged(loose, taken, made.single)
        paid = [judged(told, taken, made.single, lambda one, frames=frames: own_ms(one, frames)) for frames in (1, 1000)]
        rows.append([
            policy, f"{strict.regret:.2f}", _gap(strict), f"{able.regret:.2f}",
            f"{100.0 * everything.met:.1f} %, {everything.regret:.2f}, {_gap(everything)}",
            f"{paid[0].regret:.1f}, {paid[1].regret:.2f}" if policy == "probe" else "",
        ])  # fmt: skip
    heads = [
        "policy", "strict: mean regret", "strict: gap closed", "mean regret where some plan meets the target",
        "all instances, targets loosened to three noise floors: met, mean regret, gap closed",
        "mean regret with the time of the probe, for 1 frame, for 1,000",
    ]  # fmt: skip
    return "Counted otherwise (strict: a miss costs ten times the slowest row of the view):\n\n" + markdown_table(heads, rows)


def _singles(made: Split) -> str:
    """Format the single best of each goal."""
    best: dict[str, tuple[str, int]] = {}
    for name, parts in made.best.items():
        goal, choice = name.split(": ", 1)
        if parts > best.get(goal, ("", 0))[1]:
            best[goal] = choice, parts
    named = "; ".join(f"{goal}: `{choice}`" for goal, (choice, _) in best.items())
    score = judged([one for one in made.instances if one.tellable], made.single, made.single)
    return (
        f"\nThe single best of each target, refitted with each part left out (most often {named}), meets\n"
        f"{format_percent(score.met)} with a mean relative regret of {score.regret:.2f}.\n"
    )


def _anytime(made: Sequence[Split]) -> str:
    """Format the value of more time, with dense woods (whose frames take a second) and without."""
    rows = []
    for each in made:
        told = [one for one in each.instances if one.tellable]
        for budget, taken in [*each.by_budget.items(), ("no limit (`measure`)", each.taken["measure"])]:
            for kind, its in (("all", told), ("without dense wood", [one for one in told if one.view["family"] != DENSE])):
                if kind == "all" or len(its) < len(told):
                    score = judged(its, taken, each.single)
                    cells = [f"{100.0 * score.met:.1f} %", f"{score.regret:.2f}", f"{score.regret_p95:.2f}", _gap(score)]
                    rows.append([each.name, budget, kind, *cells])
    heads = ["split", "time of the probe", "views", "targets met", "mean relative regret", "p95", "gap closed"]
    return "\nWhat more time is worth:\n\n" + markdown_table(heads, rows)


def _parts(made: Split) -> str:
    """Format the share of met targets that are feasible, by target and by family; families without the limit of time."""
    able = [one for one in made.instances if one.tellable and one.can_be_met]
    parts = {goal.name: [one for one in able if one.goal.name == goal.name] for goal in GOALS}
    for one in able:
        if one.max_ms is None:
            parts.setdefault(one.view["family"], []).append(one)

    def met(policy: str, part: Sequence[GoalInstance]) -> str:
        taken = made.taken[policy]
        return f"{sum(one.meets(taken[one.view['name'], one.goal.name]) for one in part)} of {len(part)}" if part else ""

    rows = [[name, *(met(policy, part) for policy in made.taken)] for name, part in parts.items()]
    text = "\nTargets met of those that some plan meets (held-out views), by target, and by family without the limit of time:\n\n"
    return text + markdown_table(["target or family", *made.taken], rows)


def _probes(made: Sequence[Split]) -> str:
    """Format the time of probes, and the number of options that they draw."""
    rows = []
    for each in made:
        for kind in ("perspective", "map"):
            keys = [
                (one.view["name"], one.goal.name)
                for one in each.instances
                if one.view["descriptor"]["view_kind"] == kind and each.drawn[one.view["name"], one.goal.name]
            ]
            if keys:
                seconds, drawn = (np.array([its[key] for key in keys]) for its in (each.probe_s, each.drawn))
                rows.append([
                    f"{each.name}, {kind}", len(keys), f"{np.median(seconds):.2f} s", f"{np.quantile(seconds, 0.9):.2f} s",
                    f"{seconds.max():.1f} s", f"{np.mean(drawn):.1f}",
                ])  # fmt: skip
    text = f"\nWhat a probe of {BUDGET_S:g} s takes (pictures of 640 x 512 pixels, blocks of a map; one draw is always made):\n\n"
    return text + markdown_table(["views", "instances", "median", "nine of ten", "most", "options drawn, mean"], rows)


def _gap(its: PolicyScore) -> str:
    return "no gap to speak of" if its.gap_closed is None else f"{its.gap_closed:.2f}"


def _worst(made: Sequence[Split]) -> str:
    told = [one for one in made[0].instances if one.tellable]
    rows = [
        [policy, view, goal, f"`{row_name}`", f"{regret:.1f}"]
        for policy, taken in made[0].taken.items()
        for view, goal, row_name, regret in judged(told, taken, made[0].single).worst
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
    """Return a table in Markdown, with line ends."""
    lines = [list(map(str, heads)), ["---"] * len(heads), *(list(map(str, row)) for row in rows)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
