"""Error metrics under known, deliberate faults: the table of ``docs/reports/metrics.md``.

A metric that no fault moves measures nothing. A metric that stays at 0 under a fault does not detect it.
``python -m tests.shadows.truth.faults`` prints the table; ``--into docs/reports/metrics.md`` writes it there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from skugga.shadows.truth.metrics import block_shadow_shares, coverage_error, error_metrics, soft_error
from skugga.shadows.truth.truth import Truth
from tests.hard_cases.table import TABLE, replace_section
from tests.metrics import flicker

SIDE_PX = 192
SAMPLES_PER_SIDE = 8
"""Samples along a pixel's side, which give its share in shadow."""

SHARE_METRICS = (
    "wrong",
    "wrong_cast",
    "false_shadow",
    "missed_shadow",
    "interior",
    "interior_sees",
    "coverage",
    "flicker",
    "soft_error",
)
"""Metrics that are shares. The others are pixels and counts."""

METRICS = (
    "wrong", "wrong_cast", "false_shadow", "missed_shadow", "edge_mean", "edge_p95", "interior", "interior_parts", "interior_sees",
    "coverage", "flicker", "soft_error",
)  # fmt: skip

ShadowShape = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""A function of positions (x, y), in pixels from the upper left corner, that returns whether they are in a shadow."""


def _slanted_rectangle(x0: float, y0: float, wide: float, long: float, turn_deg: float) -> ShadowShape:
    """Return a rectangle whose foot is centred at (x0, y0), and which is ``long`` pixels long."""
    cosine, sine = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))

    def contains(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        length_px, width_px = (x - x0) * cosine + (y - y0) * sine, (y - y0) * cosine - (x - x0) * sine
        return (length_px >= 0.0) & (length_px < long) & (np.abs(width_px) < wide / 2.0)

    return contains


def _disc(x0: float, y0: float, radius: float) -> ShadowShape:
    """Return a disc with its centre at (x0, y0) and a radius in pixels."""
    return lambda x, y: np.hypot(x - x0, y - y0) < radius


HOUSE, TREE, POLE = (
    _slanted_rectangle(20.3, 30.2, 40.0, 70.0, 17.0),
    _disc(140.4, 50.7, 15.0),
    _slanted_rectangle(30.1, 120.4, 3.0, 90.0, 17.0),
)
TURNED_AWAY_SLOPE = _slanted_rectangle(60.2, 174.3, 20.0, 110.0, 0.0)
"""``TURNED_AWAY_SLOPE`` faces away from the sun. The other shapes are cast shadows."""

CAST_SHAPES = {"house": HOUSE, "tree": TREE, "pole": POLE}


@cache
def _shadow_shares(*shapes: ShadowShape, shift_right_px: float = 0.0, texel_size_px: int = 1) -> np.ndarray:
    """Return the shadowed share of each pixel (rows, cols), sampled at centres of texels of ``texel_size_px``.

    The shadows are moved right by ``shift_right_px``.
    """
    positions = (np.arange(SIDE_PX * SAMPLES_PER_SIDE) + 0.5) / SAMPLES_PER_SIDE
    positions = positions if texel_size_px == 1 else (np.floor(positions / texel_size_px) + 0.5) * texel_size_px
    x, y = np.meshgrid(positions - shift_right_px, positions)
    dark = np.logical_or.reduce([shape(x, y) for shape in shapes]) if shapes else np.zeros(x.shape, bool)
    return dark.reshape(SIDE_PX, SAMPLES_PER_SIDE, SIDE_PX, SAMPLES_PER_SIDE).mean(axis=(1, 3))


@cache
def _truth() -> tuple[Truth, np.ndarray]:
    """Return truth, decidable where a pixel has one class throughout, and the true shadow share of each pixel."""
    cast, turned_away = _shadow_shares(*CAST_SHAPES.values()), _shadow_shares(TURNED_AWAY_SLOPE)
    share = np.maximum(cast, turned_away)
    valid = np.ones(share.shape, bool)
    return Truth(share < 0.5, turned_away >= 0.5, (share == 0.0) | (share == 1.0), valid), share


@dataclass(frozen=True, eq=False)
class FaultyPicture:
    """Visibility (rows, cols) of an algorithm, visibility of the next frame under the same truth, and pixels per texel."""

    visibility: np.ndarray
    next_visibility: np.ndarray | None = field(default=None)
    texel_px: float = 0.0


def _rendered_visibility(
    *cast: ShadowShape, shift_right_px: float = 0.0, texel_size_px: int = 1, turned_away: bool = True
) -> np.ndarray:
    """Return visibility at the pixels' centres, 0 or 1."""
    dark = _shadow_shares(*cast, shift_right_px=shift_right_px, texel_size_px=texel_size_px) >= 0.5
    return 1.0 - (dark | (turned_away & (_shadow_shares(TURNED_AWAY_SLOPE) >= 0.5)))


def _with_acne(seed: int) -> np.ndarray:
    """Return the visibility of the scene with random dark pixels."""
    acne = np.random.default_rng(seed).random((SIDE_PX, SIDE_PX)) < 0.02
    return np.where(acne, 0.0, _rendered_visibility(*CAST_SHAPES.values()))


def _with_visibility(shape: ShadowShape, visibility: float) -> np.ndarray:
    """Return a picture with another visibility within a shape."""
    return np.where(_shadow_shares(shape) >= 0.5, visibility, _rendered_visibility(*CAST_SHAPES.values()))


def _without_casters(*names: str) -> np.ndarray:
    """Return the visibility of the scene without some of ``CAST_SHAPES``."""
    return _rendered_visibility(*(shape for name, shape in CAST_SHAPES.items() if name not in names))


FAULTS: Mapping[str, Callable[[], FaultyPicture]] = {
    "none": lambda: FaultyPicture(_rendered_visibility(*CAST_SHAPES.values())),
    "acne: 2 % of the pixels dark, others in each frame": lambda: FaultyPicture(_with_acne(1), _with_acne(2)),
    "peter-panning: a gap of 4 px at the house's foot": lambda: FaultyPicture(
        _with_visibility(_slanted_rectangle(20.3, 30.2, 44.0, 4.0, 17.0), 1.0)
    ),
    "a thin caster lost: the pole": lambda: FaultyPicture(_without_casters("pole")),
    "a caster missing: the tree": lambda: FaultyPicture(_without_casters("tree")),
    "a shadow invented": lambda: FaultyPicture(_with_visibility(_disc(150.2, 110.6, 9.0), 0.0)),
    "light leaks into the house's shadow": lambda: FaultyPicture(_with_visibility(_disc(52.3, 40.1, 7.0), 1.0)),
    "shifted by 1 px": lambda: FaultyPicture(_rendered_visibility(*CAST_SHAPES.values(), shift_right_px=1.0)),
    "shifted by 6 px": lambda: FaultyPicture(_rendered_visibility(*CAST_SHAPES.values(), shift_right_px=6.0)),
    "shimmer: 1 px to and fro": lambda: FaultyPicture(
        _rendered_visibility(*CAST_SHAPES.values()), _rendered_visibility(*CAST_SHAPES.values(), shift_right_px=1.0)
    ),
    "stairs of texels of 6 px": lambda: FaultyPicture(_rendered_visibility(*CAST_SHAPES.values(), texel_size_px=6), texel_px=6.0),
    "all cast shadow lost, texels of 2 px": lambda: FaultyPicture(_rendered_visibility(), texel_px=2.0),
    "all cast shadow lost, texels of 40 px": lambda: FaultyPicture(_rendered_visibility(), texel_px=40.0),
    "a penumbra 10 px wide": lambda: FaultyPicture(gaussian_filter(_rendered_visibility(*CAST_SHAPES.values()), 4.0)),
    "a turned-away slope lit": lambda: FaultyPicture(_rendered_visibility(*CAST_SHAPES.values(), turned_away=False)),
}
"""Pictures by their fault."""


@cache
def figures(fault: str) -> dict[str, float]:
    """Return each metric of the picture with a fault."""
    truth, share = _truth()
    picture = FAULTS[fault]()
    errors = vars(error_metrics(picture.visibility, truth, 1.0, picture.texel_px))
    next_visibility = picture.visibility if picture.next_visibility is None else picture.next_visibility
    other_metrics = {
        "coverage": coverage_error(block_shadow_shares(1.0 - picture.visibility), block_shadow_shares(share)),
        "flicker": flicker(picture.visibility < 0.5, next_visibility < 0.5, ~truth.lit, ~truth.lit, truth.decidable),
        "soft_error": soft_error(picture.visibility, 1.0 - share),
    }
    return {name: float({**errors, **other_metrics}[name]) for name in METRICS}


def table() -> str:
    """Return the Markdown table of metrics by fault. Values that differ from the picture without a fault are bold."""
    lines = ["| fault | " + " | ".join(f"`{name}`" for name in METRICS) + " |", "| --- |" + " ---: |" * len(METRICS)]
    clean_metrics = figures("none")
    for fault in FAULTS:
        fault_metrics = figures(fault)
        texts = [_format_metric(name, fault_metrics[name]) for name in METRICS]
        clean_texts = [_format_metric(name, clean_metrics[name]) for name in METRICS]
        cells = [text if text == clean_text else f"**{text}**" for text, clean_text in zip(texts, clean_texts, strict=True)]
        lines.append(f"| {fault} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _format_metric(name: str, value: float) -> str:
    """Format a metric: shares in per cent, others in pixels or as counts."""
    return f"{100.0 * value:.2f}" if name in SHARE_METRICS else f"{value:.0f}" if name == "interior_parts" else f"{value:.2f}"


def main() -> None:
    """Print the table of faults, or write it into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--into", metavar="FILE", type=Path, help="put the table into a Markdown file, between its marks")
    file = parser.parse_args().into
    if file is None:
        print(table())
    else:
        replace_section(file, TABLE, table())


if __name__ == "__main__":
    main()
