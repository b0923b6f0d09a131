"""Results of `benchmarks.peers`: errors and costs of tools for rasters under suns, and which tools are faster and more accurate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class SunShares:
    """Shares of a raster's cells under one sun.

    Attributes
    ----------
    azimuth_deg, altitude_deg
        The sun's angles.
    shadow
        Share of the decided cells that are in shadow. A cell is decided if its truth is certain
        (``benchmarks.sweep_accuracy.GridTruth``).
    undecided
        Share of all cells whose truth is not certain.
    """

    azimuth_deg: float
    altitude_deg: float
    shadow: float
    undecided: float


@dataclass(frozen=True)
class ComparedRaster:
    """Description of a raster.

    Attributes
    ----------
    name
        Its name.
    rows, cols
        Its size in cells.
    cell_m
        Side of a cell, metres.
    lowest_m, highest_m
        Its lowest and its highest height, metres.
    under
        Shares of its cells under each sun.
    """

    name: str
    rows: int
    cols: int
    cell_m: float
    lowest_m: float
    highest_m: float
    under: list[SunShares]


@dataclass(frozen=True)
class ToolRecord:
    """A tool that ran.

    Attributes
    ----------
    name, version
        Its name and its installed version.
    algorithm
        Description of its algorithm in a few words.
    ours
        Whether it is part of Skugga.
    casts
        Whether it computes cast shadows.
    start_s
        Least wall time of its process for a tiny raster, seconds.
    """

    name: str
    version: str
    algorithm: str
    ours: bool
    casts: bool
    start_s: float


@dataclass(frozen=True)
class ToolResult:
    """A tool's result for a raster under one sun.

    Attributes
    ----------
    tool, terrain
        Names of the tool and of the raster.
    azimuth_deg, altitude_deg
        The sun's angles.
    runs
        Number of runs.
    compute_s
        Median seconds of computing that the tool reports; ``None`` if it reports none.
    whole_s
        Median wall time of the whole process, seconds.
    peak_mb
        Peak memory, MB.
    cores
        CPU time divided by wall time, median of the runs.
    false_shadow, missed_shadow
        Errors as shares of the decided cells; ``None`` if the tool casts no shadows.
    """

    tool: str
    terrain: str
    azimuth_deg: float
    altitude_deg: float
    runs: int
    compute_s: float | None
    whole_s: float
    peak_mb: float
    cores: float
    false_shadow: float | None
    missed_shadow: float | None

    @property
    def wrong(self) -> float:
        """Share of the decided cells that are wrong in any way."""
        assert self.false_shadow is not None and self.missed_shadow is not None
        return self.false_shadow + self.missed_shadow

    @property
    def is_on_axis(self) -> bool:
        """Whether the sun stands on an axis or diagonal of the grid."""
        return self.azimuth_deg % 45.0 == 0.0

    @property
    def case(self) -> str:
        """The name of the raster and of the sun."""
        return f"{self.terrain} {self.azimuth_deg:g}/{self.altitude_deg:g}"


@dataclass(frozen=True)
class PeerComparison:
    """All results.

    Attributes
    ----------
    where
        Processor and number of cores of the machine.
    repeats
        Number of runs of each tool in each case.
    slow_s
        Longest run, seconds, that was repeated.
    took_s
        Duration of the whole measurement, seconds.
    terrains, tools, answers
        The rasters, the tools that ran, and their results.
    left_out
        Names of skipped tools, with the reason.
    date, commit
        Date of the measurement, ISO 8601, and abbreviated hash of its commit.
    """

    where: str
    repeats: int
    slow_s: float
    took_s: float
    terrains: list[ComparedRaster]
    tools: list[ToolRecord]
    left_out: dict[str, str]
    answers: list[ToolResult]
    date: str = "unknown"
    commit: str = "unknown"

    @staticmethod
    def read(values: dict[str, Any]) -> PeerComparison:
        """Build the comparison from values of its JSON file."""
        terrains = [
            ComparedRaster(**{**entry, "under": [SunShares(**sun) for sun in entry["under"]]}) for entry in values["terrains"]
        ]
        tools, answers = [ToolRecord(**entry) for entry in values["tools"]], [ToolResult(**entry) for entry in values["answers"]]
        return PeerComparison(**{**values, "terrains": terrains, "tools": tools, "answers": answers})

    def results_of(self, tool: ToolRecord, terrain: str | None = None, on_axis: bool | None = None) -> list[ToolResult]:
        """Return a tool's results, optionally only those of one raster, and only those on or off the grid's axes and diagonals."""
        return [
            answer
            for answer in self.answers
            if answer.tool == tool.name and terrain in (None, answer.terrain) and on_axis in (None, answer.is_on_axis)
        ]

    def compute_s(self, tool: ToolRecord, answer: ToolResult) -> float:
        """Return the seconds of computing that a tool reports.

        If it reports none, return an upper bound: the total minus the time of its process for a tiny raster.
        """
        return answer.compute_s if answer.compute_s is not None else max(answer.whole_s - tool.start_s, 0.0)

    def has_upper_bounds(self, tool: ToolRecord) -> bool:
        """Return whether a tool's seconds of computing are only upper bounds."""
        return any(answer.compute_s is None for answer in self.results_of(tool))

    @property
    def largest_raster(self) -> ComparedRaster:
        """The raster with the most cells."""
        return max(self.terrains, key=lambda terrain: terrain.rows * terrain.cols)

    @property
    def casting_tools(self) -> list[ToolRecord]:
        """The tools that cast shadows."""
        return [tool for tool in self.tools if tool.casts]


CLOCKS: dict[str, Callable[[PeerComparison, ToolRecord, ToolResult], float]] = {
    "computing": lambda comparison, tool, answer: comparison.compute_s(tool, answer),
    "whole process": lambda comparison, tool, answer: answer.whole_s,
}
"""Functions that return the seconds by which tools are compared, by name."""


@dataclass(frozen=True)
class ToolStanding:
    """A tool's seconds and its share of wrong cells in a case: a raster under a sun, or a mean over several."""

    tool: ToolRecord
    seconds: float
    wrong: float

    def beats(self, other: ToolStanding) -> bool:
        """Return whether the tool is both faster and more accurate than another."""
        return self.seconds < other.seconds and self.wrong < other.wrong


def standings_by_case(comparison: PeerComparison, clock: str) -> dict[str, list[ToolStanding]]:
    """Return the tools' standings in each case: every raster under every sun, and means over the suns off the grid's axes.

    ``clock`` is a key of ``CLOCKS`` and selects the seconds to compare.
    """
    out: dict[str, list[ToolStanding]] = {}
    for tool in comparison.casting_tools:
        for answer in comparison.results_of(tool):
            out.setdefault(answer.case, []).append(ToolStanding(tool, CLOCKS[clock](comparison, tool, answer), answer.wrong))
        for name in [terrain.name for terrain in comparison.terrains] + [None]:
            results = comparison.results_of(tool, name, on_axis=False)
            seconds = float(np.mean([CLOCKS[clock](comparison, tool, answer) for answer in results]))
            wrong_share = float(np.mean([answer.wrong for answer in results]))
            out.setdefault(f"{name or 'all'}, mean off the axes", []).append(ToolStanding(tool, seconds, wrong_share))
    return out


def dominated_results(comparison: PeerComparison, clock: str) -> list[tuple[str, str, str]]:
    """Return triples of a row of Skugga (the sweep with some number of lines), a peer that beats it, and the case.

    A peer beats a row if it is both faster, by ``clock``, and more accurate.
    """
    return dominated_rows(standings_by_case(comparison, clock))


def unmatched_results(comparison: PeerComparison, clock: str) -> list[tuple[str, str]]:
    """Return pairs of a peer and a case in which the peer is faster and more accurate than every row of Skugga."""
    return unmatched_peers(standings_by_case(comparison, clock))


def dominated_rows(case_standings: dict[str, list[ToolStanding]]) -> list[tuple[str, str, str]]:
    """Return triples of a row of Skugga, a peer that is both faster and more accurate, and the case."""
    return [
        (skugga_row.tool.name, peer.tool.name, case)
        for case, standings in case_standings.items()
        for skugga_row in standings
        for peer in standings
        if skugga_row.tool.ours and not peer.tool.ours and peer.beats(skugga_row)
    ]


def unmatched_peers(case_standings: dict[str, list[ToolStanding]]) -> list[tuple[str, str]]:
    """Return pairs of a peer and a case in which the peer is faster and more accurate than every row of Skugga."""
    return [
        (peer.tool.name, case)
        for case, standings in case_standings.items()
        for peer in standings
        if not peer.tool.ours and all(peer.beats(skugga_row) for skugga_row in standings if skugga_row.tool.ours)
    ]
