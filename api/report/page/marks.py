"""How algorithms and stages look in plots: colours and shapes that the colour-blind tell apart, the same in every report.

The colours are those of M. Okabe and K. Ito, Color Universal Design (2008).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin

from api.report.page.markup import tag

BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, GRAY = "#0072b2", "#d55e00", "#009e73", "#b8558f", "#e69f00", "#56b4e9", "#6b7280"

POINTS: dict[str, str] = {
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
            ("star", 10, 0.0, (1.35, 0.58)),
            ("cross", 8, pi / 4, (1.3, 0.45)),
        )
    },
}
"""Corners of shapes about the size of a circle of radius 1."""


@dataclass(frozen=True)
class Mark:
    """A shape of ``POINTS`` in a colour, filled or not."""

    shape: str
    colour: str
    filled: bool = True

    def drawn(self, x: float, y: float, radius: float = 6.0) -> str:
        """The mark as SVG around a point."""
        paint = {"fill": self.colour, "stroke": "#fff"} if self.filled else {"fill": "#fff", "stroke": self.colour}
        paint |= {
            "stroke_width": f"{(1.0 if self.filled else 2.2) / radius:.3f}",
            "transform": f"translate({x:.1f} {y:.1f}) scale({radius:g})",
        }
        return tag("circle", r=1, **paint) if self.shape == "circle" else tag("polygon", points=POINTS[self.shape], **paint)


MARKS = {
    "shadow_map": Mark("circle", BLUE),
    "perspective_shadow_map": Mark("diamond", SKY),
    "shadow_volume": Mark("square", VERMILION),
    "hybrid": Mark("triangle", GREEN),
    "planar": Mark("wedge", PURPLE),
    "sweep": Mark("star", ORANGE),
    "none": Mark("cross", GRAY),
}
SPARE = Mark("cross", "#000000")


def mark_of(family: str) -> Mark:
    """The mark of algorithms at work together (``summary.family``): that of the first but shadow maps, hollow if not alone."""
    names = family.split(" + ")
    lead = next((name for name in names if name != "shadow_map"), names[0])
    mark = MARKS.get(lead, SPARE)
    return mark if len(names) == 1 else Mark(mark.shape, mark.colour, filled=False)


STAGES = (BLUE, ORANGE, GREEN, VERMILION, SKY, PURPLE, "#8c6d31", "#f0e442", "#332288", "#88ccee", "#999933", "#44aa99")


def stage_colours(stages: list[str]) -> dict[str, str]:
    """A colour for each stage, in order; past a dozen they begin anew."""
    return {name: STAGES[k % len(STAGES)] for k, name in enumerate(stages)}
