"""Plans (choices of shadow algorithms) of a level's views in a service.

Plans use predicted costs and errors. For maps and tiles, probes of similar maps (observed errors and times) correct the
predictions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from skugga.api.workers.jobs import LevelKey
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.selector.map_probes import PROBE_SETTINGS, MapClass, map_class
from skugga.selector.select import plan_of_view, select
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.surface import map_pixel_m

if TYPE_CHECKING:
    from skugga.selector.choices import PlanRequest, PolicyName
    from skugga.selector.observation import Observation
    from skugga.selector.replanning import PlanFunction
    from skugga.shadows.plan import Plan
    from skugga.terrain.facts.descriptor import Descriptor
    from skugga.terrain.scene import Scene


def select_view_plan(
    scene: Scene,
    view: MapView | PerspectiveView,
    name: str,
    overrides: dict[str, Any],
    level: LevelKey,
    measurements: PlanMeasurements,
    policy: PolicyName = "predict",
) -> Plan:
    """Return the plan of a view of a level. Raises ``SkuggaError``.

    ``name`` is the view's name in the plan. ``overrides`` are the request's shadow settings. ``measurements`` has the calibration
    and the probes.
    """
    return plan_of_view(
        scene,
        view,
        name,
        overrides,
        policy,
        measurements.device,
        observations=_observations(scene, view, overrides, level, measurements),
    )


def view_plan_selector(
    scene: Scene, view: MapView | PerspectiveView, level: LevelKey, measurements: PlanMeasurements
) -> PlanFunction:
    """Return a function that plans a view of a level for changing descriptors, such as those of the frames of a film.

    The function's arguments are a descriptor, the level's plan request and shadow settings. It uses the calibration and the probes
    of ``measurements``, as ``select_view_plan`` does.
    """

    def plan(descriptor: Descriptor, plan_request: PlanRequest, overrides: dict[str, Any] | None) -> Plan:
        observations = _observations(scene, view, overrides or {}, level, measurements)
        return select(descriptor, plan_request, overrides, "predict", measurements.device, observations)

    return plan


def unprobed_class(
    scene: Scene, view: MapView, overrides: Mapping[str, Any], level: LevelKey, measurements: PlanMeasurements
) -> MapClass | None:
    """Return the class (scale and sun) of a map if a probe of this class would improve its plan.

    The result is ``None`` if the class is probed already, or if a probe cannot help. It cannot without a calibration, without a sun
    above the horizon, or with shadow settings that probes do not cover (``PROBE_SETTINGS``).
    """
    probe_class = _map_class(scene, view, overrides)
    return (
        probe_class
        if measurements.device is not None
        and probe_class is not None
        and measurements.probes_of(level).observations_of_class(probe_class) is None
        else None
    )


def _observations(
    scene: Scene, view: MapView | PerspectiveView, overrides: Mapping[str, Any], level: LevelKey, measurements: PlanMeasurements
) -> Mapping[str, tuple[Observation, ...]] | None:
    """Return the observations of probes of similar maps, by light; ``None`` for a perspective view."""
    return (
        measurements.probes_of(level).observations_of_class(_map_class(scene, view, overrides))
        if isinstance(view, MapView)
        else None
    )


def _map_class(scene: Scene, view: MapView, overrides: Mapping[str, Any]) -> MapClass | None:
    """Return the class (scale and sun) of a map.

    The result is ``None`` without a sun above the horizon, or with shadow settings that probes do not cover.
    """
    if scene.sun is None or not set(overrides) <= PROBE_SETTINGS:
        return None
    return map_class(map_pixel_m(scene.world, view), scene.sun.altitude_deg)
