"""Parse the body of a request for an animation into a ``AnimationSpec``."""

from __future__ import annotations

from datetime import timedelta
from importlib.util import find_spec
from typing import Annotated, Any

from pydantic import Field, create_model

from skugga.api.animations.animation_spec import AnimationSpec, FilmFormat
from skugga.api.film_span import DEFAULT_FPS, film_span
from skugga.api.http.parameters import served_settings, style_named
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.http.views.cameras import MAX_EYE_OR_TARGET_HEIGHT_M, POSITION_DESCRIPTION
from skugga.api.request import PictureRequest
from skugga.api.settings import Settings
from skugga.selector.film_request import PATH_VIEW_NAME, FilmSpan
from skugga.terrain.color_ramp import MAX_RAMP_CHARACTERS
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.geo.sun_path import as_utc, check_times
from skugga.terrain.level.camera_file import CameraPathSpec
from skugga.terrain.level.level import Shadows, parse_sun
from skugga.terrain.level.model import Model
from skugga.terrain.level.parts import Generalisation, LocalLightDeg, SkyName, SlopeExaggeration, SunSpec
from skugga.terrain.level.setting import settings_of
from skugga.terrain.scene import MAX_PERSPECTIVE_SIDE_PX

MAX_TIME_CHARACTERS = 60
"""Maximum number of characters of a time or a duration."""

FrameSide = Annotated[int, Field(ge=1, le=MAX_PERSPECTIVE_SIDE_PX, strict=True)]
TimeText = Annotated[str, Field(max_length=MAX_TIME_CHARACTERS)]


_FROM_FIELD = Field(
    default=None, examples=["2024-10-21T08:00:00-04:00"],
    description="The first frame's time, ISO 8601 with an offset: the sun moves. Or a time on the level's clock, as 0s: "
    "animated objects move, and the sun is fixed. Default: the path's.",
)  # fmt: skip
_FROM_FIELDS: dict[str, Any] = {"from": (TimeText | None, _FROM_FIELD)}  # a keyword of Python, so no class body can declare it
_FromModel: Any = create_model("_Named", __base__=Model, **_FROM_FIELDS)


class _AnimationFields(_FromModel):
    to: TimeText | None = Field(
        default=None, examples=["2024-10-21T18:00:00-04:00"], description="The last frame's time, of the same kind."
    )
    step: TimeText | None = Field(
        default=None, examples=["10m"],
        description="Time between frames: a number and s, m, h or d. Default for times on the clock: 1 / `fps` seconds.",
    )  # fmt: skip
    view: str | None = Field(
        default=None, max_length=100, examples=["ridge"], description="A view of the level; default: `map`, else its first one."
    )
    path: CameraPathSpec | None = Field(default=None, description="Instead of `view`, a camera that moves, as in a camera file.")
    size: tuple[FrameSide, FrameSide] | None = Field(
        default=None, examples=[[640, 480]], description="Width and height in pixels; default: those of the view or the path."
    )
    seconds: float | None = Field(
        default=None, ge=-1e9, le=1e9, strict=True, examples=[0],
        description="Reading of the level's clock in the first frame, if `from` is a date; default: the level's.",
    )  # fmt: skip
    format: FilmFormat = Field(default="webp", description="`webp`; `mp4` is smaller, if the service makes it.")
    lossless: bool = Field(
        default=False, strict=True, examples=[True], description="Compress `webp` without loss: about six times the size."
    )
    fps: float = Field(default=DEFAULT_FPS, strict=True, examples=[10], description="Frames a second of the film, 0.1 to 120.")
    time: TimeText | None = Field(default=None, description="Time of a fixed sun, ISO 8601 with an offset; default: the level's.")
    azimuth: float | None = Field(
        default=None, strict=True, examples=[235], description="With `altitude`: azimuth of a fixed sun, degrees from true north."
    )
    altitude: float | None = Field(default=None, strict=True, examples=[22], description="Apparent degrees above the horizon.")
    style: str | None = Field(default=None, max_length=100, examples=["swiss"], description="How relief is shaded.")
    slope_exaggeration: SlopeExaggeration | None = Field(
        default=None, strict=True, examples=[2], description="Factor of slopes in shading, for flat country."
    )
    sky: SkyName | None = Field(default=None, examples=["clear"], description="The sky that lights the ground of maps.")
    ramp: str | None = Field(
        default=None, max_length=MAX_RAMP_CHARACTERS, examples=["0:a9be98,1500:d9d2ae"],
        description="Colours of the ground by its height in metres, in place of the style's.",
    )  # fmt: skip
    local_light: LocalLightDeg | None = Field(
        default=None, strict=True, examples=[30], description="Largest turn of the light that shades relief along it, degrees."
    )
    generalisation: Generalisation | None = Field(
        default=None, strict=True, examples=[0.6], description="Share of large landforms in the slopes of maps of small scale."
    )


_SHADOW_SETTINGS = settings_of(Shadows, "pictures")

_SHADOW_FIELDS: dict[str, Any] = {
    setting.name: (setting.type | None, Field(default=None, description=setting.description, examples=[setting.example]))
    for setting in _SHADOW_SETTINGS
}

AnimationRequest: Any = create_model(
    "AskedAnimation",
    __base__=_AnimationFields,
    __doc__="An animation: its times, its view and its settings of shadows.",
    **_SHADOW_FIELDS,
)
"""The pydantic model of the request's body. Its last fields are the shadow settings."""


def animation_spec_of(body: Any, level: ServedLevel, settings: Settings) -> AnimationSpec:
    """Return the specification of an animation from a request's body (an ``AnimationRequest``).

    All checks that need no height of the level's ground are done here. Raises ``InputError``.
    """
    if body.lossless and body.format != "webp":
        raise InputError("lossless", Problem(f"films as {body.format} are lossy"), "Use the format webp")
    if body.format == "mp4" and find_spec("av") is None:
        raise InputError("format", Problem("this service has no encoder of mp4"), "Use webp")
    if body.path is not None:
        if body.view is not None:
            raise InputError.conflict("view", "path", "Use one of them; a path sets the camera")
        _check_positions(body.path)
    span = film_span(getattr(body, "from"), body.to, body.step, body.fps, body.path, body.seconds, settings.max_animation_frames)
    view = PATH_VIEW_NAME if body.path is not None else level.view_named(body.view)
    own_size = body.path.size if body.path is not None else level.view_sizes[view]
    if (size := body.size or own_size) is not None:
        _check_pixels(size, span.frames, settings)
    request = PictureRequest(
        sun=_fixed_sun(body, span),
        style=style_named(body.style),
        slope_exaggeration=body.slope_exaggeration,
        sky=body.sky,
        ramp=body.ramp,
        local_light=body.local_light,
        generalisation=body.generalisation,
        overrides=served_settings({setting.name: getattr(body, setting.name) for setting in _SHADOW_SETTINGS}),
    )
    return AnimationSpec(
        level=level.key, level_name=level.name, span=span, view=view, path=body.path, size=body.size, request=request,
        format=body.format, lossless=body.lossless, fps=body.fps,
    )  # fmt: skip


def error_with_body_key(error: InputError, spec: AnimationSpec) -> InputError:
    """Return an error from checking a film, renamed to the key of the request's body that is wrong.

    The engine's errors name a parameter of films, a key of camera files, or a frame.
    """
    name, colon, frame_parameter = error.name.partition(": ")
    if name.startswith("keys"):
        return error.renamed(f"path.{error.name}")
    if name.startswith("path, "):
        frame_location = f"{name.removeprefix('path, ')}{colon}{frame_parameter}"
        if isinstance(error.value, Problem):
            return type(error)("path", Problem(f"{frame_location}: {error.value}"), error.allowed)
        return type(error)("path", f"{frame_location}: {error.value}", error.allowed)
    if name == "time" and spec.span.start is not None:
        return error.renamed("from")
    return error


def _check_positions(path: CameraPathSpec) -> None:
    """Raise ``InputError`` for an eye or a target of a camera path that lies too far away or too high."""
    for number, key in enumerate(path.keys):
        for name, position in (("eye", key.eye), ("target", key.target)):
            if max(map(abs, position[:2])) > 1e9 or abs(position[2]) > MAX_EYE_OR_TARGET_HEIGHT_M:
                raise InputError(f"path.keys.{number}.{name}", list(position), POSITION_DESCRIPTION)


def _check_pixels(size: tuple[int, int], frames: int, settings: Settings) -> None:
    """Raise ``InputError`` if a frame, or all frames together, have more pixels than the settings allow.

    ``size`` is (width, height) of a frame in pixels, and ``frames`` is the number of frames.
    """
    pixels, size_text = size[0] * size[1], f"{size[0]}x{size[1]}"
    if pixels > settings.max_animation_frame_pixels:
        limit = f"{settings.max_animation_frame_pixels} (the service's SKUGGA_MAX_ANIMATION_FRAME_PIXELS)"
        raise InputError.over_limit("size", f"{size_text} is {pixels} pixels a frame", limit, "Use smaller frames")
    if frames * pixels > settings.max_animation_pixels:
        limit = f"{settings.max_animation_pixels} (the service's SKUGGA_MAX_ANIMATION_PIXELS)"
        value_text = f"{frames} frames of {size_text} are {frames * pixels} pixels"
        raise InputError.over_limit("size", value_text, limit, "Use fewer or smaller frames")


def _fixed_sun(body: Any, span: FilmSpan) -> SunSpec | None:
    """Return the sun of a film without dates, which does not move; ``None`` means the level's own sun.

    The result is ``None`` also for a film with dates, whose sun moves. Raises ``InputError``.
    """
    sun = parse_sun(body.time, body.azimuth, body.altitude)
    if span.start is None:
        if sun is not None and sun.time is not None:
            check_times(as_utc([sun.time]))
        return sun
    for name in ("time", "azimuth", "altitude"):
        if getattr(body, name) is not None:
            raise InputError.conflict(name, "dates in from and to", f"Omit {name}: the dates define the sun")
    for name, moment in (("from", span.start), ("to", span.start + timedelta(seconds=span.length_s))):
        try:
            check_times(as_utc([moment]))
        except InputError as error:
            raise error.renamed(name) from None
    return None
