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
"""Quality and effort of the lossy encoder. Files have a sixth of the size of lossless ones. Shadow edges stay sharp; colours beside
them bleed."""

LOSSLESS_EFFORT, LOSSLESS_METHOD = 50, 2
"""Effort of the lossless encoder. More effort takes longer and gains one per cent of size (docs/films.md)."""

MAX_RIFF_BYTES = 2**32 - 10
"""Maximum length in bytes that the header of a WebP file may state."""
MAX_FRAME_DURATION_S = 2**24 // 2000
"""Longest duration of one stored frame, seconds: half of the 2^24 ms that the format allows."""

_ANIMATION_FLAG, _NO_BLENDING_FLAG = 0x02, 0x02
"""Bit of the header's flags for an animation, and bit of a frame's flags for colours that replace the previous ones."""
_UNCHANGED_RECTANGLE_SIDE_PX = 2
"""Sides of the rectangle, pixels, that is stored for an unchanged frame when the previous one has its longest duration."""


class FrameChange(NamedTuple):
    """The difference of a frame from the previous one.

    Attributes
    ----------
    row, col
        Top left pixel of the changed rectangle; both are even.
    color
        Colours of the rectangle, uint8 (rows, cols, 3).
    duration_ms
        Duration, milliseconds.
    frame_count
        Number of identical frames that this one replaces.
    """

    row: int
    col: int
    color: np.ndarray
    duration_ms: int
    frame_count: int


def frame_changes(frames: Iterable[np.ndarray], fps: float) -> Iterator[FrameChange]:
    """Yield the changes of successive frames, uint8 (rows, cols, 3), at ``fps`` frames per second. Identical frames yield one."""
    previous: np.ndarray | None = None
    rectangle, first, number = (0, 0, np.zeros((0, 0, 3), np.uint8)), 0, 0
    for number, color in enumerate(frames):
        if previous is None:
            rectangle = 0, 0, color
        else:
            is_changed = (color != previous).any(axis=-1)
            if not is_changed.any() and number - first < MAX_FRAME_DURATION_S * fps:
                continue
            yield FrameChange(*rectangle, _frame_time_ms(number, fps) - _frame_time_ms(first, fps), number - first)
            rectangle, first = _changed_rectangle(color, is_changed), number
        previous = color
    if previous is not None:
        yield FrameChange(*rectangle, _frame_time_ms(number + 1, fps) - _frame_time_ms(first, fps), number + 1 - first)


def _frame_time_ms(frame_number: int, fps: float) -> int:
    """Return the time at which a frame begins, milliseconds after the first frame.

    ``frame_number`` counts frames from 0. ``fps`` is the number of frames per second.
    """
    return round(1000.0 * frame_number / fps)


def _changed_rectangle(color: np.ndarray, is_changed: np.ndarray) -> tuple[int, int, np.ndarray]:
    """Return the first row, the first column and the new colours of the rectangle that encloses all changed pixels of a frame.

    ``color`` is the frame, uint8 (rows, cols, 3). ``is_changed`` is bool (rows, cols). The returned row and column are even, as the
    format requires. The returned colours are uint8 (rows, cols, 3). Without a change the rectangle is a small one at the top left.
    """
    rows, cols = np.flatnonzero(is_changed.any(axis=1)), np.flatnonzero(is_changed.any(axis=0))
    if not len(rows):
        return 0, 0, color[:_UNCHANGED_RECTANGLE_SIDE_PX, :_UNCHANGED_RECTANGLE_SIDE_PX]
    row, col = int(rows[0]) // 2 * 2, int(cols[0]) // 2 * 2
    return row, col, color[row : int(rows[-1]) + 1, col : int(cols[-1]) + 1]


def encode_frame(change: FrameChange, lossless: bool) -> bytes:
    """Return the ``ANMF`` chunk of a frame with its compressed colours."""
    out = io.BytesIO()
    options = (
        {"lossless": True, "quality": LOSSLESS_EFFORT, "method": LOSSLESS_METHOD}
        if lossless
        else {"quality": LOSSY_QUALITY, "method": LOSSY_METHOD}
    )
    Image.fromarray(np.ascontiguousarray(change.color)).save(out, "WEBP", **options)
    rows, cols = change.color.shape[:2]
    header = b"".join(_uint24(value) for value in (change.col // 2, change.row // 2, cols - 1, rows - 1, change.duration_ms))
    return _chunk(b"ANMF", header + bytes([_NO_BLENDING_FLAG]) + b"".join(_color_chunks(out.getvalue())))


def _color_chunks(content: bytes) -> Iterator[bytes]:
    """Yield the chunks of a WebP file that hold its colours. ``content`` has the bytes of the file."""
    offset = 12
    while offset < len(content):
        name, size = content[offset : offset + 4], int.from_bytes(content[offset + 4 : offset + 8], "little")
        end = offset + 8 + size + size % 2
        if name in (b"VP8 ", b"VP8L"):
            yield content[offset:end]
        offset = end


def write_header(file: BinaryIO, size: tuple[int, int]) -> None:
    """Write the header of an endlessly repeated animation. ``write_riff_length`` completes it.

    ``size`` is (width, height) in pixels.
    """
    width, height = size
    extended = bytes([_ANIMATION_FLAG, 0, 0, 0]) + _uint24(width - 1) + _uint24(height - 1)
    file.write(b"RIFF\0\0\0\0WEBP" + _chunk(b"VP8X", extended) + _chunk(b"ANIM", struct.pack("<IH", 0xFFFFFFFF, 0)))


def append_frame(file: BinaryIO, frame_chunk: bytes) -> None:
    """Append the chunk of a frame (``encode_frame``). Raises ``OSError`` if the file would be longer than WebP allows."""
    if file.tell() + len(frame_chunk) > MAX_RIFF_BYTES:
        raise OSError(errno.EFBIG, f"{os.strerror(errno.EFBIG)} for WebP, whose limit is 4 GB")
    file.write(frame_chunk)


def write_riff_length(file: BinaryIO) -> None:
    """Write the file's length into the header, as the last step."""
    end = file.tell()
    file.seek(4)
    file.write(struct.pack("<I", end - 8))
    file.seek(end)


def _chunk(chunk_type: bytes, content: bytes) -> bytes:
    """Return a RIFF chunk: its four-byte type, the length of its content, and the content padded to an even length."""
    return chunk_type + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2)


def _uint24(value: int) -> bytes:
    """Return a whole number as three bytes, the least significant one first."""
    return value.to_bytes(3, "little")
