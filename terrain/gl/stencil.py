"""Stencil passes: framebuffers of float depth and eight-bit stencil, and the passes that count faces in them.

moderngl supports no stencil, so this module makes raw OpenGL calls; only this module and ``skugga.terrain.gl.device`` do. moderngl
neither clears a stencil nor disables its test, so each pass restores the state that it sets.

These passes use reversed depth: 0 is infinity, 1 is near, and the greater depth is nearer.
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

STENCIL_CACHE_BYTES, STENCIL_PIXEL_BYTES = 128 * MIB, 12
"""Limit in bytes of the cache of framebuffers, and bytes of a framebuffer's pixel.

The limit allows, for example, a view's framebuffer and that of its supersamples.
"""

MARK_BIT = 0x80
"""The stencil bit that marks pixels.

A pass over marked pixels only counts in the other seven bits (to 127), any other pass in all eight (to 255).
"""

SLOPE_OFFSET_STEPS = 1.0
"""Slope offset of faces, in steps of the rasteriser's grid (1/256 pixel).

It moves faces away from the eye, so that a face that starts at a surface at a grazing angle does not count as in front of it.
Rounding moves a corner by half a step along either axis, which moves the plane at a pixel by at most a step of its steeper slope.
"""

CountMode = Literal["z_pass", "z_fail", "faces", "seen"]
"""How faces change the stencil.

The pixel's point is the one whose depth is in the framebuffer.

- ``z_pass``: in front of the pixel's point, front faces add one and back faces subtract one.
- ``z_fail``: at or behind the pixel's point, front faces subtract one and back faces add one.
- ``faces``: each face that is not behind the pixel's point adds one, up to 255.
- ``seen``: a face that is not behind the pixel's point sets the stencil to 255.
"""

FaceSide = Literal["both", "front", "back"]
"""The faces that are drawn: all, front faces or back faces."""


class Stencil:
    """Stencil passes of a device.

    Parameters
    ----------
    ctx
        The device's context.
    require_current, check
        The device's methods of these names.
    bind_idle_target
        Function that binds another framebuffer, before the current one is released.
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        require_current: Callable[[], None],
        check: Callable[[str], None],
        bind_idle_target: Callable[[], None],
    ) -> None:
        self._ctx, self._require_current, self._check, self._bind_idle_target = ctx, require_current, check, bind_idle_target
        self._targets: Cache[tuple[moderngl.Framebuffer, int]] = Cache(
            "skugga.terrain.gl.stencil",
            "process",
            STENCIL_CACHE_BYTES,
            lambda entry: STENCIL_PIXEL_BYTES * entry[0].width * entry[0].height,
            self._release_target,
        )

    def target(self, width: int, height: int) -> moderngl.Framebuffer:
        """Return a framebuffer with float depth and eight-bit stencil, both cleared to 0. Depth 0 is infinity.

        Recently used framebuffers are cached, one for each size.
        """
        from OpenGL import GL

        self._require_current()
        entry = self._targets.get(width, height)
        if not isinstance(entry, Missing):
            target = entry[0]
        else:
            target = self._ctx.framebuffer([self._ctx.renderbuffer((width, height), 1)])  # moderngl requires a colour
            target.color_mask, target.depth_mask = (False,) * 4, True  # moderngl knows no depth attachment: enable it
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

    def _release_target(self, entry: tuple[moderngl.Framebuffer, int]) -> None:
        """Release a framebuffer with its attachments. ``entry`` is the framebuffer and OpenGL's number of its renderbuffer."""
        from OpenGL import GL

        target, storage = entry
        self._bind_idle_target()  # moderngl rebinds the current framebuffer, even a released one
        for item in (target, *target.color_attachments):
            item.release()
        GL.glDeleteRenderbuffers(1, [storage])

    def clear(self, target: moderngl.Framebuffer, bits: int = 0xFF) -> None:
        """Set the stencil bits in the mask ``bits`` to 0 in all pixels of a framebuffer."""
        from OpenGL import GL

        self._require_current()
        target.use()
        GL.glStencilMask(bits)
        GL.glClearBufferiv(GL.GL_STENCIL, 0, [0])
        GL.glStencilMask(0xFF)

    @contextmanager
    def increment_once_pass(self, target: moderngl.Framebuffer, stencil_value: int, clip_distances: int = 0) -> Iterator[None]:
        """Set the state of a pass that increments the stencil once where it is ``stencil_value``, without depth test.

        Further fragments of a pixel do not increment its stencil again. ``clip_distances`` is the number of clip distances that the
        vertex shaders write.
        """
        with self._stencil_test(target, depth=False):
            from OpenGL import GL

            GL.glStencilFunc(GL.GL_EQUAL, stencil_value, 0xFF)
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
        """Set the state of a pass that sets the stencil of all drawn pixels to ``MARK_BIT``, without depth test."""
        with self._stencil_test(target, depth=False):
            from OpenGL import GL

            GL.glStencilFunc(GL.GL_ALWAYS, MARK_BIT, 0xFF)
            GL.glStencilOp(GL.GL_KEEP, GL.GL_KEEP, GL.GL_REPLACE)
            yield

    @contextmanager
    def depth_pass(self, target: moderngl.Framebuffer, overwrite: bool = False) -> Iterator[None]:
        """Set the state of a pass that writes depths and no stencil.

        In each pixel the nearest depth wins, or with ``overwrite`` the one that is drawn last.
        """
        from OpenGL import GL

        self._require_current()
        target.use()
        self._ctx.enable_only(moderngl.DEPTH_TEST)
        self._ctx.depth_func = "1" if overwrite else ">"
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
        counting: CountMode,
        side: FaceSide = "both",
        marked_only: bool = False,
        clamp_depth: bool = False,
        offset_steps: float = 0.0,
    ) -> Iterator[None]:
        """Set the state of a pass that counts faces against the depths in the framebuffer, without writing depths.

        Front faces wind clockwise.

        Parameters
        ----------
        target
            The framebuffer.
        counting
            How faces change the stencil.
        side
            The faces to draw.
        marked_only
            Whether only marked pixels count.
        clamp_depth
            Whether to clamp depths instead of clipping at the near and far planes.
        offset_steps
            Depth offset away from the eye in float32 depth steps, besides ``SLOPE_OFFSET_STEPS``.
        """
        with self._stencil_test(target, depth=True):
            from OpenGL import GL

            target.depth_mask = False
            GL.glClipControl(_LOWER_LEFT, _ZERO_TO_ONE)
            GL.glStencilFunc(*((GL.GL_EQUAL, MARK_BIT, MARK_BIT) if marked_only else (GL.GL_ALWAYS, 0xFF, 0xFF)))
            GL.glStencilMask(0x7F if marked_only else 0xFF)
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
            self._ctx.polygon_offset = -SLOPE_OFFSET_STEPS / 256.0, -offset_steps
            self._ctx.front_face = "cw"
            if side != "both":
                self._ctx.cull_face = "back" if side == "front" else "front"
                self._ctx.enable(moderngl.CULL_FACE)
            if clamp_depth:
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
        """Read a stencil as uint8 (rows, cols). Row 0 is the first texel row. Raises ``GraphicsError`` as ``Device.read`` does."""
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
    def _stencil_test(self, target: moderngl.Framebuffer, depth: bool) -> Iterator[None]:
        """Enable the stencil test within the block, with the depth test if ``depth``. All tests are disabled after it."""
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
