"""Contact sheets of the experiments: crops of views as rendered, and with their errors in colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from benchmarks.contact_sheet import GAP_PX, PAGE_COLOR, TEXT_COLOR, TEXT_PX, encode_sheet
from benchmarks.seeds.views import DrawnVariant, Variant, ViewWithTruth
from skugga.selector.measure.compare import ComparisonRow, false_colours
from skugga.shadows.render import render_frame
from skugga.terrain.cache import clear_caches
from skugga.terrain.geo.camera import PerspectiveView

IMAGES = Path(__file__).parents[2] / "docs" / "images"
MAX_SHEET_KB = 200
"""Maximum size of a sheet's file, kilobytes."""

SHADOW_BRIGHTNESS = 0.45
"""Brightness of a pixel in shadow in pictures of errors, relative to the lit pixel."""

CropBox = tuple[int, int, int, int]
"""Left, top, width and height of a crop, pixels."""


@dataclass(frozen=True, eq=False)
class CaptionedPicture:
    """A picture with its caption."""

    picture: Image.Image
    caption: str


def draw_crop(truth_view: ViewWithTruth, variant: Variant, box: CropBox, downscale_factor: int = 1) -> Image.Image:
    """Draw a crop of a view, with both sides divided by ``downscale_factor``. The settings must not depend on the view's extent."""
    with variant.disable_part():
        color = render_frame(truth_view.scene, _crop_view(truth_view.perspective, box), truth_view.plan(variant.overrides)).color
    clear_caches("light")
    return Image.fromarray(color).convert("RGB").reduce(downscale_factor)


def draw_errors(truth_view: ViewWithTruth, drawn_variant: DrawnVariant, box: CropBox) -> Image.Image:
    """Draw a crop of a variant's result: the picture in gray, false shadow in red and missed shadow in blue."""
    left, top, width, height = box
    crop = slice(top, top + height), slice(left, left + width)
    gray = render_frame(
        truth_view.scene, _crop_view(truth_view.perspective, box), truth_view.plan({"algorithm": "none"})
    ).color.mean(axis=2)
    dark, lit, decidable = drawn_variant.is_dark[crop], truth_view.truth.lit[crop], truth_view.truth.decidable[crop]
    shade = np.where(dark & truth_view.receivers[crop], SHADOW_BRIGHTNESS * gray, gray)
    row = ComparisonRow(
        figures={}, visibility=np.where(dark, np.uint8(0), np.uint8(255)), false_shadow=decidable & dark & lit,
        missed_shadow=decidable & ~dark & ~lit,
    )  # fmt: skip
    return Image.fromarray(false_colours(shade, row))


def _crop_view(view: PerspectiveView, box: CropBox) -> PerspectiveView:
    """Return the view of a crop of the picture."""
    left, top, width, height = box
    return view.part(top, left, height, width)


_writes_pictures = True


def enable_pictures(enabled: bool) -> None:
    """Enable or disable the writing of contact sheets. The page shows only the sheets of one device."""
    global _writes_pictures
    _writes_pictures = enabled


def write_sheet(name: str, cells: Sequence[CaptionedPicture], columns: int) -> None:
    """Write pictures of one size, ``columns`` in a row, each above its caption, as the file ``name`` in ``IMAGES``."""
    if not _writes_pictures:
        return
    width, height = cells[0].picture.size
    step_x, step_y = width + GAP_PX, height + 2 * TEXT_PX + GAP_PX
    page = Image.new("RGB", (columns * step_x + GAP_PX, -(-len(cells) // columns) * step_y + GAP_PX), PAGE_COLOR)
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(TEXT_PX - 3)
    for number, cell in enumerate(cells):
        x, y = GAP_PX + number % columns * step_x, GAP_PX + number // columns * step_y
        page.paste(cell.picture, (x, y))
        draw.text((x, y + height + TEXT_PX), cell.caption, TEXT_COLOR, font, anchor="lm")
    (IMAGES / name).write_bytes(encode_sheet(page, ".webp", 1000 * MAX_SHEET_KB))
