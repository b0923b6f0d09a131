"""Films in render processes: check a film before it is drawn, then draw one frame per job.

The plan (choice of algorithms) of a frame depends on that of the previous frame, so that the shadows do not jump.
"""

from __future__ import annotations

from skugga.api.workers.jobs import Film, FilmCheckJob, FilmPicture, FilmPlanState, FrameJob
from skugga.api.workers.map_plans import view_plan_selector
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.selector.film import FrameMoment, describe_frame, film_frames, frame_moments
from skugga.selector.replanning import Replanner
from skugga.shadows.plan import Plan
from skugga.terrain.scene import Scene


def plan_first_frame(job: FilmCheckJob, scene: Scene, measurements: PlanMeasurements) -> tuple[Plan, FrameMoment]:
    """Check all frames of a film, and return the plan, time and view of its first frame.

    Raises ``SkuggaError`` if a frame cannot be drawn, for example because the camera goes under the ground.
    """
    moment = frame_moments(scene, job.film_request())[0]
    return _replanner(job, moment, scene, measurements).plan(
        describe_frame(moment.scene(scene), job.film_request(), moment),
        scene.loaded.level,
        job.request.overrides.for_selector(),
    ), moment


def draw_film_frame(job: FrameJob, scene: Scene, measurements: PlanMeasurements) -> FilmPicture:
    """Draw one frame of a film. Return its colours and the planning state for the next frame. Raises ``SkuggaError``."""
    moments = frame_moments(scene, job.film_request(), only_frame=job.frame_number)
    replanner = _replanner(job, moments[0], scene, measurements, job.previous_plan_state)
    (frame,) = film_frames(scene, job.film_request(), moments, replanner)
    assert replanner.state is not None
    return FilmPicture(frame.color, FilmPlanState(replanner.state))


def _replanner(
    film: Film, moment: FrameMoment, scene: Scene, measurements: PlanMeasurements, previous_plan_state: FilmPlanState | None = None
) -> Replanner:
    """Return the planner of a film's frames, with the planning state after the previous frame; ``None`` for the first frame."""
    plans = view_plan_selector(moment.scene(scene), moment.view, film.level, measurements)
    return Replanner(plans=plans, state=None if previous_plan_state is None else previous_plan_state.state)
