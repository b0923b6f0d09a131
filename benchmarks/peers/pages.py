"""Format the tables and the verdict of `benchmarks.peers` from its results. This module measures nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from benchmarks.peers.figures import (
    CLOCKS,
    PeerComparison,
    ToolRecord,
    ToolStanding,
    dominated_results,
    standings_by_case,
    unmatched_results,
)
from benchmarks.report_pages import Provenance, format_provenance
from benchmarks.seeds.claims import markdown_table


def format_percent(share: float) -> str:
    """Format a share in per cent with two significant digits; an exact zero as 0."""
    value = 100.0 * share
    return "0" if value == 0.0 else f"{value:.2f}" if value >= 0.1 else f"{value:.1g}" if value < 1e-3 else f"{value:.2g}"


def format_seconds(value: float) -> str:
    """Format seconds with two or three significant digits."""
    return (
        f"{value:.0f}" if value >= 10.0 else f"{value:.1f}" if value >= 2.0 else f"{value:.2f}" if value >= 0.1 else f"{value:.3f}"
    )


def format_range(values: Iterable[float], format_value: Callable[[float], str]) -> str:
    """Format the smallest and the largest value."""
    values = list(values)
    lowest, highest = format_value(min(values)), format_value(max(values))
    return lowest if lowest == highest else f"{lowest} to {highest}"


def upper_bound_prefix(comparison: PeerComparison, tool: ToolRecord) -> str:
    """Return the prefix that marks a tool's seconds of computing as an upper bound; empty if they are exact."""
    return "≤ " if comparison.has_upper_bounds(tool) else ""


def mean_wrong_share(comparison: PeerComparison, tool: ToolRecord, on_axis: bool) -> float:
    """Return a tool's mean share of wrong cells over rasters, for suns on or off the grid's axes and diagonals."""
    return float(np.mean([answer.wrong for answer in comparison.results_of(tool, on_axis=on_axis)]))


def time_table(comparison: PeerComparison) -> list[str]:
    """Format a line for each tool: seconds as ranges over the suns, memory, wrong cells."""
    rows = []
    for tool in comparison.tools:
        row = {"tool": tool.name, "version": tool.version, "how": tool.algorithm}
        for terrain in comparison.terrains:
            answers = comparison.results_of(tool, terrain.name)
            computing = format_range((comparison.compute_s(tool, answer) for answer in answers), format_seconds)
            row[f"{terrain.name}: computing s"] = upper_bound_prefix(comparison, tool) + computing if tool.casts else "-"
            row["whole s" if terrain is comparison.terrains[0] else "whole s "] = format_range(
                (answer.whole_s for answer in answers), format_seconds
            )
        row["peak MB"] = f"{max(answer.peak_mb for answer in comparison.results_of(tool)):.0f}"
        row["cores"] = f"{max(answer.cores for answer in comparison.results_of(tool)):.1f}"
        wrong_shares = [answer.wrong for answer in comparison.results_of(tool)] if tool.casts else []
        row["wrong %, on the axes"] = format_percent(mean_wrong_share(comparison, tool, True)) if wrong_shares else "-"
        row["off them"] = format_percent(mean_wrong_share(comparison, tool, False)) if wrong_shares else "-"
        row["worst"] = format_percent(max(wrong_shares)) if wrong_shares else "-"
        rows.append(row)
    return markdown_table(rows)


def error_table(comparison: PeerComparison) -> list[str]:
    """Format a line for each tool that casts shadows: false and missed shadow in every case."""
    return markdown_table([
        {"tool": tool.name}
        | {answer.case: (f"{format_percent(answer.false_shadow or 0)} / "
            f"{format_percent(answer.missed_shadow or 0)}") for answer in comparison.results_of(tool)}
        for tool in comparison.casting_tools
    ])  # fmt: skip


def short_table(comparison: PeerComparison) -> list[str]:
    """Format the short table: seconds for the largest raster, and means over the suns off the grid's axes and diagonals."""
    rows = []
    for tool in comparison.tools:
        if tool.ours and tool.name not in SHORT_TABLE_TOOLS:
            continue
        answers = comparison.results_of(tool, comparison.largest_raster.name, on_axis=False)
        computing, process_s = (float(np.mean([CLOCKS[clock](comparison, tool, answer) for answer in answers])) for clock in CLOCKS)
        rows.append({
            "mask of a DEM": f"**{tool.name}**" if tool.ours else tool.name if tool.casts else f"{tool.name} (casts none)",
            "computing, s": upper_bound_prefix(comparison, tool) + format_seconds(computing) if tool.casts else "-",
            "whole process, s": format_seconds(process_s),
            "wrong cells off the axes, %": format_percent(mean_wrong_share(comparison, tool, False)) if tool.casts else "-",
        })  # fmt: skip
    return markdown_table(rows)


def format_summary(comparison: PeerComparison) -> str:
    """Format what docs/peers.md has of the figures: the best peers beside Skugga's best rows, and the short table."""
    return "\n\n".join([_compare_best_peers(comparison), "\n".join(short_table(comparison))])


SHORT_TABLE_TOOLS = ("Skugga sweep, 1 line", "Skugga sweep, 8 lines")
"""Skugga's rows in the short table."""


def format_verdict(comparison: PeerComparison) -> str:
    """Describe whether Skugga is on the Pareto front of time and error among all tools, and the exceptions."""
    peers = [tool for tool in comparison.casting_tools if not tool.ours]
    if not peers:
        return "Open: there was no peer to compare with."
    exact_tools = [
        tool for tool in comparison.casting_tools if not any(answer.wrong for answer in comparison.results_of(tool, on_axis=True))
    ]
    names = ["Skugga" for tool in exact_tools if tool.ours][:1] + [tool.name for tool in exact_tools if not tool.ours]
    parts = [_pareto_text(comparison, clock, len(peers)) for clock in CLOCKS]
    if all(tool in exact_tools for tool in comparison.casting_tools if tool.ours):
        parts.append(f"On the axes these have no wrong cell in any row: {_join_names(names)}. Off the axes:")
    return "\n\n".join([*parts, _compare_best_peers(comparison)])


def _pareto_text(comparison: PeerComparison, clock: str, peers: int) -> str:
    """Format the verdict for one measure of time, a key of ``CLOCKS``. ``peers`` is the number of peers."""
    title, count = (
        f"**By the time of {'computing' if clock == 'computing' else 'the whole process'}:**",
        len(standings_by_case(comparison, clock)),
    )
    skugga_count = sum(tool.ours for tool in comparison.casting_tools)
    dominated, unmatched = dominated_results(comparison, clock), unmatched_results(comparison, clock)
    if not dominated:
        return (
            f"{title} Skugga lies on or beyond the Pareto front of all peers: in {count} cases none of the {peers} peers is both "
            f"faster and more accurate than any of its {skugga_count} rows."
        )
    dominated_text = "; ".join(f"{skugga_row} by {peer} ({case})" for skugga_row, peer, case in dominated)
    unmatched_text = "; ".join(f"{peer} ({case})" for peer, case in unmatched)
    return f"{title} of Skugga's {skugga_count} rows in {count} cases these are beaten in both at once: {dominated_text}. " + (
        f"Skugga does **not** lie on the front here: one peer beats all of its rows: {unmatched_text}."
        if unmatched
        else "No peer beats all of its rows in any case: there is a choice of lines that is at least as fast or as accurate."
    )


def _compare_best_peers(comparison: PeerComparison) -> str:
    """Compare the fastest peer with Skugga's fastest row, and the most accurate peer with Skugga's most accurate row.

    The figures are means over the suns off the grid's axes and diagonals.
    """
    standings = standings_by_case(comparison, "computing")["all, mean off the axes"]
    peer_standings, skugga_standings = (
        [standing for standing in standings if standing.tool.ours == is_skugga] for is_skugga in (False, True)
    )

    def line(metric: str, adjective: str) -> str:
        peer, skugga_standing = (
            min(group, key=lambda standing: getattr(standing, metric)) for group in (peer_standings, skugga_standings)
        )
        return (
            f"- the {adjective} peer is {peer.tool.name}: {format_seconds(peer.seconds)} s of computing, "
            f"{format_percent(peer.wrong)} % wrong; "
            f"Skugga's {adjective} row is {_line_count_text(skugga_standing)}: {format_seconds(skugga_standing.seconds)} s "
            f"({skugga_standing.seconds / peer.seconds:.2g} of that time), "
            f"{format_percent(skugga_standing.wrong)} % wrong;"
        )

    return "\n".join([line("seconds", "fastest"), line("wrong", "most accurate")]).removesuffix(";") + "."


def _line_count_text(standing: ToolStanding) -> str:
    """Return a row of Skugga's name without its prefix, such as "8 lines"."""
    return standing.tool.name.removeprefix("Skugga sweep, ")


def _join_names(names: list[str]) -> str:
    """Join at least one name to a list with "and"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def format_page(comparison: PeerComparison, image: str) -> str:
    """Format the report in Markdown. ``image`` is the picture's address relative to the report."""
    provenance = Provenance("python -m benchmarks.peers --python PATH", comparison.date, comparison.commit, comparison.where)
    parts = [
        "# Report: masks of a DEM, beside other tools",
        format_provenance(provenance),
        f"![Time of computing against wrong cells off the axes, each tool a point]({image})",
        "## The verdict",
        "Is there a peer that is both faster and more accurate? The question is put for each of Skugga's rows, in each raster\n"
        "under each sun, and for the means over the suns off the axes.",
        format_verdict(comparison),
        "## How it was measured",
        _method_text(comparison),
        "## Time, memory, accuracy",
        f"Seconds are ranges over the {len(comparison.terrains[0].under)} suns. Peak: memory of a tool's largest process.\n"
        "Cores: CPU time over wall time of the whole process, the largest ratio. Wrong: per cent of the decided\n"
        "cells, mean over rasters and suns, and the worst.",
        "\n".join(time_table(comparison)),
        "## Errors, case by case",
        "Raster, azimuth/altitude: false / missed shadow, per cent of the decided cells.",
        "\n".join(error_table(comparison)),
        "## Notes",
        "\n".join(f"- {note}" for note in _notes_text(comparison)),
    ]
    return "\n\n".join(parts) + "\n"


def _method_text(comparison: PeerComparison) -> str:
    """Format how rasters, suns, truth and times were chosen and measured."""
    rasters = "; ".join(
        f"{RASTER_TITLES[terrain.name]}: {terrain.cols} x {terrain.rows} cells of {terrain.cell_m:g} m, {terrain.lowest_m:.0f} to "
        f"{terrain.highest_m:.0f} m high"
        for terrain in comparison.terrains
    )
    suns = comparison.terrains[0].under
    on_axes, off_axes = (
        _join_names([f"{sun.azimuth_deg:g}/{sun.altitude_deg:g}" for sun in suns if (sun.azimuth_deg % 45.0 == 0.0) == axis])
        for axis in (True, False)
    )
    undecided = format_range((sun.undecided for terrain in comparison.terrains for sun in terrain.under), format_percent)
    shadow = format_range((sun.shadow for terrain in comparison.terrains for sun in terrain.under), format_percent)
    return f"""**Rasters.** {rasters}. Every tool gets the same GeoTIFF,
in a flat world, on a grid whose north is true north.

**Suns** (azimuth/altitude, degrees): {on_axes} on the grid's axes and diagonals, {off_axes} off them.
Only at multiples of 45 degrees does a line from cell to cell meet nothing but cell centres. A test of such suns alone hides errors.

**Truth.** Rays from the nodes through the triangles between them; quads are cut along their higher diagonals, as Skugga's are.
A cell is decided if the answer depends neither on the rays' offset, nor on a hundredth of a degree of the sun's altitude. For the
other tools, which cut quads in ways of their own, it must not depend on the diagonal either: by raster and sun, that leaves out
{undecided} % of the cells. Of the decided cells, {shadow} % lie in shadow.

**Time.** *Computing* is the time of the tool's call by its own clock, with compiled code warm. *Whole process* is wall-clock time:
start, imports, reading, computing, writing. Times are medians of {comparison.repeats}; a tool that takes over {comparison.slow_s:g}
s runs once. One process runs at a time, and the tools take turns. `≤` marks a bound: the tool does not report its computing time,
so the whole process is taken, less its least time for the small raster below. The verdict takes the bound for the time itself.
Seconds are comparable only with each other: {comparison.where}.

**Conventions.** Before the measurement, each tool shaded a block on a small flat floor under four suns: the shadow had to have the
right length and direction."""


RASTER_TITLES = {
    "Jacksboro": "*Jacksboro*, SRTM of the Jacksboro fault, warped bicubically to UTM 16N",
    "fractal": "*fractal*, mountains of spectral synthesis",
}
"""Descriptions of the rasters, by name."""


def _notes_text(comparison: PeerComparison) -> list[str]:
    """Return the notes on tools that ran, and on those that were left out."""
    tool_names = {tool.name for tool in comparison.tools}
    notes = [note for name, note in TOOL_NOTES if name in tool_names]
    if slower := [tool.name for tool in comparison.casting_tools if _low_sun_ratio(comparison, tool) > MIN_LOW_SUN_RATIO]:
        notes.append(
            "The lower the sun, the longer the shadows: on the largest raster computing takes more than "
            f"{MIN_LOW_SUN_RATIO:g} times as long under the lowest suns as under the highest with {_join_names(slower)}."
        )
    absent = [name for name, reason in comparison.left_out.items() if reason == "absent"]
    notes += [f"{name} was left out: {reason}." for name, reason in comparison.left_out.items() if reason != "absent"]
    if absent:
        notes.append(f"Absent when this was measured: {_join_names(absent)}.")
    return [*notes, EXCLUDED_TOOLS_NOTE]


MIN_LOW_SUN_RATIO = 2.0
"""Ratio of computing times, lowest to highest suns, above which a note names the tool."""


def _low_sun_ratio(comparison: PeerComparison, tool: ToolRecord) -> float:
    """Return the ratio of computing times under the lowest and the highest suns, on the largest raster."""
    answers = comparison.results_of(tool, comparison.largest_raster.name)
    altitudes_deg = [answer.altitude_deg for answer in answers]
    low, high = (
        sum(comparison.compute_s(tool, answer) for answer in answers if answer.altitude_deg == altitude_deg)
        for altitude_deg in (min(altitudes_deg), max(altitudes_deg))
    )
    return low / high if high else 1.0


TOOL_NOTES = [
    (
        "Skugga sweep, 8 lines",
        "Skugga's rows differ in the number of lines per cell that follow the sun's azimuth; the default is 8. They measure the "
        "sweep over an array, on all cores: `skugga render` and the tiles add projections, the earth's curvature and colours.",
    ),
    (
        "GRASS r.horizon",
        "r.horizon lowers far terrain by the earth's curvature, half the square of the distance by the earth's radius; truth here "
        "does not. Its whole process includes a session and a raster's import and export.",
    ),
    (
        "Whitebox Workflows",
        "Whitebox's `horizon_angle`, topocalc and r.horizon compute a horizon angle: one answer serves all altitudes of "
        "an azimuth, but no other azimuth. Its `shadow_image` takes a date and a place instead of a sun, and makes a picture.",
    ),
    ("SAGA ta_lighting", "SAGA runs in its mode `shadows only`, slim."),
    ("solweig", "solweig runs on the CPU."),
    (
        "gdaldem hillshade",
        "gdaldem hillshade casts no shadow: it shows the cost of a process that reads, compares neighbours and writes.",
    ),
]
"""Notes on tools, shown if they ran."""

EXCLUDED_TOOLS_NOTE = (
    "Not compared: tools without a package that installs by itself (HORAYZON, rayshader), those that need a GPU (xarray-spatial), "
    "a desktop or a licence (QGIS, ArcGIS, Blender), and GRASS r.sunmask, which is too slow for rasters of this size."
)
