"""The stencil of a device: a framebuffer of float depth and eight-bit stencil, and the passes that count in it.

The raw calls that moderngl has none for; with ``skugga.terrain.gl.device`` the only module that makes any. Every pass puts back
what it set: moderngl neither clears a stencil nor switches its test off.

Depths of these passes go from 0, infinitely far away, to 1, and the nearer one is the greater.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal

import moderngl
import numpy as np

from skugga.terrain.cache import MIB, Cache, Missing

_CLIP_DISTANCE0, _DEPTH_CLAMP = 0x3000, 0x864F
_LOWER_LEFT, _NEGATIVE_ONE_TO_ONE, _ZERO_TO_ONE = 0x8CA1, 0x935E, 0x935F

STENCIL_CACHE_BYTES, PIXEL_BYTES = 128 * MIB, 12
"""Framebuffers are kept up to so many bytes (that of a view and that of its samples, say), and a pixel of one takes so many."""

MARK_BIT = 0x80
"""The bit that marks pixels; what is marked counts to 127, everything else to 255."""

GRID_STEPS = 1.0
"""Faces are drawn farther away by what so many steps of the rasteriser's grid (1/256 pixel) make of their slope, so that a face
that begins at a surface and grazes it is not taken to lie before it. A corner is rounded by half a step along either axis,
which moves the plane at a pixel by at most a step of its steeper slope.
"""

Counting = Literal["z_pass", "z_fail", "faces", "seen"]
"""What faces do to the stencil. ``z_pass``: before the point, one that faces the eye adds one, another takes one. ``z_fail``:
behind it or in it, the other way round. ``faces``: each before the point adds one, up to 255. ``seen``: what is not behind makes it
255."""

Side = Literal["both", "front", "back"]
"""The faces that are drawn: those that face the eye, or do not."""


class Stencil:
    """Drawing into a stencil. ``require_current`` and ``check`` are those of the device that owns the context."""

    def __init__(
        self, ctx: moderngl.Context, require_current: Callable[[], None], check: Callable[[str], None], park: Callable[[], None]
    ) -> None:
        self._ctx, self._require_current, self._check, self._park = ctx, require_current, check, park
        self._targets: Cache[tuple[moderngl.Framebuffer, int]] = Cache(
            "skugga.terrain.gl.stencil",
            "process",
            STENCIL_CACHE_BYTES,
            lambda held: PIXEL_BYTES * held[0].width * held[0].height,
            self._let_go,
        )

    def target(self, width: int, height: int) -> moderngl.Framebuffer:
        """A framebuffer of an eight-bit stencil beside float depths; the last ones are kept. It holds 0, infinitely far away."""
        from OpenGL import GL

        self._require_current()
        found = self._targets.get(width, height)
        if not isinstance(found, Missing):
            target = found[0]
        else:
            target = self._ctx.framebuffer([self._ctx.renderbuffer((width, height), 1)])  # moderngl needs a colour
            target.color_mask, target.depth_mask = (False,) * 4, True  # it knows of no depth, and would not write any
            storage = int(GL.glGenRenderbuffers(1))
            GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, storage)
            GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, GL.GL_DEPTH32F_STENCIL8, width, height)
            GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, 0)
            target.use()
            GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, GL.GL_DEPTH_STENCIL_ATTACHMENT, GL.GL_RENDERBUFFER, storage)
            self._check("the stencil's target")
            self._targets.put(width, height, value=(target, storage))
        target.use()
        GL.glStencilMask(0xFF)
        GL.glClearBufferfi(GL.GL_DEPTH_STENCIL, 0, 0.0, 0)
        return target

    def _let_go(self, held: tuple[moderngl.Framebuffer, int]) -> None:
        from OpenGL import GL

        old, storage = held
        self._park()  # moderngl would bind a released framebuffer again if it was the current one
        for item in (old, *old.color_attachments):
            item.release()
        GL.glDeleteRenderbuffers(1, [storage])

    def clear(self, target: moderngl.Framebuffer, bits: int = 0xFF) -> None:
        """Make some bits of a stencil 0."""
        from OpenGL import GL

        self._require_current()
        target.use()
        GL.glStencilMask(bits)
        GL.glClearBufferiv(GL.GL_STENCIL, 0, [0])
        GL.glStencilMask(0xFF)

    @contextmanager
    def once_pass(self, target: moderngl.Framebuffer, held: int, clip_distances: int = 0) -> Iterator[None]:
        """Whatever the depth: what holds ``held`` holds one more where anything is drawn, however often.

        ``clip_distances`` is the number of distances that the vertex shaders write.
        """
        with self._testing(target, depth=False):
            from OpenGL import GL

            GL.glStencilFunc(GL.GL_EQUAL, held, 0xFF)
            GL.glStencilOp(GL.GL_KEEP, GL.GL_KEEP, GL.GL_INCR)
            for number in range(clip_distances):
                self._ctx.enable_direct(_CLIP_DISTANCE0 + number)
            try:
                yield
            finally:
                for number in range(clip_distances):
                    self._ctx.disable_direct(_CLIP_DISTANCE0 + number)

    @contextmanager
    def mark_pass(self, target: moderngl.Framebuffer) -> Iterator[None]:
        """Whatever the depth: mark what is drawn."""
        with self._testing(target, depth=False):
            from OpenGL import GL

            GL.glStencilFunc(GL.GL_ALWAYS, MARK_BIT, 0xFF)
            GL.glStencilOp(GL.GL_KEEP, GL.GL_KEEP, GL.GL_REPLACE)
            yield

    @contextmanager
    def depth_pass(self, target: moderngl.Framebuffer, always: bool = False) -> Iterator[None]:
        """Draw depths, the nearest wins, or with ``always`` the last; the stencil stays as it is."""
        from OpenGL import GL

        self._require_current()
        target.use()
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        self._ctx.depth_func = "1" if always else ">"
        GL.glClipControl(_LOWER_LEFT, _ZERO_TO_ONE)
        try:
            yield
        finally:
            GL.glClipControl(_LOWER_LEFT, _NEGATIVE_ONE_TO_ONE)
            self._ctx.depth_func = "<="
            self._ctx.enable_only(moderngl.NOTHING)

    @contextmanager
    def count_pass(
        self,
        target: moderngl.Framebuffer,
        counting: Counting,
        side: Side = "both",
        marked: bool = False,
        clamped: bool = False,
        away_steps: float = 0.0,
    ) -> Iterator[None]:
        """Count faces against the depths that are there, which stay as they are; those that face the eye go round clockwise.

        With ``marked`` only what is marked counts; with ``clamped`` nothing is cut off at the near and far planes. Faces are drawn
        ``away_steps`` steps of a float32 depth farther away, besides ``GRID_STEPS``.
        """
        with self._testing(target, depth=True):
            from OpenGL import GL

            target.depth_mask = False
            GL.glClipControl(_LOWER_LEFT, _ZERO_TO_ONE)
            GL.glStencilFunc(*((GL.GL_EQUAL, MARK_BIT, MARK_BIT) if marked else (GL.GL_ALWAYS, 0xFF, 0xFF)))
            GL.glStencilMask(0x7F if marked else 0xFF)
            self._ctx.depth_func = ">"
            up, down, keep = GL.GL_INCR_WRAP, GL.GL_DECR_WRAP, GL.GL_KEEP
            if counting == "z_pass":
                GL.glStencilOpSeparate(GL.GL_FRONT, keep, keep, up)
                GL.glStencilOpSeparate(GL.GL_BACK, keep, keep, down)
            elif counting == "z_fail":
                GL.glStencilOpSeparate(GL.GL_FRONT, keep, down, keep)
                GL.glStencilOpSeparate(GL.GL_BACK, keep, up, keep)
            else:
                GL.glStencilOp(keep, keep, GL.GL_INCR if counting == "faces" else GL.GL_REPLACE)
                self._ctx.depth_func = ">="
            self._ctx.polygon_offset = -GRID_STEPS / 256.0, -away_steps
            self._ctx.front_face = "cw"
            if side != "both":
                self._ctx.cull_face = "back" if side == "front" else "front"
                self._ctx.enable(moderngl.CULL_FACE)
            if clamped:
                self._ctx.enable_direct(_DEPTH_CLAMP)
            try:
                yield
            finally:
                self._ctx.disable_direct(_DEPTH_CLAMP)
                self._ctx.disable(moderngl.CULL_FACE)
                self._ctx.polygon_offset = 0.0, 0.0
                self._ctx.front_face, self._ctx.cull_face = "ccw", "back"
                self._ctx.depth_func = "<="
                GL.glStencilMask(0xFF)
                GL.glClipControl(_LOWER_LEFT, _NEGATIVE_ONE_TO_ONE)
                target.depth_mask = True

    def read(self, target: moderngl.Framebuffer) -> np.ndarray:
        """Read a stencil as uint8 (rows, cols); row 0 is the first. Raises ``GraphicsError`` as ``Device.read``."""
        from OpenGL import GL

        self._require_current()
        width, height = target.size
        out = np.zeros((height, width), np.uint8)
        target.use()
        GL.glPixelStorei(GL.GL_PACK_ALIGNMENT, 1)
        GL.glReadPixels(0, 0, width, height, GL.GL_STENCIL_INDEX, GL.GL_UNSIGNED_BYTE, out)
        self._check("reading the stencil")
        return out

    @contextmanager
    def _testing(self, target: moderngl.Framebuffer, depth: bool) -> Iterator[None]:
        from OpenGL import GL

        self._require_current()
        target.use()
        self._ctx.enable_only(moderngl.DEPTH_TEST if depth else moderngl.NOTHING)
        GL.glEnable(GL.GL_STENCIL_TEST)
        try:
            yield
        finally:
            GL.glStencilOp(GL.GL_KEEP, GL.GL_KEEP, GL.GL_KEEP)
            GL.glStencilFunc(GL.GL_ALWAYS, 0, 0xFF)
            GL.glDisable(GL.GL_STENCIL_TEST)
            self._ctx.enable_only(moderngl.NOTHING)
