"""The recorded signatures match the loops of the code."""

import importlib
import pkgutil

import pytest
from numba.core.dispatcher import Dispatcher

from skugga import api, selector, shadows, terrain
from skugga.terrain.compiling.ahead_of_time import PRODUCTS
from skugga.terrain.compiling.signatures import recorded_signatures

MODULES_WITHOUT_RECORDS = {
    "skugga.api.overviews": "`skugga overviews`",
    "skugga.shadows.horizons.far": "horizons of rasters",
    "skugga.shadows.horizons.sky_view": "sky view factors of rasters",
    "skugga.shadows.irradiation.direct": "irradiation",
    "skugga.shadows.irradiation.sky": "irradiation",
    "skugga.shadows.reconstruction.polygons": "the algorithm `reconstructed_volume`",
    "skugga.shadows.reconstruction.surface": "the algorithm `reconstructed_volume`",
    "skugga.shadows.sweep.columns": "levels of blocks",
    "skugga.shadows.sweep.grid": "`skugga.shadow`",
    "skugga.shadows.sweep.horizon": "horizons of arrays",
    "skugga.shadows.truth.metrics": "`skugga compare`",
    "skugga.terrain.casters.rays": "`skugga compare`",
    "skugga.terrain.casters.sheet_rays": "`skugga compare`",
    "skugga.terrain.effects.cloud_layer": "levels with clouds",
    "skugga.terrain.effects.clouds": "levels with clouds",
    "skugga.terrain.effects.precipitation": "levels with rain or falling snow",
    "skugga.terrain.effects.sky_clouds": "levels with clouds",
    "skugga.terrain.effects.snow": "levels with snow",
    "skugga.terrain.effects.water": "levels with water",
    "skugga.terrain.gbuffer.supersampling": "layers of classes at coarse zooms",
    "skugga.terrain.gbuffer.map_columns": "levels of blocks",
    "skugga.terrain.ground.cells": "levels of blocks",
    "skugga.terrain.ground.columns": "levels of blocks",
    "skugga.terrain.ground.decimation": "cameras over more triangles than are allowed",
    "skugga.terrain.ground.imagery": "levels with imagery",
    "skugga.terrain.ground.surface_loops": "points on magnified ground",
    "skugga.terrain.meshes.texture_loops": "models with textures or normal maps",
    "skugga.terrain.sky": "levels with water",
    "skugga.terrain.trees.canopy": "levels with a canopy",
    "skugga.terrain.trees.crown_tops": "horizons of levels with trees",
    "skugga.terrain.viewpoint": "cameras that Skugga places",
}
"""Modules with stored loops that no product records, and what needs them: their loops are compiled on the first call."""


def stored_loops() -> set[str]:
    """Return module and name of every loop that is stored for other processes."""
    loop_names = set()
    for package in (terrain, shadows, selector, api):
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if info.name.endswith("__main__"):
                continue
            for member in vars(importlib.import_module(info.name)).values():
                if isinstance(member, Dispatcher) and member.py_func.__module__ == info.name and member._cache._enabled:
                    loop_names.add(f"{info.name}:{member.py_func.__qualname__}")
    return loop_names


@pytest.mark.parametrize("product", PRODUCTS)
def test_recorded_signatures_fit_their_functions(product):
    recorded = recorded_signatures([product])
    assert recorded
    for signature in recorded:
        argument_count = signature.dispatcher().py_func.__code__.co_argcount
        assert len(signature.argument_types()) == argument_count, signature.loop


def test_all_stored_loops_are_recorded():
    """After a loop is added or renamed, run ``python scripts/record_signatures.py``."""
    unrecorded_loops = stored_loops() - {entry.loop for entry in recorded_signatures()}
    assert {entry.partition(":")[0] for entry in unrecorded_loops} == set(MODULES_WITHOUT_RECORDS)
