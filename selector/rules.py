"""The `rules` policy: a plan from readable rules over the descriptor, without a device."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic_core import PydanticCustomError

from shadows.passes import PassLog
from shadows.plan import LampMapSettings, Plan, Reasoned, Settings, ShadowMapSettings, Target, TruthSettings
from shadows.registry import ALGORITHMS, LightKind, ViewKind
from shadows.render import CASTERS_PASS, GEOMETRY_PASS, SHADING_PASS
from shadows.shadow_map import BORDER_TEXELS
from terrain.descriptor import Descriptor, LampFacts
from terrain.effects import EFFECTS
from terrain.effects.cast_shadows import of_sun
from terrain.errors import InputError, UnsupportedError
from terrain.level import SUN, AlgorithmName, CasterKind, Choice, Level, Shadows, algorithm_choice, override

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
    effects, left_out = [], []
    for effect in EFFECTS.values():
        verdict = effect.called_for(descriptor)
        wish = "auto" if level.effects == "auto" else level.effects.get(effect.name, "auto")
        runs, reason = verdict.called_for, verdict.reason
        if wish != "auto":
            runs, reason = wish == "on", f"forced {wish} by the level ({verdict.reason})"
        (effects if runs else left_out).append(Reasoned(name=effect.name, reason=reason))
    try:
        choice = algorithm_choice(asked.algorithm, level.light_names)
    except PydanticCustomError as error:
        raise InputError("algorithm", overrides.get("algorithm"), error.message()) from None
    who = "the level" if overrides.get("algorithm") is None else "the request"
    algorithm: dict[str, dict[CasterKind, AlgorithmName]] = {}
    settings: dict[str, dict[CasterKind, Settings]] = {}
    reasons: list[Reasoned] = []
    kinds_of = {SUN: "sun"} if descriptor.highest_sun_deg is not None or not descriptor.lamps else {}
    kinds_of |= {lamp.name: lamp.kind for lamp in descriptor.lamps}
    casting = any(effect.name == "cast_shadows" for effect in effects)
    missing = next((effect.reason for effect in left_out if effect.name == "cast_shadows"), "")
    for light, kind_of_light in kinds_of.items():
        for caster in descriptor.casters:
            wish = choice.get(light, {}).get(caster)
            name, reason = _algorithm(descriptor, light, caster, wish, who, missing if not casting else None)
            _check(name, kind_of_light, caster, descriptor.view_kind)
            algorithm.setdefault(light, {})[caster] = name
            reasons.append(Reasoned(name=f"{light}/{caster}: {name}", reason=reason))
    for light, per_kind in algorithm.items():
        resolved: dict[str, Settings] = {}
        for caster, name in per_kind.items():
            if name not in resolved and name != "none":
                resolved[name], why = _settings(name, descriptor, light, asked)
                reasons += why
            if name in resolved:
                settings.setdefault(light, {})[caster] = resolved[name]
    used = {name for per_kind in algorithm.values() for name in per_kind.values()}
    plan = Plan(
        view=descriptor.view, policy="rules", algorithm=algorithm, settings=settings, effects=effects, left_out=left_out,
        rejected=[Reasoned(name=name, reason=_rejected(name, used, missing, who, choice)) for name in ALGORITHMS if name not in used],
        passes=[], target=Target(max_error=asked.max_error, max_ms=asked.max_ms), reasons=reasons,
    )  # fmt: skip
    passes = [name for step in plan.steps for name in PassLog.named(step.light, step.kinds, ALGORITHMS[step.algorithm].passes)]
    return plan.model_copy(update={"passes": [GEOMETRY_PASS, CASTERS_PASS, *passes, SHADING_PASS]})


def _algorithm(
    descriptor: Descriptor, light: str, caster: CasterKind, wish: AlgorithmName | None, who: str, missing: str | None
) -> tuple[AlgorithmName, str]:
    """The algorithm of a light for a kind of casters, and the reason."""
    if missing is not None:
        return "none", missing
    if light == SUN and not of_sun(descriptor).called_for and descriptor.lamps:
        return "none", of_sun(descriptor).reason
    if wish is not None:
        return wish, f"asked for by {who}"
    if caster == "relief" and descriptor.relief_m <= 0.0:
        return "none", "level ground cannot cast"
    return "shadow_map", f"the algorithm at hand for {caster} under {'the sun' if light == SUN else light}"


def _check(name: AlgorithmName, light: LightKind, caster: CasterKind, view: ViewKind) -> None:
    able = ALGORITHMS[name]
    for wanted, served, what in ((view, able.views, "views"), (light, able.lights, "lights"), (caster, able.casters, "casters")):
        if wanted not in served:
            raise UnsupportedError("algorithm", name, f"{able.about}: it serves {what} of the kinds {', '.join(sorted(served))}")


def _rejected(name: AlgorithmName, used: set[AlgorithmName], missing: str, who: str, choice: Choice) -> str:
    if missing:
        return missing
    if choice:
        return f"{who} asks for {', '.join(sorted(used))}"
    return "there are casters and light" if name == "none" else ALGORITHMS[name].about


def _settings(name: AlgorithmName, descriptor: Descriptor, light: str, asked: Shadows) -> tuple[Settings, list[Reasoned]]:
    if name == "truth":
        return TruthSettings(), []
    if light == SUN:
        return _shadow_map_settings(descriptor, asked)
    return _lamp_map_settings(descriptor, next(lamp for lamp in descriptor.lamps if lamp.name == light), asked)


def _lamp_map_settings(descriptor: Descriptor, lamp: LampFacts, asked: Shadows) -> tuple[LampMapSettings, list[Reasoned]]:
    """A texel at the distance that the lamp is meant for keeps to ``TEXEL_PX``."""
    across_m = 2.0 * lamp.reference_m * np.tan(np.radians(min(lamp.cutoff_deg, 45.0 if lamp.kind == "omni" else 85.0)))
    size, reasons = asked.map_size, []
    if size == "auto":
        wanted = across_m / descriptor.pixel_m / TEXEL_PX + 2 * BORDER_TEXELS
        size = int(np.clip(2 ** np.ceil(np.log2(wanted)), 512, 2048 if lamp.kind == "omni" else 4096))
        texel_px = across_m / (size - 2 * BORDER_TEXELS) / descriptor.pixel_m
        reasons.append(
            Reasoned(name=f"{lamp.name}: map_size {size}", reason=f"a texel covers {texel_px:.2g} pixels where it is aimed")
        )
    bits = 32 if asked.depth_bits == "auto" else asked.depth_bits
    if asked.depth_bits == "auto":
        why = "a perspective map's steps grow with the square of the distance: even ones need float"
        reasons.append(Reasoned(name=f"{lamp.name}: depth_bits 32", reason=why))
    taps = 3 if asked.filter == "auto" else asked.filter
    return LampMapSettings(map_size=size, depth_bits=bits, filter=taps), reasons


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
