"""The HTML page of a level, its lines for map clients, and its layer definition for QGIS."""

from __future__ import annotations

import re
from html import unescape
from html.parser import HTMLParser
from urllib.parse import parse_qs, urljoin
from xml.etree import ElementTree

import pytest

from skugga.api.http.levels.level_page import level_page
from skugga.api.http.server.app import create_app
from skugga.api.settings import Settings
from tests.api.conftest import CORNER, ZOOM, Client, running, write_level
from tests.api.workers import fake_workers

BROWSER = "text/html,application/xhtml+xml,application/xml;q=0.9,image/avif,image/webp,*/*;q=0.8"
X, Y = CORNER


class Links(HTMLParser):
    """The addresses that a page links to, without ``data:`` URLs; asserts that every element is closed."""

    VOID = ("meta", "link", "img")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[str] = []
        self.open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value for name, value in attrs if name in ("href", "src") and value and not value.startswith("data:")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_accept_header_selects_page_or_json(client: Client):
    page = client.get("/levels/hills", headers={"Accept": BROWSER})
    assert page.headers["content-type"].startswith("text/html") and "Accept" in page.headers["vary"]
    assert page.text == client.get("/levels/hills.html").text
    for accept in ("*/*", "application/json", "application/json, text/html"):
        facts = client.get("/levels/hills", headers={"Accept": accept})
        assert facts.json()["name"] == "hills" and "Accept" in facts.headers["vary"]
    tag = page.headers["etag"]
    assert client.get("/levels/hills", headers={"Accept": BROWSER, "If-None-Match": tag}).status_code == 304


@pytest.mark.parametrize("name", ["hills", "site"])
def test_every_link_of_the_page_answers(client: Client, name: str):
    page = client.get(f"/levels/{name}.html")
    links = Links(page.text)
    assert not links.open and len(links.found) > 4
    for link in dict.fromkeys(links.found):
        answer = client.get(urljoin(str(page.url), link))
        assert answer.status_code == 200, link


def test_page_lines_lead_to_tiles(client: Client):
    """Each address in the lines answers once a tile's numbers replace its variables."""
    lines = unescape("\n".join(re.findall(r"<pre>(.*?)</pre>", client.get("/levels/hills.html").text, re.DOTALL)))
    for client_name in (
        "raster-dem",
        "L.tileLayer",
        "ol.source.XYZ",
        "ol.source.WMTS",
        "ipyleaflet.TileLayer",
        "setTerrain",
        "WMTS:",
    ):
        assert client_name in lines
    assert "encoding: 'terrarium'" in lines
    addresses = set(re.findall(r"http://[^\s'\",]+", lines))
    assert len(addresses) >= 5
    for address in addresses:
        assert client.get(address.replace("{z}", str(ZOOM)).replace("{x}", str(X)).replace("{y}", str(Y))).status_code == 200, (
            address
        )


def test_lines_json_equals_page_lines_and_keeps_the_query(client: Client):
    page = client.get("/levels/hills.html").text
    headings, texts = ([unescape(each) for each in re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)] for tag in ("h2", "pre"))
    plain = client.get("/levels/hills/lines.json").json()
    assert [(each["client"], each["text"]) for each in plain] == list(zip(headings, texts, strict=True))

    asked = "time=2024-06-21T18%3A00%3A00%2B00%3A00"
    lines = {each["client"]: each["text"] for each in client.get(f"/levels/hills/lines.json?layer=shadow&{asked}").json()}
    shown = f"?layer=shadow&{asked.replace('%2B00%3A00', 'Z')}"
    for name in ("Leaflet", "OpenLayers", "QGIS, XYZ tiles", "ipyleaflet", "MapLibre"):
        assert shown in lines[name], lines[name]
    tile = lines["QGIS, XYZ tiles"].format(z=ZOOM, x=X, y=Y)
    assert client.get(tile).content == client.get(f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{X}/{Y}.png{shown}").content
    assert "terrarium" in lines["MapLibre, in three dimensions"] and asked not in lines["MapLibre, in three dimensions"]
    assert client.get("/levels/site/lines.json").status_code == 422
    assert client.get("/levels/hills/lines.json?layer=sunhours").json()["parameter"] == "date"


def test_level_texts_are_escaped_in_markup(tmp_path):
    level = write_level(tmp_path, "odd & name", title="<b>Hills</b>", attribution="it's </pre> <i>ours</i>")
    with running(create_app(Settings(workers=1), [level], fake_workers.obedient)) as client:
        page = client.get("/levels/odd%20%26%20name.html")
        assert page.status_code == 200 and "<b>" not in page.text and "<i>" not in page.text
        assert not Links(page.text).open and "it\\'s" in unescape(page.text)
        capabilities = client.get("/levels/odd%20%26%20name/WMTSCapabilities.xml")
        assert "odd%20%26%20name" in ElementTree.tostring(ElementTree.fromstring(capabilities.content), encoding="unicode")
        assert ElementTree.fromstring(client.get("/levels/odd%20%26%20name.qlr").content).tag == "qlr"
        served = client.service.levels.get("odd & name")
        assert "https://maps.example/levels/odd%20%26%20name/wms" in level_page(served, "https://maps.example")


def test_qlr_lists_the_layers_for_qgis(client: Client):
    answer = client.get("/levels/timed.qlr")
    assert answer.status_code == 200 and answer.content.startswith(b"<!DOCTYPE qgis-layer-definition>")
    root = ElementTree.fromstring(answer.content)
    sources = {each.findtext("layername", ""): each.findtext("datasource", "") for each in root.iterfind("maplayers/maplayer")}
    shown = [each.get("name") for each in root.iter("layer-tree-layer") if each.get("checked") == "Qt::Checked"]
    assert list(sources) == [f"The timed: {name}" for name in ("color", "shadow", "sunhours", "heights")] and shown == [
        "The timed: color"
    ]
    color, heights = parse_qs(sources["The timed: color"]), parse_qs(sources["The timed: heights"])
    assert {each.findtext("srs/spatialrefsys/authid") for each in root.iterfind("maplayers/maplayer")} == {"EPSG:3857"}
    assert color["layers"] == ["timed:color"] and color["tileDimensions"] == ["Time=2024-06-21T16:00:00Z"]
    assert color["tileMatrixSet"] == ["WebMercatorQuad"] and color["crs"] == ["EPSG:3857"]
    assert client.get(color["url"][0]).status_code == 200
    tile = heights["url"][0].format(z=ZOOM, x=X, y=Y)
    assert heights["interpretation"] == ["terrariumterrain"] and client.get(tile).status_code == 200
    assert client.get("/levels/site.qlr").status_code == 422 and client.get("/levels/nowhere.qlr").status_code == 404
