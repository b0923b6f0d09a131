"""The recorded signatures match the loops of the code."""

import importlib
import pkgutil

import pytest
from numba.core.dispatcher import Dispatcher

from skugga import api, selector, shadows, terrain
from skugga.terrain.compiling.ahead_of_time import PRODUCTS
from skugga.terrain.compiling.signatures import recorded_signatures

RARE = {
    "skugga.api.overviews": "`skugga overviews`",
    "skugga.shadows.sweep.columns": "levels of blocks",
    "skugga.shadows.sweep.grid": "`skugga.shadow`",
    "skugga.shadows.sweep.horizon": "horizons of arrays",
    "skugga.shadows.truth.metrics": "`skugga compare`",
    "skugga.terrain.casters.rays": "`skugga compare`",
    "skugga.terrain.casters.sheet_rays": "`skugga compare`",
    "skugga.terrain.effects.clouds": "levels with clouds",
    "skugga.terrain.effects.snow": "levels with snow",
    "skugga.terrain.effects.water": "levels with water",
    "skugga.terrain.gbuffer.supersampling": "layers of classes at coarse zooms",
    "skugga.terrain.gbuffer.map_columns": "levels of blocks",
    "skugga.terrain.ground.cells": "levels of blocks",
    "skugga.terrain.ground.columns": "levels of blocks",
    "skugga.terrain.ground.decimation": "cameras over more triangles than are allowed",
    "skugga.terrain.ground.imagery": "levels with imagery",
    "skugga.terrain.ground.surface": "points on magnified ground",
    "skugga.terrain.sky": "levels with water",
    "skugga.terrain.trees.canopy": "levels with a canopy",
    "skugga.terrain.viewpoint": "cameras that Skugga places",
}
"""Modules with stored loops that no product records, and what needs them: their loops are compiled on the first call."""


def stored_loops() -> set[str]:
    """Return module and name of every loop that is stored for other processes."""
    found = set()
    for package in (terrain, shadows, selector, api):
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if info.name.endswith("__main__"):
                continue
            for each in vars(importlib.import_module(info.name)).values():
                if isinstance(each, Dispatcher) and each.py_func.__module__ == info.name and each._cache._enabled:
                    found.add(f"{info.name}:{each.py_func.__qualname__}")
    return found


@pytest.mark.parametrize("product", PRODUCTS)
def test_recorded_signatures_fit_their_functions(product):
    recorded = recorded_signatures([product])
    assert recorded
    for each in recorded:
        names = each.dispatcher().py_func.__code__.co_argcount
        assert len(each.argument_types()) == names, each.loop


def test_all_stored_loops_are_recorded():
    """After a loop is added or renamed, run ``python scripts/record_signatures.py``."""
    left = stored_loops() - {each.loop for each in recorded_signatures()}
    assert {each.partition(":")[0] for each in left} == set(RARE)
