"""The rules of the policy ``rules``, in order of precedence: an algorithm, the condition, and the source.

Most rules are the advice of a thesis: J. Sindholt, A comparison of Shadow Algorithms, DTU 2005, section 8.2 and table 1. The other
rules cover cases outside of the thesis: maps without perspective, and heightfields, which the line sweep can draw.
``docs/reports/seeds.md`` compares the advice with measurements of this engine. Each threshold has a note on its source. A
perspective shadow map is the method of Stamminger and Drettakis 2002, "Perspective shadow maps".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from skugga.shadows.bent_rays import sunlit_ground_extent_m
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Band, CastBand, CasterFacts, LampFacts, LightFacts
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import SUN, CasterKind, Shadows

TYPICAL_MAP_ERROR = 0.006
"""Mean share of wrong cast shadow of perspective shadow maps in the thesis's five scenes.

Uniform shadow maps have four times this error (``docs/reports/seeds.md``, the grades). Neither can meet a smaller limit of the
error.
"""

MAX_VOLUME_TRIANGLES = 2000
"""Maximum number of triangles of casters for which shadow volumes count as fast.

In the thesis's scene of a street, with 400 triangles, shadow volumes are fastest. In its other scenes, with 12,000 and more, they
take 1.7 to 4 times as long as a shadow map (``docs/reports/seeds.md``, the advice). The limit is the geometric mean.
"""

MIN_CLOSED_SHARE = 0.5
"""Minimum share of the triangles that belong to closed meshes, for shadow volumes to count as fast.

Each open edge of a mesh is a silhouette. So open meshes with few triangles still have many faces of shadow volumes.
"""

REFERENCE_MAP_TEXELS = 1024
"""Texels per side of the shadow map to which the thesis's advice refers."""

MAX_SHARP_TEXEL_PX = 2.0
"""If a texel covers at most this many pixels, 95 % of the edges are off by at most one pixel (``docs/reports/seeds.md``)."""

MIN_COARSE_TEXEL_PX = 4.0
"""Pixels per texel above which the camera counts as near to a shadow edge: some edges are off by more than two pixels.

See figure 52 in ``docs/reports/seeds.md``. In the thesis's scenes a texel covers 1.4 to 3 pixels in overviews, and 6 to 30 pixels
from a near camera.
"""

MAX_LAMP_DISTANCE_SHARE = 0.25
"""Maximum distance of a lamp from the eye that counts as near, as a share of the distance of the nearest shadow edge.

All shadow edges are then equally far from the lamp and from the eye to within a quarter. So the shadow map's texels are as even in
the picture as its pixels. The sun is never near: behind the camera it is the worst case for maps.
"""

MIN_COMPLEX_LAYERS = 7.0
"""Minimum mean number of faces of shadow volumes in front of a pixel for shadows that count as complex.

In the thesis's scenes, the box grid, the water tower and the room have 9 to 65, the stone circles and the street 1 to 5. The thesis
grades the scenes' complexity accordingly (section 7).
"""

MAP_SETTINGS = tuple(key for key in Shadows.model_fields if key in ShadowMapSettings.model_fields)
"""Shadow settings of shadow maps. Other algorithms have none of them, except for the filters ``1`` and ``sun``."""

MAX_VISIBLE_LIT_SHARE = 1.0 / 3.0
"""Maximum share of the lit area that a camera sees, for which a perspective shadow map is preferred.

In the thesis's scene of stone circles under the sun the share is 30 %. There a perspective shadow map has half the error of a
uniform one, in the same time (``docs/reports/seeds.md``, the advice).
"""

MIN_TEXEL_GAIN = 4.0
"""Minimum factor by which a perspective shadow map reduces texels near the eye, for it to be preferred to a uniform one."""


@dataclass(frozen=True)
class RuleInput:
    """Input of a rule: a kind of casters under a light in a view, and the requested shadow settings.

    Attributes
    ----------
    descriptor
        Facts of the view.
    light
        Name of the light.
    kind
        Kind of casters.
    requested_shadows
        Requested shadow settings.
    """

    descriptor: Descriptor
    light: str
    kind: CasterKind
    requested_shadows: Shadows

    @property
    def lamp(self) -> LampFacts | None:
        """The lamp of the light; ``None`` for the sun."""
        return next((lamp for lamp in self.descriptor.lamps if lamp.name == self.light), None)

    @property
    def light_facts(self) -> LightFacts | None:
        """Facts of the light in the view, or ``None``."""
        return self.descriptor.lights.get(self.light)

    @property
    def caster_facts(self) -> CasterFacts | None:
        """Facts of the casters, or ``None``."""
        return next((stand for stand in self.descriptor.stands if stand.kind == self.kind), None)


@dataclass(frozen=True)
class Rule:
    """A rule of the policy ``rules``.

    Attributes
    ----------
    name
        Name of the rule.
    algorithm
        The algorithm that the rule recommends.
    reason_for
        Function that returns the reason for the algorithm; ``None`` if the rule does not apply, or if facts are unknown.
    source
        Publication or document from which the rule comes.
    """

    name: str
    algorithm: AlgorithmName
    reason_for: Callable[[RuleInput], str | None]
    source: str


def _needs_map_settings_reason(case: RuleInput) -> str | None:
    """Return the reason for a shadow map: the request sets settings that only shadow maps have. ``None`` if it sets none."""
    taps = (1, "sun") if case.light == SUN and case.kind == "relief" else (1,)
    unforced_values = {"filter": ("auto", *taps)}
    keys = [key for key in MAP_SETTINGS if getattr(case.requested_shadows, key) not in unforced_values.get(key, ("auto",))]
    if not keys:
        return None
    return (
        f"settings that only shadow maps have are set: {', '.join(f'{key} {getattr(case.requested_shadows, key)}' for key in keys)}"
    )


def _heightfield_reason(case: RuleInput) -> str | None:
    """Return the reason for the sweep: the casters are relief, a heightfield, under the sun. ``None`` for others."""
    if case.light != SUN or case.kind != "relief" or sunlit_ground_extent_m(case.descriptor) is None:
        return None
    return "relief is a heightfield, so a line sweep along the sun's azimuth finds its shadows without texels"


def _needs_exact_shadows_reason(case: RuleInput) -> str | None:
    """Return the reason for shadow volumes: the limit of the error is too small for shadow maps, without a limit of the time.

    It is ``None`` for a larger limit of the error, or with a limit of the time.
    """
    if case.requested_shadows.max_error >= TYPICAL_MAP_ERROR or case.requested_shadows.max_ms is not None:
        return None  # rules know no upper bound of the time of volumes
    return (
        f"max_error {case.requested_shadows.max_error:.2g} is too small for most shadow maps: shadow volumes are exact to the pixel"
    )


def _reason_for_foliage_map(case: RuleInput) -> str | None:
    """Return the reason for a shadow map: the casters are trees, or other casters in a view with trees.

    It is ``None`` in a view without trees.
    """
    if case.kind == "forest":
        return "alpha-tested foliage needs a shadow map; a perspective shadow map has no finer texels on trees"
    if "forest" in case.descriptor.casters:
        return "the shadow map for the foliage draws the other casters at little extra cost"
    return None


def _few_polygons_reason(case: RuleInput) -> str | None:
    """Return the reason for shadow volumes: the casters have few triangles, most of them in closed meshes. ``None`` otherwise."""
    casters = case.caster_facts
    if casters is None or not 0 < casters.triangles <= MAX_VOLUME_TRIANGLES or casters.closed_share < MIN_CLOSED_SHARE:
        return None
    return f"few polygons ({casters.triangles} triangles): shadow volumes are fast, and exact to the pixel"


def _narrow_light_cone_reason(case: RuleInput) -> str | None:
    """Return the reason for a shadow map: the light is a spot whose cone is so narrow that texels are small. ``None`` otherwise."""
    if case.lamp is None or case.lamp.kind != "spot":
        return None
    across_m = 2.0 * case.lamp.reference_m * float(np.tan(np.radians(case.lamp.cutoff_deg)))
    texel_px = across_m / REFERENCE_MAP_TEXELS / case.descriptor.pixel_m
    if texel_px > MAX_SHARP_TEXEL_PX:
        return None
    return f"narrow light cone: a texel of the shadow map covers {texel_px:.2g} pixels at the lamp's target"


def _lamp_near_camera_reason(case: RuleInput) -> str | None:
    """Return the reason for a shadow map: the lamp is so near to the eye that all texels look equally large. ``None`` otherwise."""
    light_facts = case.light_facts
    if light_facts is None or light_facts.eye_to_lamp_m is None or light_facts.nearest_edge_m is None:
        return None
    if light_facts.eye_to_lamp_m > MAX_LAMP_DISTANCE_SHARE * light_facts.nearest_edge_m:
        return None
    return (
        f"lamp near the camera: {light_facts.eye_to_lamp_m:.1f} m from the eye, where the nearest shadow edge is "
        f"{light_facts.nearest_edge_m:.1f} m away, so all texels are about equally large in the picture"
    )


def _map_view_reason(case: RuleInput) -> str | None:
    """Return the reason for a shadow map: the view is a map, without perspective. ``None`` for a perspective view."""
    return "map view: all shadow edges are equally far away" if case.descriptor.view_kind == "map" else None


def _far_edges_reason(case: RuleInput) -> str | None:
    """Return the reason for a shadow map: even the nearest shadow edge is so far away that texels look small.

    It is ``None`` otherwise, and in a map view.
    """
    texel_px = _near_texel_px(case)
    if texel_px is None or texel_px > MIN_COARSE_TEXEL_PX:
        return None
    return f"camera far from shadow edges: a texel of the shadow map covers {texel_px:.2g} pixels at the nearest edge"


def _complex_near_shadows_reason(case: RuleInput) -> str | None:
    """Return the reason for ``hybrid``: shadow volumes overlap in many layers, and a shadow edge is near the eye.

    It is ``None`` otherwise, and in a map view.
    """
    texel_px = _near_texel_px(case)
    if (
        texel_px is None
        or texel_px <= MIN_COARSE_TEXEL_PX
        or case.light_facts is None
        or case.light_facts.volume_layers < MIN_COMPLEX_LAYERS
    ):
        return None
    return (
        f"complex shadows (about {case.light_facts.volume_layers:.2g} volume faces per pixel) and a near camera: "
        f"a texel of the shadow map covers {texel_px:.2g} pixels at the nearest edge"
    )


def _small_visible_lit_area_reason(case: RuleInput) -> str | None:
    """Return the reason for a perspective shadow map: the camera sees a small part of the lit area. ``None`` otherwise."""
    light_facts = case.light_facts
    if case.descriptor.camera_moves:
        return None  # its texels follow the camera, so edges would crawl
    if light_facts is None or light_facts.area_share > MAX_VISIBLE_LIT_SHARE:
        return None
    bands = _visible_bands(case)
    if not bands:
        return None
    # A perspective shadow map moves the camera back until all casters lie before it. In post-perspective space, points at infinity
    # then have depth m. The far distance is m / (m - 1) times the near one. No texel gets smaller by more than this factor.
    near_m, far_m = bands[0].near_m, bands[-1].far_m
    if far_m is None or near_m <= 0.0 or far_m / near_m < MIN_TEXEL_GAIN:
        return None
    return f"the camera sees {100.0 * light_facts.area_share:.1f} % of the lit area: a perspective shadow map puts its texels there"


def _visible_bands(case: RuleInput) -> Sequence[Band | CastBand]:
    """Return the bands of distances from the eye that hold visible surfaces, nearest first; none in a map view.

    Under a lamp they are the bands of the visible surfaces in its light, since the descriptor's bands are bounds under the sun.
    """
    if case.lamp is None:
        return case.descriptor.bands
    casting = case.light_facts.casts.get(case.kind) if case.light_facts else None
    return () if casting is None or case.descriptor.view_kind == "map" else casting.bands


def _near_texel_px(case: RuleInput) -> float | None:
    """Return the pixels that a shadow-map texel's side covers at the nearest shadow edge of a perspective view.

    The map has ``REFERENCE_MAP_TEXELS`` texels per side. The result is ``None`` in a map view, or if facts are unknown.
    """
    descriptor, light_facts, lamp = case.descriptor, case.light_facts, case.lamp
    if descriptor.pixel is None or light_facts is None or light_facts.nearest_edge_m is None:
        return None
    if lamp is not None:
        half_deg = lamp.cutoff_deg if lamp.kind == "spot" else 45.0
        across_m = 2.0 * lamp.reference_m * float(np.tan(np.radians(half_deg)))
    elif descriptor.receivers_light_m is not None:
        across_m = max(descriptor.receivers_light_m[:2])
    else:
        return None
    return across_m / REFERENCE_MAP_TEXELS / (descriptor.pixel * max(light_facts.nearest_edge_m, 1e-3))


THESIS_SECTION = "Sindholt 2005, 8.2"
"""Source of the rules that come from the thesis's section of advice."""

RULES: tuple[Rule, ...] = (
    Rule("settings of a map", "shadow_map", _needs_map_settings_reason, "docs/algorithms.md"),
    Rule(
        "a heightfield is swept",
        "sweep",
        _heightfield_reason,
        "docs/reports/sweep-accuracy.md: 0.01 % wrong in maps",
    ),
    Rule(
        "perfect shadows",
        "shadow_volume",
        _needs_exact_shadows_reason,
        f"{THESIS_SECTION}; docs/reports/seeds.md: 0.01 % wrong at most",
    ),
    Rule("foliage needs a map", "shadow_map", _reason_for_foliage_map, "Sindholt 2005, table 1; docs/reports/seeds.md, the advice"),
    Rule(
        "few polygons",
        "shadow_volume",
        _few_polygons_reason,
        f"{THESIS_SECTION}; docs/reports/seeds.md: 0.9 to 1.3 times the time of a map there",
    ),
    Rule("narrow light", "shadow_map", _narrow_light_cone_reason, f"{THESIS_SECTION}; docs/reports/seeds.md, figures 52 and 53"),
    Rule(
        "lamp near the camera",
        "shadow_map",
        _lamp_near_camera_reason,
        f"{THESIS_SECTION}; docs/reports/seeds.md, figure 54: edges are off by half a pixel in the mean",
    ),
    Rule("map view", "shadow_map", _map_view_reason, "docs/how-it-works.md: a map view has no perspective"),
    Rule(
        "far from every edge",
        "shadow_map",
        _far_edges_reason,
        f"{THESIS_SECTION}; docs/reports/seeds.md: no larger errors from afar",
    ),
    Rule(
        "complex shadows from near",
        "hybrid",
        _complex_near_shadows_reason,
        f"{THESIS_SECTION}; docs/reports/seeds.md: faster than volumes in some scenes",
    ),
    Rule(
        "small part of the lit area seen",
        "perspective_shadow_map",
        _small_visible_lit_area_reason,
        f"{THESIS_SECTION}; docs/reports/seeds.md: half the errors of a map",
    ),
)
"""The rules in order of precedence: the first one that applies decides, for each light and kind of casters."""
