"""The page on ``/``, with and without the built viewer."""

from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from skugga.api.http.server import routes_viewer
from skugga.api.http.server.app import create_app
from skugga.api.settings import Settings
from tests.api.conftest import Client, running
from tests.api.workers import fake_workers


@pytest.fixture
def app(hills_level: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """A function that makes a service whose viewer is served from an empty folder."""
    monkeypatch.setattr(routes_viewer, "STATIC_FOLDER", tmp_path)

    def make(**settings: Any) -> FastAPI:
        return create_app(Settings(**{"workers": 1} | settings), [hills_level], fake_workers.scripted)

    return make


def check_page(client: Client, expected_text: str) -> None:
    """Check that the start page is HTML and contains a text."""
    page = client.get("/")
    assert page.status_code == 200
    assert page.headers["content-type"].startswith("text/html")
    assert expected_text in page.text


def test_page_without_a_viewer_says_how_to_build_it(app):
    with running(app()) as client:
        check_page(client, "make viewer")
        check_page(client, 'href="levels/hills/WebMercatorQuad/tilejson.json"')
        assert client.get("/assets/map.js").status_code == 404
        assert client.get("/assets/map.js").headers["content-type"] == "application/problem+json"


def test_viewer_and_its_assets_are_served(app, tmp_path: Path):
    (tmp_path / "assets").mkdir()
    (tmp_path / "index.html").write_text("<title>A viewer</title>", encoding="utf-8")
    (tmp_path / "assets" / "map.js").write_text("draw()", encoding="utf-8")
    (tmp_path.parent / "secret").write_text("x", encoding="utf-8")
    with running(app()) as client:
        check_page(client, "A viewer")
        for address in ("/assets/map.js", "/static/assets/map.js"):
            assert client.get(address).text == "draw()"
        assert client.head("/assets/map.js").headers["content-length"] == "6"
        for address in ("/static/../secret", "/static/%2e%2e/secret", "/assets/..%2f..%2fsecret"):
            assert client.get(address).status_code == 404


BASE_MAPS = [
    {"title": "Streets", "tiles": "https://tiles.example/{z}/{x}/{y}.png", "attribution": "© them", "maxzoom": 17},
    {"title": "Own", "tiles": "archives/own/{z}/{x}/{y}.png"},
]


def directive_of(client: Client, name: str) -> list[str]:
    """Return the sources of a directive of the start page's Content-Security-Policy."""
    policy = client.get("/").headers["content-security-policy"]
    (directive,) = (part.split() for part in policy.split(";") if part.split()[0] == name)
    return directive[1:]


def test_page_takes_tiles_from_base_maps_only(app, tmp_path: Path):
    """Without ``SKUGGA_BASE_MAPS_ONLY`` users may paste an address of any server."""
    (tmp_path / "index.html").write_text("<title>A viewer</title>", encoding="utf-8")
    with running(app()) as client:
        assert client.get("/base-maps.json").json() == {"base_maps": [], "only": False}
        assert directive_of(client, "img-src") == ["'self'", "https:", "http:", "data:", "blob:"]
    with running(app(base_maps=BASE_MAPS, base_maps_only=True)) as client:
        document = client.get("/base-maps.json").json()
        assert document["only"] and document["base_maps"][0] == BASE_MAPS[0]
        assert document["base_maps"][1] == {**BASE_MAPS[1], "attribution": "", "maxzoom": 19}
        assert directive_of(client, "img-src") == ["'self'", "https://tiles.example", "data:", "blob:"]
        assert directive_of(client, "connect-src") == ["'self'", "https://tiles.example"]
