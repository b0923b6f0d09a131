"""What a shadow algorithm is: one record, in which the algorithm's own module ends. ``skugga.shadows.registry`` lists the records,
and the planner, the portfolio, the cost and error models, the calibration and the report read them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from skugga.shadows.bent_rays import rays_bend
from skugga.shadows.passes import PassLayer
from skugga.shadows.penumbra import MAX_POINTS, MIN_POINTS, light_points
from skugga.shadows.work import Work, Workload
from skugga.terrain.cache import caches
from skugga.terrain.facts.descriptor import Descriptor, LightKind
from skugga.terrain.facts.fact_types import CastBand, Casting
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.level.level import SUN, CasterKind, Shadows
from skugga.terrain.scene import Scene

ViewKind = Literal["map", "bent map", "perspective"]
"""``bent map``: one that no camera can see as it is, for the earth and its projection bend it."""

GroundKind = Literal["level", "uneven"]
"""``level`` is one plane: without relief, in a flat world."""

RayKind = Literal["bent rays"]
"""``bent rays``: what is drawn at once is so wide that the sun's rays are no straight lines in it."""

ExtentKind = Literal["area light"]
"""``area light``: one that is to be shown as the disc or ball that it is, with penumbrae."""

Requirement = ViewKind | LightKind | CasterKind | GroundKind | RayKind | ExtentKind
"""A part of what is asked of an algorithm: a view, a light, a kind of casters, a ground, rays, a light's extent."""

FALLS_BACK_FOR: Requirement = "bent rays"
"""What an algorithm that is asked for by name falls back for, to ``shadow_map``, and is no error. For it depends on how far one
zooms out, and a level that asks for a sweep has all zooms.
"""

MOST_BEND_PX = 0.25
"""How far, in pixels, a map may lie off what cameras see of its parts, for an algorithm that draws in the view itself."""

DRAWS_IN_THE_VIEW = "the map bends: at this scale no affine camera fits it to a quarter of a pixel"
"""Why such an algorithm refuses a ``bent map``."""


FEW_MAP_SIZES = (1024, 2048, 4096)
"""Sizes of maps that are tried beside an algorithm without maps, so that candidates do not become too many."""


def is_area(descriptor: Descriptor, light: str, shadows: Shadows) -> bool:
    """Whether a light is to be shown as the area that it is: the sun's disc if that is asked for; a lamp's ball if it has a radius
    and that is asked for, or no taps are asked for and its penumbrae are wider than a pixel.
    """
    if light == SUN:
        return shadows.filter == "sun"
    radius_m = next((lamp.radius_m for lamp in descriptor.lamps if lamp.name == light), 0.0)
    return radius_m > 0.0 and (shadows.filter == "sun" or (shadows.filter == "auto" and light_points(descriptor, light) > 1))


def requirements_of(descriptor: Descriptor, light: LightKind, caster: CasterKind, area: bool = False) -> tuple[Requirement, ...]:
    """What an algorithm is asked to serve, for a light of a kind (as an ``area``) and a kind of casters."""
    level_ground = descriptor.flat_world and descriptor.relief_m <= 0.0
    view: tuple[Requirement, ...] = (
        (descriptor.view_kind, "bent map") if descriptor.bend_px > MOST_BEND_PX else (descriptor.view_kind,)
    )
    rays: tuple[Requirement, ...] = ("bent rays",) if light == "sun" and rays_bend(descriptor) else ()
    extent: tuple[Requirement, ...] = ("area light",) if area else ()
    return (*view, light, caster, "level" if level_ground else "uneven", *rays, *extent)


class Reasoned(BaseModel):
    """A name with the reason why it is listed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    reason: str


class AlgorithmSettings(BaseModel):
    """Resolved settings of an algorithm: nothing is left to choose. A subclass says what there is."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @property
    def asked_as(self) -> dict[str, Any]:
        """The same as a level's ``shadows`` would ask for them, as far as it has such keys."""
        return {key: getattr(self, key) for key in Shadows.model_fields if hasattr(self, key)}

    @property
    def label(self) -> list[str]:
        """What tells these settings from others, a word each: part of a candidate's name."""
        required = [str(getattr(self, name)) for name, field in type(self).model_fields.items() if field.is_required()]
        return [*required, *self.changed()]

    def changed(self, *but: str) -> list[str]:
        """The values that are not the defaults, of what a level can ask for; but for some fields."""
        defaults = {name: each.default for name, each in type(self).model_fields.items() if not each.is_required()}
        named = [name for name in defaults if name in Shadows.model_fields and name not in but]
        return [str(getattr(self, name)) for name in named if getattr(self, name) != defaults[name]]


class AreaSettings(AlgorithmSettings):
    """Settings of an algorithm that shows a light as the area that it is by points of it: ``light_points`` of them."""

    light_points: int = Field(default=MAX_POINTS, ge=1)


@dataclass(frozen=True)
class SettingsRequest:
    """What an algorithm resolves its settings from: the facts of a view, a light, what level and request ask of the shadows, and
    why the sun's edges are to be sharp (``None``: they need not be).
    """

    descriptor: Descriptor
    light: str
    shadows: Shadows
    sharp_because: str | None = None

    @property
    def sharpened(self) -> Shadows:
        """What is asked, with one tap where the sun's edges are to be sharp."""
        return self.shadows.model_copy(update={"filter": 1}) if self._is_sharpened else self.shadows

    @property
    def why_sharpened(self) -> list[Reasoned]:
        """The reason for that, for an algorithm that would filter otherwise."""
        return [Reasoned(name="filter 1", reason=f"hard edges: {self.sharp_because}")] if self._is_sharpened else []

    @property
    def is_area(self) -> bool:
        """Whether the light is to be shown as the area that it is."""
        return is_area(self.descriptor, self.light, self.sharpened)

    @property
    def light_points(self) -> int:
        """Points that an area light is shown by."""
        return max(light_points(self.descriptor, self.light), MIN_POINTS) if self.is_area else MAX_POINTS

    def without_filter(self, name: str, *filters: int | str) -> list[Reasoned]:
        """Of an algorithm without filters other than these: what is said where one is asked for."""
        asked = self.sharpened.filter
        if asked in ("auto", 1, *filters):
            return []
        return [Reasoned(name=f"filter {asked}", reason=f"no effect: {name} has hard edges only")]

    @property
    def _is_sharpened(self) -> bool:
        return self.light == SUN and self.sharp_because is not None and self.shadows.filter != 1


ResolvedSettings = tuple[AlgorithmSettings | None, list[Reasoned]]
"""Settings, if an algorithm has any, and the reasons for what was left to choose."""

Overrides = Mapping[str, Any]
"""Fields of ``Shadows`` with values, as a request gives them."""


@dataclass(frozen=True)
class Search:
    """What is tried of an algorithm where the best is looked for.

    Attributes
    ----------
    tuned
        Fields of ``Shadows`` that policies turn, with the values in the order in which they are tried.
    tunes
        Whether a value of such a field makes sense for a view and a light (its name); else the field is left to the algorithm.
    map_sizes_beside
        Where it takes on some kinds of casters and maps the others: the sizes of these maps that are tried (``None``: all).
    hopeless
        Whether it is no candidate for a kind of casters, though it could serve it.
    compared, variants
        What the accuracy report compares: overrides that vary its resolution, and others, which are the first to go where they
        become too many.
    """

    tuned: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    tunes: Callable[[Descriptor, str, str, Any], bool] = lambda descriptor, light, key, value: True
    map_sizes_beside: tuple[int, ...] | None = None
    hopeless: Callable[[Descriptor, CasterKind], bool] = lambda descriptor, kind: False
    compared: tuple[Overrides, ...] = ()
    variants: tuple[Overrides, ...] = ()


@dataclass(frozen=True)
class Cost:
    """What an algorithm's time is predicted from.

    Attributes
    ----------
    work
        What a step does, by part, counted from the descriptor alone (``skugga.shadows.work``). ``None``: all pixels and triangles,
        in one part of the algorithm's name.
    passes
        Parts (without the kind of view or light) that have a pass of their own on record. What is left of a step's time is that of
        its last part.
    calibrated
        The settings that a calibration measures for a view and a light (its name) of a made scene, on which everything is tried
        (``full``), less (``some``), or only what needs the scene (``few``). ``None``: those that it has by itself.
    """

    work: Callable[[Workload, Any], Work] | None = None
    passes: Mapping[str, str] = field(default_factory=dict)
    calibrated: Callable[[Descriptor, str, str], Iterable[AlgorithmSettings | None]] | None = None


@dataclass(frozen=True)
class ErrorConstants:
    """Of an algorithm: which share of the cast shadow it gets wrong however fine it is, which part of what is wrong lies inside of
    shadows and lights, and the scales by which the logarithms of both scatter about what is expected.
    """

    floor: float
    interior: float
    spread: float
    interior_spread: float


@dataclass(frozen=True)
class Accuracy:
    """What an algorithm's errors are predicted from, and held against.

    Attributes
    ----------
    texel_px
        A texel's side in pixels in a band of distances, across the light (``skugga.selector.cost.error_model``): of a descriptor, a
        light's name, settings, a band, and the fitted number of a perspective map's texels to a pixel. ``None``: no texels.
    texel_m
        A texel's larger side on level ground, metres, at the points of a buffer (rows, cols) or everywhere: of a scene, a light's
        name, kinds of casters, settings, a buffer. ``None``: no texels.
    wrong_share
        The share of what is seen on which it throws the shadow of one kind of casters wrongly by its very nature.
    groups, group_of
        Names under which errors are fitted, if there are more than one, and which of them a view belongs to.
    constants
        Fitted constants by group, for an algorithm that is not among those of ``selector/cost/error_model.json``.
    """

    texel_px: Callable[[Descriptor, str, Any, CastBand, float], float] | None = None
    texel_m: Callable[[Scene, str, tuple[CasterKind, ...], Any, GeometryBuffer], float | np.ndarray] | None = None
    wrong_share: Callable[[Casting], float] | None = None
    groups: tuple[str, ...] = ()
    group_of: Callable[[Descriptor], str] | None = None
    constants: Mapping[str, ErrorConstants] = field(default_factory=dict)


MarkColour = Literal["blue", "vermilion", "green", "purple", "orange", "sky", "gray", "black"]


@dataclass(frozen=True)
class Mark:
    """How an algorithm looks in plots: a shape and a colour of ``skugga.api.report.page.marks``."""

    shape: Literal["circle", "square", "triangle", "diamond", "wedge", "star", "cross"]
    colour: MarkColour
    filled: bool = True


Fill = Callable[..., np.ndarray]
"""Fills the visibility of one light (rows, cols), float32 in [0, 1], for a buffer's points past some kinds of casters: takes a
``GeometryBuffer``, a ``Scene``, the light's name, kinds of casters, ``Casters``, the settings, and the ``PassLog``.
"""


FillNodes = Callable[..., np.ndarray]
"""The same of a map's ``BareNodes``, attached shadow included, past ground alone: bool (rows, cols)."""


@dataclass(frozen=True)
class Algorithm:
    """A shadow algorithm.

    Attributes
    ----------
    name, plural, about
        Its name in levels and plans; what its shadows are called in headings; a sentence about it.
    fill, passes
        What fills visibility (``None``: nothing, all is lit), and the names of the passes that this runs, in order.
    node_fill
        What fills that of nodes of bare ground from their heights alone under some settings (``None``: nothing does).
    idle_casters
        Whether its visibility stays the same to the bit under some settings if ground that throws no shadow is left out: not a
        map's, whose taps shade a few points by a step where nothing casts.
    refuses
        What it cannot serve, with the sentence that says why; it serves everything else.
    layers
        Intermediate pictures that it leaves behind when they are asked for.
    served
        Whether a request over HTTP may ask for it, and the selector may take it.
    needs_opengl
        Whether it draws.
    settings, resolve
        The types of its settings, and what resolves them. Raises ``UnsupportedError`` for what it cannot do at all.
    keeps
        The caches (``skugga.terrain.cache``) that it fills, by name; each says how long its values last.
    """

    name: str
    about: str
    fill: Fill | None = None
    node_fill: Callable[[Any], FillNodes | None] = lambda settings: None
    idle_casters: Callable[[Any], bool] = lambda settings: False
    passes: tuple[str, ...] = ()
    plural: str = ""
    refuses: Mapping[Requirement, str] = field(default_factory=dict)
    layers: tuple[PassLayer, ...] = ()
    served: bool = True
    needs_opengl: bool = True
    settings: tuple[type[AlgorithmSettings], ...] = ()
    resolve: Callable[[SettingsRequest], ResolvedSettings] = lambda request: (None, [])
    keeps: tuple[str, ...] = ()
    search: Search = Search()
    cost: Cost = Cost()
    accuracy: Accuracy = Accuracy()
    mark: Mark = Mark("cross", "black")

    def refusal(self, parts: Iterable[Requirement]) -> str | None:
        """Why it cannot serve all of these together; ``None`` if it can."""
        return next((self.refuses[part] for part in parts if part in self.refuses), None)

    def work(self, task: Workload, settings: AlgorithmSettings | None) -> Work:
        """What a step of it does, by part."""
        if self.cost.work is not None:
            return self.cost.work(task, settings)
        return {self.name: {"blocks": 1.0, "pixels": task.pixels, "triangles": task.all_triangles}} if self.passes else {}

    def calibrated(self, descriptor: Descriptor, light: str, grid: str) -> Iterator[AlgorithmSettings | None]:
        """The settings that a calibration measures."""
        if self.cost.calibrated is not None:
            yield from self.cost.calibrated(descriptor, light, grid)
        else:
            yield self.resolve(SettingsRequest(descriptor, light, Shadows()))[0]

    @property
    def error_groups(self) -> tuple[str, ...]:
        """The names under which its errors are fitted."""
        return self.accuracy.groups or (self.name,)

    def error_group(self, descriptor: Descriptor) -> str:
        """The one of a view."""
        return self.name if self.accuracy.group_of is None else self.accuracy.group_of(descriptor)

    def forget(self) -> None:
        """Empty what it keeps."""
        for cache in caches():
            if cache.name in self.keeps:
                cache.clear()
