"""Compile the loops of products ahead of time, on several cores, in a separate process. Imports no numba."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[3]
"""Folder that contains the package ``skugga``: the root of a clone, or ``site-packages`` of an installation."""

MAPS, MAPS_OF_CASTERS, PICTURES, MASKS = "map tiles", "maps of woods and buildings", "pictures", "masks"
SUN_HOURS, POINTS, VIEWS = "hours of sun", "points", "perspective views"
PRODUCTS = MAPS, MAPS_OF_CASTERS, SUN_HOURS, POINTS, VIEWS, PICTURES, MASKS
"""Products whose loops are compiled together, named for people, in the order in which a service compiles them."""

Progress = Callable[[str, int, int], None]
"""Callback with three arguments: the task in words, the number of compiled loops, the number of all missing loops."""

log = logging.getLogger("skugga")


def compile_ahead(
    products: Sequence[str],
    processes: int,
    progress: Progress = lambda task, done, total: None,
    background: bool = False,
    on_start: Callable[[subprocess.Popen[str]], None] = lambda process: None,
) -> None:
    """Compile the loops that some products need and that the cache lacks. Block until they are stored.

    A failure is logged and raises no error: a missing loop is compiled on its first call.

    Parameters
    ----------
    products
        Some of ``PRODUCTS``.
    processes
        Number of cores to use.
    progress
        Called once when the number of missing loops is known, and then after each compiled loop.
    background
        Compile at the lowest priority.
    on_start
        Called with the compiling process. Killing that process stops the work; loops compiled until then stay stored.
    """
    command = [sys.executable, "-m", "skugga.terrain.compiling.farm", f"--processes={processes}", *["--background"] * background]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path}
    try:
        farm = subprocess.Popen([*command, *products], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, env=environment, text=True)
    except OSError as error:
        log.warning("compiled loops: cannot be compiled ahead (%s). They are compiled on their first call.", error.strerror)
        return
    with farm:
        try:
            on_start(farm)
            assert farm.stdout is not None
            for line in farm.stdout:
                done, total, product = line.rstrip("\n").split(" ", 2)
                progress(f"compiling loops for {product}", int(done), int(total))
        except BaseException:
            farm.kill()
            raise
    if farm.returncode > 0:
        log.warning(
            "compiled loops: cannot be compiled ahead (exit status %d). They are compiled on their first call.", farm.returncode
        )
