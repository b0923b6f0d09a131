"""Defects of suns that move, and of films."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tests.hard_cases.mutants.mutant import Mutant, cases, edited, wrapped


def _with_azimuth(change: Callable[[float], float]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a wrapper of ``sun_of`` that changes a given azimuth, degrees."""

    def wrap(sun_of: Callable[..., Any]) -> Callable[..., Any]:
        def changed(spec: Any, world: Any) -> Any:
            if spec.azimuth is None:
                return sun_of(spec, world)
            return sun_of(spec.model_copy(update={"azimuth": change(spec.azimuth % 360.0)}), world)

        return changed

    return wrap


MUTANTS = {
    "sun_in_steps": Mutant(
        "the sun waits, and then jumps by two degrees",
        wrapped("terrain.geo.sun:sun_of", _with_azimuth(lambda azimuth: 2.0 * round(azimuth / 2.0))),
        cases("test_moving_suns", "test_edges_follow_the_sun", "shadow_map", "perspective_shadow_map", "shadow_volume"),
    ),
    "late_film": Mutant(
        "a film's sun is that of half a minute before, and its clock a hundredth of a second late",
        edited(
            "selector.film:FrameMoment.scene",
            ("SunSpec(time=self.time)", "SunSpec(time=self.time.replace(second=30))"),
            ("at_second(self.second)", "at_second(self.second + 0.01)"),
        ),
        cases("test_films", "test_films_of_a_moving_sun", "shadow_map", "shadow_volume", "sweep")
        + cases("test_films", "test_films_of_moving_bodies", "shadow_map", "planar"),
    ),
    "western_suns": Mutant(
        "suns in the west stand ten degrees farther in the north",
        wrapped("terrain.geo.sun:sun_of", _with_azimuth(lambda azimuth: azimuth + 10.0 * (azimuth > 180.0))),
        cases("test_films", "test_films_from_every_side", "shadow_map", "sweep")
        + cases("test_films", "test_perspective_films_from_every_side", "perspective_shadow_map"),
    ),
}
