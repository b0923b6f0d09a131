"""Plot marks of algorithms and colours of stages. They suit colour-blind readers and are the same in every report.

The colours are those of M. Okabe and K. Ito, Color Universal Design (2008).
"""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, sin

from skugga.api.report.page.markup import tag
from skugga.shadows.algorithm import MarkerColour, PlotMarker
from skugga.shadows.registry import ALGORITHMS, FALLBACK_ALGORITHM

COLOURS: dict[MarkerColour, str] = {
    "blue": "#0072b2", "vermilion": "#d55e00", "green": "#009e73", "purple": "#b8558f", "orange": "#e69f00", "sky": "#56b4e9",
    "gray": "#6b7280", "black": "#000000", "brown": "#8c6d31",
}  # fmt: skip

SHAPE_POINTS: dict[str, str] = {
    "circle": "circle",
    "square": " ".join(f"{x:.3g},{y:.3g}" for x, y in ((-0.88, -0.88), (0.88, -0.88), (0.88, 0.88), (-0.88, 0.88))),
    **{
        name: " ".join(
            f"{r * sin(turn + 2 * pi * k / n):.3g},{-r * cos(turn + 2 * pi * k / n):.3g}"
            for k, r in enumerate(radii * (n // len(radii)))
        )
        for name, n, turn, radii in (
            ("triangle", 3, 0.0, (1.2,)),
            ("diamond", 4, 0.0, (1.22,)),
            ("wedge", 3, pi, (1.2,)),
            ("pentagon", 5, 0.0, (1.15,)),
            ("hexagon", 6, pi / 6, (1.1,)),
            ("star", 10, 0.0, (1.35, 0.58)),
            ("cross", 8, pi / 4, (1.3, 0.45)),
        )
    },
}
"""Polygon vertices of marks, about the size of a unit circle."""


def mark_svg(mark: PlotMarker, x: float, y: float, radius: float = 6.0) -> str:
    """Return a mark as an SVG element centred at the point (``x``, ``y``), with a radius, all in pixels."""
    colour = COLOURS[mark.colour]
    paint = {"fill": colour, "stroke": "#fff"} if mark.filled else {"fill": "#fff", "stroke": colour}
    paint |= {
        "stroke_width": f"{(1.0 if mark.filled else 2.2) / radius:.3f}",
        "transform": f"translate({x:.1f} {y:.1f}) scale({radius:g})",
    }
    return tag("circle", r=1, **paint) if mark.shape == "circle" else tag("polygon", points=SHAPE_POINTS[mark.shape], **paint)


def mark_of(family: str) -> PlotMarker:
    """Return the mark of a combination of algorithms (``summary.algorithm_family``).

    It is the mark of the first algorithm other than shadow maps, and hollow if there are several.
    """
    names = family.split(" + ")
    lead = next((name for name in names if name != FALLBACK_ALGORITHM), names[0])
    mark = ALGORITHMS[lead].marker if lead in ALGORITHMS else FALLBACK_MARK
    return mark if len(names) == 1 else replace(mark, filled=False)


FALLBACK_MARK = PlotMarker("cross", "black")

STAGE_COLOURS = (
    *(COLOURS[name] for name in ("blue", "orange", "green", "vermilion", "sky", "purple")),
    *(COLOURS["brown"], "#f0e442", "#332288", "#88ccee", "#999933", "#44aa99"),
)


def stage_colours(stages: list[str]) -> dict[str, str]:
    """Return a colour for each stage in order; colours repeat after twelve."""
    return {name: STAGE_COLOURS[k % len(STAGE_COLOURS)] for k, name in enumerate(stages)}
