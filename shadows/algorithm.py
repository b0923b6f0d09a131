"""The record that declares a shadow algorithm.

The module of an algorithm ends in one ``Algorithm`` record. ``skugga.shadows.registry`` lists the records. The planner, the
portfolio, the cost and error models, the calibration and the report read them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from skugga.shadows.bent_rays import rays_bend
from skugga.shadows.passes import PassLayer
from skugga.shadows.penumbra import MAX_LIGHT_POINTS, MIN_LIGHT_POINTS, light_point_count
from skugga.shadows.work import Work, Workload
from skugga.terrain.cache import caches
from skugga.terrain.facts.descriptor import Descriptor, LightKind
from skugga.terrain.facts.fact_types import CastBand, Casting
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.level.level import SUN, CasterKind, Shadows
from skugga.terrain.scene import Scene

ViewKind = Literal["map", "bent map", "perspective"]
"""``bent map``: a map that no affine camera fits, because the earth's curvature and the projection bend it."""

GroundKind = Literal["level", "uneven"]
"""``level``: the ground is one plane, in a flat world without relief. ``uneven``: any other ground."""

RayKind = Literal["bent rays"]
"""``bent rays``: the sun's rays are no straight lines in the area drawn at once, which is too wide or lies near a pole."""

ExtentKind = Literal["area light"]
"""``area light``: the light is shown as a disc or a ball, with penumbrae."""

Requirement = ViewKind | LightKind | CasterKind | GroundKind | RayKind | ExtentKind
"""One requirement of an algorithm: a kind of view, light, casters, ground or rays, or the extent of a light."""

FALLBACK_REQUIREMENT: Requirement = "bent rays"
"""The requirement for which an algorithm that is requested by name falls back to ``shadow_map`` without an error.

The requirement depends on the zoom, and a level that requests a sweep has all zooms.
"""

MAX_BEND_PX = 0.25
"""Upper bound, in pixels, of the error of an affine camera that stands for a part of a map.

Algorithms that draw casters in the view itself need such cameras. Above the bound the map is a ``bent map``.
"""

BENT_MAP_REASON = "the map is not affine: at this scale no affine camera fits it within a quarter of a pixel"
"""The reason with which an algorithm that draws casters in the view itself refuses a ``bent map``."""


MAP_SIZES_FOR_OTHER_CASTERS = (1024, 2048, 4096)
"""Sizes, in texels a side, of shadow maps that are tried where an algorithm without maps serves the other kinds of casters.

A short list limits the number of candidates.
"""


def is_area_light(descriptor: Descriptor, light: str, shadows: Shadows) -> bool:
    """Return whether a light is shown as an area light.

    The sun is shown as its disc if ``filter`` is ``sun``. A lamp is shown as its ball if it has a radius and either ``filter`` is
    ``sun``, or ``filter`` is ``auto`` and its penumbrae are wider than a pixel.

    Parameters
    ----------
    descriptor
        The facts of a view.
    light
        The name of the light.
    shadows
        The requested shadow settings.

    Returns
    -------
    bool
        Whether the light is shown with penumbrae.
    """
    if light == SUN:
        return shadows.filter == "sun"
    radius_m = next((lamp.radius_m for lamp in descriptor.lamps if lamp.name == light), 0.0)
    return radius_m > 0.0 and (shadows.filter == "sun" or (shadows.filter == "auto" and light_point_count(descriptor, light) > 1))


def requirements_of(
    descriptor: Descriptor, light_kind: LightKind, caster_kind: CasterKind, is_area_light: bool = False
) -> tuple[Requirement, ...]:
    """Return the requirements that an algorithm has to serve for a light and a kind of casters.

    Parameters
    ----------
    descriptor
        The facts of a view.
    light_kind
        The kind of the light.
    caster_kind
        The kind of casters.
    is_area_light
        Whether the light is shown as an area light.

    Returns
    -------
    tuple of Requirement
        The kinds of view, light, casters and ground; then ``bent rays`` and ``area light`` where they apply.
    """
    level_ground = descriptor.flat_world and descriptor.relief_m <= 0.0
    view: tuple[Requirement, ...] = (
        (descriptor.view_kind, "bent map") if descriptor.bend_px > MAX_BEND_PX else (descriptor.view_kind,)
    )
    rays: tuple[Requirement, ...] = ("bent rays",) if light_kind == "sun" and rays_bend(descriptor) else ()
    extent: tuple[Requirement, ...] = ("area light",) if is_area_light else ()
    return (*view, light_kind, caster_kind, "level" if level_ground else "uneven", *rays, *extent)


class NamedReason(BaseModel):
    """A setting, algorithm or layer by name, with the reason for it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    reason: str


class AlgorithmSettings(BaseModel):
    """Resolved settings of an algorithm, without any automatic values. A subclass declares the fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @property
    def as_overrides(self) -> dict[str, Any]:
        """The settings as keys and values of a level's ``shadows``, without fields that are no such keys."""
        return {key: getattr(self, key) for key in Shadows.model_fields if hasattr(self, key)}

    @property
    def label_parts(self) -> list[str]:
        """The values that distinguish these settings from others, as text: a part of a candidate's name.

        They are the values of all required fields, then those that differ from their defaults.
        """
        required = [str(getattr(self, name)) for name, field in type(self).model_fields.items() if field.is_required()]
        return [*required, *self.changed_values()]

    def changed_values(self, *excluded: str) -> list[str]:
        """Return the values that differ from their defaults, as text.

        Parameters
        ----------
        *excluded
            Names of fields that are left out. Fields that are no keys of a level's ``shadows`` are always left out.
        """
        defaults = {
            name: field_info.default for name, field_info in type(self).model_fields.items() if not field_info.is_required()
        }
        names = [name for name in defaults if name in Shadows.model_fields and name not in excluded]
        return [str(getattr(self, name)) for name in names if getattr(self, name) != defaults[name]]


class AreaLightSettings(AlgorithmSettings):
    """Settings of an algorithm that draws an area light as the mean over ``light_points`` point lights."""

    light_points: int = Field(default=MAX_LIGHT_POINTS, ge=1)


@dataclass(frozen=True)
class SettingsRequest:
    """The input from which an algorithm resolves its settings.

    Attributes
    ----------
    descriptor
        The facts of a view.
    light
        The name of the light.
    shadows
        The shadow settings that level and request ask for.
    hard_edges_reason
        The reason why the sun's shadows need hard edges; ``None`` if they do not.
    """

    descriptor: Descriptor
    light: str
    shadows: Shadows
    hard_edges_reason: str | None = None

    @property
    def effective_shadows(self) -> Shadows:
        """The requested shadow settings, with one tap if the sun's shadows need hard edges."""
        return self.shadows.model_copy(update={"filter": 1}) if self._forces_hard_edges else self.shadows

    @property
    def hard_edges_reasons(self) -> list[NamedReason]:
        """The reason for hard edges; empty if the requested filter is not changed."""
        return [NamedReason(name="filter 1", reason=f"hard edges: {self.hard_edges_reason}")] if self._forces_hard_edges else []

    @property
    def is_area_light(self) -> bool:
        """Whether the light is shown as an area light."""
        return is_area_light(self.descriptor, self.light, self.effective_shadows)

    @property
    def light_point_count(self) -> int:
        """The number of point lights that an area light is averaged over."""
        return max(light_point_count(self.descriptor, self.light), MIN_LIGHT_POINTS) if self.is_area_light else MAX_LIGHT_POINTS

    def ignored_filter_reasons(self, algorithm_name: str, *filters: int | str) -> list[NamedReason]:
        """Return the reason why a requested filter has no effect, for an algorithm that ignores it.

        Parameters
        ----------
        algorithm_name
            The name of the algorithm.
        *filters
            Filters that the algorithm has, besides ``auto`` and 1.

        Returns
        -------
        list of NamedReason
            One entry; empty if the algorithm has the requested filter.
        """
        requested_filter = self.effective_shadows.filter
        if requested_filter in ("auto", 1, *filters):
            return []
        return [NamedReason(name=f"filter {requested_filter}", reason=f"no effect: {algorithm_name} has hard edges only")]

    @property
    def _forces_hard_edges(self) -> bool:
        return self.light == SUN and self.hard_edges_reason is not None and self.shadows.filter != 1


ResolvedSettings = tuple[AlgorithmSettings | None, list[NamedReason]]
"""The settings, if the algorithm has any, and the reasons for automatic values."""

Overrides = Mapping[str, Any]
"""Fields of ``Shadows`` with values, as in a request."""


@dataclass(frozen=True)
class SettingsSearch:
    """The settings of an algorithm that the selector searches.

    Attributes
    ----------
    search_space
        Fields of ``Shadows`` that policies vary, each with its values in the order in which they are tried.
    is_tunable
        Function of a descriptor, a light's name, a field and a value of it. It returns whether the value makes sense for the view
        and the light. If it does not, the algorithm resolves the field itself.
    map_sizes_for_other_casters
        Sizes of shadow maps that are tried where this algorithm serves some kinds of casters and a shadow map serves the others.
        ``None``: all sizes.
    is_excluded
        Function of a descriptor and a kind of casters. It returns whether the selector shall not consider the algorithm for them,
        although the algorithm could serve them.
    exclusion_reason
        The reason for ``is_excluded`` as a sentence.
    resolution_variants
        Overrides that vary the resolution, for the accuracy report.
    other_variants
        Further overrides for the accuracy report. They are dropped first if there are too many.
    """

    search_space: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    is_tunable: Callable[[Descriptor, str, str, Any], bool] = lambda descriptor, light, key, value: True
    map_sizes_for_other_casters: tuple[int, ...] | None = None
    is_excluded: Callable[[Descriptor, CasterKind], bool] = lambda descriptor, kind: False
    exclusion_reason: str = "not tried for these casters"
    resolution_variants: tuple[Overrides, ...] = ()
    other_variants: tuple[Overrides, ...] = ()


@dataclass(frozen=True)
class CostInputs:
    """The input from which the time of an algorithm is predicted.

    Attributes
    ----------
    work
        Function that returns the work of a step (one call of the algorithm) as counts by part, from the descriptor alone
        (``skugga.shadows.work``). ``None``: all pixels and triangles, in one part with the algorithm's name.
    pass_of_part
        Names of parts of the work (without the kind of view or light), each with the pass whose recorded time measures it. The
        last part takes the rest of a step's time.
    calibration_settings
        Function of a descriptor, a light's name and the extent of the calibration, that returns the settings to measure on a
        synthetic scene. The extent is ``full`` (all settings), ``some`` (fewer) or ``few`` (only those that need the scene).
        ``None``: the automatic settings.
    """

    work: Callable[[Workload, Any], Work] | None = None
    pass_of_part: Mapping[str, str] = field(default_factory=dict)
    calibration_settings: Callable[[Descriptor, str, str], Iterable[AlgorithmSettings | None]] | None = None


@dataclass(frozen=True)
class ErrorConstants:
    """Fitted constants of the error of an algorithm.

    Attributes
    ----------
    floor
        Share of the cast shadow that is wrong at any resolution.
    interior
        Share of the wrong area that lies inside of shadows and lit areas.
    spread, interior_spread
        Scales by which the logarithms of the wrong share and of the interior share scatter about their expected values.
    """

    floor: float
    interior: float
    spread: float
    interior_spread: float


@dataclass(frozen=True)
class AccuracyInputs:
    """The input from which the errors of an algorithm are predicted and checked.

    Attributes
    ----------
    texel_px
        Function that returns a texel's side perpendicular to the light, in pixels, in a band of distances from the eye
        (``skugga.selector.cost.error_model``). Its arguments are a descriptor, a light's name, settings, a band, and the fitted
        number of a perspective map's texels per pixel. ``None``: the algorithm has no texels.
    texel_m
        Function that returns a texel's larger side on level ground, in metres: an array (rows, cols) for the points of a buffer, or
        one number for all. Its arguments are a scene, a light's name, kinds of casters, settings and a buffer. ``None``: the
        algorithm has no texels.
    wrong_share
        Function that returns the share of the picture on which the algorithm's shadow of one kind of casters is wrong by design.
    error_groups
        Names of the groups of views whose errors are fitted separately; empty: one group with the algorithm's name.
    error_group_of
        Function of a descriptor that returns the group of its view.
    error_constants
        Fitted constants by group, for an algorithm that is missing in ``selector/cost/error_model.json``.
    """

    texel_px: Callable[[Descriptor, str, Any, CastBand, float], float] | None = None
    texel_m: Callable[[Scene, str, tuple[CasterKind, ...], Any, GeometryBuffer], float | np.ndarray] | None = None
    wrong_share: Callable[[Casting], float] | None = None
    error_groups: tuple[str, ...] = ()
    error_group_of: Callable[[Descriptor], str] | None = None
    error_constants: Mapping[str, ErrorConstants] = field(default_factory=dict)


MarkerColour = Literal["blue", "vermilion", "green", "purple", "orange", "sky", "gray", "black"]
"""Names of colours that stay distinct for colour-blind readers (``skugga.api.report.page.marks``)."""


@dataclass(frozen=True)
class PlotMarker:
    """The marker of an algorithm in plots.

    Attributes
    ----------
    shape, colour
        A shape and a colour of ``skugga.api.report.page.marks``.
    filled
        Whether the shape is filled.
    """

    shape: Literal["circle", "square", "triangle", "diamond", "wedge", "star", "cross"]
    colour: MarkerColour
    filled: bool = True


FillVisibility = Callable[..., np.ndarray]
"""Function that returns the visibility of one light at a buffer's points, where only the given kinds of casters block it.

The result is float32 (rows, cols) in [0, 1]. The arguments are a ``GeometryBuffer``, a ``Scene``, the light's name, the kinds of
casters, ``Casters``, the settings and the ``PassLog``.
"""


FindLitNodes = Callable[..., np.ndarray]
"""Function that returns which nodes of bare ground in a map (``BareNodes``) are lit: bool (rows, cols).

Only the ground casts. Nodes whose ground faces away from the light are not lit. The nodes are the first argument, in place of the
buffer; the others are those of ``FillVisibility``.
"""


@dataclass(frozen=True)
class Algorithm:
    """A shadow algorithm.

    Attributes
    ----------
    name
        The name in levels and plans.
    description
        One sentence about the algorithm.
    fill_visibility
        Function that fills the visibility; ``None``: all points are lit.
    lit_nodes_finder
        Function of the settings that returns a ``FindLitNodes`` function, which reads only the heights of bare ground. It returns
        ``None`` where the algorithm has no such function.
    allows_caster_culling
        Function of the settings. It returns whether ground that casts no shadow can be left out without changing one bit of the
        result. Shadow maps return False: their filter darkens a few points slightly even where nothing casts.
    passes
        The names of the passes that ``fill_visibility`` runs, in order.
    plural_name
        The name of the algorithm's shadows in headings.
    refusals
        The requirements that the algorithm cannot serve, each with the reason as a sentence.
    layers
        Intermediate pictures that it keeps on request.
    is_selectable
        Whether a request over HTTP may ask for it and the selector may choose it.
    needs_opengl
        Whether it draws with OpenGL.
    settings_types
        The types of its settings.
    resolve_settings
        Function that resolves its settings. It raises ``UnsupportedError`` for a request that the algorithm cannot serve.
    cache_names
        The names of the caches (``skugga.terrain.cache``) that it fills. Each cache says how long its values last.
    search
        The settings that the selector searches.
    cost
        The input from which its time is predicted.
    accuracy
        The input from which its errors are predicted.
    marker
        Its marker in plots.
    version
        The version of its code. It is raised with every change of the code that changes times or errors, because figures that were
        measured before the change no longer hold.
    """

    name: str
    description: str
    fill_visibility: FillVisibility | None = None
    lit_nodes_finder: Callable[[Any], FindLitNodes | None] = lambda settings: None
    allows_caster_culling: Callable[[Any], bool] = lambda settings: False
    passes: tuple[str, ...] = ()
    plural_name: str = ""
    refusals: Mapping[Requirement, str] = field(default_factory=dict)
    layers: tuple[PassLayer, ...] = ()
    is_selectable: bool = True
    needs_opengl: bool = True
    settings_types: tuple[type[AlgorithmSettings], ...] = ()
    resolve_settings: Callable[[SettingsRequest], ResolvedSettings] = lambda request: (None, [])
    cache_names: tuple[str, ...] = ()
    search: SettingsSearch = SettingsSearch()
    cost: CostInputs = CostInputs()
    accuracy: AccuracyInputs = AccuracyInputs()
    marker: PlotMarker = PlotMarker("cross", "black")
    version: int = 1

    def refusal_reason(self, requirements: Iterable[Requirement]) -> str | None:
        """Return the reason why the algorithm cannot serve some requirements together.

        Parameters
        ----------
        requirements
            The requirements.

        Returns
        -------
        str or None
            The reason for the first requirement that it refuses; ``None`` if it serves them all.
        """
        return next((self.refusals[requirement] for requirement in requirements if requirement in self.refusals), None)

    def work(self, workload: Workload, settings: AlgorithmSettings | None) -> Work:
        """Return the work of one step (one call of the algorithm), as counts by part.

        Parameters
        ----------
        workload
            The descriptor's quantities for a light and some kinds of casters.
        settings_types
            The resolved settings.
        """
        if self.cost.work is not None:
            return self.cost.work(workload, settings)
        return {self.name: {"blocks": 1.0, "pixels": workload.pixels, "triangles": workload.all_triangles}} if self.passes else {}

    def calibration_settings(
        self, descriptor: Descriptor, light: str, calibration_extent: str
    ) -> Iterator[AlgorithmSettings | None]:
        """Yield the settings that a calibration measures.

        Parameters
        ----------
        descriptor
            The facts of a view of a synthetic scene.
        light
            The name of the light.
        calibration_extent
            The extent of the calibration: ``full``, ``some`` or ``few`` (``CostInputs``).
        """
        if self.cost.calibration_settings is not None:
            yield from self.cost.calibration_settings(descriptor, light, calibration_extent)
        else:
            yield self.resolve_settings(SettingsRequest(descriptor, light, Shadows()))[0]

    @property
    def error_groups(self) -> tuple[str, ...]:
        """The names under which the errors of the algorithm are fitted."""
        return self.accuracy.error_groups or (self.name,)

    def error_group(self, descriptor: Descriptor) -> str:
        """Return the name under which the errors in a view are fitted."""
        return self.name if self.accuracy.error_group_of is None else self.accuracy.error_group_of(descriptor)

    def clear_caches(self) -> None:
        """Clear the caches that the algorithm fills."""
        for cache in caches():
            if cache.name in self.cache_names:
                cache.clear()
