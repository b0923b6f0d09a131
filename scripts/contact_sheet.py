"""Render every view of every bundled level onto one sheet of labelled pictures.

Run it from anywhere: ``python scripts/contact_sheet.py -o docs/images/scenes.webp``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont, ImageOps

from skugga.api.catalogue import bundled_levels
from skugga.api.compute import product_of_frame
from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.errors import SkuggaError
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

SHEET_PATH = Path(__file__).parents[1] / "docs" / "images" / "scenes.webp"
CELL_ASPECT = 5 / 4
"""Width over height of a picture's cell on the sheet: that of 1280 x 1024."""

GAP_PX, LABEL_PX, TEXT_PX = 12, 28, 16
"""Gap between cells, height of a label and height of its text, in pixels of the sheet."""
PAGE_COLOR, TEXT_COLOR = (255, 255, 255), (32, 32, 32)
WEBP_QUALITIES = range(85, 9, -5)


@dataclass(frozen=True)
class LabelledPicture:
    """A picture and the label below it."""

    picture: Image.Image
    label: str


def labelled_pictures(levels: Sequence[Path], width_px: int) -> Iterator[LabelledPicture]:
    """Yield a labelled picture of every view of some levels. Levels with the most views come first.

    ``levels`` are level files. ``width_px`` is the width of a picture's cell.
    """
    loaded = sorted((load_level(path) for path in levels), key=lambda level: -len(level.level.views))
    for scene in map(build_scene, loaded):
        for name in scene.loaded.level.views:
            label = f"{scene.loaded.name}: {name}"
            print(label, file=sys.stderr)
            yield LabelledPicture(render_view(scene, name, width_px), label)


def render_view(scene: Scene, name: str, width_px: int) -> Image.Image:
    """Return a view of a scene at its own aspect ratio, at most ``width_px`` pixels wide and ``width_px / CELL_ASPECT`` high."""
    native_view = scene.view(name)
    scale = min(width_px / native_view.cols, width_px / CELL_ASPECT / native_view.rows)
    size = max(round(native_view.cols * scale), 1), max(round(native_view.rows * scale), 1)
    view = scene.view(name, size=size)
    frame = render_frame(scene, view, make_plan(describe(scene, view, name), scene.loaded.level, {}))
    picture = Image.fromarray(product_of_frame(scene, frame, "color")).convert("RGBA")
    return Image.alpha_composite(Image.new("RGBA", picture.size, (*PAGE_COLOR, 255)), picture).convert("RGB")


def make_sheet(pictures: Sequence[LabelledPicture], columns: int, width_px: int) -> Image.Image:
    """Return a sheet of pictures, ``columns`` in a row. Each is ``width_px`` pixels wide, with its label below."""
    height = round(width_px / CELL_ASPECT)
    step_x, step_y = width_px + GAP_PX, height + LABEL_PX + GAP_PX
    rows = -(-len(pictures) // columns)
    page = Image.new("RGB", (columns * step_x + GAP_PX, rows * step_y + GAP_PX), PAGE_COLOR)
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(TEXT_PX)
    for number, entry in enumerate(pictures):
        x, y = GAP_PX + number % columns * step_x, GAP_PX + number // columns * step_y
        page.paste(ImageOps.pad(entry.picture, (width_px, height), color=PAGE_COLOR), (x, y))
        draw.text((x, y + height + LABEL_PX // 2), entry.label, TEXT_COLOR, font, anchor="lm")
    return page


def encode_webp(page: Image.Image, max_bytes: int) -> bytes:
    """Return the page as WebP at the best quality that fits into ``max_bytes``; at the lowest quality if none does."""
    for quality in WEBP_QUALITIES:
        buffer = BytesIO()
        page.save(buffer, "WEBP", quality=quality, method=6)
        if buffer.tell() <= max_bytes:
            break
    return buffer.getvalue()


def main() -> int:
    """Draw the sheet, write it, and return the exit status."""
    parser = argparse.ArgumentParser(description="Render every view of the bundled levels onto one sheet.")
    parser.add_argument("levels", nargs="*", type=Path, help="level files; default: all bundled levels")
    parser.add_argument("-o", "--output", type=Path, default=SHEET_PATH, help="the WebP file to write")
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--width", type=int, default=480, help="pixels of a picture")
    parser.add_argument("--most", type=int, default=600, help="maximum size of the file, kilobytes")
    arguments = parser.parse_args()
    try:
        entries = list(labelled_pictures(arguments.levels or bundled_levels(), arguments.width))
    except SkuggaError as error:
        parser.exit(1, f"contact_sheet: {error}\n")
    arguments.output.write_bytes(encode_webp(make_sheet(entries, arguments.columns, arguments.width), arguments.most * 1000))
    return 0


if __name__ == "__main__":
    sys.exit(main())
