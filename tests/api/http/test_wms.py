"""WMS 1.3.0: the structure of its capabilities, its maps compared with tiles, and OWSLib as a client."""

from __future__ import annotations

import io
from typing import Any
from xml.etree import ElementTree

import httpx
import numpy as np
import pytest
from morecantile import tms
from owslib.wms import WebMapService
from PIL import Image
from pyproj import CRS, Transformer

from tests.api.conftest import CORNER, ZOOM, Client
from tests.api.http.test_wmts import check_order, local_name

X, Y = CORNER
NAMESPACES = {"w": "http://www.opengis.net/wms", "x": "http://www.w3.org/1999/xlink", "e": "http://www.opengis.net/ogc"}
TILE = f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{X}/{Y}.png"
BOUNDS = tms.get("WebMercatorQuad").xy_bounds(X, Y, ZOOM)
MAP = {
    "SERVICE": "WMS", "VERSION": "1.3.0", "REQUEST": "GetMap", "LAYERS": "hills:color", "STYLES": "", "CRS": "EPSG:3857",
    "BBOX": ",".join(repr(value) for value in BOUNDS), "WIDTH": "256", "HEIGHT": "256", "FORMAT": "image/png",
    "TRANSPARENT": "TRUE",
}  # fmt: skip
FEATURE_INFO_QUERY = {**MAP, "REQUEST": "GetFeatureInfo", "QUERY_LAYERS": "hills:color", "I": "100", "J": "50"}

CHILD_ELEMENT_ORDER = {
    "Service": ["Name", "Title", "Abstract", "OnlineResource", "Fees", "AccessConstraints", "LayerLimit", "MaxWidth", "MaxHeight"],
    "Capability": ["Request", "Exception", "Layer"],
    "Request": ["GetCapabilities", "GetMap", "GetFeatureInfo"],
    "Layer": [
        "Name", "Title", "Abstract", "CRS", "EX_GeographicBoundingBox", "BoundingBox", "Dimension", "Attribution", "Style", "Layer",
    ],
    "EX_GeographicBoundingBox": ["westBoundLongitude", "eastBoundLongitude", "southBoundLatitude", "northBoundLatitude"],
    "Style": ["Name", "Title", "LegendURL"],
    "LegendURL": ["Format", "OnlineResource"],
    "WMS_Capabilities": ["Service", "Capability"],
}  # fmt: skip
"""The order of child elements in the schema of WMS 1.3.0 (OGC 06-042, annex E), by parent."""


@pytest.fixture(scope="module")
def root(client: Client) -> ElementTree.Element:
    """Root element of the WMS capabilities."""
    answer = client.get("/wms?SERVICE=WMS&REQUEST=GetCapabilities")
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/xml")
    return ElementTree.fromstring(answer.content)


def layers_of(root: ElementTree.Element) -> dict[str, ElementTree.Element]:
    """Return the named layers of WMS capabilities by name."""
    return {
        layer.findtext("w:Name", "", NAMESPACES): layer
        for layer in root.iter(f"{{{NAMESPACES['w']}}}Layer")
        if layer.find("w:Name", NAMESPACES) is not None
    }


def pixels(answer: httpx.Response) -> np.ndarray:
    """Return the picture of a successful response (rows, cols, channels)."""
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)))


def test_wms_capabilities_follow_the_schema(client: Client, root: ElementTree.Element):
    check_order(root, CHILD_ELEMENT_ORDER)
    assert root.get("version") == "1.3.0"
    layers = layers_of(root)
    assert set(layers) == {
        f"{level}:{layer}"
        for level in ("hills", "timed")
        for layer in ("color", "shadow", "mask", "irradiation", "sky_view", "sunhours")
    }
    color = layers["timed:color"]
    assert {element.text for element in color.iterfind("w:CRS", NAMESPACES)} >= {"EPSG:3857", "EPSG:4326", "CRS:84"}
    west, south, east, north = client.get("/levels/timed").json()["bounds"]
    boxes = {
        element.get("CRS"): [float(element.get(name, "")) for name in ("minx", "miny", "maxx", "maxy")]
        for element in color.iterfind("w:BoundingBox", NAMESPACES)
    }
    assert boxes["CRS:84"] == pytest.approx([west, south, east, north])
    assert boxes["EPSG:4326"] == pytest.approx([south, west, north, east])  # latitude is the first axis
    time = color.find("w:Dimension", NAMESPACES)
    assert time is not None and (time.get("name"), time.get("units"), time.get("default")) == (
        "time",
        "ISO8601",
        "2024-06-21T16:00:00Z",
    )
    assert time.text == "2024-01-01T00:00:00Z/2024-12-31T23:50:00Z/PT10M"  # one span: QGIS takes the first of a list for the begin
    time_dimension = layers["hills:color"].find("w:Dimension", NAMESPACES)
    assert time_dimension is not None and time_dimension.get("default") is None and "default" not in (time_dimension.text or "")
    level_root = ElementTree.fromstring(client.get("/levels/hills/wms?REQUEST=GetCapabilities").content)
    assert {name.split(":")[0] for name in layers_of(level_root)} == {"hills"}


def test_getmap_of_a_tile_extent_equals_the_tile(client: Client):
    for layer in ("color", "shadow", "mask"):
        map_response, tile = (
            client.get("/wms", params={**MAP, "LAYERS": f"hills:{layer}"}),
            client.get(TILE, params={"layer": layer}),
        )
        assert np.array_equal(pixels(map_response), pixels(tile)), layer
    lowercase_query = {name.lower(): value for name, value in MAP.items()}
    answer = client.get("/wms", params=lowercase_query)
    assert np.array_equal(pixels(answer), pixels(client.get(TILE)))
    assert client.get("/wms", params=MAP, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    assert client.get("/levels/hills/wms", params=MAP).content == answer.content


def test_getmap_follows_the_axis_order_of_the_crs(client: Client):
    """One extent gives the same picture in CRS:84, longitude first, and in EPSG:4326, latitude first."""
    to_degrees = Transformer.from_crs(3857, 4326, always_xy=True)
    (west, east), (south, north) = to_degrees.transform([BOUNDS.left, BOUNDS.right], [BOUNDS.bottom, BOUNDS.top])
    shape = {"WIDTH": "128", "HEIGHT": "128", "LAYERS": "hills:mask"}
    crs84_map = client.get("/wms", params={**MAP, **shape, "CRS": "CRS:84", "BBOX": f"{west},{south},{east},{north}"})
    other = client.get("/wms", params={**MAP, **shape, "CRS": "EPSG:4326", "BBOX": f"{south},{west},{north},{east}"})
    assert np.array_equal(pixels(crs84_map), pixels(other)) and {0, 255} <= set(np.unique(pixels(crs84_map)))
    tile = pixels(client.get(TILE, params={"layer": "mask"}))[::2, ::2]
    assert (pixels(crs84_map) == tile).mean() > 0.85  # the same ground, though its pixels lie elsewhere
    swapped = client.get("/wms", params={**MAP, **shape, "CRS": "EPSG:4326", "BBOX": f"{west},{south},{east},{north}"})
    assert (pixels(swapped) == 128).all()  # 47 degrees east and 8 north: off the data
    laea_bounds = Transformer.from_crs(3857, 3035, always_xy=True).transform_bounds(*BOUNDS)
    laea = {"CRS": "EPSG:3035", "BBOX": f"{laea_bounds[1]},{laea_bounds[0]},{laea_bounds[3]},{laea_bounds[2]}"}  # northing first
    assert {0, 255} <= set(np.unique(pixels(client.get("/wms", params={**MAP, **shape, **laea}))))


def test_getmap_fills_the_background(client: Client):
    transparent_map = pixels(client.get("/wms", params=MAP))
    no_data = transparent_map[..., 3] == 0
    assert no_data.any() and not no_data.all()
    white = pixels(client.get("/wms", params={**MAP, "TRANSPARENT": "FALSE"}))
    red = pixels(client.get("/wms", params={**MAP, "TRANSPARENT": "FALSE", "BGCOLOR": "0xFF0000"}))
    assert white.shape == (256, 256, 3) and (white[no_data] == 255).all() and (red[no_data] == [255, 0, 0]).all()
    assert np.array_equal(white[~no_data], transparent_map[~no_data][:, :3])
    shadow = pixels(client.get("/wms", params={**MAP, "LAYERS": "hills:shadow", "TRANSPARENT": "FALSE"}))
    alpha = pixels(client.get("/wms", params={**MAP, "LAYERS": "hills:shadow"}))[..., 3].astype(int)
    assert np.abs(shadow[..., 0] - (255 - alpha)).max() <= 1  # black over white by its opacity
    jpeg = client.get("/wms", params={**MAP, "FORMAT": "image/jpeg"})
    assert jpeg.headers["content-type"] == "image/jpeg" and (pixels(jpeg)[no_data] > 240).mean() > 0.98


def test_getmap_time_sets_the_sun(client: Client):
    def mask(**parameters: str) -> bytes:
        answer = client.get("/wms", params={**MAP, "LAYERS": "timed:mask", **parameters})
        assert answer.status_code == 200, answer.text
        return answer.content

    default_mask = mask()
    assert mask(TIME="2024-06-21T16:00:00Z") == default_mask == mask(TIME="2024-06-21T16:00:00.000Z/2024-06-21T17:00:00.000Z")
    assert mask(TIME="2024-06-21T05:00:00Z") != default_mask != mask(TIME="2024-12-21")
    assert mask(AZIMUTH="70", ALTITUDE="18") != default_mask
    assert "x-skugga-time" in client.get("/wms", params={**MAP, "TIME": "current"}).headers


def test_getmap_accepts_options_of_products(client: Client):
    """Keys are case-insensitive. Wrong values, and options of another product, are refused."""
    hours = {**MAP, "LAYERS": "hills:sunhours", "TIME": "2024-12-21", "WINDOW": "11:30-12:30"}
    hours_picture, first = (pixels(client.get("/wms", params={**hours, **options})) for options in ({}, {"quantity": "first"}))
    assert hours_picture.any() and (hours_picture != first).any()
    for query in ({**hours, "QUANTITY": "weeks"}, {**MAP, "QUANTITY": "first"}):
        answer = client.get("/wms", params=query)
        assert answer.status_code == 422 and 'locator="QUANTITY"' in answer.text, answer.text


def test_getfeatureinfo_equals_the_point_report(client: Client):
    """The report gives the centre of the pixel, its elevation, and whether it is lit."""
    answer = client.get("/wms", params={**FEATURE_INFO_QUERY, "INFO_FORMAT": "application/json"})
    collection = answer.json()
    assert collection["type"] == "FeatureCollection" and len(collection["features"]) == 1
    feature = collection["features"][0]
    report = feature["properties"]
    pixel = (BOUNDS.right - BOUNDS.left) / 256
    x, y = BOUNDS.left + 100.5 * pixel, BOUNDS.top - 50.5 * pixel
    lon, lat = Transformer.from_crs(3857, 4326, always_xy=True).transform(x, y)
    assert (report["lon"], report["lat"]) == pytest.approx((lon, lat), abs=1e-6)
    assert feature["type"] == "Feature" and feature["geometry"] == {"type": "Point", "coordinates": [report["lon"], report["lat"]]}
    assert CRS.from_user_input(collection["crs"]["properties"]["name"]) == CRS.from_user_input("OGC:CRS84")
    assert report["level"] == "hills" and report["now"]["azimuth"] == pytest.approx(250, abs=0.1)
    point = client.get("/levels/hills/point", params={"lon": lon, "lat": lat}).json()
    assert point["elevation_m"] == report["elevation_m"] and point["now"]["lit"] == report["now"]["lit"]
    assert client.get("/wms", params=FEATURE_INFO_QUERY, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304

    text = client.get("/wms", params={**FEATURE_INFO_QUERY, "INFO_FORMAT": "text/plain", "TIME": "2024-06-21T12:00:00Z"})
    page = client.get("/wms", params={**FEATURE_INFO_QUERY, "INFO_FORMAT": "text/html", "TIME": "2024-06-21T12:00:00Z"})
    assert text.headers["content-type"].startswith("text/plain") and f"Elevation: {report['elevation_m']:.1f} m\n" in text.text
    assert "Direct sun: " in text.text and "Date: 2024-06-21" in text.text
    assert page.headers["content-type"].startswith("text/html") and "<th>Direct sun</th>" in page.text
    answer = client.get("/wms", params={**FEATURE_INFO_QUERY, "QUERY_LAYERS": "hills:sunhours", "TIME": "2024-12-21"})
    hours = answer.json()["features"][0]["properties"]
    assert hours["day"]["date"] == "2024-12-21" and 0 <= hours["day"]["direct_h"] < 9


def test_getfeatureinfo_off_the_data_says_so(client: Client):
    for media_type in ("application/json", "text/plain", "text/html"):
        answer = client.get(
            "/wms", params={**FEATURE_INFO_QUERY, "I": "250", "J": "10", "BBOX": "0,0,1000,1000", "INFO_FORMAT": media_type}
        )
        assert answer.status_code == 200 and "no ground here" in answer.text
    outside_info = client.get(
        "/wms", params={**FEATURE_INFO_QUERY, "CRS": "EPSG:4326", "BBOX": "94,0,95,1", "INFO_FORMAT": "application/json"}
    ).json()
    assert (
        outside_info["features"][0]["geometry"] is None
        and "no place on earth" in outside_info["features"][0]["properties"]["remark"]
    )


def test_legend_has_the_announced_size(client: Client):
    legend_query = {"SERVICE": "WMS", "REQUEST": "GetLegendGraphic", "LAYER": "timed:sunhours", "FORMAT": "image/png"}
    assert pixels(client.get("/wms", params=legend_query)).shape[:2] == (85, 340)
    assert b"</svg>" in client.get("/wms", params={**legend_query, "FORMAT": "image/svg+xml", "TIME": "2024-03-21"}).content
    legend = layers_of(ElementTree.fromstring(client.get("/wms?REQUEST=GetCapabilities").content))["timed:sunhours"].find(
        "w:Style/w:LegendURL", NAMESPACES
    )
    assert legend is not None
    online = legend.find("w:OnlineResource", NAMESPACES)
    assert online is not None
    qgis_parameters = "&SLD_VERSION=1.1.0&TRANSPARENT=true&SCALE=250000"  # QGIS adds these to the announced address
    legend_pixels = pixels(client.get(online.get(f"{{{NAMESPACES['x']}}}href", "") + qgis_parameters))
    assert (str(legend_pixels.shape[1]), str(legend_pixels.shape[0])) == (legend.get("width"), legend.get("height"))


@pytest.mark.parametrize(
    ("query_changes", "status", "code", "locator"),
    [
        ({"REQUEST": None}, 422, "MissingParameterValue", "REQUEST"),
        ({"REQUEST": "GetTile"}, 422, "OperationNotSupported", "REQUEST"),
        ({"VERSION": "1.1.1"}, 422, "InvalidParameterValue", "VERSION"),
        ({"LAYERS": None}, 422, "MissingParameterValue", "LAYERS"),
        ({"LAYERS": "hills:color,hills:shadow"}, 404, "LayerNotDefined", "LAYERS"),
        ({"LAYERS": "hills:terrain-rgb"}, 404, "LayerNotDefined", "LAYERS"),
        ({"LAYERS": "hills:visibility"}, 404, "LayerNotDefined", "LAYERS"),
        ({"LAYERS": "nowhere:color"}, 404, "LayerNotDefined", "level"),
        ({"LAYERS": "site:color"}, 422, "LayerNotDefined", "LAYERS"),
        ({"STYLES": "dark"}, 422, "StyleNotDefined", "STYLES"),
        ({"CRS": "EPSG:1"}, 422, "InvalidCRS", "crs"),
        ({"CRS": "+proj=utm"}, 422, "InvalidCRS", "crs"),
        ({"BBOX": "1,2,3"}, 422, "InvalidParameterValue", "BBOX"),
        ({"WIDTH": "wide"}, 422, "InvalidParameterValue", "WIDTH"),
        ({"WIDTH": "4000", "HEIGHT": "4000"}, 422, "InvalidParameterValue", "size"),
        ({"FORMAT": "image/gif"}, 422, "InvalidFormat", "FORMAT"),
        ({"FORMAT": "image/jpeg", "LAYERS": "hills:mask"}, 422, "InvalidFormat", "FORMAT"),
        ({"BGCOLOR": "red", "TRANSPARENT": "FALSE"}, 422, "InvalidParameterValue", "BGCOLOR"),
        ({"TIME": "yesterday"}, 422, "InvalidDimensionValue", "time"),
        ({"REQUEST": "GetFeatureInfo", "QUERY_LAYERS": "hills:color", "I": "256", "J": "0"}, 422, "InvalidPoint", "I"),
        ({"REQUEST": "GetLegendGraphic", "LAYER": "hills:color"}, 422, "LayerNotDefined", "LAYER"),
    ],
)
def test_wms_exceptions_have_code_and_locator(client: Client, query_changes: dict[str, Any], status: int, code: str, locator: str):
    answer = client.get("/wms", params={name: value for name, value in {**MAP, **query_changes}.items() if value is not None})
    assert answer.status_code == status and answer.headers["content-type"].startswith("text/xml"), answer.text
    report = ElementTree.fromstring(answer.content)
    exception = report.find("e:ServiceException", NAMESPACES)
    assert local_name(report.tag) == "ServiceExceptionReport" and exception is not None and exception.text
    assert (exception.get("code"), exception.get("locator")) == (code, locator), answer.text


# -- third-party clients


def test_owslib_reads_wms(client: Client):
    service = WebMapService(f"{client.base_url}/wms", version="1.3.0")
    layer = service.contents["timed:color"]
    assert layer.boundingBoxWGS84 == pytest.approx(tuple(client.get("/levels/timed").json()["bounds"]))
    assert layer.timepositions and layer.defaulttimeposition == "2024-06-21T16:00:00Z"
    response = service.getmap(
        layers=["hills:mask"], srs="EPSG:3857", bbox=tuple(BOUNDS), size=(256, 256), format="image/png", transparent=True
    )  # fmt: skip
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(response.read()))), pixels(client.get(f"{TILE}?layer=mask")))
