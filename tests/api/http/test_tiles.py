"""Tiles over HTTP, drawn by a real render worker."""

import io
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest
from morecantile import tms as matrix_sets
from PIL import Image

from skugga.api.compute import compute
from skugga.api.encoding import encode
from skugga.api.http.server.app import create_app
from skugga.api.http.state.level_checks import FileCheck
from skugga.api.products import MAP_PRODUCTS, PRODUCTS
from skugga.api.products.product import ProductOptions
from skugga.api.request import ProductRequest
from skugga.api.settings import Settings
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene
from tests.api.conftest import CORNER, ZOOM, Client, running, write_level
from tests.api.workers import fake_workers
from tests.render import plan_of

X, Y = CORNER
TILES = "/levels/hills/tiles/WebMercatorQuad"
TILE = f"{TILES}/{ZOOM}/{X}/{Y}.png"
NIGHT = {"azimuth": 10, "altitude": -5}


def picture(answer: httpx.Response) -> Image.Image:
    """Return the image of a successful response."""
    assert answer.status_code == 200, answer.content[:300]
    return Image.open(io.BytesIO(answer.content))


def pixels(answer: httpx.Response) -> np.ndarray:
    """Return the picture of a successful response, RGBA (rows, cols, 4) if it has colours."""
    image = picture(answer)
    return np.asarray(image.convert("RGBA") if image.mode == "RGB" else image)  # opaque tiles have no alpha


@pytest.mark.parametrize(
    ("format", "layer", "mode", "image_format"),
    [
        ("png", "color", "RGBA", "PNG"), ("png", "shadow", "RGBA", "PNG"), ("png", "mask", "L", "PNG"),
        ("webp", "color", "RGBA", "WEBP"), ("webp", "shadow", "RGBA", "WEBP"), ("jpg", "color", "RGB", "JPEG"),
    ],
)  # fmt: skip
def test_tile_formats_have_their_modes(client: Client, format: str, layer: str, mode: str, image_format: str):
    answer = client.get(f"{TILES}/{ZOOM}/{X}/{Y}.{format}", params={"layer": layer})
    image = picture(answer)
    assert (image.size, image.mode, image.format) == ((256, 256), mode, image_format)
    assert answer.headers["content-type"] == f"image/{'jpeg' if format == 'jpg' else format}"


def test_color_shadow_and_mask_layers_agree(client: Client):
    color, shadow, mask = (pixels(client.get(TILE, params={"layer": layer})) for layer in ("color", "shadow", "mask"))
    assert {0, 255} <= set(np.unique(mask)) <= {0, 128, 255}
    valid = mask != 128
    assert valid.any() and not valid.all()  # the data ends in this tile
    assert (color[..., 3] == np.where(valid, 255, 0)).all()
    assert (shadow[..., :3] == 0).all()
    alpha = shadow[..., 3]
    assert (mask[alpha == 255] == 0).all() and (mask[valid & (alpha == 0)] == 255).all()  # edges are anti-aliased, masks are not
    is_partial = valid & (alpha > 0) & (alpha < 255)
    assert 0.05 < is_partial[valid].mean() < 0.12 and ((alpha > 127) == (mask == 0))[is_partial].mean() > 0.94


def test_webp_of_data_layers_is_lossless(client: Client):
    for layer in ("shadow", "mask"):
        png, webp = (picture(client.get(f"{TILES}/{ZOOM}/{X}/{Y}.{format}", params={"layer": layer})) for format in ("png", "webp"))
        assert np.array_equal(np.asarray(png.convert("RGBA")), np.asarray(webp.convert("RGBA")))


def test_tiles_of_four_blocks_equal_one_map(client: Client, hills_level):
    """2 x 2 tiles meet at the corner of four blocks; each equals its part of the map byte by byte."""
    matrix_set = matrix_sets.get("WebMercatorQuad")
    northwest, southeast = matrix_set.xy_bounds(X - 1, Y - 1, ZOOM), matrix_set.xy_bounds(X, Y, ZOOM)
    scene = build_scene(load_level(hills_level))
    bounds = northwest.left, southeast.bottom, southeast.right, northwest.top
    view = scene.view(bounds=bounds, crs="EPSG:3857", size=(512, 512))
    for layer in ("color", "shadow", "mask"):
        full_map = compute(scene, view, ProductRequest(product=layer), plan_of(scene, view)).array
        assert len(np.unique(full_map.reshape(-1, full_map.shape[-1] if full_map.ndim == 3 else 1), axis=0)) > 2
        for row in range(2):
            for col in range(2):
                answer = client.get(f"{TILES}/{ZOOM}/{X - 1 + col}/{Y - 1 + row}.png", params={"layer": layer})
                part = full_map[row * 256 : row * 256 + 256, col * 256 : col * 256 + 256]
                assert answer.content == encode(np.ascontiguousarray(part), PRODUCTS[layer], ProductOptions(), "png"), (
                    layer,
                    row,
                    col,
                )


@pytest.mark.parametrize("layer", MAP_PRODUCTS)
def test_tiles_equal_the_pixels_of_a_larger_map(client: Client, layer: str):
    """For every product, tiles of four blocks; for hours of sun, whose blocks take seconds, tiles of one block."""
    columns, rows = ((X, X + 1), (Y,)) if layer in ("irradiation", "sunhours") else ((X - 1, X), (Y - 1, Y))
    matrix_set, format = matrix_sets.get("WebMercatorQuad"), "npy" if "npy" in PRODUCTS[layer].map_formats else "png"
    first, last = matrix_set.xy_bounds(columns[0], rows[0], ZOOM), matrix_set.xy_bounds(columns[-1], rows[-1], ZOOM)
    query = {"layer": layer, **({"date": "2024-12-21"} if layer in ("irradiation", "sunhours") else {})}
    query |= {"window": "11:00-13:00"} if layer == "sunhours" else {}
    extent = {"bbox": f"{first.left},{last.bottom},{last.right},{first.top}", "crs": "EPSG:3857", "width": 512}

    def read(path: str, **parameters: object) -> np.ndarray:
        answer = client.get(f"{path}.{format}", params={**query, **parameters})
        assert answer.status_code == 200, answer.text
        body = io.BytesIO(answer.content)
        return np.load(body) if format == "npy" else np.asarray(Image.open(body).convert("RGBA"))

    map_pixels = read("/levels/hills/map", **extent)
    tiles = [np.concatenate([read(f"{TILES}/{ZOOM}/{x}/{y}") for x in columns], axis=1) for y in rows]
    np.testing.assert_array_equal(np.concatenate(tiles), map_pixels)
    assert len(np.unique(map_pixels[np.isfinite(map_pixels)])) > 1, "the map is not of one colour"


def test_2x_tile_equals_four_tiles_of_the_next_zoom(client: Client):
    double = pixels(client.get(f"{TILES}/{ZOOM}/{X}/{Y}@2x.png"))
    assert double.shape == (512, 512, 4)
    for row in range(2):
        for col in range(2):
            child_pixels = pixels(client.get(f"{TILES}/{ZOOM + 1}/{2 * X + col}/{2 * Y + row}.png"))
            assert np.array_equal(double[row * 256 : row * 256 + 256, col * 256 : col * 256 + 256], child_pixels)


def test_another_matrix_set_is_served(client: Client):
    matrix_set = matrix_sets.get("WGS1984Quad")
    zooms = client.get("/levels/hills").json()["tile_matrix_sets"]["WGS1984Quad"]
    west, south, east, north = client.get("/levels/hills").json()["bounds"]
    tile = matrix_set.tile((west + east) / 2, (south + north) / 2, zooms["maxzoom"] - 2)
    answer = client.get(f"/levels/hills/tiles/WGS1984Quad/{tile.z}/{tile.x}/{tile.y}.png")
    assert (pixels(answer)[..., 3] == 255).any()


def test_tile_off_the_data_is_empty_and_not_rendered(client: Client):
    before = client.service.pool.counters.jobs_answered
    far = f"{TILES}/{ZOOM}/{X + 50}/{Y}"
    assert not pixels(client.get(f"{far}.png")).any()
    assert pixels(client.get(f"{far}@2x.png", params={"layer": "shadow"})).shape == (512, 512, 4)
    assert (pixels(client.get(f"{far}.png", params={"layer": "mask"})) == 128).all()
    assert (pixels(client.get(f"{far}.jpg")) == 255).all()
    answer = client.get(f"{far}.png")
    assert answer.headers["etag"] and "max-age" in answer.headers["cache-control"]
    assert answer.headers["x-skugga-algorithm"] == "none"
    assert client.service.pool.counters.jobs_answered == before


def test_empty_tile_equals_a_rendered_one(client: Client):
    """The near tile lies in a block with data, which is rendered; the far one is answered without rendering."""
    near = client.get(f"{TILES}/{ZOOM}/{X}/{Y + 3}.png")  # in a block with data
    far = client.get(f"{TILES}/{ZOOM}/{X + 50}/{Y}.png")
    assert near.headers["x-skugga-algorithm"] == "none" or "server-timing" in near.headers
    assert near.content == far.content


def test_night_is_shadow_and_not_nodata(client: Client):
    mask = pixels(client.get(TILE, params={"layer": "mask", **NIGHT}))
    assert set(np.unique(mask)) == {0, 128}
    shadow = pixels(client.get(TILE, params={"layer": "shadow", **NIGHT}))
    assert (shadow[..., 3][mask == 0] == 255).all()


def test_query_sun_replaces_the_level_sun(client: Client):
    def shadows(**query) -> np.ndarray:
        return pixels(client.get(TILE, params={"layer": "mask", **query})) == 0

    default_shadow, morning, overhead = shadows(), shadows(azimuth=70, altitude=18), shadows(azimuth=180, altitude=85)
    assert (default_shadow == shadows(azimuth=250, altitude=18)).all()
    assert (default_shadow != morning).mean() > 0.1
    assert overhead.mean() < 0.1 < default_shadow.mean()


def test_time_accepts_an_unescaped_plus(client: Client):
    escaped = client.get(f"{TILE}?time=2024-06-21T19:00:00%2B02:00")
    unescaped = client.get(f"{TILE}?time=2024-06-21T19:00:00+02:00")
    assert escaped.status_code == 200
    assert (escaped.content, escaped.headers["etag"]) == (unescaped.content, unescaped.headers["etag"])


def test_query_sets_algorithm_and_settings(client: Client):
    assert client.get(TILE).headers["x-skugga-algorithm"] == "sweep"
    none = client.get(TILE, params={"algorithm": "none", "layer": "mask"})
    assert none.headers["x-skugga-algorithm"] == "none"
    shadow_map_response = client.get(TILE, params={"algorithm": "relief=shadow_map", "layer": "mask"})
    assert (pixels(none) == 0).sum() < (pixels(shadow_map_response) == 0).sum()  # attached shadow alone
    coarse_response = client.get(TILE, params={"map_size": 64, "depth_bits": 24, "filter": 1, "layer": "mask"})
    assert coarse_response.status_code == 200
    assert coarse_response.content != shadow_map_response.content


def test_tile_headers_describe_timing_reach_and_caching(client: Client):
    answer = client.get(TILE)
    timing = answer.headers["server-timing"]
    plan = client.get("/levels/hills/plan").json()
    assert [part.split(";")[0] for part in timing.split(", ")][: len(plan["passes"])] == [
        "geometry", "outside_casters", "sun-relief-sweep", "attached", "sky_view", "texture_shading", "shading",
    ]  # fmt: skip
    words = dict(part.split("=") for part in answer.headers["x-skugga-caster-reach"].split("; "))
    assert set(words) == {"used", "needed", "clipped"}
    assert int(words["needed"]) >= 0 and words["clipped"] in ("yes", "no")
    stale_directives = "stale-while-revalidate={0}, stale-if-error=86400"
    assert answer.headers["cache-control"] == f"public, max-age=3600, {stale_directives.format(3600)}"
    night_response = client.get(TILE, params=NIGHT)
    assert night_response.headers["cache-control"] == f"public, max-age=86400, {stale_directives.format(86400)}"
    unchanged = client.get(TILE, params=NIGHT, headers={"If-None-Match": night_response.headers["etag"]})
    assert unchanged.status_code == 304 and unchanged.headers["cache-control"] == night_response.headers["cache-control"]


def test_current_tiles_and_level_facts_are_never_stale(client: Client):
    for address in (
        f"{TILE}?time=current",
        "/levels/hills",
        "/levels/hills/WebMercatorQuad/tilejson.json",
        "/levels/hills/point?lon=8.4&lat=47.5",
    ):
        answer = client.get(address)
        assert answer.status_code == 200 and "stale" not in answer.headers["cache-control"], address


def test_etags_differ_between_tiles(client: Client):
    addresses = [
        f"{TILES}/{ZOOM}/{X}/{Y}.png", f"{TILES}/{ZOOM}/{X}/{Y}.webp", f"{TILES}/{ZOOM}/{X}/{Y}@2x.png",
        f"{TILES}/{ZOOM}/{X - 1}/{Y}.png", f"{TILES}/{ZOOM}/{X}/{Y}.png?layer=mask",
        f"{TILES}/{ZOOM}/{X}/{Y}.png?azimuth=1&altitude=20", f"{TILES}/{ZOOM}/{X}/{Y}.png?algorithm=none",
        TILE.replace("hills", "timed"),
    ]  # fmt: skip
    tags = [client.get(address).headers["etag"] for address in addresses]
    assert len(set(tags)) == len(tags)


def test_head_equals_get_without_the_body(client: Client):
    get, head = client.get(TILE), client.head(TILE)
    assert head.status_code == 200
    assert head.content == b""
    for name in ("etag", "content-length", "content-type", "cache-control"):
        assert head.headers[name] == get.headers[name]
    assert client.head("/levels/nowhere").status_code == 404


def test_cors_headers_are_sent_with_every_tile(client: Client):
    answer = client.get(TILE, headers={"Origin": "https://map.example"})
    assert answer.headers["access-control-allow-origin"] == "*"
    assert "X-Skugga-Caster-Reach" in answer.headers["access-control-expose-headers"]
    originless_response = client.get(TILE)
    for name in ("access-control-allow-origin", "access-control-expose-headers", "vary"):
        assert originless_response.headers.get(name) == answer.headers.get(name), (
            "a shared cache sends the same answer to requests with and without an origin"
        )


def test_concurrent_tiles_of_a_block_are_rendered_once(client: Client):
    before = client.service.pool.counters.jobs_answered
    places = [(X + i, Y + j) for i in range(2) for j in range(2)]
    query = {"azimuth": 245, "altitude": 19}  # not requested before
    with ThreadPoolExecutor(4) as threads:
        answers = list(threads.map(lambda xy: client.get(f"{TILES}/{ZOOM}/{xy[0]}/{xy[1]}.png", params=query), places))
    assert [answer.status_code for answer in answers] == [200] * 4
    rendered_count = client.service.pool.counters.jobs_answered - before
    assert rendered_count == 1


def test_service_answers_while_a_block_is_drawn(client: Client):
    """The bound of 1 s is far above an idle event loop's latency, and far below a block's time on one thread of a rasteriser."""
    finished = threading.Event()

    def draw() -> httpx.Response:
        try:
            return client.get(f"{TILES}/{ZOOM + 1}/{2 * X}/{2 * Y}.png", params={"azimuth": 131, "altitude": 7})
        finally:
            finished.set()

    latencies_s = []
    with ThreadPoolExecutor(1) as thread:
        drawing = thread.submit(draw)
        while not finished.is_set():
            start = time.perf_counter()
            assert client.get("/healthz").status_code == 200
            latencies_s.append(time.perf_counter() - start)
        assert "block;desc=drawn" in drawing.result().headers["server-timing"]
    assert len(latencies_s) > 3
    assert max(latencies_s) < 1.0


def test_opaque_color_tile_has_no_alpha(client: Client, hills_level):
    """This makes a third fewer bytes to encode and send. Tiles at the edge of the data have alpha."""
    modes = {picture(client.get(f"{TILES}/{ZOOM}/{x}/{y}.png")).mode for x in (X - 1, X) for y in (Y - 1, Y)}
    assert modes <= {"RGB", "RGBA"} and "RGBA" in modes


def test_cached_tile_bypasses_the_application(client: Client, monkeypatch):
    query = {"azimuth": 201.5, "altitude": 33.0}
    first = client.get(TILE, params=query)
    monkeypatch.setattr(FileCheck, "_is_fresh", lambda check: True)  # as if its files had just been checked
    monkeypatch.setattr(type(client.service.levels), "current", None)  # every request for a level fails
    cached_response, head = client.get(TILE, params=query), client.head(TILE, params=query)
    assert cached_response.content == first.content and "block;desc=kept" in cached_response.headers["server-timing"]
    response_headers = ("server-timing", "date", "x-request-id", "x-skugga-expected-time")
    shared_headers = {name: value for name, value in first.headers.items() if name not in response_headers}
    assert shared_headers.items() <= cached_response.headers.items()
    assert (head.status_code, head.content, head.headers["content-length"]) == (200, b"", str(len(first.content)))
    not_modified = client.get(TILE, params=query, headers={"If-None-Match": first.headers["etag"]})
    assert (not_modified.status_code, not_modified.content, not_modified.headers["etag"]) == (304, b"", first.headers["etag"])
    cross_origin = client.get(TILE, params=query, headers={"Origin": "https://a.example"})
    assert cross_origin.headers["access-control-allow-origin"] == "*"


def test_other_spelling_of_a_query_reuses_the_tile(client: Client):
    decimal_response = client.get(TILE, params={"azimuth": 202.5, "altitude": 33.0})
    other = client.get(TILE, params={"altitude": "33", "azimuth": "202.50"})
    assert other.content == decimal_response.content and other.headers["etag"] == decimal_response.headers["etag"]
    assert "block;desc=kept" in other.headers["server-timing"]


def test_changed_level_invalidates_its_tiles(tmp_path):
    level = write_level(tmp_path, "hills")
    with running(create_app(Settings(workers=1, level_check_s=0), [level], fake_workers.scripted)) as client:
        before, repeated = client.get(TILE), client.get(TILE)
        level.write_text(level.read_text(encoding="utf-8").replace("The hills", "Other hills"), encoding="utf-8")
        after = client.get(TILE)
        assert before.headers["etag"] == repeated.headers["etag"] != after.headers["etag"]
        assert client.service.pool.counters.jobs_answered == 2


def test_layers_and_formats_share_a_cached_block(client: Client):
    query = {"azimuth": 203.5, "altitude": 33.0}
    assert "block;desc=drawn" in client.get(TILE, params=query).headers["server-timing"]
    double = f"{TILES}/{ZOOM - 1}/{X // 2}/{Y // 2}@2x.png"
    for path, extra_query in ((TILE, {"layer": "shadow"}), (TILE.replace(".png", ".webp"), {}), (double, {})):
        assert "block;desc=kept" in client.get(path, params=query | extra_query).headers["server-timing"]
    assert "block;desc=drawn" in client.get(TILE, params=query | {"layer": "mask"}).headers["server-timing"]
