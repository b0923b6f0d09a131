"""Contact sheet of the shadow algorithms: each algorithm's picture of some views, and its errors.

    python -m benchmarks.contact_sheet [-o docs/images/algorithms.webp] [--width 400] [--most 1500] [--repeats 3]
                                       [--columns boxgrid rocks ...] [--rows shadow_map hybrid ...] [--json FILE] [--markdown FILE]

Rows are algorithms, columns are views. A cell shows the picture and its errors against ray-traced truth: false shadow red, missed
shadow blue. Pictures are drawn at their display width, ``width`` pixels. The caption below has three figures: ``wrong_cast``, the
95th percentile of the displacement of shadow edges, and the median milliseconds of the shadow passes with empty caches. If an
algorithm refuses a view, the cell shows its message.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from textwrap import wrap
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from skugga.api.catalogue import find_level
from skugga.selector.measure.compare import false_colours, measure_plan
from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.geo.grid import MapView
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

SHEET_PATH = Path(__file__).parents[1] / "docs" / "images" / "algorithms.webp"
CELL_ASPECT_RATIO = 5 / 4
"""Width of a picture divided by its height."""

SHEET_ALGORITHMS: dict[str, dict[str, Any]] = {
    "shadow_map 1024": {"algorithm": "shadow_map", "map_size": 1024, "cascades": 1},
    "perspective_shadow_map 1024": {"algorithm": "perspective_shadow_map", "map_size": 1024},
    "light_space_perspective_map 1024": {"algorithm": "light_space_perspective_map", "map_size": 1024},
    "shadow_volume": {"algorithm": "shadow_volume"},
    "hybrid": {"algorithm": "hybrid"},
    "reconstructed_volume 1024": {"algorithm": "reconstructed_volume", "map_size": 1024},
    "hybrid original": {"algorithm": "hybrid", "mask": "original"},
}
"""Rows of the sheet: overrides of a level's ``shadows`` by name."""

VIEWS = {
    "boxgrid": ("thesis_boxgrid_sun", "close"),
    "rocks": ("thesis_rocks_sun", "main"),
    "street": ("thesis_street_sun", "main"),
    "room": ("thesis_room_sun", "main"),
    "water_tower": ("thesis_water_tower_sun", "main"),
    "ridges": ("jacksboro", "ridges"),
    "map": ("jacksboro", "map"),
}
"""Columns of the sheet: level and view by name."""

FAULT_BOUNDS_M = (740_900.0, 4_021_000.0, 748_900.0, 4_027_400.0)
"""West, south, east and north, metres in UTM zone 16, of the map of Jacksboro: the fault's ridge and the hills west of it."""

RIDGES_CAMERA = (-84.16, 36.21333, 120.0), (-84.20, 36.25333, 0.0), 45.0
"""Eye, target and field of view, degrees, of a view over the ridges and valleys of the Jacksboro fault."""

REPORTED_METRICS = ("wrong_cast", "false_shadow", "missed_shadow", "interior", "coverage", "boundary", "edge_p95", "ms_median")
"""Figures of a comparison with truth that the JSON file contains."""

GAP_PX, TEXT_PX = 12, 17
"""Gap between cells and height of text, in pixels of the sheet."""
HEADER_PX, FOOTER_PX = 30, 28
"""Heights of the lines above and below a picture, in pixels of the sheet."""
PAGE_COLOR, TEXT_COLOR, PLACEHOLDER_COLOR = (255, 255, 255), (24, 24, 24), (238, 238, 238)
WEBP_QUALITIES = range(90, 9, -5)


@dataclass(frozen=True)
class SheetCell:
    """A cell of the sheet: one algorithm in one view.

    Attributes
    ----------
    pictures
        The picture and its errors in colour; ``None`` if the algorithm refuses the view.
    figures
        Measured figures by name.
    caption
        Text below the picture.
    """

    pictures: tuple[Image.Image, Image.Image] | None
    figures: dict[str, float]
    caption: str


def named_view(scene: Scene, name: str, size: tuple[int, int]) -> MapView | PerspectiveView:
    """Return a view by name. This module defines the views ``map`` and ``ridges`` of the level Jacksboro."""
    if name == "map":
        return scene.view(name, bounds=FAULT_BOUNDS_M, size=size)
    if name != "ridges":
        return scene.view(name, size=size)
    eye, up = scene.geolocator.point_above_ground(RIDGES_CAMERA[0], "eye")
    target, _ = scene.geolocator.point_above_ground(RIDGES_CAMERA[1], "target")
    return look_at(eye, target, up, RIDGES_CAMERA[2], size[1], size[0])


def draw_column(level: str, name: str, algorithms: Sequence[str], size: tuple[int, int], repeats: int) -> Iterator[SheetCell]:
    """Yield the cells of a view, one for each algorithm.

    ``name`` is the view's name in the bundled level. ``algorithms`` are keys of ``SHEET_ALGORITHMS``. ``size`` is (width, height)
    in pixels. ``repeats`` is the number of timed runs.
    """
    scene = build_scene(load_level(find_level(level)))
    view = named_view(scene, name, size)
    descriptor = describe(scene, view, "map" if name == "map" else "main")
    bare = render_frame(scene, view, make_plan(descriptor, scene.loaded.level, {"algorithm": "none"})).color.mean(axis=2)
    for key in algorithms:
        try:
            plan = make_plan(descriptor, scene.loaded.level, SHEET_ALGORITHMS[key])
        except UnsupportedError as error:
            yield SheetCell(None, {}, str(error))
            continue
        color = render_frame(scene, view, plan).color  # compiles and allocates, too
        row = measure_plan(scene, view, plan, repeats=repeats)
        pictures = Image.fromarray(color).convert("RGB"), Image.fromarray(false_colours(bare, row))
        figures = {name: row.figures[name] for name in REPORTED_METRICS}
        text = f"wrong {100 * figures['wrong_cast']:.2f} % of cast shadow; edge p95 {figures['edge_p95']:.1f} px"
        yield SheetCell(pictures, figures, f"{text}; {figures['ms_median']:.0f} ms")


def draw_sheet(cells: dict[tuple[str, str], SheetCell], rows: Sequence[str], columns: Sequence[str], width: int) -> Image.Image:
    """Draw all cells in a grid with names of rows and columns.

    Keys of ``cells`` are an entry of ``rows`` (names of algorithms) and one of ``columns`` (keys of ``VIEWS``). ``width`` is that
    of a picture in pixels; a cell has two of them.
    """
    height = round(width / CELL_ASPECT_RATIO)
    step_x, step_y = 2 * width + GAP_PX, HEADER_PX + height + FOOTER_PX + GAP_PX
    page = Image.new("RGB", (len(columns) * step_x + GAP_PX, len(rows) * step_y + GAP_PX), PAGE_COLOR)
    draw, font = ImageDraw.Draw(page), ImageFont.load_default(TEXT_PX)
    for column, name in enumerate(columns):
        for down, key in enumerate(rows):
            x, y, cell = GAP_PX + column * step_x, GAP_PX + down * step_y, cells[key, name]
            top = y + HEADER_PX
            draw.text((x, y + HEADER_PX // 2), f"{key}: {' '.join(VIEWS[name])}", TEXT_COLOR, font, anchor="lm")
            if cell.pictures is None:
                draw.rectangle((x, top, x + 2 * width - 1, top + height - 1), PLACEHOLDER_COLOR)
                lines = "\n".join(wrap(cell.caption, 2 * width * 2 // TEXT_PX - 6))
                draw.multiline_text((x + width, top + height // 2), lines, TEXT_COLOR, font, anchor="mm", align="center")
                continue
            for number, picture in enumerate(cell.pictures):
                page.paste(picture, (x + number * width, top))
            draw.text((x, top + height + FOOTER_PX // 2), cell.caption, TEXT_COLOR, font, anchor="lm")
    return page


def encode_sheet(page: Image.Image, suffix: str, max_bytes: int) -> bytes:
    """Encode the page as PNG, or as WebP in the highest quality that fits into ``max_bytes`` (the lowest if none fits).

    ``suffix`` is ".png" or ".webp".
    """
    for quality in WEBP_QUALITIES:
        buffer = BytesIO()
        page.save(buffer, suffix.removeprefix("."), quality=quality, method=6)
        if buffer.tell() <= max_bytes or suffix == ".png":
            break
    return buffer.getvalue()


def markdown_table(cells: dict[tuple[str, str], SheetCell]) -> str:
    """Return ``wrong_cast`` in per cent and ``edge_p95`` in pixels as a Markdown table: a line per view, a column per algorithm."""
    rows, columns = list(dict.fromkeys(key for key, _ in cells)), list(dict.fromkeys(name for _, name in cells))
    lines = [["view", *rows], ["---"] * (1 + len(rows))]
    for name in columns:
        row_figures = [cells[key, name].figures for key in rows]
        entries = [
            f"{100 * figures['wrong_cast']:.2f} / {figures['edge_p95']:.1f}" if figures else "refused" for figures in row_figures
        ]
        lines.append([" ".join(VIEWS[name]), *entries])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def main() -> None:
    """Draw the sheet, and write it with its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=SHEET_PATH, help="the .webp or .png file to write")
    parser.add_argument("--rows", nargs="+", choices=tuple(SHEET_ALGORITHMS), default=tuple(SHEET_ALGORITHMS))
    parser.add_argument("--columns", nargs="+", choices=tuple(VIEWS), default=tuple(VIEWS))
    parser.add_argument("--width", type=int, default=400, help="pixels of a picture")
    parser.add_argument("--most", type=int, default=1500, help="maximum size of the file, kilobytes")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    size = args.width, round(args.width / CELL_ASPECT_RATIO)
    cells = {}
    for name in args.columns:
        for key, cell in zip(args.rows, draw_column(*VIEWS[name], args.rows, size, args.repeats), strict=True):
            cells[key, name] = cell
            print(f"{key} {name}: {cell.caption}", flush=True)
    page = draw_sheet(cells, args.rows, args.columns, args.width)
    args.output.write_bytes(encode_sheet(page, args.output.suffix, 1000 * args.most))
    if args.markdown:
        legend = "wrong pixels in % of cast shadow / 95th percentile of the displacement of shadow edges, pixels"
        text = f"{device().renderer}, {size[0]} x {size[1]} pixels; {legend}\n\n{markdown_table(cells)}"
        args.markdown.write_text(text, encoding="utf-8")
    if args.json:
        rows = [
            {"algorithm": key, "view": VIEWS[name], "text": cell.caption, **cell.figures} for (key, name), cell in cells.items()
        ]
        args.json.write_text(
            json.dumps({"renderer": device().renderer, "size": size, "rows": rows}, indent=2) + "\n", encoding="utf-8"
        )


if __name__ == "__main__":
    main()
