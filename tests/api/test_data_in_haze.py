"""Data of a view do not depend on what the air lets one see."""

from __future__ import annotations

import json

import numpy as np
import pytest

from skugga.api.compute import compute, plan_for
from skugga.api.products import product_named
from skugga.api.request import ProductRequest
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

EYE = {"kind": "perspective", "eye": [-30, -48, 15], "target": [3, 2, 2], "fov": 45, "size": [240, 192]}


def tetrahedra(folder, name: str, **keys: object) -> Scene:
    """Return tetrahedra on a plain, seen from an eye between them."""
    level = {
        "version": 1, "terrain": {"flat": {"size": [120, 120], "cells": [40, 40]}}, "views": {"eye": EYE},
        "meshes": [{"generate": "tetrahedra"}], "sun": {"azimuth": 200, "altitude": 30}, **keys,
    }  # fmt: skip
    path = folder / f"{name}.yaml"
    path.write_text(json.dumps(level), encoding="utf-8")
    return build_scene(load_level(path))


def product_of(scene: Scene, name: str) -> np.ndarray:
    """Return the array of a product in the view ``eye``."""
    view, product = scene.view("eye"), product_named(name)
    return compute(scene, view, ProductRequest(product=name), plan_for(scene, view, "eye", product, {})).array


@pytest.mark.parametrize("product", ["mask", "visibility", "shadow"])
def test_data_are_the_same_in_thick_haze_and_in_clear_air(gl, tmp_path, product):
    """At 50 m of visibility haze hides most of the shadows, and colour pictures do not compute them."""
    hazy, clear = (tetrahedra(tmp_path, f"{visibility:g}", weather={"visibility": visibility}) for visibility in (50.0, 1e7))
    np.testing.assert_array_equal(product_of(hazy, product), product_of(clear, product))


def test_data_are_the_same_where_a_level_forces_haze(gl, tmp_path):
    thick = {"weather": {"visibility": 50.0}}
    forced = tetrahedra(tmp_path, "forced", **thick, effects={"haze": "on"})
    without = tetrahedra(tmp_path, "without", **thick, effects={"haze": "off"})
    np.testing.assert_array_equal(product_of(forced, "mask"), product_of(without, "mask"))
    assert (product_of(forced, "color") != product_of(without, "color")).any()
