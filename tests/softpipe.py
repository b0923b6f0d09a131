"""A second rasteriser: ``pytest -p tests.softpipe`` with ``SOFTPIPE`` in the environment runs tests on Mesa's softpipe.

softpipe is a slow rasteriser of Mesa that shares no code with llvmpipe. It reports OpenGL 3.3, and has two faults of its
own:

* It drops triangles whose fragment shader reads ``gl_PrimitiveID``. The plugin draws their vertices one by one, which
  numbers them.
* With a polygon offset it clamps depths at a triangle's corners instead of its pixels, so infinite volumes are skewed. In
  maps, where they begin far away, parts of their shadows are missing (``UNSUPPORTED_LEVELS``).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import moderngl
import numpy as np

from skugga.terrain.gl.device import Device

SOFTPIPE = {"GALLIUM_DRIVER": "softpipe", "MESA_GL_VERSION_OVERRIDE": "4.5", "MESA_GLSL_VERSION_OVERRIDE": "450"}

UNSUPPORTED_LEVELS = ("thesis_water_tower",)

_original_program, _original_uploaded_mesh = Device.program, Device.uploaded_mesh
_numbered_programs: set[int] = set()


def _program_with_primitive_numbers(self: Device, vertex: str, fragment: str, *args: Any, **kwargs: Any) -> moderngl.Program:
    """Compile a program for softpipe, which lacks ``gl_PrimitiveID``: the vertex shader passes the triangle's number."""
    needs_numbers = "gl_PrimitiveID" in fragment
    if needs_numbers:
        declaration = r"\1flat {} int primitive_number;\n"
        fragment = re.sub(r"(#version[^\n]*\n)", declaration.format("in"), fragment, count=1)
        fragment = fragment.replace("gl_PrimitiveID", "primitive_number")
        vertex = re.sub(r"(#version[^\n]*\n)", declaration.format("out"), vertex, count=1)
        vertex = vertex.replace("void main() {", "void main() { primitive_number = gl_VertexID / 3;")
    program = _original_program(self, vertex, fragment, *args, **kwargs)
    if needs_numbers:
        _numbered_programs.add(program.glo)
    return program


@contextmanager
def _mesh_without_indices(
    self: Device, program: moderngl.Program, vertices: np.ndarray, indices: np.ndarray, *args: Any, **kwargs: Any
) -> Iterator[moderngl.VertexArray]:
    """Upload a mesh without shared vertices if its program needs the triangle's number."""
    if program.glo in _numbered_programs:
        vertices, indices = np.asarray(vertices)[np.ravel(indices)], np.arange(np.size(indices), dtype=np.int32)
    with _original_uploaded_mesh(self, program, vertices, indices, *args, **kwargs) as array:
        yield array


def pytest_configure() -> None:
    """Install the workarounds: this module is a plugin of the process."""
    Device.program, Device.uploaded_mesh = _program_with_primitive_numbers, _mesh_without_indices  # type: ignore[method-assign]
