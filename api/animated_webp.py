"""Animated WebP files from frames that are compressed independently, several at a time.

Pillow's animation encoder works frame by frame and compresses each frame several times. This module writes the container
(RFC 9649) itself, around the compressed frames. It stores only the rectangle in which a frame differs from the previous one.
Identical frames become one frame with a longer duration.
"""

from __future__ import annotations

import errno
import io
import os
import struct
from collections.abc import Iterable, Iterator
from typing import BinaryIO, NamedTuple

import numpy as np
from PIL import Image

LOSSY_QUALITY, LOSSY_METHOD = 80, 2
"""A sixth of the size of lossless animations. Shadow edges stay sharp; colours beside them bleed."""

LOSSLESS_EFFORT, LOSSLESS_METHOD = 50, 2
"""Effort of the lossless encoder. More effort takes longer and gains one per cent of size (docs/films.md)."""

MAX_RIFF_BYTES = 2**32 - 10
LONGEST_S = 2**24 // 2000
"""Longest duration of one stored frame, seconds: half of the 2^24 ms that the format allows."""

_ANIMATION, _KEEP_BLEND_OFF = 0x02, 0x02
_SMALLEST = 2
"""Sides of the rectangle, pixels, that is stored for an unchanged frame when the previous one has its longest duration."""


class Changes(NamedTuple):
    """The difference of a frame from the previous one.

    Attributes
    ----------
    row, col
        Top left pixel of the changed rectangle; both are even.
    color
        Colours of the rectangle, uint8 (rows, cols, 3).
    duration_ms
        Duration, milliseconds.
    frames
        Number of identical frames that this one replaces.
    """

    row: int
    col: int
    color: np.ndarray
    duration_ms: int
    frames: int


def changes(colors: Iterable[np.ndarray], fps: float) -> Iterator[Changes]:
    """Yield the changes of successive frames, uint8 (rows, cols, 3). Identical frames yield one."""
    last: np.ndarray | None = None
    place, first, number = (0, 0, np.zeros((0, 0, 3), np.uint8)), 0, 0
    for number, color in enumerate(colors):
        if last is None:
            place = 0, 0, color
        else:
            differ = (color != last).any(axis=-1)
            if not differ.any() and number - first < LONGEST_S * fps:
                continue
            yield Changes(*place, _ms(number, fps) - _ms(first, fps), number - first)
            place, first = _changed(color, differ), number
        last = color
    if last is not None:
        yield Changes(*place, _ms(number + 1, fps) - _ms(first, fps), number + 1 - first)


def _ms(number: int, fps: float) -> int:
    """Return the time at which a frame begins, milliseconds."""
    return round(1000.0 * number / fps)


def _changed(color: np.ndarray, differ: np.ndarray) -> tuple[int, int, np.ndarray]:
    rows, cols = np.flatnonzero(differ.any(axis=1)), np.flatnonzero(differ.any(axis=0))
    if not len(rows):
        return 0, 0, color[:_SMALLEST, :_SMALLEST]
    row, col = int(rows[0]) // 2 * 2, int(cols[0]) // 2 * 2
    return row, col, color[row : int(rows[-1]) + 1, col : int(cols[-1]) + 1]


def animation_frame(change: Changes, lossless: bool) -> bytes:
    """Return the ``ANMF`` chunk of a frame with its compressed colours."""
    out = io.BytesIO()
    options = (
        {"lossless": True, "quality": LOSSLESS_EFFORT, "method": LOSSLESS_METHOD}
        if lossless
        else {"quality": LOSSY_QUALITY, "method": LOSSY_METHOD}
    )
    Image.fromarray(np.ascontiguousarray(change.color)).save(out, "WEBP", **options)
    rows, cols = change.color.shape[:2]
    head = b"".join(_three(value) for value in (change.col // 2, change.row // 2, cols - 1, rows - 1, change.duration_ms))
    return _chunk(b"ANMF", head + bytes([_KEEP_BLEND_OFF]) + b"".join(_compressed(out.getvalue())))


def _compressed(content: bytes) -> Iterator[bytes]:
    """Yield the chunks of a WebP file that hold its colours."""
    at = 12
    while at < len(content):
        name, size = content[at : at + 4], int.from_bytes(content[at + 4 : at + 8], "little")
        end = at + 8 + size + size % 2
        if name in (b"VP8 ", b"VP8L"):
            yield content[at:end]
        at = end


def write_head(file: BinaryIO, size: tuple[int, int]) -> None:
    """Write the header of an endlessly repeated animation of ``size`` (width, height). ``write_length`` completes it."""
    width, height = size
    extended = bytes([_ANIMATION, 0, 0, 0]) + _three(width - 1) + _three(height - 1)
    file.write(b"RIFF\0\0\0\0WEBP" + _chunk(b"VP8X", extended) + _chunk(b"ANIM", struct.pack("<IH", 0xFFFFFFFF, 0)))


def add_frame(file: BinaryIO, frame: bytes) -> None:
    """Append the chunk of a frame. Raises ``OSError`` if the file would be longer than WebP allows."""
    if file.tell() + len(frame) > MAX_RIFF_BYTES:
        raise OSError(errno.EFBIG, f"{os.strerror(errno.EFBIG)} for WebP, whose limit is 4 GB")
    file.write(frame)


def write_length(file: BinaryIO) -> None:
    """Write the file's length into the header, as the last step."""
    end = file.tell()
    file.seek(4)
    file.write(struct.pack("<I", end - 8))
    file.seek(end)


def _chunk(name: bytes, content: bytes) -> bytes:
    return name + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2)


def _three(value: int) -> bytes:
    return value.to_bytes(3, "little")
