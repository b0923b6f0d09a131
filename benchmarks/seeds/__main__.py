"""Replications of the experiments in the texts that Skugga is based on: claims of the texts and our measurements.

    python -m benchmarks.seeds [EXPERIMENT ...] [--json benchmarks/seeds/seeds.json] [--markdown docs/reports/seeds.md]
        [--write-only] [--without DEVICE]

The texts are J. Sindholt, A comparison of Shadow Algorithms (DTU 2005); a thesis at Chalmers on shadows for the GIS SpatialAce; and
a bachelor's report of Copenhagen on shadow volumes and shadow maps. The page ends with a list of everything in these and two more
texts, `items.yaml`.

Without names all experiments run, one after the other. With names, the stored figures of the other experiments stay in the JSON
file. `--write-only` measures nothing and writes the page, with its list, and the counts of claims in docs/seeds.md from
the files. Times are ratios within one run, since milliseconds are not comparable between machines.

The experiments measure the device that commands draw with (`SKUGGA_EGL_DEVICE`). Figures of other devices stay in the file, and the
page shows all of them. `--without` removes a device from the file and from the page.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

from benchmarks.report_pages import write_between_marks
from benchmarks.seeds import advice as seeds_advice
from benchmarks.seeds import bias as seeds_bias
from benchmarks.seeds import depth as seeds_depth
from benchmarks.seeds import forward as seeds_forward
from benchmarks.seeds import grades as seeds_grades
from benchmarks.seeds import items as seeds_items
from benchmarks.seeds import map_size as seeds_map_size
from benchmarks.seeds import perspective as seeds_perspective
from benchmarks.seeds import silhouettes as seeds_silhouettes
from benchmarks.seeds import spatialace as seeds_spatialace
from benchmarks.seeds import speed as seeds_speed
from benchmarks.seeds import thin as seeds_thin
from benchmarks.seeds import trapezoidal as seeds_trapezoidal
from benchmarks.seeds import tree as seeds_tree
from benchmarks.seeds.claims import Experiment, markdown_table
from benchmarks.seeds.devices import FiguresByDevice, add_figures, current_commit, format_devices, format_experiment, read_figures
from benchmarks.seeds.pictures import enable_pictures
from benchmarks.seeds.verdicts import DRAW_FACTOR, format_whole_percent
from skugga.terrain.gl.device import device

EXPERIMENTS = {
    "stages": Experiment(seeds_speed.measure_stages, seeds_speed.make_stages_section),
    "stencil": Experiment(seeds_speed.measure_stencil, seeds_speed.make_stencil_section),
    "grades": Experiment(seeds_grades.measure, seeds_grades.make_section),
    "advice": Experiment(seeds_advice.measure, seeds_advice.make_section),
    "map_size": Experiment(seeds_map_size.measure, seeds_map_size.make_section),
    "light_direction": Experiment(seeds_perspective.measure_light_direction, seeds_perspective.make_light_direction_section),
    "bad_case": Experiment(seeds_perspective.measure_bad_case, seeds_perspective.make_bad_case_section),
    "thin": Experiment(seeds_thin.measure, seeds_thin.make_section),
    "tree": Experiment(seeds_tree.measure, seeds_tree.make_section),
    "spatialace": Experiment(seeds_spatialace.measure, seeds_spatialace.make_section),
    "silhouettes": Experiment(seeds_silhouettes.measure, seeds_silhouettes.make_section),
    "bias": Experiment(seeds_bias.measure, seeds_bias.make_section),
    "depth": Experiment(seeds_depth.measure, seeds_depth.make_section),
    "trapezoidal": Experiment(seeds_trapezoidal.measure, seeds_trapezoidal.make_section),
    "forward": Experiment(seeds_forward.measure, seeds_forward.make_section),
}
"""Experiments in the order of the page."""

FOLDER = Path(__file__).parent

DOCS = FOLDER.parents[1] / "docs"

REPORT, SUMMARY_PAGE = DOCS / seeds_items.PAGE, DOCS / "seeds.md"
"""The page of all figures, and the page that sums up its claims between marks."""

INTRODUCTION = f"""# Report: the seeds' experiments, made again

Made by `python -m benchmarks.seeds`, which writes every number below. Skugga began with a few texts ([the seeds](../seeds.md)). The
script repeats their experiments in levels built after their scenes, and compares each claim with what is measured here.
[{seeds_items.LIST_TITLE}](#{seeds_items.LIST_ANCHOR}), item by item, ends the page.

Verdicts follow from the figures, by the condition in brackets. If the deciding figure lies within
{format_whole_percent(DRAW_FACTOR - 1.0)} of its limit, the claim stays open: a draw. SM, PSM and SV are `shadow_map`,
`perspective_shadow_map` and `shadow_volume`. Figures such as `wrong_cast`, `false_shadow` and `edge_p95` are those of
`skugga compare`, against ray-traced truth. Figures over ground with relief (`spatialace`, Jacksboro) in sections
without a commit were measured before the rules of shared points, cuts and smooth ground of [accuracy.md](../accuracy.md) held."""


def main() -> None:
    """Run the experiments of the command line, and write the figures and the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiments", nargs="*", metavar="EXPERIMENT", help=", ".join(EXPERIMENTS))
    parser.add_argument("--json", type=Path, default=FOLDER / "seeds.json", metavar="FILE")
    parser.add_argument("--markdown", type=Path, default=REPORT, metavar="FILE")
    parser.add_argument("--write-only", action="store_true")
    parser.add_argument("--without", metavar="DEVICE", help="OpenGL's name of the device to remove, as on the page")
    args = parser.parse_args()
    if unknown := set(args.experiments) - set(EXPERIMENTS):
        parser.error(f"no such experiment: {', '.join(sorted(unknown))}. Allowed: {', '.join(EXPERIMENTS)}.")
    measured, commit = read_figures(args.json), current_commit()
    if args.without is not None and measured.pop(args.without, None) is None:
        parser.error(f"--without: the file has no figures of {args.without}. It has figures of: {'; '.join(measured)}.")
    for name in [] if args.write_only else args.experiments or EXPERIMENTS:
        start = time.perf_counter()
        enable_pictures(not measured or device().renderer == next(iter(measured)))
        add_figures(measured, device(), name, round_figures(EXPERIMENTS[name].measure()), commit)
        args.json.write_text(json.dumps(measured) + "\n", "utf-8")
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    if args.without is not None:
        args.json.write_text(json.dumps(measured) + "\n", "utf-8")
    args.markdown.write_text(format_page(measured), "utf-8")
    if args.markdown == REPORT:
        write_between_marks(SUMMARY_PAGE, format_summary(measured))


def round_figures(figures: Any) -> Any:
    """Round all numbers in nested figures to six significant digits."""
    if isinstance(figures, dict):
        return {name: round_figures(value) for name, value in figures.items()}
    if isinstance(figures, list | tuple):
        return [round_figures(value) for value in figures]
    return float(f"{figures:.6g}") if isinstance(figures, float) else figures


def format_page(measured: FiguresByDevice) -> str:
    """Format the page of all measured experiments, with the figures of all devices, and the list of everything in the texts."""
    sections = (format_experiment(name, experiment, measured) for name, experiment in EXPERIMENTS.items())
    head = "\n\n".join([INTRODUCTION, format_devices(measured)])
    list_of_items = seeds_items.format_items(seeds_items.read_items())
    return head + "\n\n" + "\n".join([*(section for section in sections if section is not None), list_of_items])


def format_summary(measured: FiguresByDevice) -> str:
    """Format how many claims hold on the main device, in all and for each experiment."""
    figures = next(iter(measured.values()))["experiments"]
    rows, total = [], Counter[bool | None]()
    for name, experiment in EXPERIMENTS.items():
        if name not in figures:
            continue
        section = experiment.make_section(figures[name])
        counts = Counter(claim.verdict for claim in section.claims)
        total += counts
        cells = {title: str(counts[verdict]) for title, verdict in (("held", True), ("not held", False), ("open", None))}
        rows.append({"experiment": section.title, **cells})
    sentence = f"Of {total.total()} claims {total[True]} hold, {total[False]} do not, and {total[None]} are open."
    return "\n".join([sentence, "", *markdown_table(rows)])


if __name__ == "__main__":
    main()
