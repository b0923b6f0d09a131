"""The experiments of the texts that Skugga began with, made again: each claim beside what is measured here.

    python benchmarks/seeds.py [EXPERIMENT ...] [--json benchmarks/seeds.json] [--markdown docs/seeds.md] [--write-only]

The texts: J. Sindholt, A comparison of Shadow Algorithms (DTU 2005); a thesis at Chalmers on shadows for the GIS SpatialAce; a
bachelor's report of Copenhagen on shadow volumes and shadow maps. Without names all experiments run, one after the other; figures of
those that do not run are taken from the JSON file, which holds all that was measured. `--write-only` measures nothing and writes the
page from the file. Times are ratios within one run, since milliseconds do not travel from one machine to another.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from claims import Experiment, Figures, markdown
from seeds_others import EXPERIMENTS as OTHERS
from seeds_quality import EXPERIMENTS as QUALITY
from seeds_speed import EXPERIMENTS as SPEED

from terrain.gl import device

EXPERIMENTS: dict[str, Experiment] = {**SPEED, **QUALITY, **OTHERS}

HERE = Path(__file__).parent

INTRODUCTION = """# The seeds' experiments, made again

Made by `benchmarks/seeds.py`: every number below is the script's. It runs the experiments of the texts that Skugga began with in the
levels that were built after their scenes, and sets each claim beside what is measured here. Where a finding of its time does not hold
on today's devices, that is a result too."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiments", nargs="*", metavar="EXPERIMENT", help=", ".join(EXPERIMENTS))
    parser.add_argument("--json", type=Path, default=HERE / "seeds.json", metavar="FILE")
    parser.add_argument("--markdown", type=Path, default=HERE.parent / "docs" / "seeds.md", metavar="FILE")
    parser.add_argument("--write-only", action="store_true")
    given = parser.parse_args()
    if unknown := set(given.experiments) - set(EXPERIMENTS):
        parser.error(f"no such experiment: {', '.join(sorted(unknown))}; there are {', '.join(EXPERIMENTS)}")
    measured: dict[str, Figures] = json.loads(given.json.read_text("utf-8")) if given.json.exists() else {}
    for name in [] if given.write_only else given.experiments or EXPERIMENTS:
        start = time.perf_counter()
        measured[name] = {**EXPERIMENTS[name].measure(), "device": device().renderer}
        given.json.write_text(json.dumps(measured, indent=1, sort_keys=True) + "\n", "utf-8")
        print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    given.markdown.write_text(page(measured), "utf-8")


def page(measured: dict[str, Figures]) -> str:
    """The page of all experiments that were measured, in order."""
    there = {name: experiment for name, experiment in EXPERIMENTS.items() if name in measured}
    devices = ", ".join(sorted({measured[name]["device"] for name in there}))
    parts = [INTRODUCTION, f"Device: {devices}.\n"]
    return "\n\n".join(parts) + "\n" + "\n".join(markdown(each.section(measured[name])) for name, each in there.items())


if __name__ == "__main__":
    main()
