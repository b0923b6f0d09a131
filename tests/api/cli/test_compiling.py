"""``skugga compile``: its message with and without missing loops."""

from __future__ import annotations

from pathlib import Path

import pytest

from skugga.api.cli import compiling
from skugga.api.cli.compiling import compile_everything, compile_for_command
from skugga.terrain.compiling import farm, loop_cache
from skugga.terrain.compiling.ahead_of_time import PRODUCTS
from skugga.terrain.compiling.loop_cache import loop_store
from skugga.terrain.errors import RenderError


@pytest.mark.parametrize(
    ("missing_loops", "expected_start"), [(7, "Compiled 7 loops in "), (0, "Nothing to compile: all loops are in ")]
)
def test_compile_reports_the_number_of_missing_loops(
    monkeypatch: pytest.MonkeyPatch, missing_loops: int, expected_start: str
) -> None:
    compiled_products = []

    def compile_ahead(products, processes, progress) -> None:
        compiled_products.append(tuple(products))
        for done in range(missing_loops + 1 if missing_loops else 0):
            progress("compiling loops for points", done, missing_loops)

    monkeypatch.setattr(compiling, "compile_ahead", compile_ahead)
    monkeypatch.setattr(farm, "missing_tasks", lambda products: [])
    sentence = compile_everything()
    assert sentence.startswith(expected_start) and str(loop_store().folder) in sentence
    assert compiled_products == [PRODUCTS]


def test_compile_fails_where_nothing_can_be_stored(tmp_path, monkeypatch, full_disk) -> None:
    """Compile on a full disk, and with a compiling process that was killed."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "loops"))
    monkeypatch.setattr(loop_cache, "_store", [])
    monkeypatch.setattr(compiling, "compile_ahead", lambda products, processes, progress: progress("compiling loops", 7, 7))
    with full_disk(1000), pytest.raises(OSError, match="large") as caught:
        compile_everything()
    assert caught.value.filename == str(tmp_path / "loops")
    with pytest.raises(RenderError, match="loops are still missing"):
        compile_everything()
    assert not list((tmp_path / "loops").iterdir())


@pytest.mark.long
def test_a_second_compile_finds_everything_stored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "loops"))
    points = ("points",)
    assert compile_for_command(points) > 10
    assert compile_for_command(points) == 0
