"""Records of shader programs and draw calls: a program's parts, constants and textures, and each draw call made with it.

``Device.render`` makes all draw calls and records each.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import moderngl

_PART_COMMENT = "// part: "
_SAMPLER_TYPES = frozenset(
    number
    for first, last in ((0x8B5D, 0x8B64), (0x8DC0, 0x8DC5), (0x8DC9, 0x8DD8), (0x900C, 0x900F), (0x9108, 0x910D))
    for number in range(first, last + 1)
)
"""GL_SAMPLER_1D to GL_UNSIGNED_INT_SAMPLER_2D_MULTISAMPLE_ARRAY: table 7.3 of the OpenGL 4.5 core specification."""


@dataclass(frozen=True, eq=False)
class LinkedProgram:
    """Description of a linked program.

    Attributes
    ----------
    label
        Its shader parts and the constants compiled into it, separated by spaces
        (``shadows/pixels.vert shadows/maps/receiver shadows/maps/shadow_map.frag taps=3``).
    textures
        Names of its active samplers, sorted.
    """

    label: str
    textures: tuple[str, ...]


_RECORDS: ContextVar[tuple[list[LinkedProgram], ...]] = ContextVar("records", default=())


@contextmanager
def record_draw_calls() -> Iterator[list[LinkedProgram]]:
    """Collect the programs of all draw calls made in the context, one for each call, in order. Contexts may be nested."""
    calls: list[LinkedProgram] = []
    token = _RECORDS.set((*_RECORDS.get(), calls))
    try:
        yield calls
    finally:
        _RECORDS.reset(token)


def record_draw(program: LinkedProgram) -> None:
    """Add a draw call, made with a program, to all lists that ``record_draw_calls`` is collecting."""
    for calls in _RECORDS.get():
        calls.append(program)


def join_shader_parts(parts: Mapping[str, str]) -> str:
    """Return the source of a shader that concatenates named parts. A comment before each part names it."""
    return "#version 430\n" + "".join(f"{_PART_COMMENT}{name}\n{text}" for name, text in parts.items())


def specialize_shader(fragment: str, constants: Mapping[str, bool | int]) -> tuple[str, list[str]]:
    """Return a shader's source with uniforms replaced by constants, and a text (``taps=3``) for each replaced uniform.

    Constants whose uniform the shader lacks are ignored.
    """
    replacements = []
    for name, value in constants.items():
        word = str(value).lower()
        fragment, replaced_count = re.subn(rf"^uniform (\w+) {name};", rf"const \1 {name} = {word};", fragment, flags=re.MULTILINE)
        if replaced_count:
            replacements.append(f"{name}={word}")
    return fragment, replacements


def describe_program(program: moderngl.Program, texts: tuple[str, str], constants: list[str]) -> LinkedProgram:
    """Return the description of a linked program. Its textures are the samplers that the linker left active.

    ``texts`` are the sources of its vertex and fragment shader, ``constants`` the texts that ``specialize_shader`` returned.
    """
    import moderngl

    parts = [line.removeprefix(_PART_COMMENT) for text in texts for line in text.splitlines() if line.startswith(_PART_COMMENT)]
    members = {name: program[name] for name in program}
    uniforms = {name: member for name, member in members.items() if isinstance(member, moderngl.Uniform)}
    textures = [
        name
        for name, uniform in uniforms.items()
        if uniform.gl_type in _SAMPLER_TYPES  # type: ignore[attr-defined]  # the stubs lack it
    ]
    return LinkedProgram(" ".join([*parts, *constants]) or "unnamed", tuple(sorted(textures)))
