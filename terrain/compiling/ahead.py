"""Compile what a product needs before it is called, on all cores, in a process of its own. Imports no numba."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[3]
"""The folder that holds the package ``skugga``: of a clone its root, of an installation ``site-packages``."""

MAPS, MAPS_OF_CASTERS, PICTURES, MASKS = "map tiles", "maps of woods and buildings", "pictures", "masks"
SUN_HOURS, POINTS, VIEWS = "hours of sun", "points", "perspective views"
PRODUCTS = MAPS, MAPS_OF_CASTERS, SUN_HOURS, POINTS, VIEWS, PICTURES, MASKS
"""Products whose loops are compiled together, in words for people; in the order in which a service compiles them."""

Progress = Callable[[str, int, int], None]
"""Called with what is done in words, the number of loops that are compiled, and of all that were missing."""

log = logging.getLogger("skugga")


def compile_ahead(
    products: Sequence[str],
    processes: int,
    progress: Progress = lambda task, done, total: None,
    background: bool = False,
    on_start: Callable[[subprocess.Popen[str]], None] = lambda process: None,
) -> None:
    """Compile the loops that some products need and that are stored nowhere; return when they are stored.

    A failure is told in the log, and is no error: what is missing is compiled when it is called.

    Parameters
    ----------
    products
        Some of ``PRODUCTS``.
    processes
        Cores to take.
    progress
        Called when it is known how many loops are missing, and after each.
    background
        Compile at the lowest priority.
    on_start
        Called with the process that compiles. Killing it ends the work; what it has compiled is stored.
    """
    command = [sys.executable, "-m", "skugga.terrain.compiling.farm", f"--processes={processes}", *["--background"] * background]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": path}
    try:
        farm = subprocess.Popen([*command, *products], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, env=environment, text=True)
    except OSError as error:
        log.warning("loops cannot be compiled ahead: %s", error.strerror)
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
        log.warning("loops cannot be compiled ahead (exit status %d); they are compiled when they are called", farm.returncode)
