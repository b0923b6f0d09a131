"""Pool of a device's depth-only framebuffers, which also caches the depth maps drawn in them."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass

from moderngl import Framebuffer

from skugga.terrain.cache import register_cache

MAX_TARGETS, MAX_TARGET_BYTES = 16, 2**28
"""Limits of the pool: number of framebuffers, and bytes of all their texels.

The two most recently used framebuffers stay even if they exceed the limit.
"""


@dataclass(eq=False)
class _Target:
    """A framebuffer of the pool.

    Attributes
    ----------
    framebuffer
        The depth-only framebuffer.
    shape
        Width and height in texels, and bits of a depth.
    content
        Cache key of the depths drawn in it; ``None`` if they are not cached.
    """

    framebuffer: Framebuffer
    shape: tuple[int, int, int]
    content: Hashable | None = None


class DepthTargets:
    """LRU pool of depth-only framebuffers, looked up by shape (width, height, bits) or by cached content."""

    def __init__(self, make: Callable[[int, int, int], Framebuffer], release: Callable[[Framebuffer], None]) -> None:
        self._make, self._release = make, release
        self.name, self.lifetime, self.limit_bytes = "skugga.terrain.gl.depth_targets", "light", MAX_TARGET_BYTES
        self._targets: list[_Target] = []  # least recently used first
        register_cache(self)

    def __len__(self) -> int:
        """Return the number of cached contents."""
        return sum(target.content is not None for target in self._targets)

    @property
    def count(self) -> int:
        """Number of framebuffers in the pool, with or without cached content."""
        return len(self._targets)

    @property
    def nbytes(self) -> int:
        """Bytes of the texels of all framebuffers in the pool."""
        return sum(depth_bytes(*target.shape) for target in self._targets)

    def acquire(self, width: int, height: int, bits: int) -> Framebuffer:
        """Return a framebuffer of ``width`` x ``height`` texels with ``bits`` bits of depth, for drawing a depth map in it.

        Its content lasts until the next call for the same shape. Content that ``cache_content`` caches survives at least the next
        call of any shape, and longer while the pool has room.
        """
        shape = width, height, bits
        same_shape = [candidate for candidate in self._targets if candidate.shape == shape]
        target = next((candidate for candidate in same_shape if candidate.content is None), None)
        if target is None:
            self._make_room(shape, [candidate for candidate in self._targets[:-1] if candidate.content is None])
            if not self._has_room(shape):
                # Prefer the least recently used target of this shape to older ones of other shapes: allocating a framebuffer
                # costs more than redrawing its content.
                target = next((candidate for candidate in same_shape if candidate is not self._targets[-1]), None)
        if target is None:
            self._make_room(shape, self._targets[:-1])
        else:
            self._targets.remove(target)
        framebuffer = self._make(*shape) if target is None else target.framebuffer
        self._targets.append(_Target(framebuffer, shape))
        return framebuffer

    def cache_content(self, framebuffer: Framebuffer, content: Hashable) -> None:
        """Cache the content of a framebuffer under a key, while the pool has room."""
        for target in self._targets:
            if target.framebuffer is framebuffer:
                target.content = content

    def get(self, content: Hashable) -> Framebuffer | None:
        """Return the framebuffer with a cached content and mark it as used, or ``None`` if it was evicted."""
        target = next(
            (candidate for candidate in self._targets if candidate.content is not None and candidate.content == content), None
        )
        if target is None:
            return None
        self._targets.remove(target)
        self._targets.append(target)
        return target.framebuffer

    def clear(self) -> None:
        """Invalidate all cached contents. The framebuffers stay for reuse."""
        for target in self._targets:
            target.content = None

    def evict_computed_from(self, elevation: object) -> None:
        """Invalidate all cached contents, since their scenes are not recorded.

        Scenes over other elevations draw their depth maps again once.
        """
        self.clear()

    def _make_room(self, shape: tuple[int, int, int], evictable: list[_Target]) -> None:
        """Evict the given targets, in their order, until another one of a shape fits."""
        for target in evictable:
            if self._has_room(shape):
                return
            self._targets.remove(target)
            self._release(target.framebuffer)

    def _has_room(self, shape: tuple[int, int, int]) -> bool:
        """Return whether another framebuffer of a shape fits within the limits of the pool."""
        return self.count < MAX_TARGETS and self.nbytes + depth_bytes(*shape) <= MAX_TARGET_BYTES


def depth_bytes(width: int, height: int, bits: int) -> int:
    """Return the bytes of a depth target's texels."""
    return width * height * (2 if bits == 16 else 4)
