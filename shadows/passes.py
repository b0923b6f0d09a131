"""The record of what really ran: written by the passes themselves while they run, never copied from a plan."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class PassRecord:
    """One executed pass: its name, wall-clock milliseconds, draw calls, triangles, texels of shadow maps, and the bytes of
    textures and buffers it held at a time.
    """

    name: str
    ms: float = 0.0
    draws: int = 0
    triangles: int = 0
    map_texels: int = 0
    bytes: int = 0


@dataclass
class PassLog:
    """The passes of a frame in the order of their first run; blocks of one frame add up."""

    records: dict[str, PassRecord] = field(default_factory=dict)

    @contextmanager
    def run(self, name: str) -> Iterator[PassRecord]:
        """Time a pass and put it on record."""
        record = self.records.setdefault(name, PassRecord(name))
        start = time.perf_counter()
        try:
            yield record
        finally:
            record.ms += (time.perf_counter() - start) * 1000.0

    @property
    def names(self) -> list[str]:
        """Names of the passes that ran, in order."""
        return list(self.records)

    @staticmethod
    def named(light: str, kinds: tuple[str, ...], passes: tuple[str, ...]) -> list[str]:
        """The names of an algorithm's passes for a light and the kinds of casters it takes on together."""
        return [f"{light}/{'+'.join(kinds)}: {name}" for name in passes]
