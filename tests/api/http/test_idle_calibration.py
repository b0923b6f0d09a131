"""An uncalibrated service plans by rules, calibrates its device while it is idle, and then plans by predictions."""

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from skugga.api.http.server.app import create_app
from skugga.api.http.server.server import log_config
from skugga.api.settings import Settings
from skugga.api.workers import idle_calibration, idle_work
from skugga.api.workers.process_life import is_stopped
from skugga.selector.cost.device_profile import load_profile, profile_path, save_profile
from tests.api import conftest
from tests.api.conftest import CORNER, ZOOM, Client, running
from tests.api.workers import fake_calibrations, fake_workers
from tests.api.workers.test_pool import TIMEOUT_S, is_running

TILE = f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png"
OTHER_TILE = f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{CORNER[0] - 1}/{CORNER[1]}.png"
PLAN = "/levels/hills/plan"
BROKEN_CALIBRATIONS = [
    fake_calibrations.raise_graphics_error,
    fake_calibrations.exit_process,
    fake_calibrations.divide_by_zero,
    fake_calibrations.return_other_device,
]

Serve = Callable[..., Client]


def short_idle_delay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """Give services an empty cache and a short idle delay, and capture their log from the start."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(idle_work, "IDLE_DELAY_S", 0.1)
    monkeypatch.setattr(idle_work, "IDLE_CHECK_INTERVAL_S", 0.01)
    monkeypatch.setattr(conftest, "log_config", lambda settings: {**log_config(settings), "loggers": {}})
    caplog.set_level("INFO", "skugga")


@pytest.fixture
def serve(hills_level: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Iterator[Serve]:
    """Yield ``serve(measure, **settings)``, which returns a client of a service with an empty cache and a short idle delay."""
    short_idle_delay(tmp_path, monkeypatch, caplog)
    monkeypatch.setattr(idle_calibration, "CHECK_INTERVAL_S", 0.02)
    with ExitStack() as stack:

        def make(calibrate, target=fake_workers.planning, **settings) -> Client:
            service_settings = Settings(**{"workers": 1, "calibrate_when_idle": True, **settings})
            client = stack.enter_context(running(create_app(service_settings, [hills_level], target, calibrate)))
            wait_until(lambda: client.service.pool.is_ready)
            return client

        yield make


def wait_until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds. Fail after ``TIMEOUT_S`` seconds."""
    end = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def calibration_state(client: Client) -> str:
    """Return the state of calibration that ``/readyz`` reports."""
    return str(client.get("/readyz").json()["calibration"])


def plan_policy(client: Client) -> str:
    """Return the policy of the service's plan of the level."""
    return str(client.get(PLAN).json()["policy"])


def log_count(caplog: pytest.LogCaptureFixture, words: str) -> int:
    """Return the number of log lines that contain ``words``."""
    return sum(words in record.getMessage() for record in caplog.records)


def test_calibration_replaces_rules_by_predictions(serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    client = serve(functools.partial(fake_calibrations.return_when_file_exists, tmp_path / "go"))
    rules_tile = client.get(TILE)
    assert (rules_tile.status_code, rules_tile.content, plan_policy(client)) == (200, b"", "rules")
    assert rules_tile.headers["cache-control"] == "public, max-age=60"
    assert client.get(TILE, headers={"If-None-Match": rules_tile.headers["etag"]}).status_code == 304
    assert calibration_state(client) in ("waiting", "running", "paused")

    (tmp_path / "go").touch()
    wait_until(lambda: calibration_state(client) == "calibrated")
    version = client.service.pool.plan_version(None)
    assert version and plan_policy(client) == "predict"
    predictions_tile = client.get(TILE, headers={"If-None-Match": rules_tile.headers["etag"]})
    assert (predictions_tile.status_code, predictions_tile.text) == (200, version)
    assert predictions_tile.headers["etag"] != rules_tile.headers["etag"]
    assert predictions_tile.headers["cache-control"].startswith("public, max-age=3600,")
    assert client.get(TILE).text == version, "the older tile of the address is cached beside the new one"
    assert client.get(TILE, headers={"If-None-Match": predictions_tile.headers["etag"]}).status_code == 304
    assert client.get(OTHER_TILE).text == version

    wait_until(lambda: load_profile(fake_workers.RENDERER, fake_workers.VERSION) is not None)
    wait_until(lambda: log_count(caplog, "saved to") == 1)
    assert log_count(caplog, "is not calibrated, so fixed rules choose the algorithms until it is") == 1
    assert log_count(caplog, "was loaded") == 0, "the service does not load the file that it has written"


def test_saved_calibration_is_used_from_the_start(serve: Serve, tmp_path: Path):
    client = serve(functools.partial(fake_calibrations.run_endlessly, tmp_path / "begun"), target=fake_workers.planning)
    save_profile(fake_calibrations.profile())
    wait_until(lambda: calibration_state(client) == "calibrated")
    second_client = serve(functools.partial(fake_calibrations.raise_graphics_error, tmp_path / "failed"))
    wait_until(lambda: calibration_state(second_client) == "calibrated")
    assert client.get(TILE).headers["etag"] == second_client.get(TILE).headers["etag"]
    assert not (tmp_path / "failed").exists()


def test_calibration_saved_by_a_command_is_loaded(serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    client = serve(functools.partial(fake_calibrations.run_endlessly, tmp_path / "begun"))
    pool = client.service.pool
    wait_until(lambda: (tmp_path / "begun").exists() and pool.idle_work.pid is not None)
    pid, versions = pool.idle_work.pid, []
    assert pid is not None
    for took_s in (2.0, 3.0):
        save_profile(fake_calibrations.profile(took_s=took_s))
        wait_until(lambda: pool.plan_version(None) not in ("", *versions))
        versions.append(pool.plan_version(None))
        assert client.get(TILE).text == versions[-1] and plan_policy(client) == "predict"
    wait_until(lambda: not is_running(pid))  # the saved profile makes the running measurement useless
    assert log_count(caplog, "was loaded") == 2
    profile_path(fake_workers.RENDERER, fake_workers.VERSION).unlink()
    time.sleep(0.1)
    assert pool.plan_version(None) == versions[-1]


def test_estimate_does_not_replace_a_calibration(serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """An estimate is used until the device is calibrated. A later estimate is ignored."""
    estimate = fake_calibrations.profile().model_copy(update={"is_estimate": True})
    client = serve(functools.partial(fake_calibrations.run_endlessly, tmp_path / "begun"))
    save_profile(estimate)
    wait_until(lambda: log_count(caplog, "the estimate") == 1)
    assert calibration_state(client) in ("waiting", "running") and plan_policy(client) == "predict"
    save_profile(fake_calibrations.profile(took_s=2.0))
    wait_until(lambda: calibration_state(client) == "calibrated")
    version = client.service.pool.plan_version(None)
    save_profile(estimate)
    time.sleep(0.3)
    assert calibration_state(client) == "calibrated" and client.service.pool.plan_version(None) == version


def test_file_watch_survives_a_lack_of_threads(
    serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    """A calibration that is saved afterwards is loaded."""
    client = serve(functools.partial(fake_calibrations.run_endlessly, tmp_path / "begun"))
    stamp, failures = idle_calibration._file_stamp, [RuntimeError("can't start new thread"), OSError(24, "Too many open files")]

    def failing_stamp(path: Path) -> tuple[int, int, int] | None:
        if failures:
            raise failures.pop()
        return stamp(path)

    wait_until(lambda: calibration_state(client) == "running")
    monkeypatch.setattr(idle_calibration, "_file_stamp", failing_stamp)
    wait_until(lambda: log_count(caplog, "is read again later") == 2)
    save_profile(fake_calibrations.profile())
    wait_until(lambda: calibration_state(client) == "calibrated")


def test_unwritable_cache_folder_warns_once(serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    (tmp_path / "cache").write_text("in the way")  # no folder can be made in place of a file, not even by root
    (tmp_path / "go").touch()
    client = serve(functools.partial(fake_calibrations.return_when_file_exists, tmp_path / "go"), recycle_blocks=1)
    wait_until(lambda: log_count(caplog, "cannot be written") == 1)
    (record,) = [record for record in caplog.records if "cannot be written" in record.getMessage()]
    path = profile_path(fake_workers.RENDERER, fake_workers.VERSION)
    assert record.levelname == "WARNING" and str(path) in record.getMessage() and "Not a directory" in record.getMessage()
    version = client.service.pool.plan_version(None)
    assert version and calibration_state(client) == "calibrated"
    for place in (TILE, PLAN, OTHER_TILE):  # also in processes that are started later
        assert client.get(place).text in (version, '{"policy":"predict"}')
    assert client.service.pool.counters.processes_started > 1
    assert log_count(caplog, "cannot be written") == 1


@pytest.mark.parametrize(("calibrate", "reason"), list(zip(
    BROKEN_CALIBRATIONS, ["libEGL is broken", "its process ended with exit status 9", "ZeroDivisionError: division by zero",
             "of another device"],
    strict=True,
)))  # fmt: skip
def test_failed_calibration_is_logged_once(serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture, calibrate, reason: str):
    client = serve(functools.partial(calibrate, tmp_path / "begun"))
    wait_until(lambda: calibration_state(client) == "failed")
    client.get(TILE)
    time.sleep(0.5)  # several times the idle delay
    assert (tmp_path / "begun").read_text().count("\n") == 1
    (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "could not be calibrated" in warning and reason in warning
    assert plan_policy(client) == "rules" and client.get(OTHER_TILE).headers["cache-control"].startswith("public, max-age=3600,")


def test_calibration_timeout_fails(serve: Serve, tmp_path: Path, monkeypatch, caplog: pytest.LogCaptureFixture):
    monkeypatch.setattr(idle_work, "JOB_TIMEOUT_S", 0.2)
    client = serve(functools.partial(fake_calibrations.run_endlessly, tmp_path / "begun"))
    wait_until(lambda: calibration_state(client) == "failed")
    assert log_count(caplog, "it took longer than 0.2 s") == 1 and client.service.pool.idle_work.pid is None


def test_setting_disables_calibration(serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    client = serve(functools.partial(fake_calibrations.raise_graphics_error, tmp_path / "begun"), calibrate_when_idle=False)
    assert calibration_state(client) == "off" and log_count(caplog, "SKUGGA_CALIBRATE_WHEN_IDLE is false") == 1
    assert client.get(TILE).headers["cache-control"].startswith("public, max-age=3600,")
    time.sleep(0.4)
    assert not (tmp_path / "begun").exists()


def test_worker_without_a_device_is_not_calibrated(serve: Serve, tmp_path: Path):
    client = serve(functools.partial(fake_calibrations.raise_graphics_error, tmp_path / "begun"), target=fake_workers.scripted)
    assert calibration_state(client) == "none" and client.get(TILE).headers["cache-control"].startswith("public, max-age=3600,")
    time.sleep(0.4)
    assert not (tmp_path / "begun").exists()


def test_requests_pause_calibration_until_idle(serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    client = serve(functools.partial(fake_calibrations.return_when_file_exists, tmp_path / "go"))
    idle = client.service.pool.idle_work
    wait_until(lambda: idle.pid is not None and not idle.is_paused)
    monkeypatch.setattr(idle_work, "IDLE_DELAY_S", TIMEOUT_S)
    answer = client.get(TILE)
    assert (answer.status_code, idle.is_paused, calibration_state(client)) == (200, True, "paused")
    pid = idle.pid
    assert pid is not None
    wait_until(lambda: is_stopped(pid))  # the signal takes effect when its process is scheduled, late on a busy machine
    (tmp_path / "go").touch()
    time.sleep(0.2)
    assert calibration_state(client) == "paused" and plan_policy(client) == "rules"
    monkeypatch.setattr(idle_work, "IDLE_DELAY_S", 0.1)
    wait_until(lambda: calibration_state(client) == "calibrated")


@pytest.mark.parametrize("paused", [False, True])
def test_shutdown_leaves_no_process_or_file(hills_level: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, paused: bool):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(idle_work, "IDLE_DELAY_S", 0.05)
    calibrate = functools.partial(fake_calibrations.run_endlessly, tmp_path / "begun")
    app = create_app(Settings(workers=1, calibrate_when_idle=True), [hills_level], fake_workers.planning, calibrate)
    with running(app) as client:
        wait_until(lambda: (tmp_path / "begun").exists() and "\n" in (tmp_path / "begun").read_text())
        pid, temporary_file = client.service.pool.idle_work.pid, Path((tmp_path / "begun").read_text().strip())
        assert pid is not None and is_running(pid) and temporary_file.exists()
        if paused:
            monkeypatch.setattr(idle_work, "IDLE_DELAY_S", 3600.0)  # so that it stays paused
            assert client.get(TILE).status_code == 200
            wait_until(lambda: is_stopped(pid))
    assert not is_running(pid) and not temporary_file.parent.exists()
