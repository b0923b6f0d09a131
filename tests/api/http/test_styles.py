"""Styles of tiles, maps and snapshots, also by WMS and WMTS; shadows and masks have none."""

import io
from xml.etree import ElementTree

import numpy as np
import pytest
from morecantile import tms as matrix_sets
from PIL import Image

from skugga.terrain.style import STYLES
from tests.api.conftest import CORNER, ZOOM, Client

X, Y = CORNER
TILE = f"/levels/hills/tiles/WebMercatorQuad/{ZOOM}/{X}/{Y}.png"
BOUNDS = matrix_sets.get("WebMercatorQuad").xy_bounds(X, Y, ZOOM)
WMS = {
    "SERVICE": "WMS", "VERSION": "1.3.0", "REQUEST": "GetMap", "LAYERS": "hills:color", "CRS": "EPSG:3857", "FORMAT": "image/png",
    "BBOX": ",".join(map(str, BOUNDS)), "WIDTH": "256", "HEIGHT": "256", "TRANSPARENT": "TRUE",
}  # fmt: skip
WMTS = {
    "SERVICE": "WMTS", "REQUEST": "GetTile", "VERSION": "1.0.0", "LAYER": "hills:color", "FORMAT": "image/png",
    "TILEMATRIXSET": "WebMercatorQuad", "TILEMATRIX": str(ZOOM), "TILECOL": str(X), "TILEROW": str(Y),
}  # fmt: skip


def pixels(answer) -> np.ndarray:
    """Return the picture of a successful response as RGBA (rows, cols, 4)."""
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA"))


def test_styles_differ_in_colour_but_not_in_alpha(client: Client):
    pictures = {name: pixels(client.get(TILE, params={"style": name})) for name in STYLES}
    level_style = client.get("/levels/hills").json()["style"]
    assert np.array_equal(pictures[level_style], pixels(client.get(TILE)))
    assert len({picture.tobytes() for picture in pictures.values()}) == len(STYLES)
    assert len({picture[..., 3].tobytes() for picture in pictures.values()}) == 1, "all styles cover the same pixels"
    grey = pictures["grey"][..., :3].astype(int)
    assert np.ptp(grey, axis=-1).max() <= 1


def test_default_style_of_a_level_has_a_name(client: Client):
    level = client.get("/levels/hills").json()
    assert level["styles"] == list(STYLES) and level["style"] in STYLES
    assert client.get(TILE, params={"style": "default"}).headers["etag"] == client.get(TILE).headers["etag"]


def test_shadows_have_no_style(client: Client):
    for layer in ("shadow", "mask"):
        plain, styled = (
            client.get(TILE, params={"layer": layer, **options}) for options in ({}, {"style": "swiss", "slope_exaggeration": 4})
        )
        assert plain.headers["etag"] == styled.headers["etag"] and plain.content == styled.content


def test_slope_exaggeration_spreads_the_shading(client: Client):
    """On ground that the mask shows as lit, steeper slopes spread the shading wider."""
    high_sun = {"azimuth": 235, "altitude": 60, "style": "analysis"}
    plain, steep = (pixels(client.get(TILE, params={**high_sun, **options}))[..., 0] for options in ({}, {"slope_exaggeration": 3}))
    is_lit = pixels(client.get(TILE, params={**high_sun, "layer": "mask"}))[..., 0] == 255
    assert is_lit.mean() > 0.2 and steep[is_lit].std() > 1.3 * plain[is_lit].std()


def test_a_ramp_replaces_the_colours_of_a_style(client: Client):
    green, again, plain = (
        client.get(TILE, params={"style": "analysis", "azimuth": 235, "altitude": 60, **options})
        for options in ({"ramp": "0:00FF00"}, {"ramp": "0.0:#00ff00"}, {})
    )
    picture = pixels(green).astype(int)
    ground = picture[picture[..., 3] == 255]
    assert len(ground) and (ground[:, 1] > ground[:, 0] + 50).all() and ground[:, 1].max() > 150
    assert green.headers["etag"] == again.headers["etag"] != plain.headers["etag"], "one ramp has one spelling"
    mask, mask_with_ramp = (client.get(TILE, params={"layer": "mask", **options}) for options in ({}, {"ramp": "0:00ff00"}))
    assert mask.headers["etag"] == mask_with_ramp.headers["etag"]


def test_maps_and_snapshots_have_styles(client: Client):
    for address in ("/levels/hills/map.png?width=128", "/levels/hills/snapshot.png?size=96x96"):
        plain, grey = (client.get(f"{address}&style={name}") for name in ("swiss", "grey"))
        assert plain.headers["etag"] != grey.headers["etag"]
        assert np.ptp(pixels(grey)[..., :3].astype(int), axis=-1).max() <= 1


def test_wms_and_wmts_accept_styles(client: Client):
    for name in ("swiss", "analysis"):
        tile = client.get(TILE, params={"style": name})
        difference = np.abs(pixels(client.get("/wms", params={**WMS, "STYLES": name})).astype(int) - pixels(tile))
        assert difference.max() <= 1 and (difference > 0).mean() < 1e-3, (
            "maps are drawn with a geometry buffer and tiles without one, so rounding may differ"
        )
        assert client.get("/wmts", params={**WMTS, "STYLE": name}).content == tile.content
    for address, key in (("/wms", "STYLES"), ("/wmts", "STYLE")):
        base_query = WMS if address == "/wms" else WMTS
        refusal = client.get(address, params={**base_query, key: "pretty"})
        assert refusal.status_code == 422 or refusal.status_code == 400
        assert "swiss" in refusal.text and key in refusal.text
        layer = {"LAYERS" if address == "/wms" else "LAYER": "hills:mask"}
        assert client.get(address, params={**base_query, **layer, key: "swiss"}).status_code in (400, 422), "a mask has one style"


def test_capabilities_list_styles_of_color_only(client: Client):
    w, t = {"w": "http://www.opengis.net/wms"}, {"t": "http://www.opengis.net/wmts/1.0", "o": "http://www.opengis.net/ows/1.1"}
    wms = ElementTree.fromstring(client.get("/wms?SERVICE=WMS&REQUEST=GetCapabilities").content)
    wmts = ElementTree.fromstring(client.get("/wmts/1.0.0/WMTSCapabilities.xml").content)
    styles_by_layer = {
        layer.findtext("w:Name", "", w): [style.findtext("w:Name", "", w) for style in layer.iterfind("w:Style", w)]
        for layer in wms.iter(f"{{{w['w']}}}Layer")
    }
    assert styles_by_layer["hills:color"] == ["default", *STYLES] and styles_by_layer["hills:mask"] == ["default"]
    tile_styles = {
        layer.findtext("o:Identifier", "", t): [style.findtext("o:Identifier", "", t) for style in layer.iterfind("t:Style", t)]
        for layer in wmts.iter(f"{{{t['t']}}}Layer")
    }
    assert tile_styles["hills:color"] == ["default", *STYLES] and tile_styles["hills:shadow"] == ["default"]
    color = next(element for element in wmts.iter(f"{{{t['t']}}}Layer") if element.findtext("o:Identifier", "", t) == "hills:color")
    template = color.find("t:ResourceURL", t).get("template")
    assert "style={Style}" in template


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("style", "pretty", "swiss"),
        ("slope_exaggeration", "0", "0.1"),
        ("slope_exaggeration", "a", "number"),
        ("style", "", "swiss"),
        ("ramp", "viridis", "0:a9be98,1500:d9d2ae"),
        ("ramp", "5:a9be98,0:ffffff", "increasing heights"),
        ("ramp", "0:a9be98," * 80, "640"),
    ],
)
def test_invalid_styles_list_the_allowed_values(client: Client, name: str, value: str, allowed: str):
    answer = client.get(TILE, params={name: value})
    assert answer.status_code == 422
    assert name in answer.text and allowed in answer.text
