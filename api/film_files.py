"""Films as files: animated WebP, MP4, and sequences of PNG, each written whole or not at all, some frames at a time."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from skugga.api.animated_webp import add_frame, animation_frame, changes, write_head, write_length
from skugga.api.png import encode_png
from skugga.terrain.atomic_files import atomic_folder, atomic_path
from skugga.terrain.errors import InputError, Problem

SEQUENCE_SUFFIX = ".png"
FILM_SUFFIXES = ".webp", ".mp4"
FILM_WORDS = "a film: day.webp, day.mp4, or frames as frames/%04d.png"

MOST_WEBP_PX = 16383
"""A side of what WebP holds."""

MP4_QUALITY = "17"
"""x264's constant rate factor: what is lost is hardly seen."""

TICKS_PER_S = 90_000
"""Of the clock that frames of an MP4 are shown by."""

_BT709 = 1
"""In the tables of H.273: primaries, transfer and matrix."""

OnFrame = Callable[[int, int], None]
T = TypeVar("T")
R = TypeVar("R")

_NUMBER = re.compile(r"%(?:0([1-9]))?d")


def check_film_path(path: Path, frames: int, size: tuple[int, int]) -> None:
    """Look at where a film shall be written, before any frame is drawn; ``size`` is (width, height).

    Raises ``InputError`` for a name that no film can have, for frames of a longer film that would stay among these, and where the
    encoder is missing; ``FileNotFoundError`` where there is no folder.
    """
    suffix, is_sequence = path.suffix.lower(), "%" in path.name
    if suffix not in (*FILM_SUFFIXES, SEQUENCE_SUFFIX):
        raise InputError("output", str(path), FILM_WORDS)
    if (suffix == SEQUENCE_SUFFIX or is_sequence) and (
        suffix != SEQUENCE_SUFFIX or len(_NUMBER.findall(path.name)) != 1 or path.name.count("%") != 1
    ):
        raise InputError("output", str(path), f"a name with one number for {frames} frames, as frames/%04d.png")
    if suffix == ".webp" and max(size) > MOST_WEBP_PX:
        raise InputError("size", f"{size[0]}x{size[1]}", f"at most {MOST_WEBP_PX} a side in a .webp")
    if suffix == ".mp4":
        _av()
    folder = path.parent if suffix in FILM_SUFFIXES else path.parent.parent
    if not folder.is_dir():
        raise FileNotFoundError(2, "folder not found", str(path))
    if is_sequence and (longer := _later_frames(path, frames)):
        raise InputError("output", str(path), f"a folder without frames of a longer film: {longer[0]} is there")


def film_files(path: Path, frames: int) -> list[Path]:
    """The files of a film: one, or one for each frame."""
    if path.suffix.lower() in FILM_SUFFIXES:
        return [path]
    return [path.with_name(path.name % number) for number in range(1, frames + 1)]


def write_film(
    path: Path, colors: Iterable[np.ndarray], frames: int, fps: float, lossless: bool = False, on_frame: OnFrame | None = None
) -> None:
    """Write a film of ``frames`` pictures, uint8 (rows, cols, 3), which are taken one after the other, and compressed on all cores.

    PNG loses nothing, nor does WebP where it is to be ``lossless``. An MP4 is H.264 in BT.709 of limited range with halved chroma;
    since that takes even sides, the last row and the last column of odd ones are there twice. ``on_frame(written, bytes)`` is
    called with the frames that are written, and how large they are together. Whatever ends this early leaves what lay there before.

    Raises ``OSError`` with the path, and what ``colors`` raises.
    """
    count = _Count(on_frame)
    if path.suffix.lower() == SEQUENCE_SUFFIX:
        with atomic_folder(path.parent) as folder:
            encoded = _on_all_cores(encode_png, colors)
            for file, content in zip(film_files(path, frames), encoded, strict=True):
                (folder / file.name).write_bytes(content)
                count.add(len(content))
        return
    with atomic_path(path) as part:
        if path.suffix.lower() == ".webp":
            _write_webp(part, colors, fps, lossless, count)
        else:
            _write_mp4(part, colors, fps, count)


class _Count:
    """Frames and bytes that are written."""

    def __init__(self, on_frame: OnFrame | None) -> None:
        self._on_frame, self._frames, self._bytes = on_frame, 0, 0

    def add(self, content: int, frames: int = 1) -> None:
        """So many bytes more, of so many frames."""
        self._frames, self._bytes = self._frames + frames, self._bytes + content
        if self._on_frame is not None:
            self._on_frame(self._frames, self._bytes)


def _on_all_cores(work: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """What comes of each item in order; about as many as there are cores are worked on, and held, at a time."""
    from skugga.terrain.compiled import CORES

    with ThreadPoolExecutor(CORES, "skugga-encode") as threads:
        waiting: deque[Future[R]] = deque()
        try:
            for item in items:
                waiting.append(threads.submit(work, item))
                del item
                if len(waiting) > CORES:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            threads.shutdown(cancel_futures=True)


def _write_webp(path: Path, colors: Iterable[np.ndarray], fps: float, lossless: bool, count: _Count) -> None:
    with path.open("wb") as file:
        for change, content in _on_all_cores(lambda change: (change, animation_frame(change, lossless)), changes(colors, fps)):
            if file.tell() == 0:
                write_head(file, change.color.shape[1::-1])
            add_frame(file, content)
            count.add(len(content), change.frames)
        write_length(file)


def _write_mp4(path: Path, colors: Iterable[np.ndarray], fps: float, count: _Count) -> None:
    av = _av()
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = None
        for number, color in enumerate(colors):
            color = np.pad(color, ((0, color.shape[0] % 2), (0, color.shape[1] % 2), (0, 0)), "edge")
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = color.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.options = {"crf": MP4_QUALITY, "preset": "medium"}
                context = stream.codec_context
                context.color_primaries = context.color_trc = context.colorspace = context.color_range = _BT709
            frame = av.VideoFrame.from_ndarray(color, format="rgb24").reformat(format="yuv420p", dst_colorspace="ITU709")
            frame.pts = number
            _mux(container, stream.encode(frame), count)
        assert stream is not None
        _mux(container, stream.encode(None), count)


def _mux(container: Any, packets: list[Any], count: _Count) -> None:
    """Write packets, each of which is a frame. x264 looks at some dozens of frames before it gives the first one."""
    for packet in packets:
        size = packet.size  # what is muxed is taken away
        container.mux(packet)
        count.add(size)


def _later_frames(path: Path, frames: int) -> list[Path]:
    """Files of a sequence's folder that would be taken for frames after its last one."""
    before, after = _NUMBER.split(path.name)[0], path.name[path.name.rindex("d", 0, -len(path.suffix)) + 1 :]
    pattern = re.compile(re.escape(before) + "([0-9]+)" + re.escape(after))
    found = ((pattern.fullmatch(each.name), each) for each in path.parent.glob("*"))
    return sorted(each for match, each in found if match and int(match[1]) > frames and each.name == path.name % int(match[1]))


def _av() -> Any:
    """PyAV. Raises ``InputError`` where it is not installed."""
    try:
        import av
    except ImportError:
        raise InputError(
            "output", Problem("this machine has no encoder of .mp4"), "pip install 'skugga[film]', or a .webp"
        ) from None
    return av
