"""Request ids, headers, metrics, logs and tokens of all answers; clients can inject nothing into them."""

import json
import logging
import re
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from skugga.api.http.server.request_middleware import LogFormatter, request_id
from tests.api.conftest import CORNER, ZOOM, Client
from tests.api.http.test_problems import check_problem
from tests.api.workers import fake_workers

TILE = f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png"
TILE_ROUTE = "/levels/{level}/tiles/{tms}/{z}/{x}/{y}.{format}"
DASHBOARD = Path(__file__).resolve().parents[3] / "examples" / "grafana-dashboard.json"


def metric_series(client: Client) -> dict[tuple, float]:
    """Return all series of the metrics: name and sorted labels -> value."""
    answer = client.get("/metrics")
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    families = text_string_to_metric_families(answer.text)
    return {(sample.name, *sorted(sample.labels.items())): sample.value for family in families for sample in family.samples}


def request_count(client: Client, route: str, status: int) -> float:
    """Return how many GET requests of a route had a status, by the metrics."""
    labels = {"route": route, "method": "GET", "status": str(status)}
    return metric_series(client).get(("skugga_requests_total", *sorted(labels.items())), 0.0)


def test_metrics_count_requests_jobs_and_caches(serve_with):
    client = serve_with(fake_workers.scripted, level_check_s=600)
    assert client.get(TILE).status_code == 200
    assert client.get(TILE).status_code == 200
    assert client.get(TILE.replace("hills", "nowhere")).status_code == 404
    assert client.get("/some/where").status_code == 404
    values = metric_series(client)
    assert request_count(client, TILE_ROUTE, 200) == 1
    assert request_count(client, "/levels/{level}/tiles/{tms}/{z}/{x}/{y} (kept)", 200) == 1
    assert request_count(client, TILE_ROUTE, 404) == 1
    assert request_count(client, "other", 404) == 1
    assert values["skugga_jobs_total", ("outcome", "answered")] == 1
    assert values["skugga_cache_requests_total", ("cache", "tiles"), ("result", "hit")] == 1
    assert values["skugga_cache_bytes", ("cache", "blocks")] > 0
    assert values["skugga_render_processes",] == values["skugga_render_process_starts_total",] == 1
    assert values["skugga_process_memory_bytes", ("process", "render 0")] > 1e6
    assert values["skugga_pass_seconds_count", ("algorithm", "none"), ("stage", "geometry")] == 1
    assert values["skugga_request_seconds_count", ("route", TILE_ROUTE)] == 2


def test_clients_cannot_create_metric_series(serve_with):
    client = serve_with(fake_workers.scripted)
    assert client.get(TILE).status_code == 200  # the render process has series of its own once it has started

    def request_unknown_names(number: int) -> int:
        client.get(f"/nothing/{number}")
        client.request(f"M{number}", "/levels")
        client.get(f"/levels/nowhere{number}")
        return len(metric_series(client))

    request_unknown_names(1)
    assert request_unknown_names(2) == request_unknown_names(3) == request_unknown_names(4)


def test_pass_metrics_by_algorithm_are_bounded(serve_with):
    metrics = serve_with(fake_workers.scripted).service.metrics
    from skugga.api.workers.jobs import Snapshot

    for number in range(1000):
        metrics.record_passes(Snapshot(b"", 1.0, f"mix {number}", (("geometry", 1.0),), 0.0, 0.0, True, "fake"))
    sample_lines = [line for line in metrics.text().decode().splitlines() if line.startswith("skugga_pass_seconds_count")]
    assert 200 <= len(sample_lines) <= 201
    assert "skugga_reach_clipped_total 1000.0" in metrics.text().decode()


def test_dashboard_names_existing_metrics_only(serve_with):
    metrics = serve_with(fake_workers.scripted).service.metrics
    board = json.loads(DASHBOARD.read_text(encoding="utf-8"))
    queries = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    assert len(queries) >= 10
    named = {name for query in queries for name in re.findall(r"skugga_[a-z_]+", query)}
    assert named <= metrics.series_names(), named - metrics.series_names()


@pytest.mark.parametrize(
    ("sent_id", "is_kept"),
    [("abc-123_x.Y", True), ("x" * 64, True), ("x" * 65, False), ("a b", False), ('"<b>', False), ("", False)],
)
def test_only_a_valid_request_id_is_kept(serve_with, sent_id: str, is_kept: bool):
    client = serve_with(fake_workers.scripted)
    answer = client.get("/healthz", headers={"X-Request-ID": sent_id})
    answered_id = answer.headers["x-request-id"]
    assert (answered_id == sent_id) == is_kept
    assert re.fullmatch(r"[A-Za-z0-9._-]{1,64}", answered_id)


def test_all_answers_have_the_common_headers(serve_with):
    client = serve_with(fake_workers.scripted)
    tile = client.get(TILE)
    answers = [
        tile, client.get(TILE), client.get(TILE, headers={"If-None-Match": tile.headers["etag"]}), client.get("/nothing"),
        client.head("/levels"), client.post("/plan", content=b"x" * (2**20 + 1)), client.get("/"), client.options("/levels"),
    ]  # fmt: skip
    assert [answer.status_code for answer in answers] == [200, 200, 304, 404, 200, 413, 200, 405]
    for answer in answers:
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["x-request-id"]
        assert re.search(r"total;dur=[\d.]+$", answer.headers["server-timing"])
    assert "geometry;dur=" in tile.headers["server-timing"]


def test_pages_load_nothing_from_other_hosts(serve_with):
    """The one exception are tiles of a base map, whose address a user gives to the viewer."""
    client = serve_with(fake_workers.scripted)
    for page in ("/", "/docs", "/levels/hills.html"):
        policy = client.get(page).headers["content-security-policy"]
        directives = dict(part.strip().split(" ", 1) for part in policy.split(";"))
        assert directives["default-src"] == "'self'" and directives["object-src"] == "'none'"
        assert "script-src" not in directives and "unsafe-eval" not in policy
        assert "http" not in " ".join(
            sources for name, sources in directives.items() if page != "/" or name not in ("img-src", "connect-src")
        )
    assert "content-security-policy" not in client.get("/levels").headers


def test_unexpected_error_is_logged_and_has_a_request_id(
    serve_with, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    client = serve_with(fake_workers.scripted)
    monkeypatch.setattr(logging.getLogger("skugga"), "propagate", True)
    monkeypatch.setattr(client.service.levels, "names", lambda: 1 / 0)
    answer = client.get("/levels", headers={"X-Request-ID": "number-7", "Origin": "https://a.example"})
    problem = check_problem(answer, 500, "internal", None)
    assert answer.headers["x-request-id"] == "number-7"
    assert "division" not in problem["detail"]
    assert any("failed unexpectedly" in record.getMessage() for record in caplog.records)


def test_access_log_is_optional_and_has_no_forged_lines(
    serve_with, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    plain_client, logging_client = serve_with(fake_workers.scripted), serve_with(fake_workers.scripted, access_log=True)
    monkeypatch.setattr(logging.getLogger("skugga"), "propagate", True)
    with caplog.at_level("INFO", "skugga.access"):
        plain_client.get("/levels")
        plain_client.get("/healthz")
        logging_client.get("/levels?x=%0Aforged%20line")
        logging_client.get("/healthz")  # after this the previous line has been written
    (record,) = [entry for entry in caplog.records if entry.name == "skugga.access" and entry.fields["path"] == "/levels"]
    # Both services were asked for their levels; only the one with an access log wrote a line.
    assert "forged" in record.fields["query"]
    assert record.fields["route"] == "/levels" and record.fields["status"] == 422
    for as_json in (False, True):
        assert "\n" not in LogFormatter(as_json).format(record)


def test_log_line_formats_text_and_json():
    record = logging.makeLogRecord({"msg": "said %s", "args": ("it",), "levelname": "INFO", "fields": {"ms": 1.5}})
    token = request_id.set("number-1")
    try:
        line = json.loads(LogFormatter(True).format(record))
        assert LogFormatter().format(record).endswith("said it ms=1.5 [number-1]")
    finally:
        request_id.reset(token)
    assert (line["message"], line["request_id"], line["ms"], line["level"]) == ("said it", "number-1", 1.5, "INFO")


def test_token_is_required_if_set(serve_with):
    client = serve_with(fake_workers.scripted, api_token="a secret token")
    for headers in ({}, {"Authorization": "Bearer another token"}, {"Authorization": "Basic a secret token"}):
        for path in ("/levels", TILE, "/", "/metrics", "/docs", "/nothing"):
            answer = client.get(path, headers=headers)
            check_problem(answer, 401, "unauthorized", None)
            assert answer.headers["www-authenticate"] == "Bearer"
    right = {"Authorization": "Bearer a secret token"}
    assert client.get("/levels", headers=right).status_code == 200
    tile = client.get(TILE, headers=right)
    assert tile.status_code == 200 and tile.headers["cache-control"].startswith("private, max-age="), (
        "a shared cache must not store answers to a token"
    )
    check_problem(client.get(TILE), 401, "unauthorized", None)
    assert client.get("/healthz").status_code == 200
    preflight = {
        "Origin": "https://a.example",
        "Access-Control-Request-Method": "GET",
        "Access-Control-Request-Headers": "authorization",
    }
    assert client.options("/levels", headers=preflight).status_code == 200


def test_cors_allows_no_cookies(serve_with):
    client = serve_with(fake_workers.scripted)
    answer = client.get("/levels", headers={"Origin": "https://a.example"})
    assert answer.headers["access-control-allow-origin"] == "*"
    assert "access-control-allow-credentials" not in answer.headers
