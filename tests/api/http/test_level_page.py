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


class LinkParser(HTMLParser):
    """The addresses that a page links to, without ``data:`` URLs; asserts that every element is closed."""

    VOID = ("meta", "link", "img")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.urls: list[str] = []
        self.open_tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.urls += [value for name, value in attrs if name in ("href", "src") and value and not value.startswith("data:")]
        if tag not in self.VOID:
            self.open_tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open_tags.pop() == tag


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
    links = LinkParser(page.text)
    assert not links.open_tags and len(links.urls) > 4
    for link in dict.fromkeys(links.urls):
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
    headings, texts = ([unescape(item) for item in re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)] for tag in ("h2", "pre"))
    plain = client.get("/levels/hills/lines.json").json()
    assert [(item["client"], item["text"]) for item in plain] == list(zip(headings, texts, strict=True))

    time_query = "time=2024-06-21T18%3A00%3A00%2B00%3A00"
    lines = {item["client"]: item["text"] for item in client.get(f"/levels/hills/lines.json?layer=shadow&{time_query}").json()}
    normalized_query = f"?layer=shadow&{time_query.replace('%2B00%3A00', 'Z')}"
    for name in ("Leaflet", "OpenLayers", "QGIS, XYZ tiles", "ipyleaflet", "MapLibre"):
        assert normalized_query in lines[name], lines[name]
    tile = lines["QGIS, XYZ tiles"].format(z=ZOOM, x=X, y=Y)
    assert (
        client.get(tile).content == client.get(f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{X}/{Y}.png{normalized_query}").content
    )
    assert "terrarium" in lines["MapLibre, in three dimensions"] and time_query not in lines["MapLibre, in three dimensions"]
    assert client.get("/levels/site/lines.json").status_code == 422
    assert client.get("/levels/hills/lines.json?layer=sunhours").json()["parameter"] == "date"


def test_level_texts_are_escaped_in_markup(tmp_path):
    level = write_level(tmp_path, "odd & name", title="<b>Hills</b>", attribution="it's </pre> <i>ours</i>")
    with running(create_app(Settings(workers=1), [level], fake_workers.scripted)) as client:
        page = client.get("/levels/odd%20%26%20name.html")
        assert page.status_code == 200 and "<b>" not in page.text and "<i>" not in page.text
        assert not LinkParser(page.text).open_tags and "it\\'s" in unescape(page.text)
        capabilities = client.get("/levels/odd%20%26%20name/WMTSCapabilities.xml")
        assert "odd%20%26%20name" in ElementTree.tostring(ElementTree.fromstring(capabilities.content), encoding="unicode")
        assert ElementTree.fromstring(client.get("/levels/odd%20%26%20name.qlr").content).tag == "qlr"
        served_level = client.service.levels.reload_if_changed("odd & name")
        assert "https://maps.example/levels/odd%20%26%20name/wms" in level_page(served_level, "https://maps.example")


def test_qlr_lists_the_layers_for_qgis(client: Client):
    answer = client.get("/levels/timed.qlr")
    assert answer.status_code == 200 and answer.content.startswith(b"<!DOCTYPE qgis-layer-definition>")
    root = ElementTree.fromstring(answer.content)
    sources = {
        element.findtext("layername", ""): element.findtext("datasource", "") for element in root.iterfind("maplayers/maplayer")
    }
    checked_layers = [element.get("name") for element in root.iter("layer-tree-layer") if element.get("checked") == "Qt::Checked"]
    assert list(sources) == [f"The timed: {name}" for name in ("color", "shadow", "sunhours", "heights")] and checked_layers == [
        "The timed: color"
    ]
    color, heights = parse_qs(sources["The timed: color"]), parse_qs(sources["The timed: heights"])
    assert {element.findtext("srs/spatialrefsys/authid") for element in root.iterfind("maplayers/maplayer")} == {"EPSG:3857"}
    assert color["layers"] == ["timed:color"] and color["tileDimensions"] == ["Time=2024-06-21T16:00:00Z"]
    assert color["tileMatrixSet"] == ["WebMercatorQuad"] and color["crs"] == ["EPSG:3857"]
    assert client.get(color["url"][0]).status_code == 200
    tile = heights["url"][0].format(z=ZOOM, x=X, y=Y)
    assert heights["interpretation"] == ["terrariumterrain"] and client.get(tile).status_code == 200


def test_qlr_of_a_level_without_a_crs_or_of_no_level_is_refused(client: Client):
    assert client.get("/levels/site.qlr").status_code == 422
    assert client.get("/levels/nowhere.qlr").status_code == 404
