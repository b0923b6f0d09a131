"""Counting in the stencil: increments and decrements, wrap-around, marks, and no state left behind by a pass."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from skugga.terrain.gl.stencil import MARK_BIT

VERTEX_SHADER = "#version 430\nin vec3 position;\nvoid main() { gl_Position = vec4(position, 1.0); }\n"
FRAGMENT_SHADER = "#version 430\nvoid main() {}\n"
SIZE = 8

TOWARDS, AWAY = 1, -1
"""Front faces wind clockwise on the screen, whose rows run downwards; back faces wind counter-clockwise."""


def square(depth: float, facing: int = TOWARDS, left: float = -1.0, right: float = 1.0) -> np.ndarray:
    """Return two triangles (6, 3) over all rows from ``left`` to ``right``; depth is 0 infinitely far away and at most 1."""
    corners = np.array([[left, -1, depth], [left, 1, depth], [right, 1, depth], [right, -1, depth]])
    order = [0, 1, 2, 0, 2, 3] if facing == TOWARDS else [0, 2, 1, 0, 3, 2]
    return corners[order]


def draw(gl, squares: Iterable[np.ndarray]) -> None:
    """Draw squares, each as vertices of triangles."""
    points = np.concatenate(list(squares)).astype(np.float32)
    gl.draw_triangles(gl.program(VERTEX_SHADER, FRAGMENT_SHADER), points, np.arange(len(points), dtype=np.int32).reshape(-1, 3))


@pytest.fixture
def target(gl):
    """Return a stencil target over a surface at depth 0.5."""
    target = gl.stencil.target(SIZE, SIZE)
    with gl.stencil.depth_pass(target):
        draw(gl, [square(0.5)])
    return target


def uniform_count(gl, target, counting: str, squares: list[np.ndarray], **pass_options) -> int:
    """Return the count that squares over the whole picture leave in every pixel."""
    with gl.stencil.count_pass(target, counting, **pass_options):
        draw(gl, squares)
    values = np.unique(gl.stencil.read(target))
    assert len(values) == 1
    return int(values[0])


@pytest.mark.parametrize(
    ("counting", "depth", "facing", "expected_count"),
    [
        ("z_pass", 0.6, TOWARDS, 1), ("z_pass", 0.6, AWAY, 255), ("z_pass", 0.4, TOWARDS, 0), ("z_pass", 0.4, AWAY, 0),
        ("z_fail", 0.6, TOWARDS, 0), ("z_fail", 0.6, AWAY, 0), ("z_fail", 0.4, TOWARDS, 255), ("z_fail", 0.4, AWAY, 1),
        ("faces", 0.6, TOWARDS, 1), ("faces", 0.6, AWAY, 1), ("faces", 0.4, AWAY, 0),
        ("seen", 0.6, TOWARDS, 255), ("seen", 0.4, TOWARDS, 0),
    ],
)  # fmt: skip
def test_faces_increment_and_decrement(gl, target, counting, depth, facing, expected_count):
    assert uniform_count(gl, target, counting, [square(depth, facing)]) == expected_count


@pytest.mark.parametrize(
    ("counting", "facing", "expected_count"), [("z_pass", TOWARDS, 0), ("z_fail", AWAY, 1), ("z_fail", TOWARDS, 255)]
)
def test_a_face_in_the_surface_lies_behind_it(gl, target, counting, facing, expected_count):
    """The triangles are identical: a near cap and the surface that it lies on."""
    assert uniform_count(gl, target, counting, [square(0.5, facing)]) == expected_count


@pytest.mark.parametrize(("side", "expected_count"), [("both", 1), ("front", 3), ("back", 254)])
def test_front_and_back_sides_are_counted_separately(gl, target, side, expected_count):
    faces = [square(0.6, TOWARDS)] * 3 + [square(0.7, AWAY)] * 2
    assert uniform_count(gl, target, "z_pass", faces, side=side) == expected_count


@pytest.mark.parametrize("number", [127, 128, 255, 256, 257, 600])
def test_counts_wrap_around(gl, target, number):
    """Without marks, counts wrap at 256, and decrements undo increments. ``faces`` saturates at 255."""
    faces = [square(0.6)] * number
    assert uniform_count(gl, target, "z_pass", faces) == number % 256
    assert uniform_count(gl, target, "z_pass", [square(0.6, AWAY)] * number) == 0
    assert uniform_count(gl, target, "faces", faces) == min(number, 255)


@pytest.mark.parametrize("number", [1, 127, 128, 129, 300])
def test_only_marked_pixels_count(gl, target, number):
    """Counts wrap at 128 in both directions. Neither counts nor clearing them change the mark."""
    with gl.stencil.mark_pass(target):
        draw(gl, [square(0.0, right=0.0)])
    left = np.arange(SIZE) < SIZE // 2
    for facing, expected_count in ((TOWARDS, number % 128), (AWAY, 0), (AWAY, -number % 128)):
        with gl.stencil.count_pass(target, "z_pass", marked_only=True):
            draw(gl, [square(0.6, facing)] * number)
        stencil = gl.stencil.read(target)
        assert (stencil[:, left] == MARK_BIT + expected_count).all() and (stencil[:, ~left] == 0).all()
    gl.stencil.clear(target, ~MARK_BIT & 0xFF)
    assert (gl.stencil.read(target) == np.where(left, MARK_BIT, 0)).all()
    gl.stencil.clear(target)
    assert (gl.stencil.read(target) == 0).all()


def test_each_pixel_counts_once(gl, target):
    """A pixel that holds the requested count is incremented once, whatever the depth and however often it is drawn."""
    for previous_count, next_count in ((1, 0), (0, 1), (0, 1), (1, 2)):
        with gl.stencil.increment_once_pass(target, previous_count):
            draw(gl, [square(0.1), square(0.9, AWAY), square(0.1)])
        assert (gl.stencil.read(target) == next_count).all()


def test_depth_pass_keeps_the_nearest_or_the_last_depth(gl, target):
    with gl.stencil.depth_pass(target):
        draw(gl, [square(0.8), square(0.7)])
    assert uniform_count(gl, target, "z_pass", [square(0.75)]) == 0
    with gl.stencil.depth_pass(target, overwrite=True):
        draw(gl, [square(0.7)])
    assert uniform_count(gl, target, "z_pass", [square(0.75)]) == 1
    with gl.stencil.count_pass(target, "z_pass"):
        draw(gl, [square(0.9)])  # writes no depth
    assert uniform_count(gl, target, "z_pass", [square(0.75)]) == 3


def test_row_0_is_the_first_row_read(gl, target):
    with gl.stencil.mark_pass(target):
        draw(gl, [np.array([[-1, -1, 0], [1, -1, 0], [1, -0.75, 0], [-1, -1, 0], [1, -0.75, 0], [-1, -0.75, 0]])])
    stencil = gl.stencil.read(target)
    assert (stencil[0] == MARK_BIT).all() and (stencil[1:] == 0).all()


@pytest.mark.parametrize("size", [(8, 8), (5, 3), (16, 4)])
def test_a_target_starts_empty(gl, size):
    """Targets of any size, also reused ones, hold no counts and no depth before infinity."""
    for _ in range(2):
        target = gl.stencil.target(*size)
        assert gl.stencil.read(target).shape == size[::-1] and not gl.stencil.read(target).any()
        with gl.stencil.count_pass(target, "z_pass"):
            draw(gl, [square(1e-6)])
        assert (gl.stencil.read(target) == 1).all()


def shadow_map_depths(gl) -> list[np.ndarray]:
    """Return depths of shadow map targets that are drawn with the usual state.

    Clip space is the usual one, the nearest depth wins, nothing is culled or offset, and depths before the near plane are
    clamped.
    """
    out = []
    for squares in ([square(0.25), square(-0.5, AWAY)], [square(0.1, AWAY), square(0.3, left=0.0)], [square(-3.0)]):
        target = gl.depth_target(SIZE, SIZE, 32)
        with gl.depth_pass(target):
            draw(gl, squares)
        out.append(gl.read(target, attachment=-1))
    return out


PASSES = [
    ("depth_pass", {}), ("depth_pass", {"overwrite": True}), ("mark_pass", {}),
    ("increment_once_pass", {"stencil_value": 0, "clip_distances": 2}),
    *(("count_pass", {"counting": counting, "side": side, "marked_only": marked})
      for counting in ("z_pass", "z_fail", "faces", "seen") for side in ("both", "front", "back") for marked in (False, True)),
]  # fmt: skip


@pytest.mark.parametrize("fails", [False, True])
def test_no_pass_leaves_its_state_behind(gl, fails):
    """The next drawing is what it was before, even after a pass that fails."""
    before = shadow_map_depths(gl)
    assert (before[0] == np.float32(0.25)).all() and (before[2] == 0.0).all() and np.ptp(before[1]) == 0.0
    for name, pass_options in PASSES:
        target = gl.stencil.target(SIZE, SIZE)
        try:
            with getattr(gl.stencil, name)(target, **pass_options):
                if fails:
                    raise KeyError(name)
                draw(gl, [square(0.5), square(0.7, AWAY)])
        except KeyError:
            pass
        for depth_before, depth_after in zip(before, shadow_map_depths(gl), strict=True):
            np.testing.assert_array_equal(depth_after, depth_before, err_msg=f"{name} {pass_options}")
        target = gl.stencil.target(SIZE, SIZE)
        with gl.stencil.depth_pass(target):
            draw(gl, [square(0.5)])
        assert uniform_count(gl, target, "z_pass", [square(0.6, AWAY)]) == 255
