"""The table of the regression bounds of ``wrong_cast``, and why some are large.

``python -m tests.hard_cases.regression_listing docs/reports/hard-cases.md`` writes it.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

from tests.hard_cases.regressions import GROWTH_FACTOR, Records, read_records
from tests.hard_cases.table import COLUMNS, case_order, replace_section

SECTION = "regressions"
"""The name of the table's marks in the document."""

MAX_UNEXPLAINED = 0.02
"""Record of ``wrong_cast`` above which a cell must have one of ``REASONS``."""

Reasons = Mapping[tuple[str, ...], str]

REASONS: Reasons = {
    ("G5", "shadow_volume", "hybrid", "sweep"): (
        "the picture of zoom 12 is held against truth of zoom 13, on ground of four times as many nodes. Truth of zoom 12 itself "
        "differs from it by 6.3 % of the cast shadow. Against truth of their own zoom, 0.07 % or less is wrong."
    ),
    ("G5", "shadow_map"): (
        "as the others; and texels 0.36 pixels wide shift the edges of many small shadows: against truth of its own zoom 2.1 % is "
        "wrong."
    ),
    ("H27", "light_space_perspective_map"): (
        "near texels are up to 11 pixels long in the small picture. The rule for the warp's centre balances faces across the view, "
        "and this ground is seen from 20 degrees above. Every wrong pixel lies within a texel of an outline, as the case's figure "
        "proves."
    ),
    ("L1", "shadow_map", "reconstructed_volume"): (
        "26 boxes of half a metre have much outline for their area, and a face's 512 texels are 3 cm wide on a wall 8 m away. "
        "Every wrong pixel lies within one texel of an outline, as the case's figure proves."
    ),
    ("X2", "shadow_map"): (
        "the worst picture has 243 pixels of cast shadow, of a saw's teeth one cell wide. Five of them are wrong, each within "
        "reach of a texel where truth agrees with the map."
    ),
    ("X2", "reconstructed_volume"): (
        "the worst picture has 224 pixels of cast shadow under a sun of 1.7 degrees, and as many lit ones. All of these lie "
        "within reach of a texel, whose polygons shade them."
    ),
}
"""Why ``wrong_cast`` is large: by case and the algorithms that the sentence holds for."""


def largest_record(records: Records, case: str, algorithm: str) -> float:
    """Return the largest record of a cell, of all sizes and figures."""
    return max(value for values in records[case][algorithm].values() for value in values.values())


def unexplained_cells(records: Records, reasons: Reasons) -> list[tuple[str, str]]:
    """Return the cells (case, algorithm) whose record exceeds ``MAX_UNEXPLAINED`` and that have no reason."""
    explained = {(case, algorithm) for case, *algorithms in reasons for algorithm in algorithms}
    return [
        (case, algorithm)
        for case, cells in records.items()
        for algorithm in cells
        if largest_record(records, case, algorithm) > MAX_UNEXPLAINED and (case, algorithm) not in explained
    ]


def as_markdown(records: Records, reasons: Reasons) -> str:
    """Return the table of the largest record of each cell and its bound, in per cent, and the reasons below it."""
    algorithms = [algorithm for algorithm in COLUMNS if any(algorithm in cells for cells in records.values())]
    lines = [
        "| case | " + " | ".join(COLUMNS[algorithm] for algorithm in algorithms) + " |",
        "| --- |" + " ---: |" * len(algorithms),
    ]
    for case in sorted(records, key=case_order):
        percents = {algorithm: 100.0 * largest_record(records, case, algorithm) for algorithm in records[case]}
        cells = [
            f"{percents[algorithm]:.2g} ({GROWTH_FACTOR * percents[algorithm]:.2g})" if algorithm in percents else ""
            for algorithm in algorithms
        ]
        lines.append(f"| {case} | " + " | ".join(cells) + " |")
    lines += ["", f"Why cells are over {100.0 * MAX_UNEXPLAINED:g} %:", ""]
    for case, *of_algorithms in sorted(reasons, key=lambda key: case_order(key[0])):
        names = ", ".join(COLUMNS[algorithm] for algorithm in of_algorithms)
        lines.append(f"- {case}, {names}: {reasons[(case, *of_algorithms)]}")
    return "\n".join(lines)


if __name__ == "__main__":
    replace_section(Path(sys.argv[1]), SECTION, as_markdown(read_records(), REASONS))
