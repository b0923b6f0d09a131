"""Format figures as words, and judge claims by them. A verdict of ``None`` is a draw: the figures cannot decide."""

from __future__ import annotations

from collections.abc import Callable, Iterable

THESIS = "Sindholt 2005"
REPORT = "bachelor's report, Copenhagen"
SPATIALACE = "SpatialAce thesis, Chalmers"

DRAW_FACTOR = 1.05
"""Figures within this factor of a limit, or of one another, are a draw."""

DRAW = f"a draw: what decides lies within {100.0 * (DRAW_FACTOR - 1.0):.0f} % of its limit"

SM, PSM, SV, HYBRID = "shadow_map", "perspective_shadow_map", "shadow_volume", "hybrid"
FOUR = SM, PSM, SV, HYBRID
SHORT = {SM: "SM", PSM: "PSM", SV: "SV", HYBRID: "hybrid"}
SCENES = {"boxgrid": "BoxGrid", "rocks": "Rocks", "street": "Street", "room": "Room", "water_tower": "Water Tower"}

ClaimVerdict = bool | None
"""Whether a claim holds; ``None`` for a draw."""


def at_most(value: float, limit: float) -> ClaimVerdict:
    """Return whether a figure is at most a limit; ``None`` if it is too close to decide."""
    if value * DRAW_FACTOR <= limit:
        return True
    return False if value > limit * DRAW_FACTOR else None


def at_least(value: float, limit: float) -> ClaimVerdict:
    """Return whether a figure is at least a limit; ``None`` if it is too close to decide."""
    return at_most(limit, value)


def all_of(verdicts: Iterable[ClaimVerdict]) -> ClaimVerdict:
    """Return whether all verdicts hold: false if one fails, else a draw (``None``) if one is a draw."""
    verdict_list = [*verdicts]
    if any(verdict is False for verdict in verdict_list):
        return False
    return None if None in verdict_list else True


def any_of(verdicts: Iterable[ClaimVerdict]) -> ClaimVerdict:
    """Return whether any verdict holds: a draw (``None``) if none holds and one is a draw."""
    return opposite(all_of(opposite(verdict) for verdict in verdicts))


def opposite(verdict: ClaimVerdict) -> ClaimVerdict:
    return None if verdict is None else not verdict


def reason(verdict: ClaimVerdict, if_held: str, if_failed: str, if_draw: str = DRAW) -> str:
    """Return the text that fits a verdict."""
    return if_draw if verdict is None else if_held if verdict else if_failed


def percent(share: float) -> str:
    """Format a share of errors in per cent, with two decimals at most."""
    value = 100.0 * share
    return "under 0.01 %" if 0.0 < value < 0.005 else f"{round(value, 2 if value < 10.0 else 1):g} %"


def format_largest(share: float) -> str:
    """Format the largest of some shares of errors in per cent."""
    text = percent(share)
    return text if share == 0.0 or text.startswith("under") else f"at most {text}"


def whole_percent(share: float) -> str:
    """Format a share of a time in per cent."""
    return f"{100.0 * share:.0f} %"


def factor(ratio: float) -> str:
    """Format a ratio with two significant digits, or as a whole number."""
    return f"{ratio:.0f}" if ratio >= 10.0 else f"{ratio:.2f}"


def titled(name: str) -> str:
    """Return the title of a scene; any other name is returned unchanged."""
    scene, rest = next(((scene, name[len(scene) :]) for scene in SCENES if name.startswith(scene)), ("", name))
    return f"{SCENES.get(scene, '')}{rest.replace('_sun', ' (sun)')}"


def listed_by_scene(values: dict[str, float], format_value: Callable[[float], str] = factor) -> str:
    """Format values of scenes as a list with the scenes' titles."""
    return ", ".join(f"{titled(name)} {format_value(value)}" for name, value in values.items())


def join_scene_names(scene_names: list[str]) -> str:
    """Format names of scenes as a list of titles."""
    return ", ".join(map(titled, scene_names)) or "none"
