"""A folder of level files: which files are served, and how the list follows added and removed files."""

from __future__ import annotations

import functools
import json
import os
import re
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import httpx
import pytest

from skugga.api.errors import exit_status
from skugga.api.http.server.app import create_app
from skugga.api.http.state.served_levels import ServedLevels
from skugga.api.settings import Settings
from skugga.api.workers.jobs import Failure, HeartbeatRequest, HeartbeatResponse, WorkerReady
from skugga.api.workers.worker_config import WorkerConfig
from skugga.terrain.errors import InputError, LevelError
from tests.api.conftest import CORNER, ZOOM, Client, running, write_level
from tests.api.http.test_problems import check_problem
from tests.api.http.test_serve import serving_process
from tests.api.workers import fake_workers

TILE = f"tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png"
TIMEOUT_S = 120


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with the levels ``hills`` and ``moor``."""
    (tmp_path / "levels").mkdir()
    for name in ("hills", "moor"):
        write_level(tmp_path / "levels", name)
    return tmp_path / "levels"


def remove(folder: Path, name: str) -> None:
    """Remove the file and the raster of a level."""
    for suffix in (".yaml", ".tif"):
        (folder / f"{name}{suffix}").unlink()


def test_folder_serves_level_files_only(folder: Path, tmp_path: Path):
    (folder / "moor.yaml").rename(folder / "moor.yml")
    (folder / ".hills.yaml").write_text("an editor's", encoding="utf-8")
    (folder / "below.yaml").mkdir()
    named_level = write_level(tmp_path, "named")
    assert ServedLevels([named_level], folder=folder).names() == ["named", "hills", "moor"]


def test_broken_level_file_is_logged_and_left_out(folder: Path, caplog: pytest.LogCaptureFixture):
    (folder / "broken.yaml").write_text("version: 7", encoding="utf-8")
    os.mkfifo(folder / "pipe.yaml")
    (folder / "nowhere.yaml").symlink_to(folder / "gone.yaml")
    assert ServedLevels([], folder=folder).names() == ["hills", "moor"]
    messages = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert [re.findall(r"level file \S+/(\w+).yaml is left out", text) for text in messages] == [["broken"], ["nowhere"], ["pipe"]]


@pytest.mark.parametrize(("second_path", "is_argument"), [("hills.yml", False), ("hills.yaml", True)])
def test_two_level_files_of_one_name_are_an_error(folder: Path, tmp_path: Path, second_path: str, is_argument: bool):
    path = write_level(tmp_path, "hills") if is_argument else folder / second_path
    if not is_argument:
        path.write_text((folder / "hills.yaml").read_text(), encoding="utf-8")
    with pytest.raises(InputError) as caught:
        ServedLevels([path] if is_argument else [], folder=folder)
    assert caught.value.name == "SKUGGA_LEVELS" and "both named 'hills'" in str(caught.value)
    assert exit_status(caught.value) == 2


def test_missing_folder_is_an_input_error(tmp_path: Path):
    with pytest.raises(InputError, match="SKUGGA_LEVELS.*nowhere.*a folder"):
        ServedLevels([], folder=tmp_path / "nowhere")


def test_reload_folder_updates_the_list(folder: Path, caplog: pytest.LogCaptureFixture):
    levels = ServedLevels([], folder=folder)
    hills = levels.reload_if_changed("hills")
    remove(folder, "moor")
    write_level(folder, "fen")
    (folder / "broken.yaml").write_text("version: 7", encoding="utf-8")
    assert levels.names() == ["hills", "moor"], "the list changes at the next reload only"
    levels.reload_folder()
    assert levels.names() == ["fen", "hills"] and levels.reload_if_changed("hills") is hills
    assert "broken.yaml is left out" in caplog.text
    write_level(folder, "broken")
    levels.reload_folder()
    assert levels.names() == ["broken", "fen", "hills"]


def test_unreadable_folder_leaves_levels_unchanged(folder: Path, caplog: pytest.LogCaptureFixture):
    levels = ServedLevels([], folder=folder)
    write_level(folder, "fen")
    (folder / "fen.yml").write_text((folder / "fen.yaml").read_text(), encoding="utf-8")
    levels.reload_folder()
    assert levels.names() == ["hills", "moor"] and "both named 'fen'" in caplog.text
    folder.rename(folder.with_name("elsewhere"))
    levels.reload_folder()
    assert levels.names() == ["hills", "moor"] and "The levels are unchanged." in caplog.text


def test_level_broken_after_start_stays_listed(folder: Path):
    """Requests for it fail until its file is repaired."""
    levels = ServedLevels([], folder=folder)
    (folder / "moor.yaml").write_text("version: 7", encoding="utf-8")
    levels.reload_folder()
    with pytest.raises(LevelError):
        levels.reload_if_changed("moor")
    write_level(folder, "moor")
    assert levels.reload_if_changed("moor").name == "moor"


def test_clients_see_added_and_removed_levels(folder: Path):
    settings = Settings(workers=1, levels=folder)
    with running(create_app(settings, [], fake_workers.scripted)) as client:
        for name in ("hills", "moor"):
            assert client.get(f"/levels/{name}/{TILE}").status_code == 200
        remove(folder, "moor")
        write_level(folder, "fen")
        client.service.levels.reload_folder()
        assert [level["name"] for level in client.get("/levels").json()] == ["fen", "hills"]
        assert client.get(f"/levels/fen/{TILE}").status_code == client.get(f"/levels/hills/{TILE}").status_code == 200
        check_problem(client.get(f"/levels/moor/{TILE}"), 404, "not_found", "level")


def worker_missing_level_file(pipe: Connection, config: WorkerConfig, job_started, may_finish) -> None:
    """Run a fake render worker that signals ``job_started``, waits for ``may_finish``, and then fails to find the level file."""
    pipe.send(WorkerReady(fake_workers.RENDERER))
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        if isinstance(job, HeartbeatRequest):
            pipe.send(HeartbeatResponse())
            continue
        job_started.release()
        may_finish.acquire()
        pipe.send(Failure.from_error(LevelError(str(job.level.path), "No such file or directory", "a readable YAML file")))


@pytest.mark.parametrize(("target", "status"), [(fake_workers.scripted, 200), (worker_missing_level_file, 404)])
def test_level_removed_while_its_tile_is_drawn_is_404(folder: Path, target: Callable[..., None], status: int):
    """The tile itself is 200 if the worker had read the level before, else 404; later requests are 404."""
    spawn = get_context("spawn")
    job_started, may_finish = spawn.Semaphore(0), spawn.Semaphore(0)
    app = create_app(
        Settings(workers=1, levels=folder), [], functools.partial(target, job_started=job_started, may_finish=may_finish)
    )
    with running(app) as client, ThreadPoolExecutor(1) as thread:
        drawing = thread.submit(client.get, f"/levels/moor/{TILE}")
        assert job_started.acquire(timeout=TIMEOUT_S)
        remove(folder, "moor")
        client.service.levels.reload_folder()
        may_finish.release()
        answer: httpx.Response = drawing.result()
        assert answer.status_code == status
        if status == 404:
            check_problem(answer, 404, "not_found", "level")
        check_problem(client.get(f"/levels/moor/{TILE}"), 404, "not_found", "level")
        assert_alive(client)


def assert_alive(client: Client) -> None:
    """Assert that the service answers and serves only the level ``hills``."""
    assert client.get("/healthz").status_code == 200
    assert [level["name"] for level in client.get("/levels").json()] == ["hills"]


def test_missing_file_of_a_served_level_is_500(folder: Path):
    spawn = get_context("spawn")
    job_started, may_finish = spawn.Semaphore(0), spawn.Semaphore(1)
    app = create_app(
        Settings(workers=1, levels=folder),
        [],
        functools.partial(worker_missing_level_file, job_started=job_started, may_finish=may_finish),
    )
    with running(app) as client:
        check_problem(client.get(f"/levels/moor/{TILE}"), 500, "level", None)


def test_sighup_reads_the_folder_again(folder: Path):
    with serving_process([], r"on (http://\S+)", dict(os.environ) | {"SKUGGA_LEVELS": str(folder)}) as (process, address):
        assert {level["name"] for level in httpx.get(f"{address}/levels").json()} == {"hills", "moor"}
        remove(folder, "moor")
        write_level(folder, "fen")
        process.send_signal(signal.SIGHUP)
        assert process.stderr is not None
        while not (line := process.stderr.readline()).endswith("added: fen; removed: moor\n"):
            assert line, "the service ended without the log line"
        assert {level["name"] for level in httpx.get(f"{address}/levels").json()} == {"fen", "hills"}


def test_data_roots_are_a_list_of_folders(monkeypatch: pytest.MonkeyPatch, folder: Path, tmp_path: Path):
    outside = write_level(tmp_path, "outside")
    level = json.loads(outside.read_text())
    level["terrain"]["source"] = "../outside.tif"
    (folder / "inside.yaml").write_text(json.dumps(level), encoding="utf-8")
    for roots, names in (("", ["hills", "moor"]), (f"/nowhere, {tmp_path}", ["hills", "inside", "moor"])):
        monkeypatch.setenv("SKUGGA_DATA_ROOTS", roots)
        app = create_app(Settings(levels=folder), [])
        assert app.state.service.levels.names() == names
