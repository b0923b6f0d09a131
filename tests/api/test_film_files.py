"""Film files: their content, the memory they take, and the files left by a film that ends early."""

from __future__ import annotations

import os
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from skugga.api import animated_webp
from skugga.api.animated_webp import frame_changes
from skugga.api.film_files import check_film_path, film_files, write_film
from skugga.terrain.compiled import CORES
from skugga.terrain.errors import InputError

FPS = 20.0
FILMS = "film.webp", "film.mp4", "frames/%03d.png"


def pictures(count: int, rows: int = 30, cols: int = 44) -> list[np.ndarray]:
    """Return smooth ground with a moving shadow and noise of one step. Every third picture repeats the previous one."""
    rng, frames = np.random.default_rng(7), []
    ground = np.linspace(40, 220, cols)[None, :, None] * np.array([0.8, 1.0, 0.6]) * np.linspace(0.7, 1.0, rows)[:, None, None]
    for number in range(count):
        picture = ground.copy()
        picture[:, 2 * number : 2 * number + 9] *= 0.4
        frames.append(np.clip(picture + rng.integers(0, 2, picture.shape), 0, 255).astype(np.uint8))
        if number % 3 == 2:
            frames[number] = frames[number - 1]
    return frames


def frames_of_webp(path: Path) -> Iterator[np.ndarray]:
    """Yield the pictures of an animated WebP. The encoder merges equal pictures into one of longer duration."""
    with Image.open(path) as film:
        for number in range(film.n_frames):
            film.seek(number)
            picture = np.asarray(film.convert("RGB"))
            for _ in range(round(film.info["duration"] * FPS / 1000.0)):
                yield picture


def list_files(folder: Path) -> list[str]:
    """Return the paths of all files below a folder, relative to it."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize(("rows", "cols"), [(30, 44), (31, 45)])
def test_lossless_webp_keeps_every_pixel(tmp_path, rows, cols):
    source_frames = pictures(9, rows, cols)
    write_film(tmp_path / "film.webp", iter(source_frames), 9, FPS, lossless=True)
    decoded_frames = list(frames_of_webp(tmp_path / "film.webp"))
    assert len(decoded_frames) == 9 and all(
        (decoded_frame == source_frame).all() for decoded_frame, source_frame in zip(decoded_frames, source_frames, strict=True)
    )
    with Image.open(tmp_path / "film.webp") as film:
        assert film.info["loop"] == 0 and film.mode in ("RGB", "RGBX", "RGBA")
    assert list_files(tmp_path) == ["film.webp"]


def test_lossy_webp_is_small_and_similar(tmp_path):
    """A picture of shaded ground takes at most a third of the lossless size, and differs little."""
    rng = np.random.default_rng(3)
    rough = np.cumsum(np.cumsum(rng.normal(size=(120, 160)), axis=0), axis=1)
    shade = np.clip(128.0 + 40.0 * np.gradient(rough, axis=1) / np.gradient(rough, axis=1).std(), 0, 255)
    source_frames = [np.clip(shade[..., None] * np.array([0.9, 1.0, 0.8]) + number, 0, 255).astype(np.uint8) for number in range(4)]
    for lossless in (False, True):
        write_film(tmp_path / f"{lossless}.webp", iter(source_frames), 4, FPS, lossless)
    lossy_bytes, lossless_bytes = ((tmp_path / f"{lossless}.webp").stat().st_size for lossless in (False, True))
    assert lossy_bytes < lossless_bytes / 3
    for decoded_frame, source_frame in zip(frames_of_webp(tmp_path / "False.webp"), source_frames, strict=True):
        assert np.abs(decoded_frame.astype(int) - source_frame).mean() < 6.0


def test_a_webp_frame_holds_only_the_changed_rectangle():
    """The rectangle begins at an even row and column. Equal frames become one of longer duration."""
    first = np.zeros((20, 30, 3), np.uint8)
    other = first.copy()
    other[7:9, 11:16] = 200
    changes = list(frame_changes(iter([first, first, other, other, other, first]), 10.0))
    assert [(change.row, change.col, change.color.shape[:2]) for change in changes] == [
        (0, 0, (20, 30)),
        (6, 10, (3, 6)),
        (6, 10, (3, 6)),
    ]
    assert [(change.duration_ms, change.frame_count) for change in changes] == [(200, 2), (300, 3), (100, 1)]
    assert (changes[1].color == other[6:9, 10:16]).all()


def test_a_film_reports_its_size_while_it_is_written(tmp_path):
    for name in FILMS:
        progress: list[tuple[int, int]] = []
        write_film(tmp_path / name, iter(pictures(9)), 9, FPS, on_frame=lambda *update, progress=progress: progress.append(update))
        files = [path for path in film_files(tmp_path / name, 9) if path.exists()]
        assert progress == sorted(progress) and progress[-1][0] == 9
        assert 0.5 < progress[-1][1] / sum(path.stat().st_size for path in files) <= 1.0


def test_webp_larger_than_its_container_is_an_error(monkeypatch, tmp_path):
    monkeypatch.setattr(animated_webp, "MAX_RIFF_BYTES", 500)
    with pytest.raises(OSError, match="too large for WebP, whose limit is 4 GB") as caught:
        write_film(tmp_path / "film.webp", iter(pictures(9)), 9, FPS)
    assert caught.value.filename == str(tmp_path / "film.webp") and list_files(tmp_path) == []


def test_webp_durations_round_without_drift(tmp_path):
    write_film(tmp_path / "film.webp", iter(pictures(31)), 31, 30.0)
    with Image.open(tmp_path / "film.webp") as film:
        total = 0
        for number in range(film.n_frames):
            film.seek(number)
            film.load()
            total += film.info["duration"]
    assert total == pytest.approx(31 / 30.0 * 1000.0, abs=1.0)


def test_a_film_may_have_one_frame(tmp_path):
    (source_frame,) = pictures(1)
    for name in FILMS:
        write_film(tmp_path / name, iter([source_frame]), 1, FPS)
    with Image.open(tmp_path / "film.webp") as film:
        assert np.abs(np.asarray(film.convert("RGB")).astype(int) - source_frame).mean() < 6.0
    assert (np.asarray(Image.open(tmp_path / "frames/001.png")) == source_frame).all()
    assert len(decoded_frames_of(tmp_path / "film.mp4")) == 1


def test_png_frames_keep_every_pixel(tmp_path):
    source_frames = pictures(4, 31, 45)
    write_film(tmp_path / "frames/%03d.png", iter(source_frames), 4, FPS)
    assert list_files(tmp_path) == ["frames", *(f"frames/00{n}.png" for n in range(1, 5))]
    for number, picture in enumerate(source_frames, start=1):
        assert (np.asarray(Image.open(tmp_path / f"frames/00{number}.png")) == picture).all()


def decoded_frames_of(path: Path) -> list:
    """Return the frames of a video file."""
    import av

    with av.open(str(path)) as container:
        return list(container.decode(video=0))


def test_mp4_has_the_format_that_browsers_play(tmp_path):
    """The stream is H.264, 4:2:0, with even sides, tagged and encoded as BT.709 of limited range. Flat colours survive,
    also in the last row.
    """
    import av

    colors = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (200, 60, 30), (128, 128, 128), (255, 255, 255), (0, 0, 0), (30, 90, 200)]
    source_frame = np.repeat(np.array([*colors, colors[-1]], np.uint8), [20] * 8 + [1], axis=0)[None].repeat(121, axis=0)
    write_film(tmp_path / "film.mp4", iter([source_frame] * 5), 5, FPS)
    with av.open(str(tmp_path / "film.mp4")) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, stream.pix_fmt, stream.width, stream.height) == ("h264", "yuv420p", 162, 122)
        assert (context.color_primaries, context.color_trc, context.colorspace, context.color_range) == (1, 1, 1, 1)
        assert stream.average_rate == 20 and float(stream.duration * stream.time_base) == pytest.approx(5 / FPS)
    frames = decoded_frames_of(tmp_path / "film.mp4")
    assert len(frames) == 5
    decoded_frame = frames[-1].reformat(format="rgb24", src_colorspace="ITU709").to_ndarray()
    for number, color in enumerate(colors):
        assert np.abs(decoded_frame[60, 20 * number + 10].astype(int) - color).max() <= 3
    assert np.abs(decoded_frame[121, 161].astype(int) - colors[-1]).max() <= 3
    content = (tmp_path / "film.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")  # browsers need the index before the data


@pytest.mark.parametrize("name", FILMS)
def test_at_most_a_frame_for_each_core_is_in_memory(tmp_path, name):
    references: list[weakref.ref[np.ndarray]] = []
    max_count = 0

    def generate_frames() -> Iterator[np.ndarray]:
        nonlocal max_count
        for number in range(30):
            picture = np.full((30, 44, 3), number, np.uint8)
            references.append(weakref.ref(picture))
            yield picture
            del picture
            max_count = max(max_count, sum(reference() is not None for reference in references))

    write_film(tmp_path / name, generate_frames(), 30, FPS)
    assert len(references) == 30 and max_count <= CORES + 3


class StopError(Exception):
    """Raised by a test to stop the writing of a film."""

    pass


@pytest.mark.parametrize("name", FILMS)
@pytest.mark.parametrize("error", [StopError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("has_old_files", [True, False])
def test_a_film_that_fails_keeps_the_old_files(tmp_path, name, error, has_old_files):
    if has_old_files:
        write_film(tmp_path / name, iter(pictures(5)[::-1]), 5, FPS)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    def frames_until_error() -> Iterator[np.ndarray]:
        yield from pictures(3)
        raise error

    with pytest.raises(error):
        write_film(tmp_path / name, frames_until_error(), 5, FPS)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert not [path for path in tmp_path.rglob(".*")]


@pytest.mark.parametrize("name", FILMS)
def test_a_full_disk_error_names_the_film(tmp_path, name, full_disk):
    with full_disk(1500), pytest.raises(OSError, match="large|space") as caught:
        write_film(tmp_path / name, iter([*pictures(20, 90, 120)]), 20, FPS)
    assert str(caught.value.filename) in (str(tmp_path / name), str((tmp_path / name).parent))
    assert list_files(tmp_path) == []


@pytest.mark.parametrize("name", ["film.webp", "film.mp4"])
def test_a_full_device_is_an_error(tmp_path, name):
    (tmp_path / name).symlink_to("/dev/full")
    with pytest.raises(OSError, match="space"):
        write_film(tmp_path / name, iter(pictures(5)), 5, FPS)
    assert os.readlink(tmp_path / name) == "/dev/full" and list_files(tmp_path) == [name]


@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        ("film.gif", "day.webp"),
        ("film", "day.webp"),
        ("film.png", "a name with one number for 5 frames, such as frames/%04d.png"),
        ("film%04d.webp", "frames/%04d.png"),
        ("film%s.png", "frames/%04d.png"),
        ("film%d_%d.png", "frames/%04d.png"),
        ("100%_%04d.png", "frames/%04d.png"),
        ("film%-4d.png", "frames/%04d.png"),
    ],
)
def test_invalid_film_names_are_refused(tmp_path, name, allowed):
    with pytest.raises(InputError) as caught:
        check_film_path(tmp_path / name, 5, (40, 30))
    assert caught.value.name == "output" and allowed in caught.value.allowed


def test_valid_film_names_are_accepted(tmp_path):
    for name in ("a.webp", "A.MP4", "%d.png", "a%04d b.PNG", "new/%02d.png"):
        check_film_path(tmp_path / name, 5, (40, 30))
    assert [path.name for path in film_files(tmp_path / "a%02d.png", 3)] == ["a01.png", "a02.png", "a03.png"]


@pytest.mark.parametrize("name", ["nowhere/film.webp", "no/where/%d.png"])
def test_a_missing_folder_is_an_error(tmp_path, name):
    with pytest.raises(FileNotFoundError):
        check_film_path(tmp_path / name, 5, (40, 30))


def test_frames_of_an_older_longer_film_are_refused(tmp_path):
    write_film(tmp_path / "frames/%03d.png", iter(pictures(4)), 4, FPS)
    (tmp_path / "frames/notes.png").write_bytes(b"mine")
    check_film_path(tmp_path / "frames/%03d.png", 4, (40, 30))
    with pytest.raises(InputError, match="the folder of .* has frames of a longer film: .*003.png. Remove them"):
        check_film_path(tmp_path / "frames/%03d.png", 2, (40, 30))
    write_film(tmp_path / "frames/%03d.png", iter(pictures(4)[::-1]), 4, FPS)
    assert (np.asarray(Image.open(tmp_path / "frames/001.png")) == pictures(4)[3]).all()
    assert (tmp_path / "frames/notes.png").read_bytes() == b"mine"


def test_a_missing_encoder_is_an_error_with_a_remedy(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError) as caught:
        check_film_path(tmp_path / "film.mp4", 5, (40, 30))
    assert str(caught.value) == "output: this machine has no encoder of .mp4. Run pip install 'skugga[film]', or use a .webp file."


def test_pictures_too_large_for_webp_are_refused(tmp_path):
    with pytest.raises(InputError, match="at most 16383 pixels a side"):
        check_film_path(tmp_path / "film.webp", 5, (16384, 30))
