"""Every HTTP error is a problem document that names the wrong parameter."""

import json
import socket
from http.client import HTTPResponse
from pathlib import Path

import httpx
import pytest
from starlette.requests import Request

from skugga.api.errors import ERROR_REPORTS
from skugga.api.http.problems import logged_error_response
from skugga.api.http.server.app import create_app
from skugga.api.settings import Settings
from skugga.terrain.errors import BusyError, InputError, RenderTimeoutError, SkuggaError
from tests.api.conftest import CORNER, ZOOM, Client, running, write_level
from tests.api.workers import fake_workers

X, Y = CORNER
TILE = f"levels/hills/tiles/WebMercatorQuad/{ZOOM}/{X}/{Y}.png"
TILEJSON = "levels/hills/WebMercatorQuad/tilejson.json"


def check_problem(answer: httpx.Response, status: int, code: str, parameter: str | None) -> dict:
    """Check a problem response (RFC 9457) and return its body. ``parameter`` is the refused parameter; ``None`` without one."""
    assert answer.status_code == status, answer.content[:300]
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["cache-control"] == "no-store"
    problem = answer.json()
    extra_keys = {"parameter"} if parameter else {"preparing"} if code == "not_ready" else set()
    assert set(problem) == {"type", "title", "status", "detail", "code"} | extra_keys
    assert (problem["status"], problem["code"], problem.get("parameter")) == (status, code, parameter)
    assert "Traceback" not in problem["detail"] and "/" not in problem["detail"].replace(str(answer.url.path), "")
    return problem


@pytest.mark.parametrize(
    ("address", "parameter", "expected_text"),
    [
        ("levels/nowhere", "level", "hills"),
        (TILE.replace("hills", "nowhere"), "level", "hills"),
        (TILE.replace("hills", "..%2F..%2Fetc%2Fpasswd"), None, ""),
        (TILEJSON.replace("hills", "nowhere"), "level", "hills"),
        ("levels/nowhere/plan", "level", "hills"),
        (TILE.replace("WebMercatorQuad", "Nowhere"), "tms", "WebMercatorQuad"),
        (TILE.replace("WebMercatorQuad", "NZTM2000Quad"), "tms", "WebMercatorQuad"),
        (TILEJSON.replace("WebMercatorQuad", "Nowhere"), "tms", "WebMercatorQuad"),
        (f"levels/hills/tiles/WebMercatorQuad/3/{X}/{Y}.png", "z", "zooms"),
        (f"levels/hills/tiles/WebMercatorQuad/25/{X}/{Y}.png", "z", "zooms"),
        (f"levels/hills/tiles/WebMercatorQuad/{ZOOM}/999999/{Y}.png", "x", "4095"),
        (f"levels/hills/tiles/WebMercatorQuad/{ZOOM}/{X}/-1.png", "y", "4095"),
        ("nothing", None, ""),
    ],
)
def test_unknown_resources_are_404(client: Client, address: str, parameter: str | None, expected_text: str):
    problem = check_problem(client.get(address), 404, "not_found", parameter)
    assert expected_text in problem["detail"]


@pytest.mark.parametrize(
    ("address", "parameter", "expected_text"),
    [
        (f"{TILE}?time=yesterday", "time", "yesterday"),
        (f"{TILE}?time=2024-06-21T12:00:00", "time", "offset"),
        (f"{TILE}?time=1500-01-01T00:00:00Z", "time", "1678"),
        (f"{TILE}?time=9999-12-31T23:59:59Z", "time", "1678"),
        (f"{TILE}?time=2024-06-21T12:00:00Z%00later", "time", "ISO 8601"),
        (f"{TILE}?time=%ED%A0%80", "time", "ISO 8601"),
        (f"{TILE}?time=%C0%AF", "time", "ISO 8601"),
        (f"{TILE}?layer=sunhours", "date", "missing"),
        (f"{TILE}?layer=sunhours&date=1718928000", "date", "2024-03-21"),
        (f"{TILE}?layer=sunhours&date=2024-02-30", "date", "calendar"),
        (f"{TILE}?layer=sunhours&date=0001-01-01", "date", "1679"),
        (f"{TILE}?%ED%A0%80=1", "\ufffd" * 3, "unknown"),
        (f"{TILE}?time=2024-06-21T12:00:00Z&altitude=3", "time", "cannot be combined with altitude"),
        (f"{TILE}?azimuth=10&altitude=91", "altitude", "91"),
        (f"{TILE}?azimuth=north&altitude=9", "azimuth", "north"),
        (f"{TILE}?azimuth=nan&altitude=9", "azimuth", "finite"),
        (f"{TILE}?azimuth=10", "altitude", "missing"),
        (f"{TILE}?colour=red", "colour", "layer"),
        (f"{TILE}?layer=color&layer=mask", "layer", "more than once"),
        (f"{TILE}?layer=heights", "layer", "mask"),
        (f"{TILE}?algorithm=truth", "algorithm", "sweep, none, auto"),
        (f"{TILE}?algorithm=forest%3Dmagic", "algorithm", "shadow_map"),
        (f"{TILE}?algorithm=lamp%3Dshadow_map", "algorithm", "relief"),
        (f"{TILE}?map_size=63", "map_size", "64"),
        (f"{TILE}?map_size=100000", "map_size", "8192"),
        (f"{TILE}?depth_bits=17", "depth_bits", "24"),
        (f"{TILE}?filter=4", "filter", "5"),
        (TILE.replace(".png", ".npy"), "format", "webp"),
        (TILE.replace(".png", ".png?layer=visibility"), "format", "tif"),
        (TILE.replace(".png", ".bmp"), "format", "webp"),
        (TILE.replace(".png", ".jpg?layer=mask"), "format", "webp"),
        (f"levels/hills/tiles/WebMercatorQuad/{ZOOM}/x/{Y}.png", "x", "whole number"),
        ("levels/hills/map.png?width=12.0", "width", "whole number"),
        ("levels/hills/map.png?bbox=0_0,0,1_0,10&crs=EPSG:3857", "bbox", "four numbers"),
        ("levels/hills/map.png?bbox=nan,0,10,10&crs=EPSG:3857", "bbox", "four numbers"),
        ("levels/hills/point?lat=47.5", "lon", "missing"),
        ("levels/hills/point?lon=8.43&lat=47.5&date=0001-01-01", "date", "1679"),
        ("levels/hills/point?lon=8.43&lat=47.5&date=9999-12-31", "date", "2260"),
        ("levels?page=2", "page", "2"),
        ("levels/hills?page=2", "page", "2"),
        ("healthz?deep=1", "deep", "1"),
        (f"{TILEJSON}?page=2", "page", "2"),
        (f"{TILEJSON}?azimuth=1&altitude=91", "altitude", "91"),
        ("levels/hills/plan?view=ridge", "view", "map"),
        ("levels/hills/plan?page=2", "page", "2"),
    ],
)
def test_wrong_parameters_are_422_and_named(client: Client, address: str, parameter: str, expected_text: str):
    problem = check_problem(client.get(address), 422, "invalid_parameter", parameter)
    assert parameter in problem["detail"]
    assert expected_text in problem["detail"]


@pytest.mark.parametrize("address", [TILE.replace("hills", "site"), TILEJSON.replace("hills", "site")])
def test_engineering_level_has_no_tiles(client: Client, address: str):
    problem = check_problem(client.get(address), 422, "unsupported", "level")
    assert "engineering CRS" in problem["detail"]


def test_engineering_level_refuses_a_time(client: Client):
    answer = client.get("levels/site/plan?time=2024-06-21T12:00:00Z")
    assert answer.status_code == 422
    assert "engineering" in answer.json()["detail"]


def test_other_methods_are_405(client: Client):
    for method in ("POST", "PUT", "DELETE"):
        answer = client.request(method, "levels")
        check_problem(answer, 405, "method_not_allowed", None)
        assert "GET" in answer.headers["allow"]


def test_level_broken_while_served_is_500(hills_level: Path, tmp_path: Path):
    path = write_level(tmp_path, "soon_broken")
    with running(create_app(Settings(workers=1, level_check_s=0), [hills_level, path], fake_workers.scripted)) as client:
        path.write_text("version: 7", encoding="utf-8")
        problem = check_problem(client.get("levels/soon_broken"), 500, "level", None)
        assert str(tmp_path) not in problem["detail"]
        assert [level["name"] for level in client.get("levels").json()] == ["hills"]


SECRETS = "/srv/levels/hills.tif", "libEGL.so.1: cannot open", "Traceback (most recent call last)", "hunter2"


@pytest.mark.parametrize(
    "error_class", sorted(ERROR_REPORTS, key=lambda error_class: error_class.__name__), ids=lambda error_class: error_class.__name__
)
def test_problems_leak_no_internal_details(error_class: type[SkuggaError]):
    """Messages of errors that the client did not cause hold paths and drivers' texts; the answer must hold none of them."""
    report = ERROR_REPORTS[error_class]
    if report.public_message is None:
        assert report.status < 500 or issubclass(error_class, BusyError | RenderTimeoutError), (
            "a message without a public version must be safe for clients"
        )
        return
    text = " ".join(SECRETS)
    error = error_class(text, text, text) if issubclass(error_class, InputError) else error_class(text)
    request = Request({"type": "http", "method": "GET", "path": "/levels", "headers": [], "query_string": b""})
    answer = logged_error_response(request, error)
    assert answer.status_code == report.status
    response_text = answer.body.decode() + str(answer.headers)
    assert not [secret for secret in SECRETS if secret in response_text]
    assert "/" not in report.public_message


def test_unparsable_request_is_a_problem_document(client: Client):
    """The server refuses these requests before it looks for a route."""
    address = client.base_url.host, client.base_url.port
    for request, status, code in (
        (b"get /levels HTTP/1.1\r\n\r\n", 400, "bad_request"),
        (b"GET /\xd9\xa1 HTTP/1.1\r\n\r\n", 400, "bad_request"),
        (b"GET / HTTP/1.1\r\nContent-Length: -1\r\n\r\n", 400, "bad_request"),
        (b"GET / HTTP/1.1\r\n" + b"X: " + b"a" * 70_000, 431, "head_too_large"),
    ):
        with socket.create_connection(address, timeout=30) as connection:
            connection.sendall(request)
            answer = HTTPResponse(connection)
            answer.begin()
            assert (answer.status, answer.headers["Content-Type"]) == (status, "application/problem+json")
            assert json.loads(answer.read())["code"] == code


@pytest.mark.parametrize(
    ("body", "status", "parameter", "expected_text"),
    [
        (b"[" * 100_000, 400, "body", "nested"),
        (b"\xff\xfe{}", 422, "body", "JSON"),
        (b"null", 422, "body", "Allowed: "),
        (b"[]", 422, "body", "an object"),
        (b'{"points": [{"lon": "8.43", "lat": 47.5}]}', 422, "points.0.lon", "number"),
        (b'{"points": [{"lon": false, "lat": 47.5}]}', 422, "points.0.lon", "number"),
        (b'{"points": [{"lon": 1e999, "lat": 47.5}]}', 422, "points.0.lon", "finite"),
        (b'{"points": [{"lon": 8.43, "lat": 47.5, "time": 1718971200}]}', 422, "points.0.time", "ISO 8601"),
        (b'{"points": [{"lon": 8.43, "lat": 47.5}], "time": "9999-12-31T23:59:59Z"}', 422, "time", "1678"),
        (b'{"points": [{"lon": 8.43, "lat": 47.5}], "date": 1718928000}', 422, "date", "2024-03-21"),
        (b'{"points": [{"lon": 8.43, "lat": 47.5}], "date": "0001-01-01"}', 422, "date", "1679"),
        (b'{"points": [{"lon": 8.43, "lat": 47.5}], "clock": "\\ud800"}', 422, "clock", "unicode"),
    ],
)
def test_hostile_bodies_are_refused(client: Client, body: bytes, status: int, parameter: str, expected_text: str):
    answer = client.post("levels/hills/point", content=body, headers={"Content-Type": "application/json"})
    code = {400: "bad_request", 422: "invalid_parameter"}[status]
    assert expected_text in check_problem(answer, status, code, parameter)["detail"]


def test_body_with_another_content_type_is_refused(client: Client):
    answer = client.post("levels/hills/point", content=b'{"points": []}', headers={"Content-Type": "text/plain"})
    assert "Content-Type" in answer.json()["detail"].replace("application/json", "") and answer.json()["parameter"] == "body"
