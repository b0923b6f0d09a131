"""Debian's nginx as a cache before the service, with the configuration of ``examples/deployment``.

Only its addresses and folders differ here. The service is a process, which tests stop, kill and restart.
"""

from __future__ import annotations

import gzip
import hashlib
import os
import pwd
import re
import shutil
import signal
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import quote

import httpx
import pytest
from pmtiles.reader import Reader

from tests.api.conftest import CORNER, PNG, ZOOM, write_level, write_tiles

ROOT = Path(__file__).resolve().parents[2]
CONFIGURATION = ROOT / "examples" / "deployment" / "nginx.conf"

READY_S = 600
TIMEOUT_S = 30
TILES = "/levels/hills/tiles/WebMercatorQuad"
TILE = f"{TILES}/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png"
HOUR_S, DAY_S = 3600, 86400

CACHE_VERSION = 5
"""Version of nginx's cache files. They begin with two 64-bit numbers: this version, and the expiry (seconds since 1970)."""


def free_port() -> int:
    """Return the number of a TCP port that no process uses."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return listening.getsockname()[1]


def wait_until(condition: Callable[[], bool], within_s: float = TIMEOUT_S) -> None:
    """Wait until a condition holds. Fail after ``within_s`` seconds."""
    end = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


class Deployment:
    """A service of ``hills`` behind nginx, each a process; ``client`` requests from nginx, ``direct`` from the service."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.level = folder, write_level(folder, "hills")
        self.service_port, self.port = free_port(), free_port()
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=120)
        self.direct = httpx.Client(base_url=f"http://127.0.0.1:{self.service_port}", timeout=120)
        (folder / "archives").mkdir()
        write_tiles(folder / "archives" / "shadows.pmtiles", {(ZOOM, *CORNER): PNG}, layer="shadow")
        self._started: list[subprocess.Popen[bytes]] = []

    def start_service(self) -> None:
        """Start the service, and wait until it can draw."""
        settings = {"SKUGGA_CALIBRATE_WHEN_IDLE": "false", "SKUGGA_PROBE_WHEN_IDLE": "false", "SKUGGA_WORKERS": "1"}
        command = [sys.executable, "-c", "from skugga.api.cli.main import main; main()", "serve", str(self.level)]
        with (self.folder / "service.log").open("a") as log:
            self.service = subprocess.Popen(
                [*command, "--port", str(self.service_port)], cwd=ROOT, env={**os.environ, **settings}, stderr=log
            )
        self._started.append(self.service)
        wait_until(lambda: self._answers(self.direct, "/readyz"), READY_S)

    def kill_service(self) -> None:
        """Kill the service, but not nginx."""
        self.service.kill()
        self.service.wait()

    def _answers(self, client: httpx.Client, address: str) -> bool:
        """Return whether GET ``address`` has the status 200. Fail if the last started process has ended."""
        assert self._started[-1].poll() is None, "\n".join(path.read_text() for path in self.folder.glob("*.log"))
        try:
            return client.get(address).status_code == 200
        except httpx.TransportError:
            return False

    def start_nginx(self) -> None:
        """Start nginx as an ordinary user: if the tests run as root, as the user that the configuration names."""
        text = CONFIGURATION.read_text(encoding="utf-8")
        for original, replacement in {
            "listen 8080 ": f"listen 127.0.0.1:{self.port} ", "127.0.0.1:8000": f"127.0.0.1:{self.service_port}",
            "/run/nginx.pid": f"{self.folder}/nginx.pid", "/var/log/nginx/": f"{self.folder}/",
            "/var/lib/nginx/": f"{self.folder}/", "/var/cache/nginx": f"{self.folder}/cache",
            "/srv/skugga/archives/": f"{self.folder}/archives/",
        }.items():  # fmt: skip
            assert original in text, original
            text = text.replace(original, replacement)
        (self.folder / "nginx.conf").write_text(text, encoding="utf-8")
        user = {}
        if os.geteuid() == 0:
            entry = pwd.getpwnam(re.search(r"^user ([\w-]+);", text, re.MULTILINE)[1])  # type: ignore[index]
            os.chown(self.folder, entry.pw_uid, entry.pw_gid)
            user = {"user": entry.pw_uid, "group": entry.pw_gid, "extra_groups": []}
        command = ["nginx", "-e", f"{self.folder}/start.log", "-c", f"{self.folder}/nginx.conf", "-g", "daemon off;"]
        self._started.append(subprocess.Popen(command, stderr=subprocess.DEVNULL, **user))  # type: ignore[call-overload]
        wait_until(lambda: self._answers(self.client, "/healthz"))

    def close(self) -> None:
        for process in self._started:
            process.terminate()
        for process in self._started:
            process.wait(TIMEOUT_S)
        self.client.close()
        self.direct.close()

    def read_counters(self) -> Counter[str]:
        """Return the service's counters: answers of tiles by status, and pictures drawn."""
        text, counts = self.direct.get("/metrics").text, Counter[str]()
        for route, status, number in re.findall(r'skugga_requests_total\{.*?route="(.*?)",status="(\d+)"\} (\S+)', text):
            counts[status] += int(float(number)) if "/tiles/" in route else 0
        (drawn_text,) = re.findall(r'skugga_jobs_total\{outcome="answered"\} (\S+)', text)
        counts["drawn"] = int(float(drawn_text))
        return counts

    def expire(self, address: str, ago_s: float) -> None:
        """Change the expiry of nginx's cache entry of an address to ``ago_s`` seconds ago."""
        name = hashlib.md5(f"{self.client.base_url}{address}".encode()).hexdigest()
        with (self.folder / "cache" / name[-1] / name[-3:-1] / name).open("r+b") as file:
            version, until = struct.unpack("<Qq", file.read(16))
            assert version == CACHE_VERSION, "unknown cache file version: compare with nginx's ngx_http_file_cache_header_t"
            assert until > time.time() - 10 * DAY_S
            file.seek(8)
            file.write(struct.pack("<q", int(time.time() - ago_s)))


@pytest.fixture(scope="module")
def deployment() -> Iterator[Deployment]:
    """A running service behind a running nginx. The test is skipped without nginx."""
    if shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin") is None:
        pytest.skip("there is no nginx: 'make test-clients' installs it, or 'apt-get install nginx-light'")
    print(subprocess.run(["nginx", "-v"], capture_output=True, text=True, check=True).stderr.strip())
    with tempfile.TemporaryDirectory(prefix="skugga-nginx-") as folder:
        running = Deployment(Path(folder))
        try:
            running.start_service()
            running.start_nginx()
            yield running
        finally:
            running.close()


def status_and_cache_status(answer: httpx.Response) -> tuple[int, str]:
    """Return the status, and nginx's cache status."""
    return answer.status_code, answer.headers.get("x-cache-status", "")


def tile_under_sun(altitude_deg: float) -> str:
    """Return the URL path of a tile under a sun of an altitude."""
    return f"{TILE}?azimuth=200&altitude={altitude_deg:g}"


def test_second_walk_is_answered_by_the_cache(deployment: Deployment):
    """Two zooms under four suns, requested twice, as by two browsers with empty caches."""
    walk = [
        f"{TILES}/{ZOOM + deeper}/{(CORNER[0] << deeper) + col}/{(CORNER[1] << deeper) + row}.png?azimuth=150&altitude={altitude}"
        for altitude in (8, 14, 25, 40)
        for deeper in (1, 2)
        for row in range(-2, 2)
        for col in range(-2, 2)
    ]
    before, status_counts, took_ms, bodies = deployment.read_counters(), Counter[str](), {}, {}
    for walk_name in ("first", "second"):
        for address in walk:
            began_s = time.perf_counter()
            answer = deployment.client.get(address)
            took_ms.setdefault(answer.headers["x-cache-status"], []).append((time.perf_counter() - began_s) * 1000)
            assert answer.status_code == 200
            assert answer.content == bodies.setdefault(address, answer.content)
            status_counts[f"{walk_name} {answer.headers['x-cache-status']}"] += 1
    assert status_counts == {"first MISS": len(walk), "second HIT": len(walk)}
    counter_changes = deployment.read_counters() - before
    assert counter_changes["200"] == len(walk), "the second walk never reached the service"
    service_ms = [deployment.direct.get(address).elapsed.total_seconds() * 1000 for address in walk]
    figures = {**{name.lower(): times for name, times in took_ms.items()}, "cached by the service, without nginx": service_ms}
    for name, times in figures.items():
        print(f"{name}: {len(times)} tiles, median {statistics.median(times):.2f} ms, longest {max(times):.1f} ms")


def test_cached_tile_answers_if_none_match(deployment: Deployment):
    tag = deployment.client.get(TILE).headers["etag"]
    before = deployment.read_counters()
    for tags in (tag, f"W/{tag}", f'"another", {tag}'):
        answer = deployment.client.get(TILE, headers={"If-None-Match": tags})
        assert status_and_cache_status(answer) == (304, "HIT") and answer.headers["etag"] == tag and not answer.content
    assert status_and_cache_status(deployment.client.get(TILE, headers={"If-None-Match": '"another"'})) == (200, "HIT")
    head = deployment.client.head(TILE)
    assert status_and_cache_status(head) == (200, "HIT") and head.headers["etag"] == tag and not head.content
    assert deployment.read_counters() == before, "no request reached the service"


def test_expired_tile_is_revalidated_without_rendering(deployment: Deployment):
    """The service has been restarted, so it does not remember that it has drawn the tile."""
    first = deployment.client.get(TILE)
    deployment.kill_service()
    deployment.start_service()
    before = deployment.read_counters()
    deployment.expire(TILE, HOUR_S + 60)
    second = deployment.client.get(TILE)
    assert status_and_cache_status(second) == (200, "REVALIDATED") and second.content == first.content
    assert deployment.read_counters() - before == {"304": 1}
    assert status_and_cache_status(deployment.client.get(TILE)) == (200, "HIT"), "the revalidated tile is fresh for another hour"


def test_stale_tile_is_sent_while_it_is_revalidated(deployment: Deployment):
    """The service is stopped, so nginx cannot have waited for it.

    Each request has its own connection: on the one that began the update, nginx reads the next request after the update.
    """
    first = deployment.client.get(TILE)
    deployment.expire(TILE, HOUR_S - 60)
    before = deployment.read_counters()
    deployment.service.send_signal(signal.SIGSTOP)
    try:
        answers = [httpx.get(f"{deployment.client.base_url}{TILE}") for _ in range(3)]
    finally:
        deployment.service.send_signal(signal.SIGCONT)
    assert [status_and_cache_status(answer) for answer in answers] == [(200, "STALE"), (200, "UPDATING"), (200, "UPDATING")]
    assert {answer.content for answer in answers} == {first.content}
    wait_until(lambda: status_and_cache_status(deployment.client.get(TILE)) == (200, "HIT"))
    assert deployment.read_counters() - before == {"304": 1}, "nginx has revalidated the tile with one request"


def test_stale_tiles_bridge_an_outage_of_a_day(deployment: Deployment):
    """Tiles with a fixed sun are sent for a day longer, tiles of the current time are not. The service recovers by itself."""
    of_now, unknown = f"{TILE}?time=current", tile_under_sun(33.3)
    cached = deployment.client.get(TILE)
    assert cached.status_code == deployment.client.get(of_now).status_code == 200
    deployment.kill_service()
    try:
        deployment.expire(TILE, DAY_S - 60)
        stale = deployment.client.get(TILE)
        assert status_and_cache_status(stale) == (200, "STALE") and stale.content == cached.content
        deployment.expire(of_now, 1)
        for address in (of_now, unknown, "/levels"):
            unavailable = deployment.client.get(address)
            assert unavailable.status_code == 503 and unavailable.json()["code"] == "not_ready"
            assert (
                unavailable.headers["content-type"] == "application/problem+json"
                and unavailable.headers["cache-control"] == "no-store"
            )
            assert unavailable.headers["retry-after"] == "5" and unavailable.headers["access-control-allow-origin"] == "*"
        deployment.expire(TILE, DAY_S + 60)
        assert deployment.client.get(TILE).status_code == 503
    finally:
        deployment.start_service()
    assert status_and_cache_status(deployment.client.get(TILE)) == (200, "REVALIDATED")
    assert deployment.client.get(unknown).status_code == 200, "the outage is not cached"


def test_concurrent_equal_requests_are_one(deployment: Deployment):
    before, address = deployment.read_counters(), tile_under_sun(21.7)
    with ThreadPoolExecutor(20) as threads:
        answers = list(threads.map(lambda _: httpx.get(f"{deployment.client.base_url}{address}", timeout=120), range(20)))
    assert {answer.status_code for answer in answers} == {200} and len({answer.content for answer in answers}) == 1
    assert Counter(answer.headers["x-cache-status"] for answer in answers) == {"MISS": 1, "HIT": 19}
    assert deployment.read_counters() - before == {"200": 1, "drawn": 1}


def test_cache_key_includes_query_and_host(deployment: Deployment):
    answers = [deployment.client.get(tile_under_sun(altitude_deg)) for altitude_deg in (5, 6)]
    assert [status_and_cache_status(answer) for answer in answers] == [(200, "MISS")] * 2 and answers[0].content != answers[
        1
    ].content
    before = deployment.client.get(f"{TILE}?time={quote('2024-06-21T18:00:00+02:00')}")
    later = deployment.client.get(f"{TILE}?time={quote('2024-06-21T20:00:00+02:00')}")
    assert before.headers["x-skugga-time"] != later.headers["x-skugga-time"] and before.content != later.content
    other = deployment.client.get(TILE, headers={"Host": "other.example"})
    assert status_and_cache_status(other) == (200, "MISS"), (
        "answers contain addresses with the host of the request, so each host has its own cache entry"
    )


def test_error_answers_are_not_cached(deployment: Deployment):
    status_by_address = {
        f"{TILES}/{ZOOM}/0/0.gif": 422,
        f"{TILE}?altitude=5": 422,
        "/levels/nowhere": 404,
        f"{TILES}/30/0/0.png": 404,
    }
    for address, status in status_by_address.items():
        for _ in range(2):
            answer = deployment.client.get(address)
            assert status_and_cache_status(answer) == (status, "MISS") and answer.headers["cache-control"] == "no-store", address


def test_documents_are_compressed_but_not_pictures(deployment: Deployment):
    """The sent length proves it. The ETag is weak then, and still valid in If-None-Match."""
    address = "/openapi.json"
    with deployment.client.stream("GET", address, headers={"Accept-Encoding": "gzip"}) as answer:
        raw_body = b"".join(answer.iter_raw())
    assert answer.headers["content-encoding"] == "gzip" and len(gzip.decompress(raw_body)) > 5 * len(raw_body)
    assert "accept-encoding" in answer.headers["vary"].lower()
    levels = deployment.client.get("/levels/hills", headers={"Accept-Encoding": "gzip"})
    assert deployment.client.get("/levels/hills", headers={"If-None-Match": levels.headers["etag"]}).status_code == 304
    assert "content-encoding" not in deployment.client.get(TILE, headers={"Accept-Encoding": "gzip"}).headers


def test_pages_of_all_origins_share_cache_entries(deployment: Deployment):
    address = tile_under_sun(44)
    answers = [deployment.client.get(address, headers={"Origin": origin} if origin else {}) for origin in ("", "https://a.example")]
    assert [status_and_cache_status(answer) for answer in answers] == [(200, "MISS"), (200, "HIT")]
    assert {answer.headers["access-control-allow-origin"] for answer in answers} == {"*"}


def test_private_answers_are_not_shared(deployment: Deployment):
    """Metrics are refused in any spelling, answers to a token are not cached, and each answer has its own request id."""
    for address in ("/metrics", "/%6detrics", "//metrics", "/levels/../metrics"):
        assert httpx.get(f"{deployment.client.base_url}{address}").status_code == 403, address
    address = tile_under_sun(47)
    answers = [deployment.client.get(address, headers={"Authorization": "Bearer something"}) for _ in range(2)]
    assert [status_and_cache_status(answer) for answer in answers] == [(200, "BYPASS")] * 2
    assert status_and_cache_status(deployment.client.get(address)) == (200, "MISS")
    numbers = [deployment.client.get(address).headers.get_list("x-request-id") for _ in range(2)]
    assert [len(ids) for ids in numbers] == [1, 1] and numbers[0] != numbers[1]


def test_documents_contain_the_address_of_the_proxy(deployment: Deployment):
    document = deployment.client.get("/levels/hills/WebMercatorQuad/tilejson.json").json()
    assert document["tiles"][0].startswith(f"{deployment.client.base_url}/levels/hills/")


def test_nginx_serves_archives_by_byte_ranges(deployment: Deployment):
    """nginx answers the ranges that map clients read, without the service."""
    address, etags = "/files/shadows.pmtiles", []

    def read(offset: int, length: int) -> bytes:
        answer = deployment.client.get(address, headers={"Range": f"bytes={offset}-{offset + length - 1}"})
        assert answer.status_code == 206 and answer.headers["access-control-allow-origin"] == "*"
        etags.append(answer.headers["etag"])
        return answer.content

    assert Reader(read).get(ZOOM, *CORNER) == PNG
    assert len(set(etags)) == 1
    assert deployment.client.get("/files/..%2fhills.yaml").status_code == 404
    assert deployment.client.get("/files/hills.yaml").status_code == 404
