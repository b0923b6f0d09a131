"""The OpenGL device: the rasteriser that CI uses, depth formats, clamping, and guarded reads."""

from __future__ import annotations

import os
import threading

import moderngl
import numpy as np
import pytest

from skugga.terrain.errors import GraphicsError
from skugga.terrain.gl.depth_targets import MAX_TARGETS
from skugga.terrain.gl.programs import join_shader_parts, record_draw_calls
from skugga.terrain.ground.sheet import Sheet, sheet_of

VERTEX_SHADER = "#version 430\nin vec3 position;\nvoid main() { gl_Position = vec4(position, 1.0); }\n"
FRAGMENT_SHADER = "#version 430\nvoid main() {}\n"


def sheet(depth: float, rows: int = 3, cols: int = 3) -> np.ndarray:
    """Return a sheet over the whole clip square at a depth in [0, 1]."""
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, cols), indexing="ij")
    return np.stack([x, y, np.full_like(x, 2 * depth - 1)], axis=-1)


def draw_grid_mesh(gl, program: moderngl.Program, position: np.ndarray) -> int:
    """Draw a heightfield of positions (rows, cols, 3), and return the number of triangles."""
    return gl.draw_grid_mesh(program, position, sheet_of(position).triangles)


def draw(gl, sheets, bits: int = 24, size: int = 8) -> np.ndarray:
    """Return the depths (size, size) of heightfields. ``bits`` is the number of bits of a depth."""
    target = gl.depth_target(size, size, bits)
    program = gl.program(VERTEX_SHADER, FRAGMENT_SHADER)
    with gl.depth_pass(target):
        for position in sheets:
            draw_grid_mesh(gl, program, position)
    return gl.read(target, attachment=-1)


def test_ci_uses_the_rasteriser_of_the_goldens(gl):
    expected = os.environ.get("SKUGGA_EXPECT_RENDERER")
    if expected is None:
        assert not os.environ.get("CI"), "CI must say which rasteriser it expects"
        pytest.skip("SKUGGA_EXPECT_RENDERER is not set")
    assert expected in gl.renderer


@pytest.mark.parametrize(("bits", "step"), [(16, 1 / (2**16 - 1)), (24, 1 / (2**24 - 1)), (32, 2.0**-24)])
def test_depth_is_stored_with_the_requested_bits(gl, bits, step):
    depth = 0.123456789
    stored_depth = draw(gl, [sheet(depth)], bits)
    assert np.ptp(stored_depth) == 0.0
    assert abs(float(stored_depth[0, 0]) - depth) <= step / 2 + 2e-8
    assert bits != 16 or float(stored_depth[0, 0]) * (2**16 - 1) == pytest.approx(round(depth * (2**16 - 1)), abs=0.01)


def test_depth_pass_clamps_casters_and_keeps_the_nearest(gl):
    assert (draw(gl, [sheet(0.5), sheet(-3.0)]) == 0.0).all()
    assert draw(gl, [sheet(0.5), sheet(0.25), sheet(0.75)]) == pytest.approx(0.25, abs=1e-6)
    assert (draw(gl, []) == 1.0).all()


def test_depth_clamp_does_not_leak_into_the_next_pass(gl):
    draw(gl, [sheet(-3.0)])
    target = gl.depth_target(8, 8, 24)
    target.use()
    target.clear(depth=1.0)
    gl.ctx.enable_only(moderngl.DEPTH_TEST)
    draw_grid_mesh(gl, gl.program(VERTEX_SHADER, FRAGMENT_SHADER), sheet(-3.0))
    assert (gl.read(target, attachment=-1) == 1.0).all(), "clipped, as OpenGL does by default"


def test_triangles_with_a_missing_corner_are_left_out(gl):
    position = sheet(0.5, 3, 3)
    position[0, 0] = np.nan  # a corner of the NW quad only, which keeps one of its triangles
    program = gl.program(VERTEX_SHADER, FRAGMENT_SHADER)
    assert draw_grid_mesh(gl, program, position) == 7
    assert draw_grid_mesh(gl, program, sheet(0.5, 3, 3)) == 8
    assert draw_grid_mesh(gl, program, np.full((3, 3, 3), np.nan)) == 0
    assert draw_grid_mesh(gl, program, sheet(0.5, 1, 3)) == 0


def test_a_sheet_is_drawn_along_its_diagonals(gl):
    """Two opposite corners are nearer than the others. The middle is as near only if the diagonal joins these two."""
    position = sheet(0.5, 2, 2)
    position[[0, 1], [0, 1], 2] = -0.8
    program, middle_depths = gl.program(VERTEX_SHADER, FRAGMENT_SHADER), {}
    for is_cut_nw_se in (False, True):
        target = gl.depth_target(9, 9, 24)
        with gl.depth_pass(target):
            cut_sheet = Sheet(position, np.array([[is_cut_nw_se]]))
            assert gl.draw_grid_mesh(program, cut_sheet.position_frame_m, cut_sheet.triangles) == 2
        middle_depths[is_cut_nw_se] = float(gl.read(target, attachment=-1)[4, 4])
    assert middle_depths[False] == pytest.approx(0.5, abs=1e-6) and middle_depths[True] == pytest.approx(0.1, abs=1e-6)


def test_reading_without_the_context_raises(gl):
    target = gl.float_target(4, 4)
    caught: list[Exception] = []

    def read() -> None:
        try:
            gl.read(target)
        except GraphicsError as error:
            caught.append(error)

    thread = threading.Thread(target=read)
    thread.start()
    thread.join()
    assert len(caught) == 1 and "context" in str(caught[0])


def test_check_raises_a_pending_error_once(gl):
    gl.ctx.enable_direct(0x1234)  # no such capability
    with pytest.raises(GraphicsError, match="GL_INVALID_ENUM in the sheet"):
        gl.check("the sheet")
    gl.check("what comes after")


def test_a_shader_that_does_not_compile_raises_one_line(gl):
    with pytest.raises(GraphicsError) as caught:
        gl.program("#version 430\nvoid main() { nonsense }", FRAGMENT_SHADER)
    assert "\n" not in str(caught.value)
    gl.check("what comes after")


def test_a_program_s_label_lists_its_parts_and_constants(gl):
    vertex = join_shader_parts(
        {"a/one": "in vec3 position;\n", "b/two.vert": "void main() { gl_Position = vec4(position, 1.0); }\n"}
    )
    fragment = join_shader_parts(
        {"b/two.frag": "uniform int taps;\nuniform bool lamp;\nout float c;\nvoid main() { c = lamp ? taps : 0; }\n"}
    )
    program = gl.program(vertex, fragment, {"taps": 3, "lamp": True, "absent": 7})
    assert program.extra.label == "a/one b/two.vert b/two.frag taps=3 lamp=true"
    assert "taps" not in program and program.extra.label in gl.programs
    assert gl.program(vertex, fragment).extra.label == "a/one b/two.vert b/two.frag"


SAMPLER_TYPES = [
    "sampler2D",
    "sampler2DArray",
    "sampler2DShadow",
    "samplerCube",
    "samplerCubeArray",
    "usampler2D",
    "isampler3D",
    "sampler2DMS",
]


@pytest.mark.parametrize("kind", SAMPLER_TYPES)
def test_a_program_s_textures_are_its_active_samplers(gl, kind):
    """The linker drops declared samplers that nothing reads, or that a compiled-in constant rules out."""
    size = "textureSize(one)" if kind == "sampler2DMS" else "textureSize(one, level)"
    fragment = f"""#version 430
uniform {kind} one;
uniform {kind} unread;
uniform bool looks;
uniform int level;
uniform float scale;
out float c;
void main() {{ c = scale; if (looks) c *= float({size}.x); }}
"""
    assert gl.program(VERTEX_SHADER, fragment).extra.textures == ("one",)
    assert gl.program(VERTEX_SHADER, fragment, {"looks": True}).extra.textures == ("one",)
    assert gl.program(VERTEX_SHADER, fragment, {"looks": False}).extra.textures == ()


def test_draw_calls_are_recorded_with_their_programs(gl):
    target, program, other = (
        gl.depth_target(8, 8, 24),
        gl.program(VERTEX_SHADER, FRAGMENT_SHADER),
        gl.program(VERTEX_SHADER, FRAGMENT_SHADER + "// another\n"),
    )
    triangle, none = np.array([[0, 1, 2]], np.int32), np.zeros((0, 3), np.int32)
    corners = sheet(0.5).reshape(-1, 3)
    with record_draw_calls() as calls, gl.depth_pass(target):
        draw_grid_mesh(gl, program, sheet(0.5))
        gl.draw_triangles(other, corners, triangle)
        gl.draw_triangles(other, corners, none)  # nothing to draw: no call
        draw_grid_mesh(gl, program, np.full((3, 3, 3), np.nan))
        with gl.uploaded_mesh(program, corners, triangle) as array:
            gl.render(array)
            gl.render(array, moderngl.LINES, vertices=2)
    gl.draw_triangles(other, corners, triangle)
    assert len(calls) == 4 and [call is other.extra for call in calls] == [False, True, False, False]


def test_the_number_of_depth_targets_is_bounded(gl):
    """The device caches at most ``MAX_TARGETS`` targets and releases the others."""
    for size in range(16, 16 + 8 * MAX_TARGETS, 4):
        gl.depth_target(size, size, 16)
    assert gl.depth_targets.count <= MAX_TARGETS
    assert gl.depth_target(80, 80, 16) is gl.depth_target(80, 80, 16)
