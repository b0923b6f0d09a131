"""What is done for served levels before a render process is ready."""

from __future__ import annotations

from pathlib import Path

import pytest

from api.http.first_pictures import SUNS, served_pictures
from api.http.served_levels import ServedLevels
from api.workers import preparation
from api.workers.jobs import BlockJob, Job, LevelKey, ServedPictures, SnapshotJob, SunHoursJob
from api.workers.preparation import prepare
from api.workers.render_worker import WorkerState
from tests.api.conftest import write_level


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Job]:
    """The jobs that would have been drawn."""
    jobs: list[Job] = []
    monkeypatch.setattr(preparation, "run_job", lambda job, state: jobs.append(job))
    return jobs


def is_prepared(level: ServedPictures, drawn: list[Job]) -> bool:
    """Whether each of a level's pictures was drawn and its hours of sun were found, and nothing else."""
    *pictures, hours = drawn
    return pictures == list(level.pictures) and isinstance(hours, SunHoursJob) and hours.level == level.level


def said_to(state: WorkerState, *levels: ServedPictures) -> list[str]:
    said: list[str] = []
    prepare(levels, state, said.append)
    return said


def state_of(gl) -> WorkerState:
    return WorkerState(gl.renderer)


def test_pictures_of_a_level(hills_level: Path):
    (hills,) = served_pictures(ServedLevels([hills_level]))
    blocks, views = ([job for job in hills.pictures if isinstance(job, kind)] for kind in (BlockJob, SnapshotJob))
    zooms = list(dict.fromkeys(job.zoom for job in blocks))
    assert len(zooms) == 3 and zooms[1] < zooms[0] < zooms[2]
    assert {job.request.sun for job in blocks} == {None, *SUNS}
    assert [job.view for job in views] == ["map"]


def test_a_level_is_drawn_once_in_an_installation(gl, hills_level: Path, drawn: list[Job]):
    (hills,) = served_pictures(ServedLevels([hills_level]))
    said = said_to(state_of(gl), hills)
    assert is_prepared(hills, drawn)
    assert len(said) == len(hills.pictures) and "first start with hills" in said[0] and "level 1 of 1, picture 1 of 10" in said[0]
    assert said_to(state_of(gl), hills) == [] and is_prepared(hills, drawn)
    changed = ServedPictures(LevelKey(path=hills.level.path, version="another"), hills.pictures)
    assert said_to(state_of(gl), changed) != []


def test_one_block_is_enough_where_there_is_more_than_ground(gl, tmp_path: Path, drawn: list[Job]):
    level = write_level(tmp_path, "roofs", terrain={"source": "roofs.tif", "surface": "blocks"})
    (roofs,) = served_pictures(ServedLevels([level]))
    said_to(state_of(gl), roofs)
    assert [type(job) for job in drawn] == [BlockJob, SnapshotJob]


def test_scenes_are_open_and_their_sky_is_known(gl, hills_level: Path, drawn: list[Job]):
    (hills,) = served_pictures(ServedLevels([hills_level]))
    state = state_of(gl)
    said_to(state, hills)
    assert len(state.scenes) == 1
    state.scenes.get(hills.level).close()


def test_a_level_that_cannot_be_opened_holds_nothing_up(gl, tmp_path: Path, hills_level: Path, drawn: list[Job]):
    level = write_level(tmp_path, "gone")
    gone, hills = served_pictures(ServedLevels([level, hills_level]))
    (tmp_path / "gone.tif").unlink()
    said = said_to(state_of(gl), gone, hills)
    assert said[0].startswith("level gone cannot be drawn yet: ") and "gone.tif" in said[0]
    assert is_prepared(hills, drawn)


def test_a_level_that_fails_unexpectedly_holds_nothing_up(gl, tmp_path: Path, hills_level: Path, monkeypatch: pytest.MonkeyPatch):
    odd, hills = served_pictures(ServedLevels([write_level(tmp_path, "odd"), hills_level]))
    drawn = []

    def draw(job: BlockJob | SnapshotJob, state: WorkerState) -> None:
        if job.level == odd.level:
            raise ZeroDivisionError
        drawn.append(job)

    monkeypatch.setattr(preparation, "run_job", draw)
    said = said_to(state_of(gl), odd, hills)
    assert said[1] == "level odd cannot be prepared for: ZeroDivisionError"
    assert is_prepared(hills, drawn)


def test_a_cache_that_cannot_be_written_is_no_error(
    gl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hills_level: Path, drawn: list[Job]
):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    (hills,) = served_pictures(ServedLevels([hills_level]))
    assert said_to(state_of(gl), hills) and said_to(state_of(gl), hills)
