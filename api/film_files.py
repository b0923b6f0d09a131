"""Film files: animated WebP, MP4 and PNG sequences.

Files are written atomically. A few frames are encoded in parallel.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from skugga.api.animated_webp import append_frame, encode_frame, frame_changes, write_header, write_riff_length
from skugga.api.png import encode_png
from skugga.terrain.atomic_files import atomic_folder, atomic_path
from skugga.terrain.errors import InputError, Problem

SEQUENCE_SUFFIX = ".png"
"""Suffix of a film that is a sequence of pictures, one file for each frame."""
FILM_SUFFIXES = ".webp", ".mp4"
"""Suffixes of films in one file."""
FILM_FORMATS_TEXT = "a film such as day.webp or day.mp4, or frames such as frames/%04d.png"

MAX_WEBP_SIDE_PX = 16383
"""Maximum side of a WebP picture in pixels."""

X264_CRF = "17"
"""Constant rate factor of x264, at which losses are hardly visible."""

MP4_TICKS_PER_S = 90_000
"""Time base of MP4 frames, ticks per second."""

_BT709_CODE = 1
"""BT.709's number in the tables of H.273: primaries, transfer and matrix."""

OnFrame = Callable[[int, int], None]
"""Callback with the number of frames written so far, and their total bytes."""
T = TypeVar("T")
R = TypeVar("R")

_FRAME_NUMBER_PATTERN = re.compile(r"%(?:0([1-9]))?d")


def check_film_path(path: Path, frame_count: int, size: tuple[int, int]) -> None:
    """Check the output path of a film of ``frame_count`` frames before any frame is drawn. ``size`` is (width, height) in pixels.

    Raises ``InputError`` for an unsuitable name or size, and for a missing encoder. Also raises it for a folder that contains
    higher-numbered frames of another film. Raises ``FileNotFoundError`` for a missing folder.
    """
    suffix, is_sequence = path.suffix.lower(), "%" in path.name
    if suffix not in (*FILM_SUFFIXES, SEQUENCE_SUFFIX):
        raise InputError("output", str(path), FILM_FORMATS_TEXT)
    if (suffix == SEQUENCE_SUFFIX or is_sequence) and (
        suffix != SEQUENCE_SUFFIX or len(_FRAME_NUMBER_PATTERN.findall(path.name)) != 1 or path.name.count("%") != 1
    ):
        raise InputError("output", str(path), f"a name with one number for {frame_count} frames, such as frames/%04d.png")
    if suffix == ".webp" and max(size) > MAX_WEBP_SIDE_PX:
        raise InputError("size", f"{size[0]}x{size[1]}", f"at most {MAX_WEBP_SIDE_PX} pixels a side in a .webp file")
    if suffix == ".mp4":
        _import_av()
    folder = path.parent if suffix in FILM_SUFFIXES else path.parent.parent
    if not folder.is_dir():
        raise FileNotFoundError(2, "folder not found", str(path))
    if is_sequence and (later_frames := _later_frames(path, frame_count)):
        raise InputError(
            "output",
            Problem(f"the folder of {path} has frames of a longer film: {later_frames[0]}"),
            "Remove them or use another folder",
        )


def film_files(path: Path, frame_count: int) -> list[Path]:
    """Return the files of a film: one, or one for each frame."""
    if path.suffix.lower() in FILM_SUFFIXES:
        return [path]
    return [path.with_name(path.name % number) for number in range(1, frame_count + 1)]


def write_film(
    path: Path, frames: Iterable[np.ndarray], frame_count: int, fps: float, lossless: bool = False, on_frame: OnFrame | None = None
) -> None:
    """Write a film, compressed on all cores.

    PNG is lossless, and WebP on request. MP4 is H.264 in limited-range BT.709 with 4:2:0 chroma subsampling. That needs even
    sides, so the last row or column of an odd side is repeated. An interrupted write leaves the previous file in place.

    Parameters
    ----------
    path
        File to write, or a pattern for the frames' names (``film_files``).
    frames
        Frames, uint8 (rows, cols, 3), consumed one after the other.
    frame_count
        Number of frames.
    fps
        Frames per second.
    lossless
        Whether WebP is lossless.
    on_frame
        Called as ``on_frame(written, bytes)`` with the number of frames written so far and their total size.

    Raises
    ------
    OSError
        The film cannot be written. The error has the path. Errors of ``frames`` pass through.
    """
    progress = _Progress(on_frame)
    if path.suffix.lower() == SEQUENCE_SUFFIX:
        with atomic_folder(path.parent) as folder:
            encoded = _map_in_order(encode_png, frames)
            for file, content in zip(film_files(path, frame_count), encoded, strict=True):
                (folder / file.name).write_bytes(content)
                progress.add(len(content))
        return
    with atomic_path(path) as part:
        if path.suffix.lower() == ".webp":
            _write_webp(part, frames, fps, lossless, progress)
        else:
            _write_mp4(part, frames, fps, progress)


class _Progress:
    """Counter of written frames and bytes."""

    def __init__(self, on_frame: OnFrame | None) -> None:
        self._on_frame, self._frames, self._bytes = on_frame, 0, 0

    def add(self, nbytes: int, frame_count: int = 1) -> None:
        """Add ``nbytes`` bytes of ``frame_count`` frames, and report the totals."""
        self._frames, self._bytes = self._frames + frame_count, self._bytes + nbytes
        if self._on_frame is not None:
            self._on_frame(self._frames, self._bytes)


def _map_in_order(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Yield the results of ``function`` for all items, in the items' order. About one item per core is in memory at a time."""
    from skugga.terrain.compiled import CORES

    with ThreadPoolExecutor(CORES, "skugga-encode") as threads:
        pending: deque[Future[R]] = deque()
        try:
            for item in items:
                pending.append(threads.submit(function, item))
                del item
                if len(pending) > CORES:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            threads.shutdown(cancel_futures=True)


def _write_webp(path: Path, frames: Iterable[np.ndarray], fps: float, lossless: bool, progress: _Progress) -> None:
    """Write the frames, uint8 (rows, cols, 3), as an animated WebP file."""
    with path.open("wb") as file:
        for change, content in _map_in_order(lambda change: (change, encode_frame(change, lossless)), frame_changes(frames, fps)):
            if file.tell() == 0:
                write_header(file, change.color.shape[1::-1])
            append_frame(file, content)
            progress.add(len(content), change.frame_count)
        write_riff_length(file)


def _write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float, progress: _Progress) -> None:
    """Write the frames, uint8 (rows, cols, 3), as an MP4 file. An odd number of rows or columns is padded by one."""
    av = _import_av()
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = None
        for number, color in enumerate(frames):
            color = np.pad(color, ((0, color.shape[0] % 2), (0, color.shape[1] % 2), (0, 0)), "edge")
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = color.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.options = {"crf": X264_CRF, "preset": "medium"}
                context = stream.codec_context
                context.color_primaries = context.color_trc = context.colorspace = context.color_range = _BT709_CODE
            frame = av.VideoFrame.from_ndarray(color, format="rgb24").reformat(format="yuv420p", dst_colorspace="ITU709")
            frame.pts = number
            _mux_packets(container, stream.encode(frame), progress)
        assert stream is not None
        _mux_packets(container, stream.encode(None), progress)


def _mux_packets(container: Any, packets: list[Any], progress: _Progress) -> None:
    """Write the packets of an encoder; each holds one frame. x264 buffers some dozens of frames before its first packet."""
    for packet in packets:
        size = packet.size  # muxing empties the packet
        container.mux(packet)
        progress.add(size)


def _later_frames(path: Path, frame_count: int) -> list[Path]:
    """Return the files in a film's folder that are numbered beyond the film's last frame."""
    prefix, suffix = _FRAME_NUMBER_PATTERN.split(path.name)[0], path.name[path.name.rindex("d", 0, -len(path.suffix)) + 1 :]
    pattern = re.compile(re.escape(prefix) + "([0-9]+)" + re.escape(suffix))
    matches = ((pattern.fullmatch(file.name), file) for file in path.parent.glob("*"))
    return sorted(
        file for match, file in matches if match and int(match[1]) > frame_count and file.name == path.name % int(match[1])
    )


def _import_av() -> Any:
    """Import and return PyAV. Raises ``InputError`` if it is not installed."""
    try:
        import av
    except ImportError:
        raise InputError(
            "output", Problem("this machine has no encoder of .mp4"), "Run pip install 'skugga[film]', or use a .webp file"
        ) from None
    return av
