"""Test whether probes in the middle of a level apply elsewhere: compare choices in other blocks with those in the middle.

    python -m benchmarks.selection.blocks DATA       minutes on two cores; the device must be calibrated (skugga calibrate)

A probe renders a few choices of shadow algorithms, and compares them with ray-traced truth. The script prints how far errors and
times of the same choice differ between blocks (``skugga.selector.map_probes``). It also prints how often plans of other blocks meet
errors of 1 % and 3 %, and their cost. Plans are made by prediction, with a probe of the middle, and with probes as a service makes
them.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import defaultdict
from math import hypot, log
from pathlib import Path

import numpy as np

from benchmarks.selection.views import RASTERS, scene_of
from skugga.api.map_probing import map_block, probe_blocks
from skugga.api.workers.idle_probes import PROBE_BUDGET_S
from skugga.selector.cost.device_profile import DeviceProfile, load_profile
from skugga.selector.cost.error_model import log_error
from skugga.selector.map_probes import MapClass, MapProbes, ProbedClass
from skugga.selector.measure.probe import probed_plan
from skugga.selector.measure.probing import leader_of
from skugga.selector.measure.scene_prober import ProbedPictures, SceneProber
from skugga.selector.planner.planner import make_plan, planner_of
from skugga.selector.predict import plan_options
from skugga.terrain.describe import describe
from skugga.terrain.geo.grid import MapView
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import SUN
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene

LEVELS = ("jacksboro_wooded", "grenoble", "lisbon", "sanfrancisco", "quebec", "bilbao, trees")
"""Levels to probe: keys of ``RASTERS``, or names of bundled levels."""
PLACES = ((0.25, 0.3), (0.75, 0.72), (0.45, 0.85))
"""Centres of the other blocks, as shares of the level's sides from the west and from the south."""
SUNS = (SunSpec(azimuth=140.0, altitude=12.0), SunSpec(azimuth=220.0, altitude=40.0))
TARGETS = (0.01, 0.03)
"""Largest allowed errors (shares of the cast shadow) for which plans are made."""
MAX_POINTS_S = 2.0
"""Seconds that truth at the next set of sample points may take. Points are added while it would take less."""


def main() -> None:
    """Compare the blocks of all levels, suns and pixel sizes, and print the summary."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data
    gpu = device()
    profile = load_profile(gpu.renderer, gpu.version)
    assert profile is not None and not profile.is_estimate, "run skugga calibrate first"
    differences: dict[str, list[tuple[float, float]]] = defaultdict(list)
    outcomes: dict[tuple[str, float], list[tuple[bool, float]]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as folder:
        for name in LEVELS:
            opened = scene_of(RASTERS.get(name, name), data, Path(folder))
            cell_m = opened.elevation.cell_size_m(opened.world.metres_per_unit)
            for sun in SUNS:
                for pixel_m in (cell_m, 4.0 * cell_m):
                    text = f"{name}, {sun.altitude:g} degrees, {pixel_m:.3g} m"
                    _compare_block(text, opened.with_sun(sun), pixel_m, profile, differences, outcomes)
            opened.close()
    for label, values in differences.items():
        deviation, chance = np.array(values).T
        square, by_chance, third = np.mean(deviation**2), np.mean(chance**2), np.quantile(np.abs(deviation), 2 / 3)
        print(
            f"{label}: {len(deviation)} differences of logarithms, root mean square {np.sqrt(square):.2f}, by chance (few points, "
            f"noisy clocks) {np.sqrt(by_chance):.2f}; two in three under {third:.2f}"
        )
    for (policy, target), rows in outcomes.items():
        met, times = [row[0] for row in rows], [row[1] for row in rows]
        print(f"{policy}, {100 * target:g} %: {sum(met)} of {len(met)} blocks keep to it, {np.mean(times):.1f} ms in the mean")


def _compare_block(
    name: str,
    scene: Scene,
    pixel_m: float,
    profile: DeviceProfile,
    differences: dict[str, list[tuple[float, float]]],
    outcomes: dict[tuple[str, float], list[tuple[bool, float]]],
) -> None:
    """Compare the level's blocks at ``PLACES`` with probes, and add the results to ``differences`` and ``outcomes``.

    ``name`` is printed. ``pixel_m`` is the side of a pixel in metres. ``differences`` has the keys ``errors`` and ``times``. Its
    entries are pairs: the difference between the logarithms of a choice's figure in a block and in the probe, and the standard
    deviation of that difference that sampling alone explains. Keys of ``outcomes`` are a way of planning (predict, a probe of the
    middle, probes) and the largest allowed error. Its entries are pairs: whether the block's plan stays within that error, and its
    milliseconds.
    """
    probed = probe_blocks(scene, pixel_m, profile, budget_s=PROBE_BUDGET_S)
    observed_options = probed.observations.get(SUN, ())
    origin_class = MapClass(0, 0)
    middle = probed_plan(scene, map_block(scene, pixel_m), device=profile, budget_s=PROBE_BUDGET_S)
    elsewhere, of_middle = (
        MapProbes(classes=(ProbedClass(scale=0, sun=0, seen=probe.observations),)).observations_of_class(origin_class) or {}
        for probe in (probed, middle)
    )
    print(name, [f"{probe.choice} {probe.error:.2%} {probe.ms:.1f} ms" for probe in observed_options], flush=True)
    for place in PLACES:
        block = _Block(scene, map_block(scene, pixel_m, place), profile)
        if block.options is None:
            continue
        numbers = {option.choice.name: number for number, option in enumerate(block.options.options)}
        for probe in observed_options:
            if probe.choice in numbers:
                error, ms, noise = block.measured_option(numbers[probe.choice])
                deviation, chance = log_error(error) - log_error(probe.error), hypot(probe.error_noise, noise)
                differences["errors"].append((deviation, chance))
                differences["times"].append((log(ms) - log(probe.ms), hypot(probe.ms_noise, probe.ms_noise)))
        beliefs = {"predict": block.options}
        for policy, observations in (("a probe of the middle", of_middle), ("probes", elsewhere)):
            beliefs[policy] = block.options.with_observations(observations.get(SUN, ()))
        for target in TARGETS:
            for policy, believed in beliefs.items():
                error, ms, _ = block.measured_option(leader_of(believed, target, None))
                outcomes[policy, target].append((error <= target, ms))


class _Block:
    """A block of map tiles. Each option (choice of algorithms for the sun) is drawn at most once.

    ``options`` is ``None`` if no object in the block casts shadows.
    """

    def __init__(self, scene: Scene, view: MapView, profile: DeviceProfile) -> None:
        descriptor = describe(scene, view, "map", "points")
        options = plan_options(planner_of(descriptor, scene.loaded.level, None), profile)
        self.options = options.lights.get(SUN)
        if self.options is not None:
            pictures = ProbedPictures(scene, view, make_plan(descriptor, scene.loaded.level, None, choices={}).effect_names)
            self._prober = SceneProber(pictures, options.planner, SUN, self.options)
        self._drawn: dict[int, tuple[float, float, float]] = {}

    def measured_option(self, which: int) -> tuple[float, float, float]:
        """Return error, milliseconds and error noise of the option with the index ``which`` in ``options.options``.

        The noise is the standard deviation of the error's logarithm that sampling of points causes. A refused option has the error
        1 and infinite time.
        """
        if which not in self._drawn:
            ms = self._prober.draw(which)
            while not self._drawn and (self._prober.add_points_s() or np.inf) < MAX_POINTS_S:
                self._prober.add_points()
            observation = None if ms is None else self._prober.measurement(which).to_observation("", ms)
            self._drawn[which] = (
                (1.0, np.inf, 0.0) if observation is None else (observation.error, observation.ms, observation.error_noise)
            )
        return self._drawn[which]


if __name__ == "__main__":
    main()
