"""Cached pictures of trees: painted once and then read from disk, unless the code that paints them changes."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

from skugga.terrain.trees import cached_pictures as module
from skugga.terrain.trees.cached_pictures import cached_pictures
from skugga.terrain.trees.foliage import PAINTER_FILES

ROOT = Path(__file__).resolve().parents[3]


class Painter:
    """Paint pictures, and count the calls."""

    def __init__(self) -> None:
        self.times = 0

    def __call__(self) -> tuple[np.ndarray, ...]:
        self.times += 1
        return tuple(np.full((2, side, side, 4), 10 * side + self.times, np.uint8) for side in (8, 4))


@pytest.fixture
def source(tmp_path) -> Path:
    """File of a program that paints a picture."""
    path = tmp_path / "paint.py"
    path.write_text("green = 1", encoding="utf-8")
    return path


def test_cached_pictures_are_read(tmp_path, source):
    paint = Painter()
    first, second = (cached_pictures(paint, (source,), tmp_path / "kept") for _ in range(2))
    assert paint.times == 1 and len(second) == 2
    for picture, other_picture in zip(first, second, strict=True):
        assert other_picture.dtype == np.uint8
        np.testing.assert_array_equal(picture, other_picture)


def test_changed_code_or_packages_repaint_and_replace(tmp_path, source, monkeypatch):
    paint = Painter()
    cached_pictures(paint, (source,), tmp_path / "kept")
    source.write_text("green = 2", encoding="utf-8")
    cached_pictures(paint, (source,), tmp_path / "kept")
    assert paint.times == 2
    monkeypatch.setattr(module, "PACKAGE_VERSIONS", ("0.1", "0.2", "0.3"))
    cached_pictures(paint, (source,), tmp_path / "kept")
    assert paint.times == 3
    assert len(list((tmp_path / "kept").iterdir())) == 1


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[: len(content) // 2],
        lambda content: b"PK" * 99,
        lambda content: content[:400] + b"\xff\xfe\xfd" + content[403:],
    ],
)
def test_damaged_file_is_repainted(tmp_path, source, damage):
    paint = Painter()
    cached_pictures(paint, (source,), tmp_path / "kept")
    (path,) = (tmp_path / "kept").iterdir()
    path.write_bytes(damage(path.read_bytes()))
    repainted = cached_pictures(paint, (source,), tmp_path / "kept")
    assert paint.times == 2 and (repainted[0] == 82).all()
    cached_pictures(paint, (source,), tmp_path / "kept")
    assert paint.times == 2


def test_unwritable_folder_is_no_error(tmp_path, source):
    (tmp_path / "file").write_text("", encoding="utf-8")
    paint = Painter()
    assert len(cached_pictures(paint, (source,), tmp_path / "file" / "kept")) == 2
    assert paint.times == 1


def test_painter_files_include_all_imported_code():
    """Modules of the project that painters import are part of the cache key, except modules that cannot change a picture."""
    excluded_modules = {
        "skugga.terrain.cache",
        "skugga.terrain.compiled",
        "skugga.terrain.errors",
        "skugga.terrain.trees.cached_pictures",
    }
    files = {path.resolve() for path in PAINTER_FILES}
    assert len(files) == 3
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.ImportFrom)
                and node.module
                and node.module.startswith("skugga.terrain")
                and node.module not in excluded_modules
            ):
                assert (ROOT / f"{node.module.replace('.', '/')}.py").resolve() in files, node.module
