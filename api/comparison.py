"""How a comparison is shown: a table on the terminal, false-colour pictures in a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL import Image
from rich.console import Console
from rich.table import Table

from selector.compare import Comparison, Row, false_colours
from selector.rules import choose
from shadows.render import render_frame
from terrain.descriptor import describe
from terrain.scene import Scene


def row_name(figures: dict[str, Any]) -> str:
    """A row's algorithm and settings in few words, as ``shadow_map-2048-3-16`` or ``hybrid-512-original``."""
    names = [name for per_kind in figures["algorithm"].values() for name in per_kind.values() if name != "none"]
    name = "+".join(dict.fromkeys(names)) or "none"
    every = [settings for per_kind in figures["settings"].values() for settings in per_kind.values()]
    words = next((_words(settings, "map_size", "filter", "depth_bits") for settings in every if "map_size" in settings), [])
    words = next((_words(settings["map"] | settings, "map_size", "mask") for settings in every if "mask" in settings), words)
    return "-".join([name, *words])


def show(comparison: Comparison, console: Console | None = None) -> None:
    """Print the rows, best first by ``wrong_cast``, and what holds for all of them."""
    console = console or Console(width=140)
    table = Table(box=None, header_style="bold")
    table.add_column("algorithm-map-filter-bits or -mask")
    for title in (
        "ms",
        "wrong cast %",
        "wrong %",
        "false %",
        "missed %",
        "edge p95 px",
        "interior %",
        "coverage %",
        "MB",
        "front",
    ):
        table.add_column(title, justify="right")
    for row in sorted(comparison.rows, key=lambda row: row.figures["wrong_cast"]):
        table.add_row(*_cells(row))
    console.print(table)
    console.print(
        f"boundary {100 * comparison.boundary:.2f} % of the surface (no error is counted there), "
        f"surface {100 * comparison.surface:.2f} % (what the drawn grid changes against the full raster), "
        f"noise floor {100 * comparison.noise_floor:.3f} % wrong"
    )
    for remark in comparison.remarks:
        console.print(f"note: {remark}")


def write_pictures(scene: Scene, comparison: Comparison, folder: Path, view: str = "map") -> None:
    """One PNG a row into a folder: false shadow red, missed shadow blue, over the shaded ground in gray."""
    folder.mkdir(parents=True, exist_ok=True)
    plan = choose(describe(scene, comparison.view, view), scene.loaded.level, {"algorithm": "none"})
    ground = render_frame(scene, comparison.view, plan).color.mean(axis=2)
    for row in comparison.rows:
        Image.fromarray(false_colours(ground, row)).save(folder / f"{row_name(row.figures)}.png")


def _words(settings: dict[str, Any], *names: str) -> list[str]:
    return [str(settings[name]) for name in names]


def _cells(row: Row) -> list[str]:
    f = row.figures
    return [
        row_name(f),
        f"{f['ms_median']:.0f}",
        f"{100 * f['wrong_cast']:.2f}",
        f"{100 * f['wrong']:.3f}",
        f"{100 * f['false_shadow']:.3f}",
        f"{100 * f['missed_shadow']:.3f}",
        f"{f['edge_p95']:.2f}",
        f"{100 * f['interior']:.4f}",
        f"{100 * f['coverage']:.2f}",
        f"{f['bytes'] / 1e6:.0f}",
        "*" if f["pareto"] else "",
    ]
