"""WMTS 1.0.0: the structure of its capabilities, the tiles that they lead to, and OWSLib as a client."""

from __future__ import annotations

import io
from datetime import UTC, datetime
from typing import Any
from xml.etree import ElementTree

import httpx
import numpy as np
import pytest
from morecantile import tms
from owslib.wmts import WebMapTileService
from PIL import Image
from pyproj import CRS

from skugga.api.http.ogc.ogc_times import TimeDimension, requested_date, requested_instant, time_dimension
from skugga.api.http.ogc.ogc_xml import lon_lat_box
from skugga.api.http.server.app import create_app
from skugga.api.settings import Settings
from skugga.terrain.errors import InputError
from tests.api.conftest import CORNER, ZOOM, Client, running, write_level
from tests.api.workers import fake_workers

X, Y = CORNER
ADDRESS = "/wmts/1.0.0/WMTSCapabilities.xml"
NAMESPACES = {"w": "http://www.opengis.net/wmts/1.0", "o": "http://www.opengis.net/ows/1.1", "x": "http://www.w3.org/1999/xlink"}
TILE = f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{X}/{Y}.png"
KEYS = {
    "SERVICE": "WMTS", "REQUEST": "GetTile", "VERSION": "1.0.0", "LAYER": "hills:color", "STYLE": "default", "FORMAT": "image/png",
    "TILEMATRIXSET": "WebMercatorQuad", "TILEMATRIX": str(ZOOM), "TILECOL": str(X), "TILEROW": str(Y),
}  # fmt: skip

LAYERS = {
    "color",
    "shadow",
    "mask",
    "visibility",
    "height",
    "terrain-rgb",
    "terrarium",
    "cosi",
    "irradiation",
    "sky_view",
    "sunhours",
}

CHILD_ELEMENT_ORDER = {
    "Layer": [
        "Title", "Abstract", "WGS84BoundingBox", "Identifier", "Style", "Format", "Dimension", "TileMatrixSetLink", "ResourceURL",
    ],
    "Dimension": ["Identifier", "UOM", "Default", "Value"],
    "Style": ["Title", "Identifier", "LegendURL"],
    "TileMatrixSetLink": ["TileMatrixSet", "TileMatrixSetLimits"],
    "TileMatrixLimits": ["TileMatrix", "MinTileRow", "MaxTileRow", "MinTileCol", "MaxTileCol"],
    "TileMatrixSet": ["Identifier", "SupportedCRS", "WellKnownScaleSet", "TileMatrix"],
    "TileMatrix": [
        "Identifier", "ScaleDenominator", "TopLeftCorner", "TileWidth", "TileHeight", "MatrixWidth", "MatrixHeight",
    ],
    "Contents": ["Layer", "TileMatrixSet"],
    "Capabilities": ["ServiceIdentification", "OperationsMetadata", "Contents", "ServiceMetadataURL"],
}  # fmt: skip
"""The order of child elements in the schema of WMTS 1.0.0 (OGC 07-057r7, annex B), by parent."""


def local_name(tag: str) -> str:
    """Return an element's tag without its namespace."""
    return tag.rpartition("}")[2]


def check_order(root: ElementTree.Element, order: dict[str, list[str]]) -> None:
    """Assert that the schema knows every element's children, and that they have its order."""
    for element in root.iter():
        children = [local_name(child.tag) for child in element]
        if local_name(element.tag) in order and children:
            allowed_children = order[local_name(element.tag)]
            assert set(children) <= set(allowed_children), (local_name(element.tag), children)
            assert [allowed_children.index(child) for child in children] == sorted(
                allowed_children.index(child) for child in children
            ), children


@pytest.fixture(scope="module")
def root(client: Client) -> ElementTree.Element:
    """Root element of the WMTS capabilities."""
    answer = client.get(ADDRESS)
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/xml")
    return ElementTree.fromstring(answer.content)


def layer_of(root: ElementTree.Element, name: str) -> ElementTree.Element:
    """Return the element of a layer of WMTS capabilities."""
    return next(
        node for node in root.iterfind("w:Contents/w:Layer", NAMESPACES) if node.findtext("o:Identifier", "", NAMESPACES) == name
    )


def pixels(answer: httpx.Response) -> np.ndarray:
    """Return the picture of a successful response as RGBA (rows, cols, 4)."""
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA"))


def test_wmts_capabilities_follow_the_schema(root: ElementTree.Element):
    check_order(root, CHILD_ELEMENT_ORDER)
    names = [node.findtext("o:Identifier", "", NAMESPACES) for node in root.iterfind("w:Contents/w:Layer", NAMESPACES)]
    assert set(names) == {f"{level}:{layer}" for level in ("hills", "timed") for layer in LAYERS} and len(set(names)) == len(names)
    for layer in root.iterfind("w:Contents/w:Layer", NAMESPACES):
        assert layer.findall("w:Style[@isDefault='true']", NAMESPACES) and layer.findall("w:Format", NAMESPACES)


def test_matrix_set_corners_follow_the_axis_order(client: Client, root: ElementTree.Element):
    served_sets = client.get("/levels/hills").json()["tile_matrix_sets"]
    linked_names = {node.text for node in layer_of(root, "hills:color").iterfind("w:TileMatrixSetLink/w:TileMatrixSet", NAMESPACES)}
    described_sets = {
        node.findtext("o:Identifier", "", NAMESPACES): node for node in root.iterfind("w:Contents/w:TileMatrixSet", NAMESPACES)
    }
    assert linked_names == set(served_sets) == set(described_sets)
    for name, element in described_sets.items():
        crs = CRS.from_user_input(element.findtext("o:SupportedCRS", "", NAMESPACES))
        first = element.find("w:TileMatrix", NAMESPACES)
        assert first is not None
        corner = tuple(float(value) for value in first.findtext("w:TopLeftCorner", "", NAMESPACES).split())
        bounds = tms.get(name).xy_bounds(0, 0, tms.get(name).minzoom)
        expected = (bounds.top, bounds.left) if crs.axis_info[0].direction == "north" else (bounds.left, bounds.top)
        assert corner == pytest.approx(expected, abs=1e-3), name
    assert described_sets["WGS1984Quad"].findtext("w:TileMatrix/w:TopLeftCorner", "", NAMESPACES) == "90.0 -180.0"


def test_matrix_sets_end_at_the_maxzoom_of_the_level(client: Client, root: ElementTree.Element):
    """GDAL opens a layer at the finest matrix, and QGIS requests its tiles, whatever the limits say."""
    last = {name: zooms["maxzoom"] for name, zooms in client.get("/levels/hills").json()["tile_matrix_sets"].items()}
    for element in root.iterfind("w:Contents/w:TileMatrixSet", NAMESPACES):
        matrices = [node.text for node in element.iterfind("w:TileMatrix/o:Identifier", NAMESPACES)]
        name = element.findtext("o:Identifier", "", NAMESPACES)
        assert matrices == [str(zoom) for zoom in range(tms.get(name).minzoom, last[name] + 1)], name


def test_tile_matrix_limits_contain_the_data(client: Client, root: ElementTree.Element):
    """In every matrix set, also one twice as wide as high. The expected tiles are those of the corners by morecantile."""
    level_info = client.get("/levels/hills").json()
    west, south, east, north = level_info["bounds"]
    links = {
        node.findtext("w:TileMatrixSet", "", NAMESPACES): node
        for node in layer_of(root, "hills:color").iterfind("w:TileMatrixSetLink", NAMESPACES)
    }
    assert len(links) > 3
    for name, link in links.items():
        zooms = level_info["tile_matrix_sets"][name]
        limits = {
            node.findtext("w:TileMatrix", "", NAMESPACES): node for node in link.iterfind(".//w:TileMatrixLimits", NAMESPACES)
        }
        assert list(limits) == [str(zoom) for zoom in range(zooms["minzoom"], zooms["maxzoom"] + 1)]
        for zoom in (zooms["minzoom"], zooms["maxzoom"]):
            first_row, last_row, first_col, last_col = (int(node.text or "") for node in list(limits[str(zoom)])[1:])
            corners = [tms.get(name).tile(lon, lat, zoom) for lon in (west, east) for lat in (south, north)]
            tile_cols, tile_rows = [tile.x for tile in corners], [tile.y for tile in corners]
            assert (
                first_col <= min(tile_cols) <= max(tile_cols) <= last_col
                and first_row <= min(tile_rows) <= max(tile_rows) <= last_row
            ), name
            assert (last_row - first_row, last_col - first_col) <= (
                max(tile_rows) - min(tile_rows) + 2,
                max(tile_cols) - min(tile_cols) + 2,
            ), name
    limits = {
        node.findtext("w:TileMatrix", "", NAMESPACES): node
        for node in links["WebMercatorQuad"].iterfind(".//w:TileMatrixLimits", NAMESPACES)
    }
    # The level's middle is the corner of four tiles, which contain it.
    assert [node.text for node in list(limits[str(ZOOM)])[1:]] == [str(Y - 1), str(Y), str(X - 1), str(X)]


def test_time_dimension_lists_default_and_range(root: ElementTree.Element):
    color_dimension, angles, hours = (
        layer_of(root, name).find("w:Dimension", NAMESPACES) for name in ("timed:color", "hills:color", "timed:sunhours")
    )
    assert color_dimension is not None and angles is not None and hours is not None
    assert color_dimension.findtext("o:Identifier", "", NAMESPACES) == "Time"
    assert color_dimension.findtext("w:Default", "", NAMESPACES) == "2024-06-21T16:00:00Z"  # 18:00+02:00
    values = [node.text for node in color_dimension.iterfind("w:Value", NAMESPACES)]
    assert values == ["2024-06-21T16:00:00Z", "2024-01-01T00:00:00Z/2024-12-31T23:50:00Z/PT10M"]
    assert angles.findtext("w:Default", "", NAMESPACES) == "default"
    assert hours.findtext("w:Default", "", NAMESPACES) == "2024-06-21"
    assert [node.text for node in hours.iterfind("w:Value", NAMESPACES)] == ["2024-06-21", "2024-01-01/2024-12-31/P1D"]
    assert layer_of(root, "hills:terrain-rgb").find("w:Dimension", NAMESPACES) is None
    assert b"current" not in ElementTree.tostring(root)


def test_level_time_lies_on_its_time_dimension(tmp_path):
    """18:07:30 +02:00 is no multiple of the step of 10 minutes, so the range begins at 00:07:30."""
    level = write_level(tmp_path, "odd", sun={"time": "2024-06-21T18:07:30+02:00"})
    with running(create_app(Settings(workers=1), [level], fake_workers.scripted)) as client:
        served_level = client.service.levels.reload_if_changed("odd")
    assert time_dimension(served_level, "color", 2020) == TimeDimension(
        "2024-06-21T16:07:30Z", "2024-01-01T00:07:30Z/2024-12-31T23:57:30Z/PT10M"
    )


def test_capabilities_accept_another_default_time(client: Client):
    """GDAL uses no time but the document's default."""

    def defaults(time: str) -> list[str]:
        document = ElementTree.fromstring(client.get("/levels/timed/WMTSCapabilities.xml", params={"time": time}).content)
        names = ("timed:color", "timed:sunhours")
        return [layer_of(document, name).findtext("w:Dimension/w:Default", "", NAMESPACES) for name in names]

    assert defaults("2024-12-21T10:00:00+02:00") == ["2024-12-21T08:00:00Z", "2024-12-21"]
    assert defaults("current") == ["current", "2024-06-21"] and defaults("default") == ["2024-06-21T16:00:00Z", "2024-06-21"]
    answer = client.get("/levels/timed/WMTSCapabilities.xml?time=soon")
    assert answer.status_code == 422 and b'locator="time"' in answer.content


def test_resource_templates_lead_to_tiles(client: Client, root: ElementTree.Element):
    """Each layer and format answers; the document's own values fill every variable."""
    for layer in sorted(LAYERS):
        element = layer_of(root, f"timed:{layer}")
        formats = [node.text for node in element.iterfind("w:Format", NAMESPACES)]
        templates = element.findall("w:ResourceURL", NAMESPACES)
        assert [node.get("format") for node in templates] == formats
        time = element.findtext("w:Dimension/w:Default", "", NAMESPACES)
        for node in templates:
            variables = {"TileMatrixSet": "WebMercatorQuad", "TileMatrix": ZOOM, "TileCol": X, "TileRow": Y, "Time": time}
            variables["Style"] = element.findtext("w:Style[@isDefault='true']/o:Identifier", "", NAMESPACES)
            address = node.get("template", "").format(**variables)
            if layer in ("irradiation", "sunhours"):  # its blocks take long to draw; 304 says that the address is valid
                assert client.get(address, headers={"If-None-Match": "*"}).status_code == 304, address
                continue
            answer = client.get(address)
            assert answer.status_code == 200 and answer.headers["content-type"] == node.get("format"), address
    angles = layer_of(root, "hills:color").find("w:ResourceURL", NAMESPACES)
    assert angles is not None and angles.get("template", "").endswith(
        "/{TileMatrixSet}/{TileMatrix}/{TileCol}/{TileRow}.png?style={Style}&time={Time}"
    )
    assert client.get(f"{TILE}?time=default").content == client.get(TILE).content


def test_layers_of_a_colour_scale_have_a_legend(client: Client, root: ElementTree.Element):
    legend = layer_of(root, "timed:sunhours").find("w:Style/w:LegendURL", NAMESPACES)
    assert legend is not None and legend.get("format") == "image/png"
    assert pixels(client.get(legend.get(f"{{{NAMESPACES['x']}}}href", ""))).shape == (85, 340, 4)
    assert layer_of(root, "timed:sky_view").find("w:Style/w:LegendURL", NAMESPACES) is not None
    assert layer_of(root, "timed:color").find("w:Style/w:LegendURL", NAMESPACES) is None


def test_level_has_capabilities_of_its_own(client: Client):
    document = ElementTree.fromstring(client.get("/levels/timed/WMTSCapabilities.xml").content)
    names = [node.findtext("o:Identifier", "", NAMESPACES) for node in document.iterfind("w:Contents/w:Layer", NAMESPACES)]
    assert {name.split(":")[0] for name in names} == {"timed"}
    answer = client.get("/levels/site/WMTSCapabilities.xml")
    assert answer.status_code == 422 and b"engineering CRS" in answer.content
    assert client.get("/levels/nowhere/WMTSCapabilities.xml").status_code == 404


def test_kvp_gettile_equals_the_rest_tile(client: Client):
    tile = client.get(TILE)
    answer = client.get("/wmts", params=KEYS)
    assert answer.content == tile.content and answer.headers["etag"] == tile.headers["etag"]
    assert client.get("/wmts", params=KEYS, headers={"If-None-Match": tile.headers["etag"]}).status_code == 304
    lowercase_query = {name.lower(): value for name, value in KEYS.items()}
    timed = client.get("/wmts", params={**lowercase_query, "time": "2024-06-21T17:00:00+02:00", "layer": "hills:mask"})
    assert timed.content == client.get(f"{TILE}?layer=mask&time=2024-06-21T15:00:00Z").content
    assert (
        client.get("/wmts", params={**KEYS, "AZIMUTH": "70", "ALTITUDE": "18"}).content
        == client.get(f"{TILE}?azimuth=70&altitude=18").content
    )
    capabilities = client.get("/wmts?service=WMTS&request=GetCapabilities&acceptversions=1.0.0")
    assert capabilities.content == client.get(ADDRESS).content and capabilities.headers["etag"]
    assert "x-skugga-time" in client.get("/wmts", params={**KEYS, "TIME": "current"}).headers


@pytest.mark.parametrize(
    ("query_changes", "status", "code", "locator"),
    [
        ({"LAYER": None}, 422, "MissingParameterValue", "LAYER"),
        ({"REQUEST": None}, 422, "MissingParameterValue", "REQUEST"),
        ({"REQUEST": "GetFeatureInfo"}, 422, "OperationNotSupported", "REQUEST"),
        ({"SERVICE": "WFS"}, 422, "InvalidParameterValue", "SERVICE"),
        ({"VERSION": "2.0.0"}, 422, "VersionNegotiationFailed", "VERSION"),
        ({"LAYER": "hills"}, 404, "InvalidParameterValue", "LAYER"),
        ({"LAYER": "hills:depth"}, 404, "InvalidParameterValue", "LAYER"),
        ({"LAYER": "nowhere:color"}, 404, "InvalidParameterValue", "level"),
        ({"STYLE": "dark"}, 422, "InvalidParameterValue", "STYLE"),
        ({"FORMAT": "image/gif"}, 422, "InvalidParameterValue", "FORMAT"),
        ({"TILEMATRIXSET": "Mars"}, 404, "InvalidParameterValue", "tms"),
        ({"TILEMATRIX": "deep"}, 422, "InvalidParameterValue", "TILEMATRIX"),
        ({"TILECOL": "-1"}, 422, "InvalidParameterValue", "TILECOL"),
        ({"TILECOL": "99999"}, 404, "TileOutOfRange", "x"),
        ({"TIME": "yesterday"}, 422, "InvalidParameterValue", "time"),
        ({"LAYER": "site:color"}, 422, "InvalidParameterValue", "LAYER"),
    ],
)
def test_wmts_exceptions_have_code_and_locator(client: Client, query_changes: dict[str, Any], status: int, code: str, locator: str):
    answer = client.get("/wmts", params={name: value for name, value in {**KEYS, **query_changes}.items() if value is not None})
    assert answer.status_code == status and answer.headers["content-type"].startswith("text/xml")
    assert answer.headers["cache-control"] == "no-store"
    report = ElementTree.fromstring(answer.content)
    exception = report.find("o:Exception", NAMESPACES)
    assert local_name(report.tag) == "ExceptionReport" and exception is not None
    assert (exception.get("exceptionCode"), exception.get("locator")) == (code, locator), answer.text
    assert exception.findtext("o:ExceptionText", "", NAMESPACES)


# -- third-party clients


def test_owslib_reads_wmts(client: Client):
    service = WebMapTileService(f"{client.base_url}{ADDRESS}")
    layer = service.contents["timed:color"]
    assert layer.boundingBoxWGS84 == pytest.approx(tuple(client.get("/levels/timed").json()["bounds"]), abs=1e-9)
    assert "WebMercatorQuad" in layer.tilematrixsetlinks and "image/png" in layer.formats
    tile = service.gettile(
        layer="hills:mask", tilematrixset="WebMercatorQuad", tilematrix=str(ZOOM), row=Y, column=X, format="image/png",
        style="default",
    )  # fmt: skip
    assert tile.read() == client.get(f"{TILE}?layer=mask").content


# -- without a service


def test_requested_instant_and_date_parse_times():
    assert [requested_instant(text, 0.0) for text in (None, "", "default")] == [None] * 3
    assert requested_instant("2024-06-21T16:00:00Z", 7.0) == "2024-06-21T16:00:00Z"
    assert requested_instant("2024-06-21T16:00", 7.0) == "2024-06-21T16:00Z"
    assert requested_instant("2024-06-21T16:00:00+02:00/2024-06-22T00:00:00+02:00", 7.0) == "2024-06-21T16:00:00+02:00"
    assert requested_instant("2024-06-21", -90.0) == "2024-06-21T18:00:00Z"  # solar noon, six hours after that of Greenwich
    for wrong in ("2024-13-41", "soon", "2024-06-21T25:00Z"):
        with pytest.raises(InputError, match=f"time: '{wrong}' is not allowed. Allowed: a date, an ISO 8601 time"):
            requested_instant(wrong, 0.0)
    default = datetime(2024, 3, 21, tzinfo=UTC).date()
    assert requested_date("2024-06-21T00:00:00Z", default).isoformat() == "2024-06-21" and requested_date(None, default) == default
    with pytest.raises(InputError, match="a date"):
        requested_date("soon", default)


def test_box_across_the_antimeridian_spans_all_longitudes():
    assert lon_lat_box((170.0, -20.0, 190.0, -10.0)) == (-180.0, -20.0, 180.0, -10.0)
    assert lon_lat_box((8.0, 47.0, 9.0, 48.0)) == (8.0, 47.0, 9.0, 48.0)
