"""Expected cost of a picture by its plan: the limit above which the picture is refused, and level keys that reduce the cost."""

from __future__ import annotations

from skugga.api.errors import TooCostlyError
from skugga.api.settings import load_settings
from skugga.selector.formatting import format_list
from skugga.shadows.plan import Plan
from skugga.terrain.level.level import SUN

SLOW_PICTURE_MS = 5000.0
"""Expected milliseconds from which on reports name a cheaper setting."""


ESTIMATE_MARGIN = 3.0
"""Factor by which an estimated time must exceed a limit for a picture to be refused: estimates are off by up to a factor of two."""


MAX_MS_OPTION = "--max-ms"
"""The option of commands that sets their limit."""


def time_limit_ms() -> float:
    """Return the time after which a service gives up a picture, milliseconds."""
    return 1000.0 * load_settings().render_timeout_s


def limit_or_service_limit_ms(max_ms: float | None) -> float:
    """Return the limit of a command's pictures: ``max_ms`` of its user, or that of a service, milliseconds."""
    return time_limit_ms() if max_ms is None else max_ms


def sphere_lamps(plan: Plan) -> dict[str, int]:
    """Return the lamps that a plan renders as spheres: name, and number of sample points on the sphere."""
    return {
        light: max(getattr(settings, "light_points", 1) for settings in kinds.values())
        for light, kinds in plan.settings.items()
        if light != SUN and any(getattr(settings, "filter", None) == "sun" for settings in kinds.values())
    }


def cost_remedy(plan: Plan) -> str | None:
    """Return a text on level keys that make a plan cheaper; ``None`` if no such key is known."""
    lamps = sphere_lamps(plan)
    if not lamps:
        return None
    keys = format_list([f"lights.{name}.radius: 0" for name in lamps])
    return f"{keys} makes shadows hard, which need 1 sample point of a lamp instead of {max(lamps.values())}"


def is_over_limit(plan: Plan, limit_ms: float) -> bool:
    """Return whether a picture is expected to take longer than a limit in milliseconds, also where its time is estimated only."""
    if plan.predicted is None:
        return False
    return plan.predicted.ms > limit_ms * (ESTIMATE_MARGIN if plan.predicted.is_estimate else 1.0)


def check_cost(plan: Plan, subject: str, limit_ms: float | None, limit_name: str, has_free_size: bool = True) -> None:
    """Raise ``TooCostlyError`` if a picture is expected to take longer than ``limit_ms``, milliseconds; ``None``: no limit.

    On a device that is not calibrated the time must exceed ``ESTIMATE_MARGIN`` times the limit. The message calls the picture
    ``subject``, and the setting of the limit ``limit_name``. ``has_free_size`` says whether the caller can choose the picture's
    size. Blocks of tiles and maps have a fixed size.
    """
    if limit_ms is None or plan.predicted is None or not is_over_limit(plan, limit_ms):
        return
    reason = f"{subject} by {plan.algorithms_text} is expected to take {plan.predicted.ms / 1000.0:.0f} s"
    cheaper = cost_remedy(plan)
    advice = cheaper or f"Use a faster algorithm{' or a smaller picture' if has_free_size else ''}"
    if limit_name == MAX_MS_OPTION:
        advice += f", or allow more time with {limit_name}"
    raise TooCostlyError.over_limit(
        "size" if has_free_size else limit_name, reason, f"{limit_ms / 1000.0:g} s ({limit_name})", advice
    )
