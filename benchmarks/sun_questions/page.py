"""Format the tables and verdicts of `sun_questions` from its results. This module measures nothing."""

from __future__ import annotations

from benchmarks.peers.figures import dominated_rows, unmatched_peers
from benchmarks.peers.pages import format_percent, format_seconds
from benchmarks.report_pages import Provenance, format_provenance
from benchmarks.seeds.claims import markdown_table
from benchmarks.sun_questions.day_hours import HOURS_QUESTION
from benchmarks.sun_questions.figures import ANSWER_CLOCKS, SunAnswer, SunComparison, tool_standings
from benchmarks.sun_questions.many_masks import ALTITUDE_TOLERANCE_DEG, MASKS_QUESTION
from benchmarks.sun_questions.one_horizon import AZIMUTH_STEP_DEG, HORIZON_QUESTION, TOPOCALC_AZIMUTH_STEP_DEG
from benchmarks.sun_questions.whole_rasters import (
    AZIMUTH_COUNT,
    FIRST_SAMPLE,
    RASTER_HORIZONS_QUESTION,
    REACHES_CELLS,
    SAMPLE_STRIDE,
    SKY_VIEW_QUESTION,
)

TITLES = {
    HOURS_QUESTION: "1. Hours of sun of a day",
    HORIZON_QUESTION: "2. The horizon at a point",
    MASKS_QUESTION: "3. 31 masks of a day",
    RASTER_HORIZONS_QUESTION: "4. Horizons of a whole raster",
    SKY_VIEW_QUESTION: "5. Sky view factors of a whole raster",
}

UNIT_BY_QUESTION = {
    HOURS_QUESTION: "minutes",
    HORIZON_QUESTION: "degrees",
    MASKS_QUESTION: "% of the cells",
    RASTER_HORIZONS_QUESTION: "degrees",
    SKY_VIEW_QUESTION: "% of the sky",
}


def format_error(question: str, value: float | None) -> str:
    """Format an error in the question's unit: minutes, degrees, or the share ``value`` of cells in per cent. ``None`` is "-"."""
    if value is None:
        return "-"
    if question == MASKS_QUESTION:
        return format_percent(value)
    return f"{value:.2f}" if value >= 0.1 or value == 0.0 else f"{value:.1g}"


def _format_seconds(value: float | None, answer: SunAnswer) -> str:
    """Format seconds of an answer, with "~" if they are extrapolated; ``None`` as "-"."""
    return "-" if value is None else f"{'~ ' if answer.scaled else ''}{format_seconds(value)}"


def answer_table(comparison: SunComparison, question: str) -> list[str]:
    """Format a line for each tool in each case."""
    rows = []
    answers = comparison.answers_to(question)
    for answer in answers:
        name = f"**{answer.tool}**" if answer.ours else answer.tool
        row = {"case": answer.case, "tool": name}
        if any(sun_answer.compute_s is not None for sun_answer in answers):
            row["computing, s"] = _format_seconds(answer.compute_s, answer)
        row["whole process, s"], row["its CPU time, s"] = (
            _format_seconds(answer.whole_s, answer),
            _format_seconds(answer.cpu_s, answer),
        )
        if any(sun_answer.peak_mb is not None for sun_answer in answers):
            row["memory, MB"] = "-" if answer.peak_mb is None else f"{answer.peak_mb:.0f}"
        row[f"wrong, {UNIT_BY_QUESTION[question]}"] = format_error(question, answer.wrong)
        if any(sun_answer.wrong_p99 is not None for sun_answer in answers):
            row["99 % under"] = format_error(question, answer.wrong_p99)
        if any(sun_answer.wrong_in_reach is not None for sun_answer in answers):
            row["wrong within its reach"] = format_error(question, answer.wrong_in_reach)
        if any(sun_answer.wrong_as_is is not None for sun_answer in answers):
            row["wrong as it is"] = format_error(question, answer.wrong_as_is)
        rows.append(row)
    return markdown_table(rows)


def format_verdict(comparison: SunComparison, question: str) -> str:
    """Describe for each clock which peers are both faster and more accurate than rows of Skugga, or better in one respect."""
    peers = {answer.tool for answer in comparison.answers_to(question) if not answer.ours and answer.wrong is not None}
    if not peers or not any(answer.ours for answer in comparison.answers_to(question)):
        return "Open: there was nothing to compare with."
    lines = []
    for clock in ANSWER_CLOCKS:
        case_standings = tool_standings(comparison, question, clock)
        if not case_standings:
            continue
        dominated, unmatched = dominated_rows(case_standings), unmatched_peers(case_standings)
        dominated_text = "; ".join(f"{skugga_row} by {peer} ({case})" for skugga_row, peer, case in dominated)
        text = (
            f"in {len(case_standings)} case{'s' * (len(case_standings) > 1)} no peer is both faster and more accurate than any row "
            f"of Skugga's."
            if not dominated
            else f"beaten in both at once: {dominated_text}. "
            + (
                "**Not** on the front: " + "; ".join(f"{peer} beats every row ({case})" for peer, case in unmatched) + "."
                if unmatched
                else "No peer beats all of its rows in any case."
            )
        )
        lines.append(f"- **By {clock}:** {text}")
    return "\n".join([*lines, *_better_peers(comparison, question)])


def _better_peers(comparison: SunComparison, question: str) -> list[str]:
    """Describe which peers are better than every row of Skugga in one respect: accuracy, or time."""
    lines = [_better_peers_text(comparison, question, "wrong", "the whole process", "more accurate")]
    return lines + [_better_peers_text(comparison, question, "seconds", clock, f"faster by {clock}") for clock in ANSWER_CLOCKS]


def _better_peers_text(comparison: SunComparison, question: str, metric: str, clock: str, adjective: str) -> str:
    """Describe the peers that beat Skugga's best row in accuracy or time, with the number of cases and the largest factor.

    ``metric`` is a field of ``ToolStanding``, ``clock`` a key of ``ANSWER_CLOCKS``. ``adjective`` is the comparative in the text.
    """
    standings_by_case = tool_standings(comparison, question, clock)
    if not standings_by_case:
        return f"- {adjective[0].upper()}{adjective[1:]}: not measured."
    factors_by_tool: dict[str, list[float]] = {}
    for case_standings in standings_by_case.values():
        skugga_best = min(getattr(standing, metric) for standing in case_standings if standing.tool.ours)
        for standing in case_standings:
            value = getattr(standing, metric)
            if not standing.tool.ours and value < skugga_best:
                factors_by_tool.setdefault(standing.tool.name, []).append(skugga_best / value if value else float("inf"))
    if not factors_by_tool:
        return f"- {adjective[0].upper()}{adjective[1:]} than Skugga's best row: no peer, in any case."
    peers_text = "; ".join(
        f"{name} in {len(ratios)} of {len(standings_by_case)} cases, up to {max(ratios):.2g} times"
        for name, ratios in factors_by_tool.items()
    )
    return f"- {adjective[0].upper()}{adjective[1:]} than Skugga's best row: {peers_text}."


def check_table(comparison: SunComparison) -> list[str]:
    """Format a line for each tool: its hours of sun on a level floor, and its error before a cliff."""
    return markdown_table([
        {
            "tool": check.tool,
            "level floor, h": f"{check.floor_h:.3f}",
            "its sun's day, h": f"{check.day_h:.3f}",
            "floor is off, minutes": f"{(check.floor_h - check.day_h) * 60.0:+.1f}",
            "before a cliff wrong, minutes": f"{check.cliff_wrong_min:.1f}",
        }
        for check in comparison.checks
    ])  # fmt: skip


METHOD_BY_QUESTION = {
    HOURS_QUESTION: """\
21 March, rasters of which every tool gets the same GeoTIFF. Truth are rays every 10 seconds. `Wrong` is the mean over
the sampled cells of the minutes by which a tool differs from rays under *its own* sun, earth and horizon, so that only shadows
and steps of time are judged; `wrong as it is` the same beside astronomy's sun (NREL's, with refraction) on the round earth,
which is what a user gets. Computing: Skugga's `level.sun_hours` as an array, the second time; the call of `time_in_daylight`,
without reading; the modules r.sun and r.horizon on two threads, without import and export. Whitebox's share of the day is made
hours by the length of its own day.

Skugga's rows are of the commit above. Later that day long steps became more accurate ([hours of sun](sun-hours.md)), so these
rows are upper bounds.

GRASS is Debian's 8.2. Its r.horizon has a known fault: it returns negative horizons, some of them wrong, and r.sun is wrong
with such maps (OSGeo/grass, issue 2935). From 8.3 on it returns no negative horizons (pull request 2955). The row *horizons every
5°* is that of 8.2.""",
    HORIZON_QUESTION: f"""\
720 directions, every half degree, from a cell's middle on the ground. Truth is the exact profile in float64: every
crossing of the direction with the triangles' edges, to the raster's rim, on the round earth (for topocalc, which knows none, in
a flat world). Computing: one point of a level that is open and whose loops are compiled; the module r.horizon. Whole process:
`skugga point` with a horizon file, which reports the day as well. topocalc computes whole rasters:
{360.0 / TOPOCALC_AZIMUTH_STEP_DEG:.0f} directions are measured, and the seconds multiplied by \
{TOPOCALC_AZIMUTH_STEP_DEG / AZIMUTH_STEP_DEG:.0f} (`~`).
r.horizon takes a sample every `distance` cells' sides; 1 is its default. At a point GRASS 8.2 has a second fault, variables that
are not set, which later versions mend (OSGeo/grass, pull requests 3288 and 3441).""",
    MASKS_QUESTION: f"""\
31 times from the morning to the evening of 21 March, each mask written as a GeoTIFF. Other tools get each time's
azimuth and altitude, one process a mask. Wrong: per cent of the answers that are certain (the same under suns \
{ALTITUDE_TOLERANCE_DEG:g} degrees
lower and higher) at the sampled cells, beside rays: of each cell's sun on the round earth for Skugga, of the given angles in a flat
world for the others. *One process at best* is a bound, not a run: the computing of all masks and the least of everything else,
once. gdaldem hillshade casts no shadows, and is what a process costs. `~`: some of the suns were measured, and their seconds
multiplied; of *31 runs* one in three or five.""",
    RASTER_HORIZONS_QUESTION: f"""\
The horizon of every cell towards {AZIMUTH_COUNT} azimuths, one run of each tool. A process reads the raster, computes, and writes
all horizons (GRASS: as its own maps). Truth are rays from the middles of the sampled cells, as in question 2: all crossings with
rows, columns and both diagonals, to the rim. `Wrong` is beside rays as a tool defines its horizons: in a flat world, or on the
round earth for GRASS; and not below the level for topocalc and SurtGIS. Between four cells the ground is a convention: Skugga
cuts quads along their higher diagonals, ends the ground a cell beyond the outermost middles, and is judged by that; for each
other tool the better of both cuts counts, and its ground ends with the outermost middles.
`Wrong as it is` is beside the horizon on the round earth over the higher diagonals, which may be negative. Memory is the peak of
the largest process. `~`: {AZIMUTH_COUNT // SAMPLE_STRIDE} of the azimuths were measured, every \
{360 * SAMPLE_STRIDE // AZIMUTH_COUNT} degrees from {360 * FIRST_SAMPLE // AZIMUTH_COUNT} on, and the seconds of
computing multiplied; their errors and memory are those of these azimuths. GRASS is 8.2, whose r.horizon has a known fault with
negative horizons, mended in 8.3 (see question 1).""",
    SKY_VIEW_QUESTION: f"""\
{AZIMUTH_COUNT} azimuths for every tool, one run each. Each is judged by its own definition, of rays at the same azimuths. With h
the horizon, not below the level:

- `solid_angle`, 1 - mean sin h: Skugga, GRASS r.skyview, RVT, xarray-spatial.
- `cosine`, mean cos² h: Skugga, and SurtGIS, whose type stubs do not tell; it is close to that of its own horizons.
- `tilted`, the sky of the cell's own plane after Dozier and Frew (1990): Skugga, whose horizon is also that of the plane; SAGA;
  topocalc, which leaves out azimuths whose part is negative. Planes are as a tool fits them: Horn's for topocalc, central
  differences for SAGA and Skugga.

The earth is flat, but round for GRASS. Quads are cut as in question 4. `Wrong` is in hundredths of the whole sky, beside rays to
the rim. A tool's *cells* are how far it looks: RVT, xarray-spatial and SurtGIS look {REACHES_CELLS[0]} cells far unless told, and
their seconds grow with the distance; `wrong within its reach` is beside rays that end there. RVT mirrors the ground beyond the rim,
which counts as wrong. Memory is the peak of the largest process. r.skyview is an addon that could not be installed here: its two
steps, r.horizon and r.mapcalc, were run instead, by GRASS 8.2, whose r.horizon has a known fault with negative horizons, mended in
8.3 (see question 1). xarray-spatial compiles its loops in each process; Skugga's were compiled before. HORAYZON was not
measured.""",
}

CONVENTIONS = """What "hours" mean differs, and was looked at before: on a level floor a tool's hours must be the length of its day,
and to the west of a long cliff of 300 m those of the closed form.

- **Skugga**: NREL's sun, refraction included, the middle of its disc above the level plane through the cell; round earth; true
  north.
- **GRASS r.sun**: true solar time, one declination all day, no refraction; round earth; true north. 21 March is day 80.
- **Whitebox time_in_daylight**: the share of the day in which the sun's altitude at the middle of an azimuth's bin exceeds the
  horizon. The sun is that of suncalc in 2020 (21 March is day 81), whose equinox is that of 2000: it is up to 0.2 degrees off. The
  day begins and ends at -0.5 degrees without refraction; flat earth; the grid's north. The program is closed: that its sun is
  taken right was checked by its shares on a level floor.

The sun's path of each is made again for truth. What is left on the level floor is a tool's own: steps of time or of azimuth."""


def format_summary(comparison: SunComparison) -> str:
    """Format the table of docs/sun-questions.md: Skugga's most accurate row of each case, and the best other tools."""
    rows = []
    for question, title in TITLES.items():
        is_computing = any(answer.compute_s is not None for answer in comparison.answers_to(question))
        for case in dict.fromkeys(answer.case for answer in comparison.answers_to(question)):
            answers = [answer for answer in comparison.answers_to(question, case) if answer.wrong is not None]
            ours = min((answer for answer in answers if answer.ours), key=_error_of)
            others = [answer for answer in answers if not answer.ours and _seconds_of(answer, is_computing) is not None]
            fastest = min(others, key=lambda answer: _seconds_of(answer, is_computing) or 0.0)
            row = {"question, place": f"{title.partition(' ')[2]}, {case}", "error in": UNIT_BY_QUESTION[question]}
            most_accurate = min(others, key=_error_of)
            for head, answer in (("Skugga", ours), ("fastest other tool", fastest), ("most accurate other tool", most_accurate)):
                seconds = _format_seconds(_seconds_of(answer, is_computing), answer)
                row[head] = f"{answer.tool}: {seconds} s, {format_error(question, answer.wrong)}"
            rows.append(row)
    return "\n".join(markdown_table(rows))


def _error_of(answer: SunAnswer) -> float:
    """Return an answer's error, which has to be known."""
    assert answer.wrong is not None
    return answer.wrong


def _seconds_of(answer: SunAnswer, is_computing: bool) -> float | None:
    """Return an answer's seconds of computing, or of the whole process."""
    return answer.compute_s if is_computing else answer.whole_s


def format_sun_page(comparison: SunComparison) -> str:
    """Format the report, in Markdown."""
    command = "python -m benchmarks.sun_questions DATA --python PATH"
    provenance = Provenance(command, comparison.date, comparison.commit, comparison.where)
    versions = ", ".join(f"{name} {number}" for name, number in comparison.versions.items())
    parts = [
        "# Report: questions of sun, beside other tools",
        format_provenance(provenance),
        "`DATA` is a folder with the rasters named below; `PATH` is an interpreter that has the others' packages. The command\n"
        "writes every number and verdict. Masks of one sun, by more tools: [peers](peers.md).",
        f"{versions}. {comparison.took_s / 60.0:.0f} minutes. **The machine was shared** with other work (load "
        f"{comparison.load:.1f} at the end): wall-clock seconds are comparable only with each other, and CPU time of a process and "
        "its\nchildren, which suffers less, stands beside them. Every tool runs as a process of its own, one at a time.",
    ]
    for question in TITLES:
        if comparison.answers_to(question):
            cases = "\n".join(f"- *{case.case}*: {case.about}" for case in comparison.cases if case.question == question)
            parts += [f"## {TITLES[question]}", format_verdict(comparison, question), cases, METHOD_BY_QUESTION[question]]
            parts.append("\n".join(answer_table(comparison, question)))
            if question == HOURS_QUESTION and comparison.checks:
                parts += ["### Conventions", CONVENTIONS, "\n".join(check_table(comparison))]
    if comparison.left_out:
        parts += ["## Left out", "\n".join(f"- {name}: {reason}" for name, reason in comparison.left_out.items())]
    return "\n\n".join(parts) + "\n"
