"""Hashes of every layer of every view of the bundled levels. Equal hashes prove that a change of the code alters no picture.

    python -m benchmarks.picture_hashes write before.json     # on the commit before
    python -m benchmarks.picture_hashes check before.json     # on the commit after: lists differences, exit status 1

Each view is drawn by the plan of the fixed rules, and by every algorithm that supports it, with all layers that these produce. If
an algorithm refuses a view, the hash is that of its message. Two processes need about ten minutes on two cores with llvmpipe.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from skugga.api.catalogue import bundled_levels
from skugga.api.compute import product_of_frame
from skugga.api.products import products_with
from skugga.selector.planner.planner import make_plan
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.errors import SkuggaError
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

AUTO_ALGORITHM = "auto"
"""Label of the plan of the fixed rules, beside the names of algorithms."""

FRAME_PRODUCTS = products_with(lambda each: each.pass_layer is None and "perspective" in each.view_kinds)
"""Products of every frame."""


def array_hash(array: np.ndarray) -> str:
    """Return a hash of an array's bytes, shape and data type, 16 hexadecimal digits."""
    digest = hashlib.sha256(f"{array.dtype.str} {array.shape}".encode())
    digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def view_hashes(scene: Scene, name: str, algorithm: str) -> Iterator[tuple[str, str]]:
    """Yield names and hashes of a view's layers, of its plan, and of its report on casters outside the view.

    ``name`` is the name of the view. ``algorithm`` is a name, or ``AUTO_ALGORITHM``. If the algorithm refuses the view, yield the
    hash of its message.
    """
    view = scene.view(name)
    try:
        plan = make_plan(
            describe(scene, view, name), scene.loaded.level, {} if algorithm == AUTO_ALGORITHM else {"algorithm": algorithm}
        )
        requested_layers = frozenset(layer for step in plan.steps for layer in ALGORITHMS[step.algorithm].layers)
        frame = render_frame(scene, view, plan, layers=requested_layers)
    except SkuggaError as error:
        yield "refusal", array_hash(np.frombuffer(str(error).encode(), np.uint8))
        return
    yield "plan", array_hash(np.frombuffer(plan.model_dump_json().encode(), np.uint8))
    yield "reach", array_hash(np.array([frame.reach.used_m, frame.reach.needed_m, frame.reach.clipped], float))
    for layer in FRAME_PRODUCTS:
        yield layer, array_hash(product_of_frame(scene, frame, layer))
    for light, visibility in frame.visibilities.items():
        yield f"visibility of {light}", array_hash(visibility)
    for layer, by_light in sorted(frame.layers.items()):
        for light, picture in by_light.items():
            yield f"{layer} of {light}", array_hash(picture)


def picture_hashes_of_level(path: Path) -> dict[str, str]:
    """Return all hashes of a level, by ``LEVEL/VIEW/ALGORITHM/LAYER``."""
    result: dict[str, str] = {}
    scene = build_scene(load_level(path))
    for view in scene.loaded.level.views:
        for algorithm in (AUTO_ALGORITHM, *(name for name, algorithm_info in ALGORITHMS.items() if algorithm_info.is_selectable)):
            for layer, value in view_hashes(scene, view, algorithm):
                result[f"{path.stem}/{view}/{algorithm}/{layer}"] = value
    print(f"{path.stem}: {len(result)} hashes", file=sys.stderr, flush=True)
    return result


def all_hashes() -> dict[str, str]:
    """Return the hashes of all bundled levels, sorted by name."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as workers:
        levels = list(workers.map(picture_hashes_of_level, bundled_levels()))
    return dict(sorted((name, value) for level_hashes in levels for name, value in level_hashes.items()))


def main() -> int:
    """Write the hashes to a file, or compare them with a file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("write", "check"))
    parser.add_argument("file", type=Path)
    args = parser.parse_args()
    hashes = all_hashes()
    if args.what == "write":
        args.file.write_text(json.dumps(hashes, indent=0) + "\n", encoding="utf-8")
        print(f"{len(hashes)} hashes written to {args.file}")
        return 0
    before = json.loads(args.file.read_text(encoding="utf-8"))
    differ = [name for name in sorted(before.keys() | hashes.keys()) if before.get(name) != hashes.get(name)]
    for name in differ:
        print(f"differs: {name}: {before.get(name, 'missing')} before, {hashes.get(name, 'missing')} now")
    print(f"{len(hashes)} hashes, {len(differ)} differ")
    return 1 if differ else 0


if __name__ == "__main__":
    sys.exit(main())
