"""Results of `benchmarks.irradiation`, as they are stored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from benchmarks.irradiation.rays import BeamErrors


@dataclass(frozen=True)
class HillRow:
    """The error of a part of the irradiation of Gaussian hills, as shares of the cells' mean.

    Attributes
    ----------
    part
        The part of the light.
    mean_kwh
        Mean of truth, kWh/m2.
    mean, p99, bias
        The mean error without sign, the 99th percentile, and the bias, beside truth with the same hourly suns.
    step_mean, step_bias
        The error of hourly suns themselves: truth with them beside truth with suns every five minutes; ``None`` if not measured.
    """

    part: str
    mean_kwh: float
    mean: float
    p99: float
    bias: float
    step_mean: float | None = None
    step_bias: float | None = None


@dataclass(frozen=True)
class RayRow:
    """The beam of a year of a raster beside rays.

    Attributes
    ----------
    raster
        Name of the raster.
    cells
        Number of its cells.
    suns
        Number of suns.
    mean_kwh
        Mean beam by rays with these suns, kWh/m2.
    whole_s, cpu_s, peak_mb
        Cost of `skugga irradiation --part beam`: wall time, CPU time, and peak memory.
    errors
        Errors beside rays to the same suns.
    errors_5min
        Errors beside rays every five minutes.
    step_errors
        Errors of the rays to hourly suns beside those every five minutes.
    """

    raster: str
    cells: int
    suns: int
    mean_kwh: float
    whole_s: float
    cpu_s: float
    peak_mb: float
    errors: BeamErrors
    errors_5min: BeamErrors
    step_errors: BeamErrors


@dataclass(frozen=True)
class ToolRow:
    """The beam of a period by a tool, beside rays.

    Attributes
    ----------
    raster, period
        Name of the raster, and the period.
    tool, is_skugga
        Name of the tool with its settings, and whether it is Skugga.
    compute_s, whole_s, cpu_s, peak_mb
        Seconds of computing, of the whole process, and its CPU time; and the peak memory of the largest process.
    mean_kwh
        Mean beam by rays, kWh/m2.
    errors
        Errors of the tool.
    """

    raster: str
    period: str
    tool: str
    is_skugga: bool
    compute_s: float | None
    whole_s: float
    cpu_s: float
    peak_mb: float
    mean_kwh: float
    errors: BeamErrors


@dataclass(frozen=True)
class Results:
    """All results, and the conditions of the measurement.

    Attributes
    ----------
    where
        Processor and number of cores.
    load_before, load_after
        One-minute load average before and after the last measurement.
    versions
        Versions of the tools.
    left_out
        Names of tools that were skipped, with the reason.
    hills, rays, tools
        The tables' rows.
    date, commit
        Date of the latest measurement, ISO 8601, and abbreviated hash of its commit.
    """

    where: str
    load_before: float
    load_after: float
    versions: dict[str, str]
    left_out: dict[str, str]
    hills: list[HillRow]
    rays: list[RayRow]
    tools: list[ToolRow]
    date: str = "unknown"
    commit: str = "unknown"

    @staticmethod
    def read(values: dict[str, Any]) -> Results:
        """Build the results from values of their JSON file."""
        rays = [
            RayRow(**row | {key: BeamErrors(**row[key]) for key in ("errors", "errors_5min", "step_errors")})
            for row in values["rays"]
        ]
        tools = [ToolRow(**row | {"errors": BeamErrors(**row["errors"])}) for row in values["tools"]]
        return Results(**values | {"hills": [HillRow(**row) for row in values["hills"]], "rays": rays, "tools": tools})
