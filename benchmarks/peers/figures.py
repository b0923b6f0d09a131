"""Results of `benchmarks.peers`: answers of tools for rasters under suns, and which tools are faster and more accurate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class SunShares:
    """A raster under one sun: the shares of its decided cells in shadow, and of all cells that are undecided."""

    azimuth_deg: float
    altitude_deg: float
    shadow: float
    undecided: float


@dataclass(frozen=True)
class TestRaster:
    """A raster: cells, their side, its lowest and highest height in metres, and its shares under each sun."""

    name: str
    rows: int
    cols: int
    cell_m: float
    lowest_m: float
    highest_m: float
    under: list[SunShares]


@dataclass(frozen=True)
class ToolRecord:
    """A tool that ran: ``start_s`` is the minimum time of its process for a tiny raster."""

    name: str
    version: str
    algorithm: str
    ours: bool
    casts: bool
    start_s: float


@dataclass(frozen=True)
class ToolResult:
    """A tool's answer for a raster under one sun: median seconds, peak memory, shares of the decided cells."""

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
        """Share of the decided cells, all kinds of errors."""
        assert self.false_shadow is not None and self.missed_shadow is not None
        return self.false_shadow + self.missed_shadow

    @property
    def on_axis(self) -> bool:
        """Whether the sun stands on an axis or diagonal of the grid."""
        return self.azimuth_deg % 45.0 == 0.0

    @property
    def case(self) -> str:
        """The raster and the sun."""
        return f"{self.terrain} {self.azimuth_deg:g}/{self.altitude_deg:g}"


@dataclass(frozen=True)
class PeerComparison:
    """All results. ``left_out`` are names of tools with the reason."""

    where: str
    repeats: int
    slow_s: float
    took_s: float
    terrains: list[TestRaster]
    tools: list[ToolRecord]
    left_out: dict[str, str]
    answers: list[ToolResult]

    @staticmethod
    def read(values: dict[str, Any]) -> PeerComparison:
        """Build it from JSON values."""
        terrains = [TestRaster(**{**entry, "under": [SunShares(**sun) for sun in entry["under"]]}) for entry in values["terrains"]]
        tools, answers = [ToolRecord(**entry) for entry in values["tools"]], [ToolResult(**entry) for entry in values["answers"]]
        return PeerComparison(**{**values, "terrains": terrains, "tools": tools, "answers": answers})

    def of(self, tool: ToolRecord, terrain: str | None = None, on_axis: bool | None = None) -> list[ToolResult]:
        """Return a tool's answers; of one raster, and on or off the axes, if given."""
        return [
            answer
            for answer in self.answers
            if answer.tool == tool.name and terrain in (None, answer.terrain) and on_axis in (None, answer.on_axis)
        ]

    def compute_s(self, tool: ToolRecord, answer: ToolResult) -> float:
        """Return seconds of computing; without the tool's own figure, at most the total minus its process's time for a tiny
        raster.
        """
        return answer.compute_s if answer.compute_s is not None else max(answer.whole_s - tool.start_s, 0.0)

    def bounded(self, tool: ToolRecord) -> bool:
        """Return whether its seconds of computing are an upper bound."""
        return any(answer.compute_s is None for answer in self.of(tool))

    @property
    def largest(self) -> TestRaster:
        """The raster with the most cells."""
        return max(self.terrains, key=lambda terrain: terrain.rows * terrain.cols)

    @property
    def casting(self) -> list[ToolRecord]:
        """The tools that cast shadows."""
        return [tool for tool in self.tools if tool.casts]


CLOCKS: dict[str, Callable[[PeerComparison, ToolRecord, ToolResult], float]] = {
    "computing": lambda found, tool, answer: found.compute_s(tool, answer),
    "whole process": lambda found, tool, answer: answer.whole_s,
}


@dataclass(frozen=True)
class ToolStanding:
    """The standing of a tool in a case: seconds, and wrong cells as a share."""

    tool: ToolRecord
    seconds: float
    wrong: float

    def beats(self, other: ToolStanding) -> bool:
        """Return whether it is both faster and more accurate."""
        return self.seconds < other.seconds and self.wrong < other.wrong


def cases(comparison: PeerComparison, clock: str) -> dict[str, list[ToolStanding]]:
    """Return standings of all tools: in each raster under each sun, and in the means over the suns off the axes."""
    out: dict[str, list[ToolStanding]] = {}
    for tool in comparison.casting:
        for answer in comparison.of(tool):
            out.setdefault(answer.case, []).append(ToolStanding(tool, CLOCKS[clock](comparison, tool, answer), answer.wrong))
        for name in [terrain.name for terrain in comparison.terrains] + [None]:
            results = comparison.of(tool, name, on_axis=False)
            seconds = float(np.mean([CLOCKS[clock](comparison, tool, answer) for answer in results]))
            wrong_share = float(np.mean([answer.wrong for answer in results]))
            out.setdefault(f"{name or 'all'}, mean off the axes", []).append(ToolStanding(tool, seconds, wrong_share))
    return out


def dominated_results(comparison: PeerComparison, clock: str) -> list[tuple[str, str, str]]:
    """Return Skugga's rows with peers that are both faster and more accurate, and the case."""
    return dominated_rows(cases(comparison, clock))


def unmatched_results(comparison: PeerComparison, clock: str) -> list[tuple[str, str]]:
    """Return peers that beat every row of Skugga's in a case, and the case."""
    return unmatched_peers(cases(comparison, clock))


def dominated_rows(standings_by_case: dict[str, list[ToolStanding]]) -> list[tuple[str, str, str]]:
    """Return, from standings by case, Skugga's rows with peers that are both faster and more accurate, and the case."""
    return [
        (our_row.tool.name, peer.tool.name, case)
        for case, standings in standings_by_case.items()
        for our_row in standings
        for peer in standings
        if our_row.tool.ours and not peer.tool.ours and peer.beats(our_row)
    ]


def unmatched_peers(standings_by_case: dict[str, list[ToolStanding]]) -> list[tuple[str, str]]:
    """Return, from standings by case, peers that beat every row of Skugga's there, and the case."""
    return [
        (peer.tool.name, case)
        for case, standings in standings_by_case.items()
        for peer in standings
        if not peer.tool.ours and all(peer.beats(our_row) for our_row in standings if our_row.tool.ours)
    ]
