"""Price of accuracy in time, over all measured views: a sentence for the README, and a table and a figure for the docs.

For each view the price of a goal is a ratio of two times. The first is that of the cheapest plan that meets the goal. The second is
that of the cheapest plan that meets the loosest goal. Plans meet a goal by the rule of ``benchmarks.selection.judge``. Where one
plan is the cheapest for both, accuracy is free: a median over such views would say nothing, so they are counted separately. So are
views where no plan meets both goals, or where truth is too noisy to tell. The sentence compares each view's loosest goal with the
finest one that can be told and met there, so that views with noisy truth (woods) count with the goals that they can be judged by.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from benchmarks.selection.judge import GOALS, Goal, instances_of
from skugga.selector.cost.device_profile import DeviceProfile

LOOSEST_GOAL, *FINER_GOALS = [goal for goal in GOALS if goal.time_share is None]
"""The reference goal of prices, and the goals that have a price."""

ROOT = Path(__file__).parents[2]

README, PAGE, FIGURE = ROOT / "README.md", ROOT / "docs" / "accuracy.md", ROOT / "docs" / "images" / "cost-of-accuracy.svg"

MARK_NAME = "cost of accuracy"
"""Name in the HTML comments that mark the replaced text of README and page."""

TEXT_COLOR, GRID_COLOR, GOAL_COLORS = "#333333", "#E4E4E4", ("#9CC3E6", "#3D87C4", "#0B3C68")
"""Colours of the figure: lighter is looser."""

MIN_VIEWS_OF_MEDIAN = 2
"""The least number of views for a median."""

Figures = dict[str, Any]
"""A measured view's record by key."""


@dataclass(frozen=True)
class PriceRatios:
    """Prices over some views.

    Attributes
    ----------
    ratios
        Time of the cheapest plan for the finer goal divided by that for the loosest goal, of each view where these are two plans.
    same_plan_views
        Number of views where the same plan is the cheapest for both goals, so that accuracy costs nothing.
    view_count
        Number of all views.
    """

    ratios: np.ndarray
    same_plan_views: int
    view_count: int

    @property
    def omitted_views(self) -> int:
        """Number of views without a plan for both goals, or whose truth is too noisy to tell."""
        return self.view_count - len(self.ratios) - self.same_plan_views

    @property
    def median(self) -> float:
        """The median of ``ratios``; NaN without any."""
        return float(np.median(self.ratios)) if self.ratios.size else np.nan

    @property
    def p90(self) -> float:
        """The 90th percentile of ``ratios``; NaN without any."""
        return float(np.quantile(self.ratios, 0.9)) if self.ratios.size else np.nan


@dataclass(frozen=True)
class Price(PriceRatios):
    """The price of a goal over some views.

    Attributes
    ----------
    goal
        The goal.
    """

    goal: Goal


def device_name(profile: DeviceProfile) -> str:
    """Return the name of a device for readers, such as "llvmpipe on 2 cores"."""
    return f"{profile.renderer.partition(' (')[0]} on {profile.cpus} cores"


def cheapest_rows(view: Figures) -> dict[str, tuple[str, float]]:
    """Return by goal the name and the milliseconds of the row of the cheapest plan that meets it.

    Goals that no plan meets are omitted. So are goals that cannot be decided because of the noise of truth.
    """
    result = {}
    for instance in instances_of([view], [LOOSEST_GOAL, *FINER_GOALS]):
        name = instance.cheapest
        if name is not None and instance.is_decidable:
            result[instance.goal.name] = name, instance.rows[name]["ms"]
    return result


def prices(views: Sequence[Figures]) -> list[Price]:
    """Return the price of each goal that is finer than the loosest one, over some views."""
    cheapest = [cheapest_rows(view) for view in views]
    result = []
    for goal in FINER_GOALS:
        pairs = [(rows[LOOSEST_GOAL.name], rows[goal.name]) for rows in cheapest if LOOSEST_GOAL.name in rows and goal.name in rows]
        ratios = [fine_ms / loose_ms for (loose, loose_ms), (fine, fine_ms) in pairs if fine != loose]
        result.append(Price(np.array(sorted(ratios)), len(pairs) - len(ratios), len(views), goal))
    return result


@dataclass(frozen=True)
class FinestPrice(PriceRatios):
    """The price, over some views, of each view's finest goal: the finest that truth can tell and that some plan meets.

    Attributes
    ----------
    views_by_goal
        Number of compared views by the name of their finest goal.
    """

    views_by_goal: dict[str, int]


def finest_price(views: Sequence[Figures]) -> FinestPrice:
    """Return the price of each view's finest goal, over some views."""
    ratios, same_plan_views, views_by_goal = [], 0, {goal.name: 0 for goal in reversed(FINER_GOALS)}
    for rows in map(cheapest_rows, views):
        finest = next((goal.name for goal in reversed(FINER_GOALS) if goal.name in rows), None)
        if finest is None or LOOSEST_GOAL.name not in rows:
            continue
        views_by_goal[finest] += 1
        (loose, loose_ms), (fine, fine_ms) = rows[LOOSEST_GOAL.name], rows[finest]
        if fine == loose:
            same_plan_views += 1
        else:
            ratios.append(fine_ms / loose_ms)
    return FinestPrice(np.array(sorted(ratios)), same_plan_views, len(views), views_by_goal)


def views_by_family(views: Sequence[Figures]) -> dict[str, list[Figures]]:
    """Group views by kind of scene (family)."""
    result: dict[str, list[Figures]] = {}
    for view in views:
        result.setdefault(view["family"], []).append(view)
    return result


def format_sentence(views: Sequence[Figures], device: str) -> str:
    """Describe the price of accuracy in time, over all views and by kind of scene. ``device`` is the name of the device."""
    price = finest_price(views)
    by_family = [(name, finest_price(family_views)) for name, family_views in views_by_family(views).items()]
    priced = [f"{name}: {of_family.median:.1f}" for name, of_family in by_family if len(of_family.ratios) >= MIN_VIEWS_OF_MEDIAN]
    reached = ", ".join(f"{goal} in {count}" for goal, count in price.views_by_goal.items() if count)
    omitted = ", ".join(f"{name}: {of_family.omitted_views}" for name, of_family in by_family if of_family.omitted_views)
    return (
        f"**What accuracy costs:** in {price.same_plan_views} of {price.view_count} measured views nothing: the fastest shadows of "
        f"which at most {LOOSEST_GOAL.name} is wrong are right to the finest share, too, that ray-traced truth can tell and some "
        f"plan reaches ({reached} views). In {len(price.ratios)} views it has a price: shadows right to that share take "
        f"{price.median:.1f} times as long in the median, and more than {price.p90:.1f} times in one view of ten (medians by kind "
        f"of scene, where it has a price: {'; '.join(priced)}; {device}). The other {price.omitted_views} are left out, since "
        f"truth tells nothing finer than {LOOSEST_GOAL.name} there, or no plan reaches {FINER_GOALS[0].name} ({omitted})."
    )


def format_table(views: Sequence[Figures]) -> str:
    """Return median and 90th percentile of the prices by kind of scene, as Markdown."""
    lines = [
        "| kind of scene | views | "
        f"{' | '.join(f'{goal.name}: median, 90th percentile (views), free in' for goal in FINER_GOALS)} |",
        "| --- | --- |" + " --- |" * len(FINER_GOALS),
    ]
    for name, family_views in [*views_by_family(views).items(), ("all", list(views))]:
        cells = [
            (
                f"{price.median:.2f}, {price.p90:.2f} ({len(price.ratios)}), {price.same_plan_views}"
                if price.ratios.size
                else f"none, {price.same_plan_views}"
            )
            for price in prices(family_views)
        ]
        lines.append(f"| {name} | {len(family_views)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def replace_between_marks(text: str, part: str) -> str:
    """Replace the text between the comments of ``MARK_NAME`` in the page ``text`` by ``part``.

    Raises ``ValueError`` if the page lacks the comments.
    """
    start, end = f"<!-- {MARK_NAME} -->\n", f"<!-- end of {MARK_NAME} -->\n"
    if not (start in text and end in text):
        raise ValueError(f"the page has no {start.strip()} and {end.strip()}")
    return re.sub(f"{re.escape(start)}.*?{re.escape(end)}", lambda _: start + part + end, text, count=1, flags=re.DOTALL)


def wrap_paragraph(text: str, width: int = 132) -> str:
    """Wrap a paragraph to lines of at most ``width`` characters. Words are never cut."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > width:
            lines.append("")
        lines[-1] += (" " if lines[-1] else "") + word
    return "\n".join(lines) + "\n"


def figure_svg(views: Sequence[Figures]) -> str:
    """Return the figure: a point for each kind of scene, goal and view, medians as bars; prices increase to the right.

    Kinds without a price appear only in the table.
    """
    kinds = [
        (name, family_views)
        for name, family_views in views_by_family(views).items()
        if any(price.ratios.size for price in prices(family_views))
    ]
    kinds.append(("all", list(views)))
    style = {
        "font.family": "DejaVu Sans",
        "font.size": 10,
        "text.color": TEXT_COLOR,
        "axes.edgecolor": TEXT_COLOR,
        "svg.hashsalt": "skugga",
    }
    with mpl.rc_context(style):
        figure = Figure(figsize=(9.4, 0.62 * len(kinds) + 1.5), layout="constrained")
        axes = figure.subplots()
        for row, (_, family_views) in enumerate(kinds):
            _draw_prices(axes, row, prices(family_views))
        _style_axes(axes, [name for name, _ in kinds])
        out = io.StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None})
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()) + "\n"


def write_cost_of_accuracy(views: Sequence[Figures], device: str) -> None:
    """Write the sentence into README and the page on accuracy, there with the table, and draw the figure.

    ``device`` is the name of the device that measured the views.
    """
    text = wrap_paragraph(format_sentence(views, device))
    for path, part in ((README, text), (PAGE, f"{text}\n{format_table(views)}")):
        path.write_text(replace_between_marks(path.read_text(encoding="utf-8"), part), encoding="utf-8")
    FIGURE.write_text(figure_svg(views), encoding="utf-8")


def _draw_prices(axes: Axes, row: int, family_prices: Sequence[Price]) -> None:
    """Draw one kind of scene in the figure, a line of points for each goal.

    ``row`` is the kind's index from the top. ``family_prices`` has a price for each of ``FINER_GOALS``.
    """
    for number, (price, colour) in enumerate(zip(family_prices, GOAL_COLORS, strict=True)):
        y = row + 0.24 * (number - 1)
        axes.plot(price.ratios, np.full(len(price.ratios), y), ".", color=colour, markersize=7, alpha=0.6, markeredgewidth=0)
        if len(price.ratios) >= MIN_VIEWS_OF_MEDIAN:
            axes.plot([price.median] * 2, [y - 0.1, y + 0.1], color=colour, linewidth=3.2, solid_capstyle="butt")
            axes.plot([price.median, price.p90], [y, y], color=colour, linewidth=1.2)


def _style_axes(axes: Axes, names: Sequence[str]) -> None:
    """Set scales, ticks, labels and legend of the figure. ``names`` are the kinds of scene from the top."""
    axes.set(xscale="log", ylim=(len(names) - 0.5, -0.5), yticks=range(len(names)), yticklabels=names)
    ticks = [tick for tick in (1, 2, 5, 10, 20, 50, 100) if tick <= 1.4 * axes.get_xlim()[1]]
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g} x"))
    axes.set_xlabel(
        f"time of the fastest plan, as a multiple of that for {LOOSEST_GOAL.name} (bar: median, line: to the 90th percentile)"
    )
    axes.axvline(1.0, color=TEXT_COLOR, linewidth=0.8)
    axes.axhline(len(names) - 1.5, color=TEXT_COLOR, linewidth=0.8)
    axes.grid(axis="x", color=GRID_COLOR)
    axes.set_axisbelow(True)
    axes.tick_params(axis="y", length=0)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    for goal, colour in zip(FINER_GOALS, GOAL_COLORS, strict=True):
        axes.plot([], [], color=colour, linewidth=3.2, label=goal.name)
    axes.figure.legend(
        loc="outside upper right",
        ncols=len(FINER_GOALS),
        frameon=False,
        handlelength=1.2,
        title="of the cast shadow wrong, at most",
    )
    axes.set_title("What accuracy costs in time", loc="left", fontsize=13)
