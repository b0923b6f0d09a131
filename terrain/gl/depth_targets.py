"""The depth targets of a device: framebuffers for reuse, and some whose content is kept until it is asked for again."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass

from moderngl import Framebuffer

from skugga.terrain.cache import register_cache

MAX_TARGETS, MAX_TARGET_BYTES = 16, 2**28
"""So many are held, of so many bytes together: the two used last at any size, those used before them while there is room."""


@dataclass(eq=False)
class _Target:
    framebuffer: Framebuffer
    shape: tuple[int, int, int]
    content: Hashable | None = None


class DepthTargets:
    """Depth-only framebuffers by shape (width, height, bits) or by what is drawn in them, the ones used last."""

    def __init__(self, make: Callable[[int, int, int], Framebuffer], release: Callable[[Framebuffer], None]) -> None:
        self._make, self._release = make, release
        self.name, self.lifetime, self.limit_bytes = "skugga.terrain.gl.depth_targets", "light", MAX_TARGET_BYTES
        self._held: list[_Target] = []  # the one used last at the end
        register_cache(self)

    def __len__(self) -> int:
        """How many contents are kept."""
        return sum(each.content is not None for each in self._held)

    @property
    def count(self) -> int:
        """How many are held, whether or not their content is."""
        return len(self._held)

    @property
    def nbytes(self) -> int:
        """Bytes of the texels of all that are held."""
        return sum(depth_bytes(*each.shape) for each in self._held)

    def take(self, width: int, height: int, bits: int) -> Framebuffer:
        """One to draw in, whose content lasts until the next one of its shape is taken, or, if it is kept, while there is room: it
        is there for sure until the one after the next is taken.
        """
        shape = width, height, bits
        alike = [each for each in self._held if each.shape == shape]
        found = next((each for each in alike if each.content is None), None)
        if found is None:
            self._make_room(shape, [each for each in self._held[:-1] if each.content is None])
            if not self._has_room(shape):
                # The oldest of the shape, before older ones of others: to make one costs more than to draw again what was in it.
                found = next((each for each in alike if each is not self._held[-1]), None)
        if found is None:
            self._make_room(shape, self._held[:-1])
        else:
            self._held.remove(found)
        framebuffer = self._make(*shape) if found is None else found.framebuffer
        self._held.append(_Target(framebuffer, shape))
        return framebuffer

    def keep(self, framebuffer: Framebuffer, content: Hashable) -> None:
        """Say what is drawn in one, so that it can be found again while there is room."""
        for each in self._held:
            if each.framebuffer is framebuffer:
                each.content = content

    def kept(self, content: Hashable) -> Framebuffer | None:
        """The one with a content, if it is still there."""
        found = next((each for each in self._held if each.content is not None and each.content == content), None)
        if found is None:
            return None
        self._held.remove(found)
        self._held.append(found)
        return found.framebuffer

    def clear(self) -> None:
        """Forget what is drawn in them, so that everything is drawn anew; the framebuffers stay for reuse."""
        for each in self._held:
            each.content = None

    def clear_of(self, owner: object) -> None:
        """Forget all, whatever it was drawn for: that costs other scenes no more than one drawing."""
        self.clear()

    def _make_room(self, shape: tuple[int, int, int], spare: list[_Target]) -> None:
        """Let go of targets, in their order, until there is room for another one."""
        for each in spare:
            if self._has_room(shape):
                return
            self._held.remove(each)
            self._release(each.framebuffer)

    def _has_room(self, shape: tuple[int, int, int]) -> bool:
        return self.count < MAX_TARGETS and self.nbytes + depth_bytes(*shape) <= MAX_TARGET_BYTES


def depth_bytes(width: int, height: int, bits: int) -> int:
    """Bytes of a depth target's texels."""
    return width * height * (2 if bits == 16 else 4)
