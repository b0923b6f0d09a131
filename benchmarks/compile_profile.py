"""CPU seconds that numba takes to compile each loop for the first product, and to compile its own helper functions.

A loop is a function that numba compiles. `python -m benchmarks.start --compile` calls this module in a fresh process without a
cache of compiled loops.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from threading import local
from typing import Any

import numba
import numpy as np
import rasterio
from numba.core import event

from benchmarks.sweep_speed import fractal_heights_m

ROOT = Path(__file__).resolve().parents[1]
WOODED_LEVEL = ROOT / "configs" / "jacksboro_wooded.yaml"

SIDE_CELLS, CELL_M = 400, 30.0
"""Size of the raster that is written: 12 x 12 km of fractal mountains in UTM zone 11, with a hole."""

PROJECT_PACKAGES = "skugga", "benchmarks"
"""Packages whose loops belong to the project. Others are helpers of numba."""
BASELINE_REPEATS = 3


@dataclass
class Compilation:
    """A compilation of one loop for one signature.

    Attributes
    ----------
    loop : str
        Module and name.
    signature : str
        Types of its arguments.
    cause : str
        The project's loop whose compilation required this one; the loop itself if it belongs to the project.
    own_s, total_s : float
        CPU seconds without and with the compilation of its callees.
    frontend_s : float
        Part of ``own_s`` before the generation of machine code, such as type inference, in seconds.
    """

    loop: str
    signature: str
    cause: str
    own_s: float = 0.0
    total_s: float = 0.0
    frontend_s: float = 0.0

    @property
    def is_project_loop(self) -> bool:
        """Whether the loop is one of this project, rather than a helper function of numba."""
        return self.loop.split(".")[0] in PROJECT_PACKAGES


@dataclass
class CompilationListener(event.Listener):
    """Record the CPU time of numba's compiler passes, by loop and signature."""

    compilations: list[Compilation] = field(default_factory=list)
    _state: local = field(default_factory=local)

    def _stack(self) -> list[Any]:
        """Return the running compiler passes of this thread, from outermost to innermost.

        An entry is a list: the compilation, the CPU time at the start of the pass, and the seconds of nested passes.
        """
        if not hasattr(self._state, "stack"):
            self._state.stack, self._state.siblings = [], [{}]
        return self._state.stack

    def on_start(self, event: Any) -> None:
        """Record the start of a compiler pass, which may be nested in a pass of the caller."""
        stack = self._stack()
        siblings = self._state.siblings[-1]
        module, name = event.data["module"], event.data["qualname"]
        key = f"{module}.{name}", str(event.data["args"])
        if key not in siblings:
            compilation = Compilation(*key, cause="")
            compilation.cause = compilation.loop if compilation.is_project_loop or not stack else stack[-1][0].cause
            siblings[key] = compilation
            self.compilations.append(compilation)
        self._state.siblings.append({})
        stack.append([siblings[key], time.thread_time(), 0.0])

    def on_end(self, event: Any) -> None:
        """Record the end of the innermost compiler pass."""
        stack = self._stack()
        self._state.siblings.pop()
        compilation, begin, nested_s = stack.pop()
        elapsed_s = time.thread_time() - begin
        compilation.total_s += elapsed_s
        compilation.own_s += elapsed_s - nested_s
        if "native_lowering" not in event.data["name"]:
            compilation.frontend_s += elapsed_s - nested_s
        if stack:
            stack[-1][2] += elapsed_s


def reference_compile_s() -> float:
    """Return the median CPU seconds to compile a fixed small loop, as a reference for the speed of the machine."""
    seconds = []
    for number in range(BASELINE_REPEATS + 1):  # the first round imports numba's modules
        source = _reference_loop(number)
        begin = time.process_time()
        source(np.zeros((4, 4)), 1.0)
        seconds.append(time.process_time() - begin)
    return float(np.median(seconds[1:]))


def _reference_loop(number: int) -> Callable[[np.ndarray, float], float]:
    """Return a small loop that is not compiled yet. Each ``number`` gives other machine code, so that no cache holds it."""

    @numba.njit
    def smooth(values, weight):  # type: ignore[no-untyped-def]
        total = float(number)
        for i in range(1, values.shape[0] - 1):
            for j in range(1, values.shape[1] - 1):
                near = values[i - 1, j] + values[i + 1, j] + values[i, j - 1] + values[i, j + 1]
                values[i, j] += weight * (near / 4 - values[i, j])
                total += np.sqrt(abs(values[i, j]))
        return total

    return smooth  # type: ignore[no-any-return]


def write_mountains(folder: Path) -> Path:
    """Write a GeoTIFF of fractal mountains with a hole, and return its path."""
    heights = fractal_heights_m(SIDE_CELLS)
    heights[100:120, 200:230] = -9999.0
    path = folder / "mountains.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=SIDE_CELLS, height=SIDE_CELLS, count=1, dtype="float32", crs="EPSG:32611", nodata=-9999.0,
        transform=rasterio.transform.from_origin(400_000.0, 3_800_000.0, CELL_M, CELL_M),
    ) as file:  # fmt: skip
        file.write(heights, 1)
    return path


def _draw_tile(file: str, folder: Path) -> None:
    """Draw the first block of tiles in the middle of a level file, as a render process does. ``folder`` is not used."""
    from morecantile import tms as matrix_sets

    from skugga.api.compute import draw_picture
    from skugga.api.products import product_named
    from skugga.api.workers.block_views import block_of_grid
    from skugga.api.workers.warm_up import warm_up
    from skugga.selector.select import plan_of_view
    from skugga.terrain.geo.grid import BLOCK_PX, tile_grid
    from skugga.terrain.level.level import load_level
    from skugga.terrain.level.level_source import LevelSource
    from skugga.terrain.scene import build_scene

    warm_up()
    scene, zoom = build_scene(load_level(LevelSource(path=Path(file).resolve()))), 12
    grid, matrices = tile_grid(matrix_sets.get("WebMercatorQuad"), zoom), matrix_sets.get("WebMercatorQuad")
    point = matrices.xy(scene.world.anchor_lon_deg, scene.world.anchor_lat_deg)
    x, y = int((point.x - grid.x0) / grid.step // BLOCK_PX), int((grid.y0 - point.y) / grid.step // BLOCK_PX)
    view = block_of_grid(grid, x, y)
    draw_picture(scene, view, product_named("color"), plan_of_view(scene, view, policy="rules"))
    scene.close()


def _run_command(*arguments: str) -> Callable[[str, Path], None]:
    """Return a function that runs a command of ``skugga``. ``{file}`` and ``{folder}`` in its words are replaced."""

    def run(file: str, folder: Path) -> None:
        from skugga.api.cli.main import app

        app([part.format(file=file, folder=folder) for part in arguments], standalone_mode=False)

    return run


PRODUCTS: dict[str, Callable[[str, Path], None]] = {
    "tile": _draw_tile,
    "shade": _run_command("shade", "{file}", "-o", "{folder}/shade.tif", "--azimuth", "200", "--altitude", "30"),
    "sunhours": _run_command("sunhours", "{file}", "-o", "{folder}/hours.tif", "--date", "2024-03-21"),
    "point": _run_command("point", "{file}", "--at", "-118.05,34.28", "--time", "2024-03-21T15:00:00-08:00"),
    "render": _run_command("render", "{file}", "-o", "{folder}/view.png", "--size", "400x300"),
}
"""Functions that compute a product: the first tile of a render process, or the output of a command."""


def profile_product(product: str, file: str | None) -> dict[str, Any]:
    """Compute a product (a key of ``PRODUCTS``) once in a fresh process with an empty cache of compiled loops.

    Return the record of all compilations. ``file`` ``None`` stands for a level that the module chooses.
    """
    with tempfile.TemporaryDirectory() as folder:
        if file is None:
            file = str(WOODED_LEVEL if product == "render" else write_mountains(Path(folder)))
        profile_path = Path(folder) / "profile.json"
        env = {**os.environ, "NUMBA_CACHE_DIR": str(Path(folder) / "loops"), "XDG_CACHE_HOME": str(Path(folder) / "cache")}
        subprocess.run([sys.executable, "-m", __spec__.name, product, file, folder, str(profile_path)], env=env, check=True)
        return dict(json.loads(profile_path.read_text(encoding="utf-8")))


def _measure_product(product: str, file: str, folder: str, profile_path: str) -> None:
    """Compute a product, and write the record of all compilations to the JSON file ``profile_path``. A fresh process calls this."""
    reference_s = reference_compile_s()
    profile = CompilationListener()
    with event.install_listener("numba:run_pass", profile):
        begin = time.process_time()
        PRODUCTS[product](file, Path(folder))
        cpu_s = time.process_time() - begin
    result = {"cpu_s": cpu_s, "yardstick_s": reference_s, "loops": [vars(compilation) for compilation in profile.compilations]}
    Path(profile_path).write_text(json.dumps(result), encoding="utf-8")


def profile_lines(product: str, profile: dict[str, Any], rows: int) -> list[str]:
    """Format a profile as lines of text: totals, then the project's loops and numba's helpers, sorted by their own time.

    ``profile`` is the result of ``profile_product``. ``rows`` is the largest number of loops and of helpers.
    """
    compilations = [Compilation(**compilation) for compilation in profile["loops"]]
    own_loops, helpers = (
        [compilation for compilation in compilations if compilation.is_project_loop],
        [compilation for compilation in compilations if not compilation.is_project_loop],
    )
    own_s, frontend_s = (sum(getattr(compilation, field) for compilation in compilations) for field in ("own_s", "frontend_s"))
    lines = [
        f"{product}: {own_s:.1f} CPU seconds for {len(compilations)} compilations, {profile['cpu_s']:.1f} CPU seconds in total; "
        f"{own_s / profile['yardstick_s']:.0f} times the reference loop ({profile['yardstick_s'] * 1e3:.0f} ms)",
        f"  {len(own_loops)} compilations of {len({compilation.loop for compilation in own_loops})} loops of the project: "
        f"{sum(e.own_s for e in own_loops):.1f} s; {len(helpers)} of numba's helpers: {sum(e.own_s for e in helpers):.1f} s; "
        f"{own_s - frontend_s:.1f} s for machine code, {frontend_s:.1f} s for the compiler's front end",
        "",
        "  own s   with callees  helpers  loop (a line for each signature)",
    ]
    helper_s = Counter[str]()
    for compilation in helpers:
        helper_s[compilation.cause] += compilation.own_s
    for compilation in sorted(own_loops, key=lambda e: -e.own_s)[:rows]:
        lines.append(
            f"  {compilation.own_s:6.2f}  {compilation.total_s:12.2f}  {helper_s[compilation.loop]:7.2f}  "
            f"{compilation.loop}{_abbreviate(compilation.signature)}"
        )
    lines += ["", "   sum s  times  helper of numba, and the loops that cause it"]
    sums, times, causes = Counter[str](), Counter[str](), dict[str, Counter[str]]()
    for compilation in helpers:
        sums[compilation.loop] += compilation.own_s
        times[compilation.loop] += 1
        causes.setdefault(compilation.loop, Counter())[compilation.cause.rpartition(".")[2]] += 1
    for name, seconds in sums.most_common(rows):
        by = ", ".join(f"{cause} {count}" if count > 1 else cause for cause, count in causes[name].most_common())
        lines.append(f"  {seconds:6.2f}  {times[name]:5}  {name}: {by}")
    return lines


def _abbreviate(signature: str) -> str:
    """Shorten the names of types in a signature, and cut it to 160 characters."""
    for long, short in (("array", ""), ("int64", "i8"), ("int32", "i4"), ("float64", "f8"), ("float32", "f4")):
        signature = signature.replace(long, short)
    return signature if len(signature) < 160 else f"{signature[:156]}...)"


if __name__ == "__main__":
    _measure_product(*sys.argv[1:])
