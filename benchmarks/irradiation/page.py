"""Format the tables of `benchmarks.irradiation` from its results. This module measures nothing."""

from __future__ import annotations

from benchmarks.irradiation.figures import HillRow, RayRow, Results, ToolRow
from benchmarks.irradiation.rays import BeamErrors
from benchmarks.peers.pages import format_percent, format_seconds
from benchmarks.report_pages import Provenance, format_provenance
from benchmarks.seeds.claims import markdown_table


def format_share(value: float | None) -> str:
    """Format a share in per cent with two significant digits; ``None`` as "-"."""
    return "-" if value is None else f"{format_percent(abs(value))} %"


def format_bias(value: float | None) -> str:
    """Format a share with its sign in per cent; ``None`` as "-"."""
    return "-" if value is None else f"{'-' if value < 0.0 else '+'}{format_percent(abs(value))} %"


def _error_columns(errors: BeamErrors, prefix: str = "") -> dict[str, str]:
    """Return columns of a table with errors."""
    return {
        f"{prefix}mean error": format_share(errors.mean), f"{prefix}95 % within": format_share(errors.p95),
        f"{prefix}bias": format_bias(errors.bias),
    }  # fmt: skip


def hill_table(rows: list[HillRow]) -> list[str]:
    """Format a line for each part of the light."""
    return markdown_table([
        {
            "part": f"`{row.part}`", "kWh/m2": f"{row.mean_kwh:.4g}", "mean error": format_share(row.mean),
            "99 % within": format_share(row.p99), "bias": format_bias(row.bias),
            "hourly suns: mean error": format_share(row.step_mean), "hourly suns: bias": format_bias(row.step_bias),
        }
        for row in rows
    ])  # fmt: skip


def ray_table(rows: list[RayRow]) -> list[str]:
    """Format a line for each raster."""
    return markdown_table([
        {
            "raster": row.raster, "cells": f"{row.cells:,}", "suns": f"{row.suns:,}", "kWh/m2": f"{row.mean_kwh:.4g}",
            **_error_columns(row.errors), **_error_columns(row.step_errors, "hourly suns: "),
            "seconds": format_seconds(row.whole_s), "CPU s": format_seconds(row.cpu_s), "MB": f"{row.peak_mb:.0f}",
        }
        for row in rows
    ])  # fmt: skip


def tool_table(rows: list[ToolRow]) -> list[str]:
    """Format a line for each tool, raster and period."""
    return markdown_table([
        {
            "raster": row.raster, "period": row.period, "tool": f"**{row.tool}**" if row.is_skugga else row.tool,
            "computing, s": "-" if row.compute_s is None else format_seconds(row.compute_s),
            "process, s": format_seconds(row.whole_s), "its CPU, s": format_seconds(row.cpu_s), "MB": f"{row.peak_mb:.0f}",
            "kWh/m2": f"{row.mean_kwh:.3g}", **_error_columns(row.errors),
        }
        for row in rows
    ])  # fmt: skip


HILLS_METHOD = """\
Four hills of 400 m standard deviation in cells of 20 m, at 47 degrees north, every tenth day of 2023. Truth is quadrature: analytic
normals, heights and shadows of each hourly sun, and analytic horizons towards 360 azimuths. Published tools have errors of 0.55 to
1.66 % on Gaussian surfaces. The last columns are the error of hourly suns alone: truth with them beside truth with suns every 5
minutes (every thirtieth day)."""

RAYS_METHOD = """\
`skugga irradiation --year 2023 --part beam` beside Embree rays to the same suns at random cells, each with its own vertical, plane
and height. The last errors are those of hourly suns alone: rays to them beside rays every 5 minutes."""

TOOLS_METHOD = """\
The middles of two rasters. Each tool has an air of its own, and all can do without (GRASS with a turbidity of 0, SAGA with a
transmittance of 100 %). So the question is geometry: a cell's beam as a share of that of open level ground *by the same tool*,
times the true one, beside rays to NREL's suns every 5 minutes (of the year: every 10). Skugga's default for a day is 10
minutes. A cell's plane is fitted as the tool does it. `insolation` is a library without a loop over suns; it was given Skugga's
hourly ones. r.sun computes single days, and SAGA's year of every fifth day takes 73 times as long as its day; behind a wall on
a plain its own walk casts a shadow, but none in GRASS 8.2.1 once slope and aspect maps are given, so it was run on level planes
as well. r.horizon of GRASS 8.2 returns wrong negative horizons, which 8.3 mends; `none negative` is the same with horizons of
at least 0. `saga_cmd` 8.5 ignores dates on its command line, and was run by a tool
chain."""


def format_report(results: Results) -> str:
    """Format the report: all tables with their explanations, in Markdown."""
    provenance = Provenance(
        "python -m benchmarks.irradiation DATA --python PATH --write", results.date, results.commit, results.where
    )
    versions = ", ".join(f"{name} {number}" for name, number in results.versions.items())
    paragraphs = [
        "# Report: irradiation beside truth and other tools",
        format_provenance(provenance),
        "`DATA` is the folder of sample rasters; `PATH` is an interpreter that has the package `insolation` and SurtGIS.\n"
        "Errors are shares of the mean of truth over the compared cells: the mean without sign, a percentile, and the bias. "
        f"Load {results.load_before:.1f} before and {results.load_after:.1f} after: under load, seconds are "
        f"comparable only with each other. {versions}.",
    ]  # fmt: skip
    sections = [
        ("Gaussian hills", HILLS_METHOD, hill_table(results.hills)), ("Rays", RAYS_METHOD, ray_table(results.rays)),
        ("Other tools", TOOLS_METHOD, tool_table(results.tools)),
    ]  # fmt: skip
    for title, method, table in sections:
        if table:
            paragraphs += [f"## {title}", method, "\n".join(table)]
    if results.left_out:
        paragraphs.append("Left out:\n\n" + "\n".join(f"- {name}: {reason}." for name, reason in results.left_out.items()))
    return "\n\n".join(paragraphs) + "\n"
