"""Surfaces that must not shade themselves."""

from __future__ import annotations

import numpy as np

from tests.hard_cases.cases import Trial, hard_case


@hard_case("H1", "Level ground without casters is lit", "a level plane under a sun at 90 to 0.5 degrees", {"false_shadow": 0.0})
def test_level_ground_is_lit(trial: Trial) -> dict[str, float]:
    scene = trial.scene({"flat": {"size": [1000, 1000], "cells": [40, 40]}}, sun=(200, 45), effects={"cast_shadows": "on"})
    from terrain.level_parts import SunSpec

    worst = 0.0
    for altitude in np.arange(90.0, 0.0, -0.5 if trial.thorough else -10.0):
        under = scene.with_sun(SunSpec(azimuth=200.0, altitude=float(altitude)))
        size = 1024 if trial.thorough else 256
        seen = trial.see(under, under.view(size=(size, size)), map_size=2048)
        worst = max(worst, seen.errors.false_shadow)
    return {"false_shadow": worst}
