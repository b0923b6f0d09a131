"""Frames at rest: the share of a new frame's time that remains, as plans expect it and as measured.

    python -m benchmarks.at_rest [LEVEL ...] [--size 640 512] [--repeats 5]

Nothing moves between a frame and the next: maps, volumes and masks of hybrids are cached. For some algorithms in the levels' main
views, the script prints the expected share (``ms_at_rest`` over ``ms``, with this device's calibration or the estimate of a typical
one), and the measured one. Measured times are the processor's, of all threads, since other load on the machine does not change
them. Each is the median of several turns.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from benchmarks.benchmark_views import benchmark_view, run_interleaved
from skugga.api.device_calibration import calibration_for
from skugga.selector.select import select
from skugga.terrain.describe import describe
from skugga.terrain.gl.device import device

LEVELS = ("thesis_rocks_sun", "thesis_street_sun", "thesis_boxgrid", "thesis_water_tower_sun")
"""Bundled levels with a single light in which nothing moves."""

VARIANTS = {
    "shadow_map 1024": {"algorithm": "shadow_map", "map_size": 1024, "cascades": 1},
    "shadow_map 4096": {"algorithm": "shadow_map", "map_size": 4096},
    "perspective_shadow_map 1024": {"algorithm": "perspective_shadow_map", "map_size": 1024},
    "shadow_volume": {"algorithm": "shadow_volume"},
    "hybrid": {"algorithm": "hybrid"},
}
"""Names and overrides of the compared plans."""


def shares_of_level(level: str, size: tuple[int, int], repeats: int) -> dict[str, tuple[float, float]]:
    """Return the expected and the measured share of a new frame's time that remains at rest, by name of the variant.

    ``size`` is (width, height) in pixels. ``repeats`` is the number of timed turns.
    """
    view = benchmark_view(level, "main", size)
    descriptor, loaded = describe(view.scene, view.view, "main"), view.scene.loaded.level
    profile = calibration_for(loaded.shadows, {})
    plans = {name: select(descriptor, loaded, overrides, "predict", profile) for name, overrides in VARIANTS.items()}
    times_ms = run_interleaved({name: (view, plan) for name, plan in plans.items()}, repeats, time.process_time).times_ms
    shares = {}
    for name, plan in plans.items():
        predicted = plan.predicted
        expected = np.nan if predicted is None or predicted.ms_at_rest is None else predicted.ms_at_rest / predicted.ms
        shares[name] = expected, float(np.median(times_ms[name, "kept"]) / np.median(times_ms[name, "redrawn"]))
    return shares


def main() -> None:
    """Print a Markdown table of the levels on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("levels", nargs="*", default=LEVELS)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 512))
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    print(device().renderer, "", f"| level | {' | '.join(VARIANTS)} |", "| --- |" + " --- |" * len(VARIANTS), sep="\n")
    for level in args.levels:
        shares = shares_of_level(level, tuple(args.size), args.repeats)
        print(f"| {level} | " + " | ".join(f"{expected:.2f}, {measured:.2f}" for expected, measured in shares.values()) + " |")


if __name__ == "__main__":
    main()
