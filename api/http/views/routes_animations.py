"""Serve animations as jobs: create, poll, download and dismiss them. A film takes longer than a request may."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Body, Depends, Path, Request, Response

from skugga.api.animations.animation import Animation
from skugga.api.http.openapi_parts import WORK_ERROR_STATUSES, LevelPath, ResponseDocs, file_docs, problem_docs
from skugga.api.http.parameters import allow_only_parameters
from skugga.api.http.responses import base_url
from skugga.api.http.state.service import Service, ServiceDep
from skugga.api.http.views.animation_request import AnimationRequest, animation_spec_of, error_with_body_key
from skugga.api.http.views.animation_states import (
    FILM_MEDIA_TYPES,
    AnimationState,
    animation_state_of,
    film_response,
    state_response,
)
from skugga.api.workers.jobs import FilmCheckJob, FilmCheckResult
from skugga.terrain.errors import InputError

router = APIRouter(tags=["animations"])

ANIMATION_EXAMPLE: dict[str, Any] = {
    "from": "2024-10-21T15:00:00-04:00", "to": "2024-10-21T17:00:00-04:00", "step": "1h", "size": [64, 48], "fps": 2,
}  # fmt: skip
ANIMATION_ID_EXAMPLE = "6f1c2a7e0d9b4c53a8e1f0d2b3c4a596"

RESULT_ERROR_STATUSES = 404, 409, 422, 500, 503, 504, 507
"""Statuses of the result of an animation that failed or is not finished."""

AnimationPath = Annotated[
    str, Path(max_length=100, description="An animation by its `jobID`, which cannot be guessed.", examples=[ANIMATION_ID_EXAMPLE])
]

STATE_DOCS: ResponseDocs = {200: {"description": "Its state.", "model": AnimationState}}


@router.post(
    "/levels/{level}/animations",
    summary="Request an animation",
    status_code=202,
    response_model=AnimationState,
    responses=problem_docs(*WORK_ERROR_STATUSES, 413)
    | {
        200: {"description": "The same animation was requested before, and its film is ready.", "model": AnimationState},
        202: {"description": "It is drawn, or waits in the queue. `Location` is its address.", "model": AnimationState},
    },
    dependencies=[Depends(allow_only_parameters())],
)
async def ask_for_animation(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    animation_request: Annotated[
        AnimationRequest, Body(description="Its time span, view and settings.", examples=[ANIMATION_EXAMPLE])
    ],
) -> Response:
    """Create an animation of a level with a moving sun, a moving camera, or both.

    All frames are checked before the animation is accepted. They are then drawn one by one, with lower priority than other
    requests. Poll the state at `Location`: an animation that no client asks about is dismissed. The same request returns the same
    animation while it is drawn, or while its film is kept.
    """
    served_level = await service.level(level)
    spec = animation_spec_of(animation_request, served_level, service.settings)
    animation = service.animations.find(spec)
    if animation is None:
        service.animations.check_queue()
        check = FilmCheckJob(**{name: getattr(spec, name) for name in FilmCheckJob.model_fields})
        try:
            checked = await service.run_job(request, check)
        except InputError as error:
            raise error_with_body_key(error, spec) from None
        assert isinstance(checked, FilmCheckResult)
        animation = service.animations.request(spec, service.expected_frame_s(spec, checked))
    return _state_response(request, service, animation, 200 if animation.has_ended else 202)


@router.get(
    "/animations/{animation}",
    summary="State of an animation",
    response_model=AnimationState,
    responses=STATE_DOCS | problem_docs(404),
    dependencies=[Depends(allow_only_parameters())],
)
async def animation_state(request: Request, service: ServiceDep, animation: AnimationPath) -> Response:
    """Return the state of an animation.

    The status is `accepted`, `running`, `successful`, `failed` or `dismissed`. The state also has the number of drawn frames and
    the expected time left. `Retry-After` says when to ask again.
    """
    return _state_response(request, service, service.animations.get(animation))


@router.get(
    "/animations/{animation}/result",
    summary="The film of an animation",
    response_class=Response,
    responses=problem_docs(*RESULT_ERROR_STATUSES)
    | file_docs("The film.", FILM_MEDIA_TYPES.values())
    | {
        206: {
            "description": "The part of it that `Range` asks for.",
            "content": {media_type: {} for media_type in FILM_MEDIA_TYPES.values()},
        }
    },
    dependencies=[Depends(allow_only_parameters())],
)
async def animation_result(request: Request, service: ServiceDep, animation: AnimationPath) -> Response:
    """Return the film, or the part of it that `Range` asks for.

    An unfinished animation answers 409 with `Retry-After`. A failed one answers with its problem.
    """
    return film_response(request, service.animations.get(animation), service.animations, service.settings)


@router.delete(
    "/animations/{animation}",
    summary="Dismiss an animation",
    response_model=AnimationState,
    responses=STATE_DOCS | problem_docs(404),
    dependencies=[Depends(allow_only_parameters())],
)
async def dismiss_animation(request: Request, service: ServiceDep, animation: AnimationPath) -> Response:
    """Stop drawing an animation, and delete its film."""
    job = service.animations.get(animation)
    service.animations.dismiss(job, "A client dismissed it.")
    return _state_response(request, service, job)


def _state_response(request: Request, service: Service, animation: Animation, status: int = 200) -> Response:
    """Return the state of an animation as a response with the HTTP status ``status``."""
    address = f"{base_url(request, service.settings.public_url)}/animations/{animation.id}"
    return state_response(status, animation_state_of(animation, service.animations, address), service.settings)
