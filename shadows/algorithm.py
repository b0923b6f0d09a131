"""The record that declares a shadow algorithm.

The module of an algorithm ends in one ``Algorithm`` record. ``skugga.shadows.registry`` lists the records. The planner, the
portfolio, the cost and error models, the calibration and the report read them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from skugga.shadows.algorithm_settings import AlgorithmSettings, Overrides, ResolvedSettings, SettingsRequest
from skugga.shadows.passes import PassLayer
from skugga.shadows.requirements import Requirement
from skugga.shadows.work import Work, Workload
from skugga.terrain.cache import caches
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import CastBand, Casting
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.level.level import CasterKind, Shadows
from skugga.terrain.scene import Scene

MAP_SIZES_FOR_OTHER_CASTERS = (1024, 2048, 4096)
"""Sizes, in texels a side, of shadow maps that are tried where an algorithm without maps serves the other kinds of casters.

A short list limits the number of candidates.
"""


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
        number of a perspective shadow map's texels per pixel. ``None``: the algorithm has no texels.
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


MarkerColour = Literal["blue", "vermilion", "green", "purple", "orange", "sky", "gray", "black", "brown"]
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

    shape: Literal["circle", "square", "triangle", "diamond", "wedge", "pentagon", "hexagon", "star", "cross"]
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
        Whether the selector may choose it and a request over HTTP may name it; False for references.
    needs_opengl
        Whether it draws with OpenGL.
    needs_view_pixels
        Whether it finds the visibility at pixels of the view only, not at any point: it counts in the stencil.
    settings_types
        The types of its settings.
    resolve_settings
        Function that resolves its settings. It raises ``UnsupportedError`` for a request that the algorithm cannot serve.
    cache_names
        The names of the caches (``skugga.terrain.cache``) that it fills. Each cache has the lifetime of its values.
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
    needs_view_pixels: bool = False
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
        """Return the work of one step (one call of the algorithm), as counts by part of the work.

        Parameters
        ----------
        workload
            The descriptor's quantities for a light and some kinds of casters.
        settings
            The resolved settings; ``None`` if the algorithm has none.
        """
        if self.cost.work is not None:
            return self.cost.work(workload, settings)
        return (
            {self.name: {"blocks": 1.0, "pixels": workload.pixel_count, "triangles": workload.all_triangle_count}}
            if self.passes
            else {}
        )

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
