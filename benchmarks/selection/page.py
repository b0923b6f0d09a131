"""The measured tables of docs/reports/selection.md, formatted from the table of measurements in the repository."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.selection.fit import cases_of
from benchmarks.selection.judge import GOALS, GoalInstance, PolicyScore, instances_of, marginal_values, score_choices
from benchmarks.selection.policies import BUDGET_S, Split, errors_of_time, splits
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.formatting import format_percent
from skugga.shadows.registry import selectable_algorithms

Figures = dict[str, Any]
"""A measured view's record by key."""

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
"""The aims of each policy as texts: least share of met targets, least closed share of the gap, and largest regret (mean, 95th
percentile)."""

ALGORITHM_TITLES = {each.name: each.plural_name for each in selectable_algorithms()}
"""Plural names of the algorithms for readers, by name."""


def page(views: Sequence[Figures], device: DeviceProfile) -> str:
    """Format all tables as Markdown. ``views`` are all records of the file, and ``device`` is the calibration of their device."""
    all_splits = splits(views, device)
    parts = [
        _instances_text(views),
        *(_policies(split) for split in all_splits),
        _anytime(all_splits),
        _met_shares(all_splits[0]),
        _probes(all_splits),
        _worst(all_splits),
        _marginal(views),
        _times(views, device),
    ]
    return "\n".join(parts)


def with_tables(text: str, tables: str) -> str:
    """Replace the measured tables in the text of a page."""
    before, rest = text.split(START)
    _, after = rest.split(END)
    return before + START + tables + END + after


def _instances_text(views: Sequence[Figures]) -> str:
    """Format the numbers of views, terrains and plans by family, and the number of decidable instances."""
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
    decidable = [instance for instance in instances if instance.is_decidable]
    text = (
        f"\nEach view counts once with each of {len(GOALS)} targets ({goals}): {len(instances)} instances, measured on\n"
        f"{views[0]['renderer']}. In {len(instances) - len(decidable)} of them the target lies under three noise floors of truth:\n"
        f"they are a class of their own. Of the other {len(decidable)}, some plan meets "
        f"{sum(instance.can_be_met for instance in decidable)}.\n\n"
    )
    return text + markdown_table(["family", "views", "terrains", "plans measured"], [*rows, total_row]) + _origins_text(views)


def _origins_text(views: Sequence[Figures]) -> str:
    """Format dates and commits of the figures, and the sizes of the pictures."""
    lines = []
    for step, title in {"compared": "Errors", "timed": "Times", "probed": "Probes"}.items():
        origins = [view[step] for view in views if step in view]
        days = sorted({origin["date"][:10] for origin in origins})
        commits = ", ".join(f"`{commit}`" for commit in dict.fromkeys(origin["commit"] for origin in origins))
        lines.append(f"{title}: {' to '.join(dict.fromkeys((days[0], days[-1])))}, at {commits}." if origins else f"{title}: none.")
    return "\n" + "\n".join(lines) + "\nPerspective views have 640 x 512 pixels (dense wood 320 x 256), maps 512 x 512.\n"


def _policies(split: Split) -> str:
    """Format the scores of the policies on decidable instances, and then by other rules of counting."""
    decidable = [instance for instance in split.instances if instance.is_decidable]
    free = [instance for instance in decidable if instance.max_ms is None]
    rows = []
    for policy in split.choices:
        rows.append(_score_row(policy, score_choices(decidable, split.choices[policy], split.single), TARGETS.get(policy, {})))
        name = f"{policy}, no limit of time"
        rows.append(_score_row(name, score_choices(free, split.choices[policy], split.single), TARGETS.get(name, {})))
    heads = [
        "policy", "targets met (95 % interval)", "gap closed", "relative regret: mean (95 % interval)", "median", "p95",
        "mean where met", "interior error though a clean row met the target", "aims: met, gap closed, mean, p95",
    ]  # fmt: skip
    text = f"\n**{split.name[0].upper()}{split.name[1:]}.** {len(decidable)} instances with decidable targets.\n\n"
    return text + markdown_table(heads, rows) + "\n" + _alternative_scores(split) + _singles(split)


def _score_row(name: str, score: PolicyScore, aims: Mapping[str, str]) -> list[str]:
    """Return the cells of a policy in the table of scores. ``aims`` is its entry in ``TARGETS``."""
    low, high = score.met_interval
    aim = ", ".join(aims.get(key, "-") for key in ("met", "gap", "mean", "p95")) if aims else ""
    return [
        name, f"{100.0 * score.met:.1f} % ({100.0 * low:.1f} to {100.0 * high:.1f})", _format_gap(score),
        f"{score.regret:.2f} ({score.regret_interval[0]:.2f} to {score.regret_interval[1]:.2f})", f"{score.regret_median:.2f}",
        f"{score.regret_p95:.2f}", f"{score.regret_met:.2f}", format_percent(score.needless_interior_error_share), aim,
    ]  # fmt: skip


def _alternative_scores(split: Split) -> str:
    """Format the same choices by other rules of counting."""
    decidable = [instance for instance in split.instances if instance.is_decidable]
    loose = list(split.instances)
    met = [instance for instance in decidable if instance.can_be_met]

    def own_ms(instance: GoalInstance, frames: int) -> float:
        return 1000.0 * split.probe_s[instance.view["name"], instance.goal.name] / frames

    rows = []
    for policy, choices in split.choices.items():
        strict = score_choices(decidable, choices, split.single, strict=True)
        able = score_choices(met, choices, split.single)
        all_score = score_choices(loose, choices, split.single)
        paid = [
            score_choices(decidable, choices, split.single, lambda instance, frames=frames: own_ms(instance, frames))
            for frames in (1, 1000)
        ]
        rows.append([
            policy, f"{strict.regret:.2f}", _format_gap(strict), f"{able.regret:.2f}",
            f"{100.0 * all_score.met:.1f} %, {all_score.regret:.2f}, {_format_gap(all_score)}",
            f"{paid[0].regret:.1f}, {paid[1].regret:.2f}" if policy == "probe" else "",
        ])  # fmt: skip
    heads = [
        "policy", "strict: mean regret", "strict: gap closed", "mean regret where some plan meets the target",
        "all instances, targets loosened to three noise floors: met, mean regret, gap closed",
        "mean regret with the time of the probe, for 1 frame, for 1,000",
    ]  # fmt: skip
    return "Counted otherwise (strict: a miss costs ten times the slowest row of the view):\n\n" + markdown_table(heads, rows)


def _singles(split: Split) -> str:
    """Format the single best (the choice with the least mean loss over views) of each goal."""
    best: dict[str, tuple[str, int]] = {}
    for name, parts in split.best.items():
        goal, choice = name.split(": ", 1)
        if parts > best.get(goal, ("", 0))[1]:
            best[goal] = choice, parts
    named = "; ".join(f"{goal}: `{choice}`" for goal, (choice, _) in best.items())
    score = score_choices([instance for instance in split.instances if instance.is_decidable], split.single, split.single)
    return (
        f"\nThe single best of each target, refitted with each part left out (most often {named}), meets\n"
        f"{format_percent(score.met)} with a mean relative regret of {score.regret:.2f}.\n"
    )


def _anytime(all_splits: Sequence[Split]) -> str:
    """Format the value of longer probes, with and without views of dense woods, whose frames take a second."""
    rows = []
    for split in all_splits:
        decidable = [instance for instance in split.instances if instance.is_decidable]
        for budget, choices in [
            ("none (`predict`)", split.choices["predict"]),
            *split.by_budget.items(),
            ("no limit (`measure`)", split.choices["measure"]),
        ]:
            for kind, subset in (
                ("all", decidable),
                ("without dense wood", [instance for instance in decidable if instance.view["family"] != DENSE]),
            ):
                if kind == "all" or len(subset) < len(decidable):
                    score = score_choices(subset, choices, split.single)
                    cells = [f"{100.0 * score.met:.1f} %", f"{score.regret:.2f}", f"{score.regret_p95:.2f}", _format_gap(score)]
                    rows.append([split.name, budget, kind, *cells])
    heads = ["split", "time of the probe", "views", "targets met", "mean relative regret", "p95", "gap closed"]
    return "\nWhat more time is worth:\n\n" + markdown_table(heads, rows)


def _met_shares(split: Split) -> str:
    """Format how many of the feasible targets each policy meets, by target and by family of scenes.

    The shares by family only count targets without a limit of time.
    """
    able = [instance for instance in split.instances if instance.is_decidable and instance.can_be_met]
    parts = {goal.name: [instance for instance in able if instance.goal.name == goal.name] for goal in GOALS}
    for instance in able:
        if instance.max_ms is None:
            parts.setdefault(instance.view["family"], []).append(instance)

    def met(policy: str, part: Sequence[GoalInstance]) -> str:
        choices = split.choices[policy]
        return (
            f"{sum(instance.meets(choices[instance.view['name'], instance.goal.name]) for instance in part)} of {len(part)}"
            if part
            else ""
        )

    rows = [[name, *(met(policy, part) for policy in split.choices)] for name, part in parts.items()]
    text = "\nTargets met of those that some plan meets (held-out views), by target, and by family without the limit of time:\n\n"
    return text + markdown_table(["target or family", *split.choices], rows)


def _probes(all_splits: Sequence[Split]) -> str:
    """Format the time of probes, and the number of options that they draw."""
    rows = []
    for split in all_splits:
        for kind in ("perspective", "map"):
            keys = [
                (instance.view["name"], instance.goal.name)
                for instance in split.instances
                if instance.view["descriptor"]["view_kind"] == kind and split.drawn[instance.view["name"], instance.goal.name]
            ]
            if keys:
                seconds, draw_counts = (np.array([values[key] for key in keys]) for values in (split.probe_s, split.drawn))
                rows.append([
                    f"{split.name}, {kind}", len(keys), f"{np.median(seconds):.2f} s", f"{np.quantile(seconds, 0.9):.2f} s",
                    f"{seconds.max():.1f} s", f"{np.mean(draw_counts):.1f}",
                ])  # fmt: skip
    text = f"\nWhat a probe of {BUDGET_S:g} s takes (pictures of 640 x 512 pixels, blocks of a map; one draw is always made):\n\n"
    return text + markdown_table(["views", "instances", "median", "nine of ten", "most", "options drawn, mean"], rows)


def _format_gap(score: PolicyScore) -> str:
    """Format the closed share of the gap between single best and virtual best."""
    return "gap too small to report" if score.gap_closed is None else f"{score.gap_closed:.2f}"


def _worst(all_splits: Sequence[Split]) -> str:
    """Format the choices with the largest regret of each policy, on held-out views."""
    decidable = [instance for instance in all_splits[0].instances if instance.is_decidable]
    rows = [
        [policy, view, goal, f"`{row_name}`", f"{regret:.1f}"]
        for policy, choices in all_splits[0].choices.items()
        for view, goal, row_name, regret in score_choices(decidable, choices, all_splits[0].single).worst
    ]
    heads = ["policy", "view", "target", "taken", "relative regret"]
    return "\nThe worst choices (held-out views):\n\n" + markdown_table(heads, rows)


def _marginal(views: Sequence[Figures]) -> str:
    """Format how much each algorithm adds to the virtual best, with one view that it wins."""
    instances = instances_of(views)
    rows = []
    for name, (gain, share) in marginal_values(instances, list(ALGORITHM_TITLES)).items():
        wins = [
            instance
            for instance in instances
            if name in instance.rows[min(instance.losses(), key=instance.losses().__getitem__)]["algorithms"]
        ]
        example = f"{wins[0].view['name']}, {wins[0].goal.name}" if wins else "nowhere"
        rows.append([ALGORITHM_TITLES[name], f"{gain:.3f}", format_percent(share), example])
    return "\nWhat each algorithm adds to the virtual best:\n\n" + markdown_table(
        ["algorithm", "mean loss more without it", "takes part in the best", "for example"], rows
    )


def _times(views: Sequence[Figures], device: DeviceProfile) -> str:
    """Format the errors of expected times as shares of measured times, and the time of planning."""
    cases, rows = [case for view in views for case in cases_of(view)], []
    for name in ALGORITHM_TITLES:
        deviations = errors_of_time(cases, device, lambda case, name=name: name in case.algorithms)
        rows.append(
            [
                ALGORITHM_TITLES[name],
                len(deviations),
                format_percent(float(np.median(np.abs(deviations)))),
                f"{100.0 * np.median(deviations):+.0f} %",
            ]
        )
    deviations = errors_of_time(cases, device)
    rows.append(
        ["all", len(deviations), format_percent(float(np.median(np.abs(deviations)))), f"{100.0 * np.median(deviations):+.0f} %"]
    )
    plan_ms = [view["plan_ms"] for view in views]
    text = "\nExpected times against those measured; none of these scenes is among those that the device is calibrated with:\n\n"
    text += markdown_table(["plans with", "number", "median error", "median bias"], rows)
    return text + (
        f"\nDescribing a warm scene and choosing takes {np.median(plan_ms):.0f} ms in the median,"
        f"\n{np.quantile(plan_ms, 0.9):.0f} ms in nine of ten views and {max(plan_ms):.0f} ms at most.\n\n"
    )


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return the text of a Markdown table."""
    lines = [list(map(str, heads)), ["---"] * len(heads), *(list(map(str, row)) for row in rows)]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)
