"""The constants of the error model, fitted to measured views."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from selector.error_model import Counted, ErrorModel, expected_errors
from selector.picks import Asked
from selector.portfolio import portfolio
from selector.rules import planner_of
from shadows.plan import Step
from shadows.registry import ALGORITHMS
from terrain.descriptor import Descriptor
from terrain.level import SUN, Shadows

Figures = dict[str, Any]

LEAST = 1e-3
"""Errors are fitted as their logarithms, from this one on."""

CAUTIOUS = 0.9
"""Share of the rows whose error lies below the cautious one."""

MAPS = ("shadow_map", "perspective_shadow_map")

START = (1.0, 4.0, 1.2, 1.0, 4.0, 1.2, 1.3, 3e-4, 3e-4)
"""The part of what differs that counts (most, half, steepness) of solid casters and of foliage; texels of perspective maps to a
pixel; the floors of both kinds of maps."""


class Case:
    """A measured row: the steps it took, and what it got wrong."""

    def __init__(self, view: Figures, steps: tuple[Step, ...], row: Figures) -> None:
        self.descriptor, self.light, self.steps = described(view), view["light"], steps
        self.error, self.wrong, self.interior = row[view["error"]], row["wrong"], row["interior"]
        self.algorithms = frozenset(step.algorithm for step in steps)

    def expected(self, model: ErrorModel) -> float:
        return expected_errors(self.descriptor, self.light, self.steps, model).wrong_cast


def described(view: Figures) -> Descriptor:
    """A view's descriptor."""
    return _described(view["name"], _Same(view["descriptor"]))


class _Same:
    """A value that counts as equal to itself alone."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.value is self.value


@lru_cache(maxsize=256)
def _described(name: str, same: _Same) -> Descriptor:
    return Descriptor.model_validate(same.value)


def asked_of(descriptor: Descriptor, shadows: Shadows | None = None) -> Asked:
    """Wishes for a descriptor that comes without a level."""
    return Asked(shadows or Shadows(), (SUN, *(lamp.name for lamp in descriptor.lamps)))


def cases(views: Sequence[Figures]) -> list[Case]:
    """The rows of picks, each once, of views in which anything lies in cast shadow."""
    found = []
    for view in views:
        descriptor, light = described(view), view["light"]
        if not descriptor.lights[light].cast_share > 0.0:
            continue
        planner = planner_of(descriptor, asked_of(descriptor))
        seen = set()
        for pick in portfolio(descriptor, light, planner.casting(light)):
            name = view["picks"].get(pick.name)
            if name in view["rows"] and name not in seen:
                seen.add(name)
                found.append(Case(view, planner.steps(light, pick), view["rows"][name]))
    return found


def fitted(views: Sequence[Figures]) -> ErrorModel:
    """The constants that fit measured views."""
    its = cases(views)
    mapped = [case for case in its if case.algorithms & set(MAPS)]

    def off(logarithms: np.ndarray) -> np.ndarray:
        model = _model(np.exp(logarithms))
        return np.array([np.log(case.expected(model) + LEAST) - np.log(case.error + LEAST) for case in mapped])

    found = least_squares(off, np.log(START), loss="soft_l1")
    model = _model(np.exp(found.x))
    exact = {name: _quantile([case.error for case in its if case.algorithms == {name}], 0.5) for name in ALGORITHMS}
    floor = {name: model.floor[name] if name in MAPS else exact[name] for name in ALGORITHMS}
    model = model.model_copy(update={"floor": floor})
    inside, caution = {}, {}
    for name in ALGORITHMS:
        with_it = [case for case in its if name in case.algorithms]
        shares = [case.interior / max(case.wrong, 1e-6) for case in with_it if case.wrong > 0.0]
        ratios = [(case.error + LEAST) / (case.expected(model) + LEAST) for case in with_it]
        inside[name] = min(_quantile(shares, CAUTIOUS), 1.0)
        caution[name] = max(_quantile(ratios, CAUTIOUS), 1.0)
    return model.model_copy(update={"interior": inside, "caution": caution})


def _model(x: np.ndarray) -> ErrorModel:
    solid, leaves = (Counted(most=x[k], half_px=x[k + 1], steepness=x[k + 2]) for k in (0, 3))
    floor = {name: x[7] if name == "shadow_map" else x[8] if name in MAPS else 0.0 for name in ALGORITHMS}
    ones, zeros = dict.fromkeys(ALGORITHMS, 1.0), dict.fromkeys(ALGORITHMS, 0.0)
    counted = {"relief": solid, "meshes": solid, "forest": leaves}
    return ErrorModel(counted=counted, perspective=x[6], floor=floor, interior=zeros, caution=ones)  # type: ignore[arg-type]


def _quantile(values: Sequence[float], share: float) -> float:
    return float(np.quantile(values, share)) if len(values) else 0.0
