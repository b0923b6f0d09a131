"""Programs as they go on record: what they were made of, the textures that they can read, and every draw made with them.

The record is that of the draw calls themselves: ``Device.render``, the only place that makes any, notes each.
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

_PART = "// part: "
_SAMPLER_TYPES = frozenset(
    number
    for first, last in ((0x8B5D, 0x8B64), (0x8DC0, 0x8DC5), (0x8DC9, 0x8DD8), (0x900C, 0x900F), (0x9108, 0x910D))
    for number in range(first, last + 1)
)
"""GL_SAMPLER_1D to GL_UNSIGNED_INT_SAMPLER_2D_MULTISAMPLE_ARRAY: table 7.3 of the OpenGL 4.5 core specification."""


@dataclass(frozen=True, eq=False)
class Linked:
    """A linked program: ``label``, the shader parts that it was made of and the constants compiled into it, by spaces
    (``shadows/pixels.vert shadows/maps/receiver shadows/maps/shadow_map.frag taps=3``), and ``textures``, its active samplers.
    """

    label: str
    textures: tuple[str, ...]


_RECORDS: ContextVar[tuple[list[Linked], ...]] = ContextVar("records", default=())


@contextmanager
def recorded() -> Iterator[list[Linked]]:
    """The programs of all draw calls made meanwhile, one for each call, in order; records within records note alike."""
    calls: list[Linked] = []
    token = _RECORDS.set((*_RECORDS.get(), calls))
    try:
        yield calls
    finally:
        _RECORDS.reset(token)


def note_draw(program: Linked) -> None:
    """Note a draw call."""
    for calls in _RECORDS.get():
        calls.append(program)


def join_shader_parts(parts: Mapping[str, str]) -> str:
    """The text of a shader of named parts, one after another; comments say which is which."""
    return "#version 430\n" + "".join(f"{_PART}{name}\n{text}" for name, text in parts.items())


def with_constants(fragment: str, constants: Mapping[str, bool | int]) -> tuple[str, list[str]]:
    """A shader's text with some of its uniforms made constants, and which those are (``taps=3``): it may lack others."""
    made = []
    for name, value in constants.items():
        word = str(value).lower()
        fragment, found = re.subn(rf"^uniform (\w+) {name};", rf"const \1 {name} = {word};", fragment, flags=re.MULTILINE)
        if found:
            made.append(f"{name}={word}")
    return fragment, made


def linked(program: moderngl.Program, texts: tuple[str, str], constants: list[str]) -> Linked:
    """A program as it goes on record: its samplers are those that the linker has left active."""
    import moderngl

    parts = [line.removeprefix(_PART) for text in texts for line in text.splitlines() if line.startswith(_PART)]
    members = {name: program[name] for name in program}
    uniforms = {name: member for name, member in members.items() if isinstance(member, moderngl.Uniform)}
    textures = [
        name
        for name, uniform in uniforms.items()
        if uniform.gl_type in _SAMPLER_TYPES  # type: ignore[attr-defined]  # the stubs lack it
    ]
    return Linked(" ".join([*parts, *constants]) or "unnamed", tuple(sorted(textures)))
