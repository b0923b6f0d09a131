"""Rasters of hours of sun: of any size, block by block, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from skugga.api.contour_lines import write_contours
from skugga.api.device_calibration import calibration_for
from skugga.api.raster_file import RasterNotes, cog
from skugga.api.shade import RasterView
from skugga.api.sun_quantities import QUANTITIES, QUANTITY_NOTES
from skugga.selector.select import plan_of_view
from skugga.shadows.plan import Plan
from skugga.shadows.sun_hours.sun_hours import SunRules, ground_extent, sun_hours
from skugga.shadows.sun_hours.suns import window_suns
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.covered_nodes import WIDE_M, is_bare
from skugga.terrain.geo.daily_windows import DailyWindow, clock_text
from skugga.terrain.geo.grid import BLOCK_PX, MapView, blocks_of, step_at_anchor_m
from skugga.terrain.scene import Scene

BLOCK_NODES = 2 * BLOCK_PX
"""Side of a block of bare ground: twice a picture's, since each of its suns looks for casters beside it anew."""

LARGE_RASTER_CELLS = 16_000_000
"""From as many on a raster's blocks are smaller: what may stand beside one is more than itself, and memory is bounded."""

BLOCK_NODES_OF_LARGE = BLOCK_PX

LEAST_BLOCK_NODES = 64


def write_sun_hours(
    scene: Scene,
    raster: RasterView,
    windows: Sequence[DailyWindow],
    rules: SunRules,
    paths: dict[str, Path],
    on_block: Callable[[int, int], None] | None = None,
    contours: tuple[Path, Sequence[float]] | None = None,
    clock: str = "solar",
) -> None:
    """Write some quantities of a raster's cells, by name, into a file each; and ``contours`` of the first, a file and values.
    The files say what sun they count, and name the windows' ``clock``.
    ``on_block(done, total)`` is called after each block of each date. Raises ``SkuggaError`` and ``OSError``.
    """
    for name in paths:
        if name not in QUANTITIES:
            raise InputError("quantity", name, ", ".join(QUANTITIES))
    days = window_suns(scene.world, windows)
    view = raster.view
    blocks, plan_of = sun_blocks(scene, view), _plans(scene)
    with ExitStack() as stack:
        files = {
            name: stack.enter_context(
                cog(
                    path,
                    raster.crs,
                    raster.transform,
                    raster.shape,
                    1,
                    "float32",
                    float("nan"),
                    name == "hours",
                    sun_hours_notes(scene, name, windows, rules, clock),
                )  # fmt: skip
            )
            for name, path in paths.items()
        }
        done, total = 0, len(blocks) * len(days)

        def on_day() -> None:
            nonlocal done
            done += 1
            if on_block is not None and done < total:
                on_block(done, total)

        for number, (block, row, col) in enumerate(blocks):
            done = number * len(days)
            found = sun_hours(scene, block, days, rules, plan_of(block), on_day)
            inside = slice(max(-row, 0), view.rows - row), slice(max(-col, 0), view.cols - col)
            for name, file in files.items():
                file.write(*raster.placed(max(row, 0), max(col, 0), QUANTITIES[name](found)[inside]))
    if contours is not None:
        write_contours(next(iter(paths.values())), contours[1], contours[0])
    if on_block is not None:
        on_block(total, total)


def sun_hours_notes(scene: Scene, quantity: str, windows: Sequence[DailyWindow], rules: SunRules, clock: str) -> RasterNotes:
    """What a raster of a quantity says of itself: the level, the dates, the part of each day, and what counts as sun."""
    about, unit = QUANTITY_NOTES[quantity]
    first, last = windows[0], windows[-1]
    tags = {
        "quantity": quantity, "level": scene.loaded.name, "date": first.date.isoformat(),
        "date_to": "" if len(windows) == 1 else last.date.isoformat(), "dates": str(len(windows)),
        "window": f"{clock_text(first.clock_min)}-{clock_text(round(first.reading_min(first.minutes)))}", "clock": clock,
        "step_min": "auto" if rules.step_min is None else f"{rules.step_min:g}",
        "threshold_h": f"{rules.threshold_h:g}" if quantity == "days" else "",
        "least_altitude_deg": f"{rules.least_altitude_deg:g}", "height_m": f"{rules.height_m:g}",
    }  # fmt: skip
    return RasterNotes(f"{quantity}: {about}", (about,), unit, tags)


def sun_hours_array(scene: Scene, raster: RasterView, windows: Sequence[DailyWindow], rules: SunRules, quantity: str) -> np.ndarray:
    """A quantity of a raster's cells, by name: float32 (rows, cols). Raises ``SkuggaError``."""
    if quantity not in QUANTITIES:
        raise InputError("quantity", quantity, ", ".join(QUANTITIES))
    days, plan_of, view = window_suns(scene.world, windows), _plans(scene), raster.view
    out = np.full((view.rows, view.cols), np.nan, np.float32)
    for block, row, col in sun_blocks(scene, view):
        found = QUANTITIES[quantity](sun_hours(scene, block, days, rules, plan_of(block)))
        inside = slice(max(-row, 0), view.rows - row), slice(max(-col, 0), view.cols - col)
        part = found[inside]
        rows, cols = part.shape
        out[max(row, 0) : max(row, 0) + rows, max(col, 0) : max(col, 0) + cols] = part
    return raster.order.in_raster(out)


def sun_blocks(scene: Scene, view: MapView) -> list[tuple[MapView, int, int]]:
    """The blocks in which hours of sun over a map's cells are found, as from ``blocks_of``: those of bare ground are larger,
    fixed on the cells' own grid, and end where the raster ends.
    """
    if not is_bare(scene):
        return blocks_of(view)
    nodes = view.as_nodes()
    side = BLOCK_NODES if scene.elevation.rows * scene.elevation.cols < LARGE_RASTER_CELLS else BLOCK_NODES_OF_LARGE
    if not scene.world.flat:
        side = int(np.clip(WIDE_M / step_at_anchor_m(scene.world, nodes.grid), LEAST_BLOCK_NODES, side))
    limits = []
    for (low, high), count in zip(ground_extent(scene, nodes), (view.rows, view.cols), strict=True):
        limits.append((int(max(np.floor(low), -side)), int(min(np.ceil(high) + 1.0, count + side))))
    (top, bottom), (left, right) = limits
    blocks = []
    for row in range(-(int(nodes.row0) % side), view.rows, side):
        for col in range(-(int(nodes.col0) % side), view.cols, side):
            first_row, first_col = max(row, top), max(col, left)
            rows, cols = min(row + side, bottom) - first_row, min(col + side, right) - first_col
            meets = first_row + rows > 0 and first_row < view.rows and first_col + cols > 0 and first_col < view.cols
            if rows > 0 and cols > 0 and meets:
                blocks.append((nodes.part(first_row, first_col, rows, cols), first_row, first_col))
    return blocks


def _plans(scene: Scene) -> Callable[[MapView], Callable[[Scene], Plan]]:
    """What plans a block under a sun."""
    device = None if is_bare(scene) else calibration_for(scene.loaded.level.shadows, {})
    return lambda block: lambda seen: plan_of_view(seen, block, "map", {}, device=device)
