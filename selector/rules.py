"""The `rules` policy: a plan from readable rules over the descriptor, without a device."""

from __future__ import annotations

from typing import Any

import numpy as np

from shadows.plan import Plan, Reasoned, ShadowMapSettings, Target, TruthSettings
from shadows.registry import ALGORITHMS
from shadows.render import CASTERS_PASS, GEOMETRY_PASS, SHADING_PASS
from shadows.shadow_map import BORDER_TEXELS
from terrain.descriptor import Descriptor
from terrain.effects import EFFECTS
from terrain.errors import UnsupportedError
from terrain.level import Choice, Level, Shadows, algorithm_choice, override

TEXEL_PX = 0.4
"""A texel's footprint on level ground, in pixels, that an automatic map size keeps to (between 512 and 4096 texels)."""

DEPTH_PX = 0.25
"""How far a depth step may shift a shadow on level ground, in pixels, before an automatic depth takes more bits."""


def choose(descriptor: Descriptor, level: Level, overrides: dict[str, Any] | None = None) -> Plan:
    """The plan of a view. ``overrides`` (algorithm, map_size, depth_bits, filter) go before what the level says.

    Raises ``InputError`` for an override that is wrong and ``UnsupportedError`` for one that cannot be served.
    """
    overrides = overrides or {}
    asked = override(level.shadows, overrides)
    reasons: list[Reasoned] = []
    effects, left_out = [], []
    for effect in EFFECTS.values():
        verdict = effect.called_for(descriptor)
        wish = "auto" if level.effects == "auto" else level.effects.get(effect.name, "auto")
        runs, reason = verdict.called_for, verdict.reason
        if wish != "auto":
            runs, reason = wish == "on", f"forced {wish} by the level ({verdict.reason})"
        (effects if runs else left_out).append(Reasoned(name=effect.name, reason=reason))
    choice: Choice = algorithm_choice(asked.algorithm)
    who = "the level" if overrides.get("algorithm") is None else "the request"
    rejected: list[Reasoned] = []
    name, reason = _algorithm(descriptor, choice, who, effects, left_out, rejected)
    reasons.append(Reasoned(name=name, reason=reason))
    settings = {}
    if name == "shadow_map":
        resolved, why = _shadow_map_settings(descriptor, asked)
        settings = {"sun": {"relief": resolved}}
        reasons += why
    elif name == "truth":
        settings = {"sun": {"relief": TruthSettings()}}
    return Plan(
        view=descriptor.view, policy="rules", algorithm={"sun": {"relief": name}}, settings=settings,
        effects=effects, left_out=left_out, rejected=rejected,
        passes=[GEOMETRY_PASS, CASTERS_PASS, *ALGORITHMS[name].passes, SHADING_PASS],
        target=Target(max_error=asked.max_error, max_ms=asked.max_ms), reasons=reasons,
    )  # fmt: skip


def _algorithm(descriptor, choice, who, effects, left_out, rejected):  # type: ignore[no-untyped-def]
    """The algorithm for the relief under the sun and the reason; adds to ``rejected``."""
    called = {effect.name: effect.reason for effect in effects}
    missing = {effect.name: effect.reason for effect in left_out}
    wish = choice.get("sun", {}).get("relief")
    if "cast_shadows" in missing:
        for name in ALGORITHMS:
            if name != "none":
                rejected.append(Reasoned(name=name, reason=missing["cast_shadows"]))
        return "none", missing["cast_shadows"]
    if wish is not None:
        able = ALGORITHMS[wish]
        if descriptor.view_kind not in able.views:
            raise UnsupportedError("algorithm", wish, f"{able.about}: not for {descriptor.view_kind} views")
        for name in ALGORITHMS:
            if name != wish:
                rejected.append(Reasoned(name=name, reason=f"{who} asks for {wish}"))
        return wish, f"asked for by {who}"
    rejected.append(Reasoned(name="truth", reason=ALGORITHMS["truth"].about))
    rejected.append(Reasoned(name="none", reason=called["cast_shadows"]))
    return "shadow_map", "the algorithm at hand for relief under the sun in a map view"


def _shadow_map_settings(descriptor: Descriptor, asked: Shadows) -> tuple[ShadowMapSettings, list[Reasoned]]:
    assert descriptor.receivers_light_m is not None and descriptor.sun_altitude_deg is not None
    right, up, along = descriptor.receivers_light_m
    altitude = np.radians(max(descriptor.sun_altitude_deg, 0.5))
    footprint_px = np.array([right, up / np.sin(altitude)]) / descriptor.pixel_m
    reasons = []
    size, bits, taps = asked.map_size, asked.depth_bits, asked.filter
    if size == "auto":
        wanted = float(footprint_px.max()) / TEXEL_PX + 2 * BORDER_TEXELS
        size = int(np.clip(2 ** np.ceil(np.log2(wanted)), 512, 4096))
        reasons.append(Reasoned(
            name=f"map_size {size}",
            reason=f"a texel covers {footprint_px.max() / (size - 2 * BORDER_TEXELS):.2f} pixels of level ground"
            + (f", above the {TEXEL_PX} wished for: the largest automatic size" if wanted > 4096 else ""),
        ))  # fmt: skip
    texel = right / (size - 2 * BORDER_TEXELS), up / (size - 2 * BORDER_TEXELS)
    range_m = along * 1.1 + 3 * BORDER_TEXELS * max(texel)
    shift_px = range_m / (2**16 - 1) * np.cos(altitude) / descriptor.pixel_m
    if bits == "auto":
        bits = 16 if shift_px <= DEPTH_PX else 24
        verdict = "at most" if bits == 16 else "more than"
        reasons.append(Reasoned(
            name=f"depth_bits {bits}",
            reason=f"a 16-bit step of {range_m / (2**16 - 1):.3g} m shifts a shadow by {shift_px:.2g} pixels, "
            f"{verdict} {DEPTH_PX}",
        ))  # fmt: skip
    if taps == "auto":
        taps = 3
        reasons.append(Reasoned(name="filter 3", reason="nine taps smooth the stairs of texels along shadow edges"))
    steps = 2**16 - 1 if bits == 16 else 2**24 - 1
    return ShadowMapSettings(
        map_size=size, depth_bits=bits, filter=taps, texel_m=texel, depth_step_m=float(range_m / steps)
    ), reasons
