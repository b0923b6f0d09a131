"""What a picture is expected to cost by its plan, which key makes it cheaper, and the bound beyond which none is drawn."""

from __future__ import annotations

from skugga.api.errors import TooCostlyError
from skugga.api.settings import load_settings
from skugga.selector.formatting import format_list
from skugga.shadows.plan import Plan
from skugga.terrain.errors import Problem
from skugga.terrain.level.level import SUN

NOTABLE_MS = 5000.0
"""From here on it is said what makes a picture cheaper."""


def time_limit_ms() -> float:
    """Return the milliseconds beyond which a service gives up a picture."""
    return 1000.0 * load_settings().render_timeout_s


def soft_lamps(plan: Plan) -> dict[str, int]:
    """The lamps that a plan shows as balls, with the points that each is drawn from."""
    return {
        light: max(getattr(each, "light_points", 1) for each in kinds.values())
        for light, kinds in plan.settings.items()
        if light != SUN and any(getattr(each, "filter", None) == "sun" for each in kinds.values())
    }


def remedy(plan: Plan) -> str | None:
    """Which keys of a level make a plan cheaper, in words; ``None`` where none is known."""
    lamps = soft_lamps(plan)
    if not lamps:
        return None
    keys = format_list([f"lights.{name}.radius: 0" for name in lamps])
    return f"{keys} makes shadows hard, which are drawn from 1 point of a lamp and not {max(lamps.values())}"


def check_cost(plan: Plan, subject: str, most_ms: float | None, bound: str) -> None:
    """Raise ``TooCostlyError`` where a calibrated device is expected to take longer for a picture than ``most_ms``."""
    expected_ms = None if plan.predicted is None else plan.predicted.ms
    if most_ms is None or expected_ms is None or expected_ms <= most_ms:
        return
    reason = Problem(f"{subject} by {plan.headline} is expected to take {expected_ms / 1000.0:.0f} s")
    cheaper = remedy(plan)
    raise TooCostlyError(
        "size", reason, f"pictures of at most {most_ms / 1000.0:g} s ({bound})" + (f"; {cheaper}" if cheaper else "")
    )
