"""Films in render processes: check a film before it is drawn, then draw one frame per job.

The plan (choice of algorithms) of a frame depends on that of the previous frame, so that the shadows do not jump.
"""

from __future__ import annotations

from skugga.api.workers.jobs import Film, FilmCheckJob, FilmPicture, FilmPlanState, FrameJob
from skugga.api.workers.map_plans import plan_function_in_service
from skugga.api.workers.plan_basis import PlanBasis
from skugga.selector.film import FrameMoment, film_frames, frame_moments
from skugga.selector.replanning import Replanner
from skugga.shadows.plan import Plan
from skugga.terrain.describe import describe
from skugga.terrain.scene import Scene


def first_plan(job: FilmCheckJob, scene: Scene, basis: PlanBasis) -> tuple[Plan, FrameMoment]:
    """Return the plan, time and view of a film's first frame, after a check of all frames.

    Raises ``SkuggaError`` if a frame cannot be drawn, for example because the camera goes under the ground.
    """
    moment = frame_moments(scene, job.film_request())[0]
    return _replanner(job, moment, scene, basis).plan(
        describe(moment.scene(scene), moment.view, job.film_request().view_name),
        scene.loaded.level,
        job.request.overrides.for_selector(),
    ), moment


def film_picture(job: FrameJob, scene: Scene, basis: PlanBasis) -> FilmPicture:
    """Draw one frame of a film. Return its colours and the planning state for the next frame. Raises ``SkuggaError``."""
    moments = frame_moments(scene, job.film_request(), only_frame=job.number)
    replanner = _replanner(job, moments[0], scene, basis, job.previous_plan_state)
    (frame,) = film_frames(scene, job.film_request(), moments, replanner)
    assert replanner.state is not None
    return FilmPicture(frame.color, FilmPlanState(replanner.state))


def _replanner(
    film: Film, moment: FrameMoment, scene: Scene, basis: PlanBasis, previous_plan_state: FilmPlanState | None = None
) -> Replanner:
    plans = plan_function_in_service(moment.scene(scene), moment.view, film.level, basis)
    return Replanner(plans=plans, state=None if previous_plan_state is None else previous_plan_state.state)
