"""Format figures as text, and decide claims by them. A verdict of ``None`` is a draw: the figures cannot decide."""

from __future__ import annotations

from collections.abc import Callable, Iterable

THESIS = "Sindholt 2005"
COPENHAGEN_REPORT = "bachelor's report, Copenhagen"
SPATIALACE = "SpatialAce thesis, Chalmers"

DRAW_FACTOR = 1.05
"""Figures within this factor of a limit, or of one another, are a draw."""

DRAW_TEXT = f"a draw: what decides lies within {100.0 * (DRAW_FACTOR - 1.0):.0f} % of its limit"

SM, PSM, SV, HYBRID = "shadow_map", "perspective_shadow_map", "shadow_volume", "hybrid"
THESIS_ALGORITHMS = SM, PSM, SV, HYBRID
ABBREVIATIONS = {SM: "SM", PSM: "PSM", SV: "SV", HYBRID: "hybrid"}
"""Short names of the algorithms on the page."""
SCENE_TITLES = {"boxgrid": "BoxGrid", "rocks": "Rocks", "street": "Street", "room": "Room", "water_tower": "Water Tower"}
"""The thesis's names of its scenes, by the levels' names without ``thesis_``."""

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
    """Return whether all verdicts hold: false if one fails, else ``None`` if one is a draw."""
    verdict_list = [*verdicts]
    if any(verdict is False for verdict in verdict_list):
        return False
    return None if None in verdict_list else True


def any_of(verdicts: Iterable[ClaimVerdict]) -> ClaimVerdict:
    """Return whether any verdict holds: ``None`` if none holds and one is a draw."""
    return negate(all_of(negate(verdict) for verdict in verdicts))


def negate(verdict: ClaimVerdict) -> ClaimVerdict:
    """Return the opposite verdict; a draw stays a draw."""
    return None if verdict is None else not verdict


def choose_reason(verdict: ClaimVerdict, if_held: str, if_failed: str, if_draw: str = DRAW_TEXT) -> str:
    """Return the text for a verdict."""
    return if_draw if verdict is None else if_held if verdict else if_failed


def format_percent(share: float) -> str:
    """Format an error share in per cent, with at most two decimals."""
    value = 100.0 * share
    return "under 0.01 %" if 0.0 < value < 0.005 else f"{round(value, 2 if value < 10.0 else 1):g} %"


def format_max_percent(share: float) -> str:
    """Format an upper bound of error shares in per cent."""
    text = format_percent(share)
    return text if share == 0.0 or text.startswith("under") else f"at most {text}"


def format_whole_percent(share: float) -> str:
    """Format a share in whole per cent."""
    return f"{100.0 * share:.0f} %"


def format_ratio(ratio: float) -> str:
    """Format a ratio with two significant digits, or as a whole number."""
    return f"{ratio:.0f}" if ratio >= 10.0 else f"{ratio:.2f}"


def scene_title(name: str) -> str:
    """Return the title of a scene. Other names are returned unchanged."""
    scene, rest = next(((scene, name[len(scene) :]) for scene in SCENE_TITLES if name.startswith(scene)), ("", name))
    return f"{SCENE_TITLES.get(scene, '')}{rest.replace('_sun', ' (sun)')}"


def format_by_scene(values: dict[str, float], format_value: Callable[[float], str] = format_ratio) -> str:
    """Format values of scenes as a list with the scenes' titles."""
    return ", ".join(f"{scene_title(name)} {format_value(value)}" for name, value in values.items())


def join_scene_names(scene_names: list[str]) -> str:
    """Format names of scenes as a list of titles."""
    return ", ".join(map(scene_title, scene_names)) or "none"
