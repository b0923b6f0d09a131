"""An idle service probes its levels; the probes give the plans of their tiles a new version."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from skugga.api import map_probing
from skugga.api.http.server.app import create_app
from skugga.api.settings import Settings
from skugga.api.workers import idle_probes
from skugga.api.workers.idle_probes import probe_level
from skugga.selector.cost.device_profile import save_profile
from skugga.selector.map_probes import MapProbes, ProbedClass
from skugga.selector.probe_store import load_probes, probes_folder, save_probes
from tests.api.conftest import Client, running
from tests.api.http.test_idle_calibration import OTHER_TILE, TILE, log_count, short_idle_delay, wait_until
from tests.api.workers import fake_probes, fake_workers
from tests.api.workers.fake_calibrations import profile

Serve = Callable[..., Client]


@pytest.fixture
def serve(hills_level: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Iterator[Serve]:
    """Yield ``serve(probe, **settings)``, which returns a client of a calibrated service with a short idle delay."""
    short_idle_delay(tmp_path, monkeypatch, caplog)
    monkeypatch.setattr(idle_probes, "READ_INTERVAL_S", 0.02)
    save_profile(profile())
    with ExitStack() as stack:

        def make(probe=fake_probes.probe_two_scales, **settings) -> Client:
            service_settings = Settings(**{"workers": 1, "probe_when_idle": True, **settings})
            client = stack.enter_context(running(create_app(service_settings, [hills_level], fake_workers.planning, probe=probe)))
            wait_until(lambda: client.service.pool.is_ready and client.service.pool.plan_version(None) != "")
            return client

        yield make


def waiting_probes(client: Client) -> int:
    """Return the number of waiting probes that ``/readyz`` reports."""
    return int(client.get("/readyz").json()["probes_waiting"])


def saved_probe_files() -> list[Path]:
    """Return the files with stored probes of the fake device."""
    return list(probes_folder(fake_workers.RENDERER, fake_workers.VERSION).glob("*.json"))


def test_probes_replace_predictions(serve: Serve, caplog: pytest.LogCaptureFixture):
    client = serve()
    predicted = client.get(TILE)
    assert predicted.text == client.service.pool.plan_version(None)
    assert predicted.headers["cache-control"] == "public, max-age=60"
    wait_until(lambda: waiting_probes(client) == 0)
    level = client.service.levels.cached_levels()[0].key
    version = client.service.pool.plan_version(level)
    assert version != predicted.text
    probed = client.get(TILE, headers={"If-None-Match": predicted.headers["etag"]})
    assert (probed.status_code, probed.text, "max-age=3600," in probed.headers["cache-control"]) == (200, version, True)
    assert client.get(OTHER_TILE).text == version
    assert [path.stem for path in saved_probe_files()] == [level.version]
    assert load_probes(saved_probe_files()[0]) == fake_probes.probe_two_scales(level, fake_workers.UNPROBED_CLASS.sun, profile())
    assert log_count(caplog, "were probed at 2 scales") == 1


def test_saved_probes_are_used_from_the_first_tile(serve: Serve):
    first = serve()
    first.get(TILE)
    wait_until(lambda: waiting_probes(first) == 0)
    version = first.service.pool.plan_version(first.service.levels.cached_levels()[0].key)
    assert serve(fake_probes.failing).get(TILE).text == version != first.service.pool.plan_version(None)


def test_probes_saved_by_a_command_are_loaded(serve: Serve):
    client = serve(probe_when_idle=False)
    before = client.get(TILE)
    assert waiting_probes(client) == 0 and before.headers["cache-control"].startswith("public, max-age=3600,")
    level = client.service.levels.cached_levels()[0].key
    probes = MapProbes(classes=(ProbedClass(scale=4, sun=-1, seen={"sun": (fake_probes.observation(),)}),))
    save_probes(fake_workers.RENDERER, fake_workers.VERSION, level.version, probes)
    wait_until(lambda: client.get(TILE).text != before.text)


def test_failed_probe_keeps_predictions(serve: Serve, caplog: pytest.LogCaptureFixture):
    client = serve(fake_probes.failing)
    predicted = client.get(TILE).text
    wait_until(lambda: log_count(caplog, "could not be probed") == 1)
    assert log_count(caplog, "the raster is gone") == 1 and waiting_probes(client) == 0 and saved_probe_files() == []
    assert client.get(OTHER_TILE).text == predicted
    assert log_count(caplog, "could not be probed") == 1, "a failed probe is not repeated"


def test_unsaved_probes_last_until_shutdown(serve: Serve, caplog: pytest.LogCaptureFixture):
    folder = probes_folder(fake_workers.RENDERER, fake_workers.VERSION)
    folder.parent.mkdir(parents=True)
    folder.touch()  # a file in its place
    client = serve()
    predicted = client.get(TILE).text
    wait_until(lambda: client.get(TILE).text != predicted)
    assert log_count(caplog, "until this service ends") == 1


def test_probed_level_covers_all_scales(gl, hills_level: Path, monkeypatch: pytest.MonkeyPatch):
    from skugga.api.workers.jobs import LevelKey
    from skugga.selector.cost.typical_device import typical_device

    monkeypatch.setattr(map_probing, "probed_scales", lambda scene: range(4, 6))
    level_probes = probe_level(LevelKey(path=hills_level, version="1"), -1, typical_device())
    assert [probed_class.scale for probed_class in level_probes.classes] == [4, 5]
    assert {probed_class.sun for probed_class in level_probes.classes} == {-1}
    assert all(probed_class.seen["sun"] for probed_class in level_probes.classes)
