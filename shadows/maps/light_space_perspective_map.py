"""`light_space_perspective_map`: a depth map that is warped in the light's own space, fine near the eye and coarse far away.

The method is that of Wimmer, Scherzer and Purgathofer 2004, "Light space perspective shadow maps".
``skugga.shadows.maps.light_space_perspective`` computes the map's matrix. Fitting, drawing, look-ups, taps and the division into
ranges of distance are those of ``perspective_shadow_map``. Policies do not search it: with that algorithm's constants of errors
and times, probes of Rocks, Room and Water Tower take a third more time, since the two are hard to tell apart.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from skugga.shadows.algorithm import AccuracyInputs, CostInputs, PlotMarker, SettingsSearch
from skugga.shadows.maps import perspective_shadow_map
from skugga.shadows.maps.light_space_perspective import light_space_perspectives
from skugga.shadows.maps.resolve import resolve_perspective_map
from skugga.shadows.maps.texels import perspective_map_texel_px
from skugga.shadows.maps.work import perspective_map_work

NAME = "light_space_perspective_map"

ALGORITHM = replace(
    perspective_shadow_map.ALGORITHM,
    name=NAME,
    description="depth map warped in the light's space: fine near the eye",
    plural_name="light-space perspective maps",
    resolve_settings=partial(resolve_perspective_map, has_slide_back=False),
    fill_visibility=partial(perspective_shadow_map.fill_visibility, find_candidates=light_space_perspectives),
    search=SettingsSearch(
        is_excluded=lambda descriptor, kind: True,
        exclusion_reason="policies try perspective_shadow_map instead, whose errors and times are near its own",
    ),
    cost=CostInputs(
        partial(perspective_map_work, algorithm=NAME), calibration_settings=perspective_shadow_map.calibration_settings
    ),
    accuracy=AccuracyInputs(
        texel_px=perspective_map_texel_px,
        texel_m=partial(perspective_shadow_map.texel_on_ground_m, find_candidates=light_space_perspectives),
    ),
    marker=PlotMarker("hexagon", "black"),
)
