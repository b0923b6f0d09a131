"""The OpenGL device of a process: context, state, raw calls and read-back.

- A process has at most one context. The first call of ``device()`` creates it, and it stays current in that thread for the life of
  the process. moderngl holds the GIL in every call and never switches contexts, so further contexts or threads gain nothing.
- A read with the wrong context current returns stale process memory. So every read goes through ``Device.read``, which checks the
  context and reads into zeroed memory.
- moderngl lacks calls for 16-bit and float depth storage and for depth clamp. These raw calls are here and in
  ``skugga.terrain.gl.stencil``.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

os.environ.setdefault("PYOPENGL_PLATFORM", "egl")

import moderngl  # noqa: E402  (PyOpenGL and moderngl choose their platform on import)

from skugga.terrain.cache import KIB, MIB, Cache, Missing  # noqa: E402
from skugga.terrain.errors import GraphicsError, NoOpenGLError  # noqa: E402
from skugga.terrain.gl.depth_targets import DepthTargets  # noqa: E402
from skugga.terrain.gl.egl_devices import LIBEGL, NO_OPENGL_RENDERER, open_context  # noqa: E402
from skugga.terrain.gl.programs import describe_program, record_draw, specialize_shader  # noqa: E402
from skugga.terrain.gl.shader_cache import safe_shader_cache  # noqa: E402
from skugga.terrain.gl.stencil import Stencil  # noqa: E402

_DEPTH_CLAMP = 0x864F
_DEPTH_FORMATS = {16: 0x81A5, 24: 0x81A6, 32: 0x8CAC}  # GL_DEPTH_COMPONENT16, 24, 32F
_LOWER_LEFT, _NEGATIVE_ONE_TO_ONE, _ZERO_TO_ONE = 0x8CA1, 0x935E, 0x935F
_TEXTURE_2D_ARRAY = 0x8C1A
_TEXTURE_2D, _DEPTH_COMPONENT, _FLOAT = 0x0DE1, 0x1902, 0x1406
MAX_VISIBILITY_BUFFERS = 2
"""Visibility framebuffers in the pool: one for a view's pixels, and one for its supersamples."""

PROGRAM_BYTES = 64 * KIB
"""Estimated size of a compiled program."""


class Device:
    """The OpenGL context of the process, with the objects that live as long as it."""

    def __init__(self) -> None:
        self.ctx, self.egl_device = open_context()
        self.ctx.gc_mode = "auto"  # safe: one thread owns the context and all objects
        self._egl = ctypes.CDLL(LIBEGL)
        self._egl.eglGetCurrentContext.restype = ctypes.c_void_p
        self._context, self._thread = self._egl.eglGetCurrentContext(), threading.get_ident()
        info = self.ctx.info
        self.renderer, self.version = info["GL_RENDERER"], info["GL_VERSION"]
        self.max_size = int(info["GL_MAX_TEXTURE_SIZE"])
        _ = self.ctx.error  # clear errors: moderngl queries limits that a driver may not know
        self._programs: Cache[moderngl.Program] = Cache(
            "skugga.terrain.gl.device.programs", "process", 64 * MIB, lambda program: PROGRAM_BYTES, moderngl.Program.release
        )
        self.depth_targets = DepthTargets(
            self._make_depth_target, lambda target: self._release_target(target, target.depth_attachment)
        )
        self._float_target: moderngl.Framebuffer | None = None
        self._visibility_buffers: list[moderngl.Framebuffer] = []  # least recently used first
        self.stencil = Stencil(self.ctx, self.require_current, self.check, lambda: self._idle_target.use())
        self._read_memory: dict[np.dtype[Any], np.ndarray] = {}  # read-back memory by texel dtype
        self._texture_arrays: Cache[moderngl.TextureArray] = Cache(
            "skugga.terrain.gl.device.layers", "process", 256 * MIB, _layers_bytes, moderngl.TextureArray.release
        )
        self._idle_target = self.ctx.framebuffer([self.ctx.renderbuffer((1, 1))])
        self._quad = self.ctx.buffer(np.array([-1, -1, 3, -1, -1, 3], "f4"))

    def require_current(self) -> None:
        """Raise ``GraphicsError`` unless the context is current in this thread."""
        if threading.get_ident() != self._thread or self._egl.eglGetCurrentContext() != self._context:
            raise GraphicsError(
                "OpenGL: the context is not current in this thread. Use the device only in the process and thread that created it."
            )

    def check(self, operation: str) -> None:
        """Raise ``GraphicsError`` if an OpenGL call since the last check failed. The message names ``operation``."""
        error = self.ctx.error
        if error != "GL_NO_ERROR":
            raise GraphicsError(f"OpenGL: error {error} in {operation}.")

    def program(self, vertex: str, fragment: str, constants: dict[str, bool | int] | None = None) -> moderngl.Program:
        """Return the program of two shader sources, compiled once and cached.

        ``constants`` are uniforms of the fragment shader whose values are compiled in (specialization constants). A software
        rasteriser executes every branch and loop that depends on a uniform, so constants save time.

        Raises ``GraphicsError`` if a shader does not compile.
        """
        self.require_current()
        key = (vertex, fragment, tuple((constants or {}).items()))
        program = self._programs.get(*key)
        if isinstance(program, Missing):
            text, replacements = specialize_shader(fragment, constants or {})
            try:
                program = self.ctx.program(vertex_shader=vertex, fragment_shader=text)
            except moderngl.Error as error:
                _ = self.ctx.error  # clear the error of the failed program: it is reported here
                raise GraphicsError(f"OpenGL: a shader does not compile: {' '.join(str(error).split())}") from None
            program.extra = describe_program(program, (vertex, fragment), replacements)
            self._programs.put(*key, value=program)
        return program

    @property
    def programs(self) -> tuple[str, ...]:
        """Labels of all cached programs, in the cache's order (``skugga.terrain.gl.programs.LinkedProgram``)."""
        return tuple(program.extra.label for program in self._programs.values)

    def texture(self, array: np.ndarray) -> moderngl.Texture:
        """Return a float32 texture of an array (rows, cols) or (rows, cols, 1 to 4). Texel (col, row) is element (row, col)."""
        self.require_current()
        data = np.ascontiguousarray(array, np.float32)
        rows, cols = data.shape[:2]
        texture = self.ctx.texture((cols, rows), 1 if data.ndim == 2 else data.shape[2], data, dtype="f4", alignment=4)
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        return texture

    def depth_target(self, width: int, height: int, bits: int) -> moderngl.Framebuffer:
        """Return a depth-only framebuffer of 16, 24 (normalised) or 32 bits (float).

        Its texture has no depth comparison. The content lasts until the next call for the same shape, unless
        ``depth_targets.cache_content`` caches it.
        """
        self.require_current()
        return self.depth_targets.acquire(width, height, bits)

    def _make_depth_target(self, width: int, height: int, bits: int) -> moderngl.Framebuffer:
        """Return a new depth-only framebuffer of ``width`` x ``height`` texels with 16, 24 or 32 bits of depth."""
        target = self.ctx.framebuffer(depth_attachment=self._depth_texture(width, height, bits))
        self.check("depth_target")
        return target

    def _depth_texture(self, width: int, height: int, bits: int) -> moderngl.Texture:
        """Return a new depth texture, which shaders sample without filter and without depth comparison."""
        from OpenGL import GL

        texture = self.ctx.depth_texture((width, height))
        GL.glBindTexture(_TEXTURE_2D, texture.glo)
        GL.glTexImage2D(_TEXTURE_2D, 0, _DEPTH_FORMATS[bits], width, height, 0, _DEPTH_COMPONENT, _FLOAT, None)
        GL.glBindTexture(_TEXTURE_2D, 0)
        texture.compare_func = ""  # sample raw depths; the shader compares
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        return texture

    def float_target(self, width: int, height: int) -> moderngl.Framebuffer:
        """Return a one-channel float32 framebuffer. Calls for the same size reuse it, with its content."""
        self.require_current()
        if self._float_target is None or self._float_target.size != (width, height):
            if self._float_target is not None:
                self._release_target(self._float_target, self._float_target.color_attachments[0])
            self._float_target = self.ctx.framebuffer([self.ctx.texture((width, height), 1, dtype="f4")])
        return self._float_target

    @contextmanager
    def depth_pass(self, target: moderngl.Framebuffer, offset: tuple[float, float] = (0.0, 0.0)) -> Iterator[None]:
        """Set the state of a depth-only pass, in which the nearest depth wins, and clear the depths to 1 (far).

        Depth clamp draws geometry in front of the near plane at depth 0, instead of clipping it. ``offset`` moves depths away from
        the eye: factor of the slope, and units of the smallest depth step (glPolygonOffset).
        """
        self.require_current()
        target.use()
        target.clear(depth=1.0)
        self.ctx.enable_only(moderngl.DEPTH_TEST)
        self.ctx.depth_func = "<="
        self.ctx.polygon_offset = offset
        self.ctx.enable_direct(_DEPTH_CLAMP)
        try:
            yield
        finally:
            self.ctx.disable_direct(_DEPTH_CLAMP)
            self.ctx.polygon_offset = 0.0, 0.0
            self.ctx.enable_only(moderngl.NOTHING)

    @contextmanager
    def cull_front_faces(self, clockwise: bool) -> Iterator[None]:
        """Cull front faces within the block.

        Front faces wind clockwise in the picture if ``clockwise`` is set, otherwise counter-clockwise.
        """
        self.require_current()
        self.ctx.front_face, self.ctx.cull_face = "cw" if clockwise else "ccw", "front"
        self.ctx.enable(moderngl.CULL_FACE)
        try:
            yield
        finally:
            self.ctx.disable(moderngl.CULL_FACE)
            self.ctx.front_face, self.ctx.cull_face = "ccw", "back"

    def visibility_buffer_target(self, width: int, height: int) -> moderngl.Framebuffer:
        """Return a visibility framebuffer: uint32 primitive numbers, RGBA8 albedo and float32 depth.

        The last ``MAX_VISIBILITY_BUFFERS`` framebuffers are reused for views of the same size.
        """
        self.require_current()
        target = next((candidate for candidate in self._visibility_buffers if candidate.size == (width, height)), None)
        if target is not None:
            self._visibility_buffers.remove(target)
        else:
            while len(self._visibility_buffers) >= MAX_VISIBILITY_BUFFERS:
                old = self._visibility_buffers.pop(0)
                self._release_target(old, *old.color_attachments, old.depth_attachment)
            colors = [self.ctx.texture((width, height), 1, dtype="u4"), self.ctx.texture((width, height), 4)]
            target = self.ctx.framebuffer(colors, self._depth_texture(width, height, 32))
            self.check("visibility_buffer_target")
        self._visibility_buffers.append(target)
        return target

    @contextmanager
    def visibility_buffer_pass(self, target: moderngl.Framebuffer) -> Iterator[None]:
        """Set the state of a visibility pass, in which the nearest surface wins, and clear the framebuffer.

        Depth is reversed: it runs from 1 (near) to 0 (infinity). In float32 its relative resolution is the same at all distances.
        """
        from OpenGL import GL

        self.require_current()
        target.use()
        target.clear(0.0, 0.0, 0.0, 0.0, depth=0.0)
        GL.glClearBufferuiv(GL.GL_COLOR, 0, (0, 0, 0, 0))  # clear() leaves integer attachments to the driver
        self.ctx.enable_only(moderngl.DEPTH_TEST)
        self.ctx.depth_func = ">"
        GL.glClipControl(_LOWER_LEFT, _ZERO_TO_ONE)
        try:
            yield
        finally:
            GL.glClipControl(_LOWER_LEFT, _NEGATIVE_ONE_TO_ONE)
            self.ctx.depth_func = "<="
            self.ctx.enable_only(moderngl.NOTHING)

    def write_depths(self, target: moderngl.Framebuffer, depths: np.ndarray) -> None:
        """Write depths (rows, cols) float32 into a framebuffer of float depths. Row 0 is the first texel row."""
        self.require_current()
        texture = target.depth_attachment
        assert isinstance(texture, moderngl.Texture)
        texture.write(np.ascontiguousarray(depths, np.float32), alignment=4)
        target.use()

    def srgb_texture_array(self, mip_levels: tuple[np.ndarray, ...]) -> moderngl.TextureArray:
        """Return an sRGB texture array with the mip levels ``mip_levels``.

        Each mip level is uint8 (layers, side, side, 4) and has half the side of the previous one. Samplers decode sRGB to linear
        colours. A texture is cached as long as ``mip_levels[0]`` lives.
        """
        from OpenGL import GL

        self.require_current()
        texture = self._texture_arrays.get(mip_levels[0])
        if isinstance(texture, Missing):
            count, side = mip_levels[0].shape[:2]
            texture = self.ctx.texture_array((side, side, count), 4)
            GL.glBindTexture(_TEXTURE_2D_ARRAY, texture.glo)
            GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
            for level, data in enumerate(mip_levels):
                size = data.shape[1]
                GL.glTexImage3D(
                    _TEXTURE_2D_ARRAY, level, GL.GL_SRGB8_ALPHA8, size, size, count, 0, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE,
                    np.ascontiguousarray(data),
                )  # fmt: skip
            GL.glTexParameteri(_TEXTURE_2D_ARRAY, GL.GL_TEXTURE_MAX_LEVEL, len(mip_levels) - 1)
            GL.glBindTexture(_TEXTURE_2D_ARRAY, 0)
            texture.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
            texture.repeat_x = texture.repeat_y = False
            self.check("srgb_texture_array")
            self._texture_arrays.put(mip_levels[0], value=texture)
        return texture

    def render(
        self, array: moderngl.VertexArray, mode: int = moderngl.TRIANGLES, vertices: int = -1, first: int = 0, instances: int = -1
    ) -> None:
        """Make a draw call and record it with its program (one that ``program`` returned). No other code makes draw calls.

        ``vertices``, ``first`` and ``instances`` are those of ``moderngl.VertexArray.render``.
        """
        array.render(mode, vertices, first=first, instances=instances)
        record_draw(array.program.extra)

    def draw_triangles(
        self, program: moderngl.Program, vertices: np.ndarray, triangles: np.ndarray, first_primitive: int = 0
    ) -> int:
        """Draw triangles, indices (m, 3) of vertices (n, k) float32 (attribute ``position``), and return their number m.

        ``first_primitive`` is the number of triangles in earlier draws, for programs that have a uniform ``first``.
        """
        self.require_current()
        if not len(triangles):
            return 0
        if "first" in program:
            program["first"] = first_primitive
        with self.uploaded_mesh(program, vertices, triangles) as array:
            self.render(array)
        return len(triangles)

    @contextmanager
    def uploaded_mesh(self, program: moderngl.Program, vertices: np.ndarray, indices: np.ndarray) -> Iterator[moderngl.VertexArray]:
        """Upload vertices (n, k) float32 (attribute ``position``) and indices, for any number of ``render`` calls."""
        self.require_current()
        arrays = np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(indices, np.int32)
        buffers = [self.ctx.buffer(array) for array in arrays]
        layout = f"{vertices.shape[1]}f"
        array = self.ctx.vertex_array(program, [(buffers[0], layout, "position")], index_buffer=buffers[1])
        try:
            yield array
        finally:
            array.release()
            for buffer in buffers:
                buffer.release()

    def draw_instances(self, program: moderngl.Program, triangles: np.ndarray, instances: list[tuple[str, np.ndarray]]) -> int:
        """Draw triangles (m, 3) once per instance and return the number of triangles.

        Corners of ``triangles`` reach the shader as ``gl_VertexID``. ``instances`` are names and values (n, k) float32 of
        per-instance attributes; attributes that the program lacks are skipped.
        """
        self.require_current()
        count = len(instances[0][1])
        if not count:
            return 0
        buffers = [self.ctx.buffer(np.ascontiguousarray(data, np.float32)) for _, data in instances]
        content = [
            (buffer, f"{data.shape[1]}f/i", name)
            for buffer, (name, data) in zip(buffers, instances, strict=True)
            if name in program
        ]
        buffers.append(self.ctx.buffer(np.ascontiguousarray(triangles, np.int32)))
        array = self.ctx.vertex_array(program, content, index_buffer=buffers[-1])
        self.render(array, instances=count)
        array.release()
        for buffer in buffers:
            buffer.release()
        return count * len(triangles)

    def draw_grid_mesh(self, program: moderngl.Program, position: np.ndarray, triangles: np.ndarray) -> int:
        """Draw triangles between the nodes ``position`` (rows, cols, k) of a grid, and return the number of triangles.

        ``triangles`` (m, 3) are indices of nodes, counted row by row.
        """
        return self.draw_triangles(program, position.reshape(-1, position.shape[-1]), triangles)

    def draw_pixels(self, program: moderngl.Program, target: moderngl.Framebuffer) -> None:
        """Run a fragment shader once for each pixel of a framebuffer."""
        self.require_current()
        target.use()
        self.ctx.enable_only(moderngl.NOTHING)
        self.draw_quad(program)

    def draw_quad(self, program: moderngl.Program) -> None:
        """Run a fragment shader once for each pixel that passes the current depth, stencil and scissor tests."""
        array = self.ctx.vertex_array(program, [(self._quad, "2f", "corner")])
        self.render(array, vertices=3)
        array.release()

    def read(
        self,
        target: moderngl.Framebuffer,
        attachment: int = 0,
        texel_type: str = "f4",
        components: int = 1,
        size: tuple[int, int] | None = None,
        reuse_memory: bool = False,
    ) -> np.ndarray:
        """Read an attachment (-1: the depth) as an array (rows, cols) or (rows, cols, components). Row 0 is the first texel row.

        ``texel_type`` is ``f4`` for float32, ``u4`` for uint32, ``f1`` for bytes, ``u2`` for integer 16-bit depths. ``size``
        (width, height) limits the read to the first texels. With ``reuse_memory`` the array is the device's own memory, valid until
        the next such read: allocating memory for a large map costs more than reading it.

        Raises ``GraphicsError`` if the context is not current, so that a mistake never returns stale memory.
        """
        self.require_current()
        width, height = size or target.size
        shape = (height, width) if components == 1 else (height, width, components)
        texel = np.dtype({"f4": np.float32, "u4": np.uint32, "f1": np.uint8, "u2": np.uint16}[texel_type])
        out = self._reused_memory(texel, shape) if reuse_memory else np.zeros(shape, texel)
        window = 0, 0, width, height
        target.read_into(out, window, components=components, attachment=attachment, dtype=texel_type, alignment=out.itemsize)
        self.check("read")
        return out

    def _reused_memory(self, texel: np.dtype[Any], shape: tuple[int, ...]) -> np.ndarray:
        """Return zeroed memory of a shape, reused between reads of one dtype."""
        count = int(np.prod(shape))
        memory = self._read_memory.get(texel)
        if memory is None or memory.size < count:
            memory = self._read_memory[texel] = np.empty(count, texel)
        memory[:count] = 0
        return memory[:count].reshape(shape)

    def _release_target(self, target: moderngl.Framebuffer, *textures: moderngl.Texture | moderngl.Renderbuffer) -> None:
        """Release a framebuffer and its textures."""
        self._idle_target.use()  # moderngl rebinds the current framebuffer, even a released one
        target.release()
        for texture in textures:
            texture.release()


def _layers_bytes(texture: moderngl.TextureArray) -> int:
    """Return the bytes of a texture array with its mipmaps."""
    width, height, count = texture.size
    return 4 * width * height * count * 4 // 3


_device: Device | None = None
_no_opengl: NoOpenGLError | None = None


def device() -> Device:
    """Return the device of the process. The first call creates it, and its thread owns it.

    Raises ``NoOpenGLError`` if the machine has no OpenGL. A process that failed once does not try again, so that all its pictures
    are rendered alike. Raises ``InputError`` if the setting ``SKUGGA_EGL_DEVICE`` is wrong, and ``GraphicsError`` if the device
    that it names gives no context (``skugga.terrain.gl.egl_devices``).
    """
    global _device, _no_opengl
    if _no_opengl is not None:
        raise NoOpenGLError(str(_no_opengl))
    if _device is None:
        try:
            with safe_shader_cache():
                _device = Device()
        except NoOpenGLError as error:
            _no_opengl = error
            raise
    return _device


def renderer_and_version() -> tuple[str, str]:
    """Return OpenGL's renderer and version strings, or ``NO_OPENGL_RENDERER`` and an empty string without OpenGL."""
    try:
        return device().renderer, device().version
    except NoOpenGLError:
        return NO_OPENGL_RENDERER, ""


def egl_device_name() -> str:
    """Return a display name of the process's EGL device, or an empty string before one is created."""
    return "" if _device is None else f"EGL device {_device.egl_device}"


def is_device_open() -> bool:
    """Return whether the process has created its device."""
    return _device is not None
