"""Text of a plan: the choice for each light with reasons, the expected cost, and the rejected alternatives."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Iterator

from skugga.api.picture_cost import SLOW_PICTURE_MS, cost_remedy, is_over_limit, time_limit_ms
from skugga.selector.formatting import format_duration, format_list, format_percent, format_wrong_share
from skugga.selector.planner.planner import SETTING_NAMES
from skugga.selector.predict import TARGET_MISSED
from skugga.shadows.algorithm_settings import AlgorithmSettings, NamedReason
from skugga.shadows.plan import Plan, Step, Target
from skugga.shadows.registry import ALGORITHMS, NO_SHADOWS
from skugga.terrain.effects import EFFECTS
from skugga.terrain.geo.sun import Sun
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

LINE_WIDTH = 100
"""Maximum characters of a line."""

POLICY_PHRASES = {"rules": "by the rules", "predict": "by prediction", "probe": "by a probe", "measure": "by measuring"}

COMPASS_POINTS = (
    "north", "north-north-east", "north-east", "east-north-east", "east", "east-south-east", "south-east", "south-south-east",
    "south", "south-south-west", "south-west", "west-south-west", "west", "west-north-west", "north-west", "north-north-west",
)  # fmt: skip

ALWAYS_LISTED_SETTINGS = ("cascades", "map_size", "depth_bits", "filter")
"""Settings that are listed even without a reason."""

SETTING_ORDER = (*ALWAYS_LISTED_SETTINGS, *(key for key in SETTING_NAMES if key not in ALWAYS_LISTED_SETTINGS))

_SNAKE_CASE_WORD = re.compile(r"\b[a-z]+(?:_[a-z]+)+\b")

CHOSEN_REASON = "as chosen"
"""Reason of a setting that follows from the choice of the algorithm, whose reason is listed already."""


def format_heading(scene: Scene, plan: Plan) -> str:
    """Return the heading of a plan: level, view, sun and policy."""
    title = scene.loaded.level.title or scene.loaded.name
    return f"{title}. {format_view_and_sun(scene, plan)}; chosen {POLICY_PHRASES[plan.policy]}."


def format_view_and_sun(scene: Scene, plan: Plan) -> str:
    """Return the view and the sun of a plan as text."""
    return f"View {plan.view}, {format_sun(scene.sun)}"


def format_sun(sun: Sun | None) -> str:
    """Return the position of a sun as text, such as ``the sun 12 degrees high in the west-south-west``."""
    if sun is None:
        return "without a sun"
    compass_point = COMPASS_POINTS[round(sun.azimuth_deg / 22.5) % 16]
    if sun.altitude_deg < 0.0:
        return f"the sun {_format_degrees(-sun.altitude_deg)} degrees below the horizon in the {compass_point}"
    return f"the sun {_format_degrees(sun.altitude_deg)} degrees high in the {compass_point}"


def format_plan(plan: Plan, title: str) -> str:
    """Return a plan as text for a terminal: sentences under headings, in lines of at most ``LINE_WIDTH`` characters."""
    plan = _with_display_names(plan)
    reason_list = _ReasonList(plan)
    parts = [[title, *reason_list.take_notes("policy")], *(reason_list.light_lines(light) for light in plan.algorithm)]
    if not plan.algorithm:
        parts.append(["Nothing here casts a shadow."])
    reason_list.take_notes("missed")  # dropped: the expectation has them
    parts += [[format_expectation(plan)], reason_list.take_remaining()]
    parts += [
        _reason_section("Effects that run", plan.effects),
        _reason_section("Effects left out", plan.left_out),
        _reason_section("Rejected algorithms", _rejected_algorithms(plan)),
    ]
    return "\n\n".join("\n".join(_wrapped(line) for line in part) for part in parts if part)


def format_choices(plan: Plan) -> list[str]:
    """Return a sentence for each light and caster kind with shadows: the algorithm and its reason."""
    reasons = {entry.name: entry.reason for entry in _with_display_names(plan).reasons}
    return [
        f"{_capitalized(kind)}{'' if light == SUN else f' under {light}'} by {display_name(name)}: "
        f"{reasons[f'{light}/{kind}: {name}']}."
        for light, kinds in plan.algorithm.items()
        for kind, name in kinds.items()
        if name != NO_SHADOWS and f"{light}/{kind}: {name}" in reasons
    ]


def format_expectation(plan: Plan) -> str:
    """Return sentences on a plan's expected time and error, on its target, and on its time while nothing moves."""
    return " ".join(filter(None, [_expectation_sentences(plan), _at_rest_sentence(plan)]))


def _at_rest_sentence(plan: Plan) -> str:
    """Return a sentence on the expected time of a frame in which nothing has moved; empty where it is not shorter or not known."""
    if plan.predicted is None or plan.predicted.ms_at_rest is None:
        return ""
    at_rest = format_duration(plan.predicted.ms_at_rest)
    if plan.predicted.ms_at_rest >= plan.predicted.ms or at_rest == format_duration(plan.predicted.ms):
        return ""
    return f"While nothing moves: {at_rest} a frame, since caches hold maps and volumes."


def _expectation_sentences(plan: Plan) -> str:
    """Return one or two sentences on a plan's expected time and error, and on its target."""
    target = format_target(plan.target)
    if plan.predicted is None:
        return f"Time and error are not predicted. Asked for: {target}."
    verb = {"measure": "Measured", "probe": "By the probe"}[plan.policy] if plan.predicted.is_measured else "Expected"
    text = (
        f"{verb}: {format_duration(plan.predicted.ms)} of shadow work, "
        f"{format_wrong_share(plan.predicted.wrong_cast, plan.predicted.is_coverage)}."
    )
    if plan.predicted.ms > SLOW_PICTURE_MS and (cheaper := cost_remedy(plan)) is not None:
        text = f"{text} For less time, {cheaper}."
    if is_over_limit(plan, limit_ms := time_limit_ms()):
        limit = f"A service gives up pictures after {format_duration(limit_ms)} (SKUGGA_RENDER_TIMEOUT_S): it refuses this one."
        return f"{text} {limit} Asked for: {target}."
    if plan.target.met is None:
        return f"{text} Asked for: {target}."
    if plan.target.met:
        return f"{text} That meets the target: {target}."
    return f"{text} That misses the target ({target}) by {format_overshoot(plan)}; nothing comes nearer."


def format_target(target: Target) -> str:
    """Return a target as text: ``at most 3 % of the cast shadow wrong, within 40 ms``."""
    error = f"at most {100.0 * target.max_error:.3g} % of the cast shadow wrong"
    return error if target.max_ms is None else f"{error}, within {format_duration(target.max_ms)}"


def display_name(name: str) -> str:
    """Return the display name of an algorithm or an effect, without underscores."""
    return "no shadows" if name == NO_SHADOWS else name.replace("_", " ")


def format_overshoot(plan: Plan) -> str:
    """Return the amount by which a plan misses its target, such as ``2.1 % of the cast shadow and 15 ms``."""
    assert plan.predicted is not None
    over = []
    if (error := plan.predicted.wrong_cast - plan.target.max_error) > 0.0:
        over.append(f"{format_percent(error)} of {'coverage' if plan.predicted.is_coverage else 'the cast shadow'}")
    if plan.target.max_ms is not None and (ms := plan.predicted.ms - plan.target.max_ms) > 0.0:
        over.append(format_duration(ms))
    missed_reasons = (entry.reason.removeprefix("expected: ") for entry in plan.reasons if entry.name.endswith(TARGET_MISSED))
    return " and ".join(over) or "; ".join(missed_reasons)


class _ReasonList:
    """The reasons that a plan gives for its choices. Each is printed once.

    A reason is printed beside its light and caster kind, beside its setting, or else at the end. Methods that take a reason remove
    it from the list.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._unused = list(plan.reasons)

    def take_notes(self, name_part: str) -> list[str]:
        """Take the reasons whose name contains a word, and return them as sentences."""
        return [_sentence(entry.reason) for entry in self._take(lambda name: name_part in name.split(" "))]

    def light_lines(self, light: str) -> list[str]:
        """Return the lines about a light: heading, algorithms and settings."""
        lines = ["Under the sun" if light == SUN else f"Under the light {light}"]
        for step in self._plan.steps:
            if step.light == light:
                lines += self._step_lines(step)
        return lines

    def take_remaining(self) -> list[str]:
        """Take all remaining reasons, and return them as sentences."""
        return [f"{_capitalized(entry.name)}: {entry.reason}." for entry in self._take(lambda _: True)]

    def _step_lines(self, step: Step) -> Iterator[str]:
        """Yield the lines about a step (one algorithm for some caster kinds): its algorithm and its settings, with reasons."""
        kinds_by_reason: dict[str, list[str]] = {}
        for kind in step.kinds:
            reasons = self._take_named(f"{step.light}/{kind}: {step.algorithm}")
            kinds_by_reason.setdefault("; ".join(reasons), []).append(kind)
        for reason, kinds in kinds_by_reason.items():
            algorithm_phrase = "casts nothing" if step.algorithm == NO_SHADOWS else f"by {display_name(step.algorithm)}"
            yield f"  {_capitalized(format_list(kinds))} {algorithm_phrase}{f': {reason}' if reason else ''}."
        for key, value in _setting_values(step.settings):
            reasons = self._take_named(f"{key} {value}", f"{step.light}: {key} {value}")
            if reasons or (key in ALWAYS_LISTED_SETTINGS and (key, value) not in (("cascades", 1), ("filter", 1))):
                reason = f": {reasons[0]}" if reasons and reasons[0] != CHOSEN_REASON else ""
                yield f"    {_capitalized(_setting_phrase(key, value))}{reason}."

    def _take_named(self, *names: str) -> list[str]:
        """Take the reasons that have one of some names."""
        return [entry.reason for entry in self._take(lambda name: name in names)]

    def _take(self, matches: Callable[[str], bool]) -> list[NamedReason]:
        """Take the reasons whose name fulfils a condition, and return them."""
        matching = [entry for entry in self._unused if matches(entry.name)]
        self._unused = [entry for entry in self._unused if not matches(entry.name)]
        return matching


def _setting_values(settings: AlgorithmSettings | None) -> Iterator[tuple[str, object]]:
    """Yield names and values of the requested settings of a step (one algorithm for some caster kinds), in ``SETTING_ORDER``.

    The value of ``cascades`` is their number.
    """
    overrides = {} if settings is None else settings.as_overrides
    yield from ((key, overrides[key]) for key in SETTING_ORDER if key in overrides)


def _matched_display_name(match: re.Match[str]) -> str:
    """Return the display name of a matched algorithm or effect; return any other word unchanged."""
    word = match.group()
    return display_name(word) if word in ALGORITHMS or word in EFFECTS else word


def _setting_phrase(key: str, value: object) -> str:
    """Return the setting ``key`` with its value as a phrase, such as ``2048 x 2048 texels``."""
    match key, value:
        case "map_size", _:
            return f"{value} x {value} texels"
        case "cascades", 1:
            return "one map"
        case "cascades", _:
            return f"{value} maps, one behind the other"
        case "depth_bits", _:
            return f"{value} bits of depth"
        case "filter", 1:
            return "one tap, so that edges are sharp"
        case "filter", "sun":
            return "the penumbra of the light's extent"
        case "filter", _:
            return f"{value} x {value} taps"
        case "culling", "none":
            return "no culling"
        case "mask" | "slide_back", "off":
            return f"no {display_name(key)}"
        case _, str() if key != "culling":
            return f"{display_name(value)} {display_name(key)}"
        case _:
            return f"{display_name(key)} {value}"


def _with_display_names(plan: Plan) -> Plan:
    """Return a plan whose reasons use the display names of algorithms and effects."""

    def renamed(named_reasons: list[NamedReason]) -> list[NamedReason]:
        return [
            NamedReason(name=entry.name, reason=_SNAKE_CASE_WORD.sub(_matched_display_name, entry.reason))
            for entry in named_reasons
        ]

    lists = ("effects", "left_out", "rejected", "reasons")
    return plan.model_copy(update={key: renamed(getattr(plan, key)) for key in lists})


def _rejected_algorithms(plan: Plan) -> list[NamedReason]:
    """Return the rejected algorithms; reasons that repeat a listed reason are shortened."""
    reported = {f": {entry.reason}" for entry in plan.reasons}
    ends = {entry.name: next((end for end in reported if entry.reason.endswith(end)), "") for entry in plan.rejected}
    return [NamedReason(name=entry.name, reason=entry.reason.removesuffix(ends[entry.name])) for entry in plan.rejected]


def _reason_section(title: str, named_reasons: list[NamedReason]) -> list[str]:
    """Return lines that list names by their common reason, below a title; an empty list without reasons."""
    names: dict[str, list[str]] = {}
    for entry in named_reasons:
        names.setdefault(entry.reason, []).append(display_name(entry.name))
    return (
        [title, *(f"  {_capitalized(format_list(listed_names, max_items=9))}: {reason}." for reason, listed_names in names.items())]
        if named_reasons
        else []
    )


def _sentence(text: str) -> str:
    """Return a text as a sentence."""
    return f"{_capitalized(text)}."


def _capitalized(text: str) -> str:
    """Return a text with an upper-case first letter."""
    return text[:1].upper() + text[1:]


def _format_degrees(degrees: float) -> str:
    """Return an angle with one decimal, or with none if that is 0."""
    return f"{degrees:.1f}".removesuffix(".0")


def _wrapped(line: str) -> str:
    """Return a line broken into lines of at most ``LINE_WIDTH`` characters. Further lines are indented by two spaces more."""
    indent = " " * (len(line) - len(line.lstrip()))
    return textwrap.fill(line.strip(), LINE_WIDTH, initial_indent=indent, subsequent_indent=f"{indent}  ", break_on_hyphens=False)
