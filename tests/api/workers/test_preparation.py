"""Preparation of levels by an idle render process."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from skugga.api.http.server.first_blocks import central_block, central_blocks
from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET, ServedLevels
from skugga.api.workers import preparation
from skugga.api.workers.preparation import prepare_level
from skugga.api.workers.worker_state import WorkerState
from tests.api.conftest import write_level


def test_first_block_lies_in_the_middle_of_the_level(hills_level: Path) -> None:
    (level,) = ServedLevels([hills_level]).cached_levels()
    (block,) = central_blocks(ServedLevels([hills_level]))
    zooms = level.zooms[DEFAULT_MATRIX_SET]
    assert block.zoom == zooms.first and block.level == level.key
    fine_block = central_block(level, zooms.last)
    assert fine_block is not None
    ratio = 2 ** (zooms.last - zooms.first)
    assert abs(fine_block.block_x / ratio - block.block_x) <= 1 and abs(fine_block.block_y / ratio - block.block_y) <= 1


def test_preparation_opens_the_level_and_its_sky_view(gl, hills_level: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (block,) = central_blocks(ServedLevels([hills_level]))
    state, elevations = WorkerState(gl.renderer), []
    monkeypatch.setattr(preparation, "sky_view", lambda elevation, world: elevations.append(elevation))
    prepare_level(block, state)
    assert len(state.scenes) == 1
    scene = state.scenes.get(block.level)
    assert elevations == [scene.elevation]
    scene.close()


def test_a_level_that_cannot_be_opened_is_only_logged(gl, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (broken_block,) = central_blocks(ServedLevels([write_level(tmp_path, "gone")]))
    (tmp_path / "gone.tif").unlink()
    prepare_level(broken_block, WorkerState(gl.renderer))
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.message.startswith("level gone cannot be drawn yet: ") and "gone.tif" in record.message


def test_a_bug_with_one_level_does_not_end_the_process(
    gl, hills_level: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(preparation, "plan_of_tiles", fail)
    prepare_level(central_blocks(ServedLevels([hills_level]))[0], WorkerState(gl.renderer))
    assert "cannot be prepared" in caplog.text and "ZeroDivisionError" in caplog.text
