"""Snapshots over HTTP, drawn by a real render process."""

import io
import json
import os
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from mmap import PAGESIZE, mmap
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image

from skugga.api.cli.snapshot import snapshot
from skugga.api.encoding import encode_picture
from skugga.api.http.server.app import create_app
from skugga.api.http.state.served_levels import ServedLevels
from skugga.api.products.mask import MASK_LIT, MASK_NO_SURFACE, MASK_SHADOW
from skugga.api.request import ProductRequest
from skugga.api.settings import Settings
from skugga.api.workers.jobs import LevelKey
from skugga.api.workers.process_life import resident_bytes
from skugga.api.workers.worker_state import MAX_PROCESS_BYTES, SceneCache
from skugga.terrain.level.parts import SunSpec
from tests.api.conftest import Client, running
from tests.api.http.test_problems import check_problem
from tests.api.workers import fake_workers

YARD = "/levels/yard/snapshot"
WIDTH, HEIGHT = 160, 120
LEVEL = {
    "version": 1,
    "terrain": {"flat": {"size": [200, 200], "cells": [8, 8]}},
    "meshes": [{"generate": "tetrahedra", "motion": {"spin": 30}}],
    "sun": {"azimuth": 240, "altitude": 35},
    "lights": {"lamp": {"kind": "spot", "position": [15, 12, 70], "target": [0, 0, 0], "cutoff": 40}},
    "views": {
        "across": {"kind": "perspective", "eye": [-60, -70, 45], "target": [0, 0, 5], "fov": 60, "size": [WIDTH, HEIGHT]},
        "low": {"kind": "perspective", "eye": [-60, -70, 20], "target": [0, 0, 18], "fov": 60, "size": [WIDTH, HEIGHT]},
    },
}
"""A rotating figure on a floor, under the sun and a lamp."""


def write_yard(folder: Path, name: str = "yard", **keys) -> Path:
    """Write the level ``LEVEL`` with other ``keys`` and return its file."""
    path = folder / f"{name}.yaml"
    path.write_text(json.dumps({**LEVEL, **keys}), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def yard_level(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File of the level ``LEVEL``."""
    return write_yard(tmp_path_factory.mktemp("yard"))


@pytest.fixture(scope="module")
def yard_client(yard_level: Path) -> Iterator[Client]:
    """Run a service with one real render process over ``yard_level`` and over ``cellar``, whose only light is the lamp."""
    cellar = write_yard(yard_level.parent, "cellar", sun="none", views={**LEVEL["views"], "map": {"kind": "map", "size": [90, 70]}})
    with running(create_app(Settings(workers=1), [yard_level, cellar])) as client:
        yield client


def pixels(answer: httpx.Response) -> np.ndarray:
    """Return the picture of a successful response (rows, cols, channels)."""
    assert answer.status_code == 200, answer.content[:300]
    return np.asarray(Image.open(io.BytesIO(answer.content)))


@pytest.mark.parametrize(
    ("format", "layer", "mode", "image_format"),
    [
        ("png", "color", "RGBA", "PNG"), ("png", "shadow", "RGBA", "PNG"), ("png", "mask", "L", "PNG"),
        ("webp", "color", "RGB", "WEBP"), ("webp", "shadow", "RGBA", "WEBP"), ("jpg", "color", "RGB", "JPEG"),
    ],
)  # fmt: skip
def test_formats_and_layers_have_their_image_modes(yard_client: Client, format: str, layer: str, mode: str, image_format: str):
    answer = yard_client.get(f"{YARD}.{format}", params={"view": "across", "layer": layer})
    image = Image.open(io.BytesIO(answer.content))
    assert (image.size, image.mode, image.format) == ((WIDTH, HEIGHT), mode, image_format)
    assert answer.headers["content-type"] == f"image/{'jpeg' if format == 'jpg' else format}"


@pytest.mark.parametrize("view", ["across", "map"])
def test_a_snapshot_equals_one_drawn_in_this_process(yard_client: Client, yard_level: Path, view: str):
    size = None if view == "across" else (64, 48)
    parameters = {"view": view, "azimuth": 200, "altitude": 30, "map_size": 512, "depth_bits": 24, "filter": 2, "seconds": 1.5}
    overrides = {"map_size": 512, "depth_bits": 24, "filter": 2}
    sun = SunSpec(azimuth=200, altitude=30)

    def draw_in_process(layer: str, light: str | None = None) -> np.ndarray:
        request = ProductRequest(product=layer, sun=sun)
        return snapshot(yard_level, view, request, overrides, size, seconds=1.5, light=light).computed.array

    parameters |= {} if size is None else {"size": "64x48"}
    for layer, format in (("color", "png"), ("color", "webp"), ("color", "jpg"), ("shadow", "png"), ("mask", "webp")):
        answer = yard_client.get(f"{YARD}.{format}", params={**parameters, "layer": layer})
        assert answer.content == encode_picture(draw_in_process(layer), format), (layer, format)
    lamp = yard_client.get(f"{YARD}.png", params={**parameters, "layer": "mask", "light": "lamp"})
    assert lamp.content == encode_picture(draw_in_process("mask", "lamp"), "png")


def test_the_sky_is_opaque_and_has_no_shadow(yard_client: Client):
    color, shadow, mask = (
        pixels(yard_client.get(f"{YARD}.png", params={"view": "low", "layer": name})) for name in ("color", "shadow", "mask")
    )
    sky = mask == MASK_NO_SURFACE
    assert sky[0].all() and not sky[-1].any()
    assert set(np.unique(mask)) == {MASK_SHADOW, MASK_NO_SURFACE, MASK_LIT}
    assert (color[..., 3] == 255).all() and color[sky][:, :3].min() > 0
    assert (shadow[sky] == 0).all()


def test_the_default_view_is_the_listed_map_or_the_first(yard_client: Client):
    first, named = (yard_client.get(f"{YARD}.png", params=query) for query in ({}, {"view": "across"}))
    assert (first.content, first.headers["etag"]) == (named.content, named.headers["etag"])
    assert pixels(yard_client.get("/levels/cellar/snapshot.png")).shape == (70, 90, 4)
    assert yard_client.get("/levels/yard/plan").json()["view"] == "across"
    assert yard_client.get("/levels/cellar/plan").json()["view"] == "map"


def test_the_size_of_the_query_is_respected(yard_client: Client):
    assert pixels(yard_client.get(f"{YARD}.png", params={"view": "across", "size": "50x33"})).shape == (33, 50, 4)
    assert pixels(yard_client.get(f"{YARD}.png", params={"view": "map", "size": "50x33"})).shape == (33, 50, 4)


def test_the_light_of_the_query_selects_the_shadow(yard_client: Client):
    def mask(**query) -> np.ndarray:
        return pixels(yard_client.get(f"{YARD}.png", params={"view": "across", "layer": "mask", **query}))

    default_mask, sun, lamp = mask(), mask(light="sun"), mask(light="lamp")
    assert np.array_equal(default_mask, sun)
    assert (sun != lamp).mean() > 0.01
    assert np.array_equal(lamp == MASK_NO_SURFACE, sun == MASK_NO_SURFACE)
    before = yard_client.service.pool.counters.jobs_answered
    sunlit, lamplit = (yard_client.get(f"{YARD}.png", params={"view": "across", **query}) for query in ({}, {"light": "lamp"}))
    assert sunlit.content == lamplit.content  # light applies to shadow and mask: colour shows all lights
    assert yard_client.service.pool.counters.jobs_answered - before <= 1


def test_a_level_without_a_sun_shows_its_lamp(yard_client: Client):
    cellar = "/levels/cellar/snapshot.png"
    default_response, lamp = (yard_client.get(cellar, params={"layer": "mask", **query}) for query in ({}, {"light": "lamp"}))
    assert default_response.content == lamp.content
    problem = check_problem(yard_client.get(cellar, params={"light": "sun"}), 422, "invalid_parameter", "light")
    assert problem["detail"].endswith("Allowed: lamp.")
    sunlit_response = yard_client.get(cellar, params={"layer": "mask", "light": "sun", "azimuth": 90, "altitude": 40})
    assert MASK_LIT in pixels(sunlit_response)


def test_the_clock_rotates_moving_meshes(yard_client: Client):
    def mask(seconds: float) -> np.ndarray:
        return pixels(
            yard_client.get(f"{YARD}.png", params={"view": "map", "size": "100x100", "layer": "mask", "seconds": seconds})
        )

    start_mask, turned_mask, full_turn_mask = mask(0), mask(2), mask(12)
    assert (start_mask != turned_mask).mean() > 0.002
    assert (start_mask != full_turn_mask).mean() < 0.0005  # 12 s at 30 degrees per second are one turn


def test_headers_report_timings_algorithm_and_caching(yard_client: Client):
    answer = yard_client.get(f"{YARD}.png", params={"view": "across"})
    plan = yard_client.get("/levels/yard/plan", params={"view": "across"}).json()
    assert plan["view"] == "across"
    assert set(plan["algorithm"]) == {"sun", "lamp"}
    timings = [part.split(";")[0] for part in answer.headers["server-timing"].split(", ")]
    assert len(timings) == len(plan["passes"]) + 3
    assert (timings[0], timings[-4:]) == ("geometry", ["haze", "encode", "snapshot", "total"])
    assert "lamp-meshes" in answer.headers["server-timing"]
    reach_fields = dict(part.split("=") for part in answer.headers["x-skugga-caster-reach"].split("; "))
    assert set(reach_fields) == {"used", "needed", "clipped"}
    assert "meshes=shadow_volume" in answer.headers["x-skugga-algorithm"]
    assert answer.headers["cache-control"].startswith("public, max-age=3600,")
    fixed_sun_response = yard_client.get(f"{YARD}.png", params={"view": "across", "azimuth": 100, "altitude": 40})
    assert fixed_sun_response.headers["cache-control"].startswith("public, max-age=86400,")
    elsewhere = yard_client.get(f"{YARD}.png", params={"view": "across"}, headers={"Origin": "https://map.example"})
    assert elsewhere.headers["access-control-allow-origin"] == "*"


def test_the_algorithm_of_the_query_is_used(yard_client: Client):
    def answer(algorithm: str) -> httpx.Response:
        return yard_client.get(f"{YARD}.png", params={"view": "across", "layer": "mask", "algorithm": algorithm})

    assert answer("none").headers["x-skugga-algorithm"] == "none"
    assert answer("lamp=none").headers["x-skugga-algorithm"].endswith("lamp=none")
    assert (pixels(answer("none")) == MASK_SHADOW).sum() < (pixels(answer("shadow_map")) == MASK_SHADOW).sum()


def test_variants_of_volumes_draw_the_same_shadow(yard_client: Client):
    """Shadow volumes draw the same shadow by each way of counting, everywhere or only where a map cannot decide."""

    def answer(algorithm: str, **query) -> httpx.Response:
        return yard_client.get(f"{YARD}.png", params={"view": "across", "layer": "mask", "algorithm": algorithm, **query})

    plain = pixels(answer("shadow_volume"))
    assert (plain == MASK_SHADOW).sum() > (pixels(answer("none")) == MASK_SHADOW).sum()
    for algorithm, query in (("shadow_volume", {"stencil": "two_pass", "counting": "z_fail"}), ("hybrid", {})):
        response = answer(algorithm, **query)
        assert response.headers["x-skugga-algorithm"] == algorithm
        np.testing.assert_array_equal(pixels(response), plain)


def test_a_cached_picture_costs_no_rendering(yard_client: Client):
    query = {"view": "across", "size": "40x30", "seconds": 0.25}
    tag = yard_client.get(f"{YARD}.png", params=query).headers["etag"]
    before = yard_client.service.pool.counters.jobs_answered
    for if_none_match in (tag, f'"other", W/{tag}', "*"):
        answer = yard_client.get(f"{YARD}.png", params=query, headers={"If-None-Match": if_none_match})
        assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", tag)
    cached_response = yard_client.get(f"{YARD}.png", params=query)
    assert "snapshot;desc=kept" in cached_response.headers["server-timing"]
    head = yard_client.head(f"{YARD}.png", params=query)
    assert (head.status_code, head.content) == (200, b"")
    for name in ("etag", "content-length", "content-type", "cache-control"):
        assert head.headers[name] == cached_response.headers[name]
    assert yard_client.service.pool.counters.jobs_answered == before


def test_different_queries_have_different_entity_tags(yard_client: Client):
    queries = [
        "png?view=across", "webp?view=across", "png?view=low", "png?view=across&layer=mask", "png?view=across&layer=shadow",
        "png?view=across&layer=mask&light=lamp", "png?view=across&seconds=1", "png?view=across&size=10x10",
        "png?view=across&azimuth=1&altitude=20", "png?view=across&algorithm=none", "png?view=across&filter=1",
        "png?view=across&stencil=two_pass", "png?view=across&counting=z_fail", "png?view=across&mask=original",
    ]  # fmt: skip
    tags = [entity_tag(yard_client, f"{YARD}.{query}") for query in [*queries, *queries]]
    assert len(set(tags)) == len(queries)


def entity_tag(client: Client, address: str) -> str:
    """Return the entity tag of a picture without drawing it."""
    answer = client.get(address, headers={"If-None-Match": "*"})
    assert answer.status_code == 304
    return answer.headers["etag"]


def test_equal_snapshots_at_once_are_one_render(yard_client: Client):
    before = yard_client.service.pool.counters.jobs_answered
    query = {"view": "across", "azimuth": 33, "altitude": 44}  # not requested before
    with ThreadPoolExecutor(4) as threads:
        answers = list(threads.map(lambda _: yard_client.get(f"{YARD}.png", params=query), range(4)))
    assert len({answer.content for answer in answers}) == 1
    assert [answer.status_code for answer in answers] == [200] * 4
    assert yard_client.service.pool.counters.jobs_answered - before == 1


@pytest.mark.parametrize(
    ("query", "parameter", "expected_text"),
    [
        ("png?view=ridge", "view", "map, across, low"),
        ("png?size=0x10", "size", "WIDTHxHEIGHT"),
        ("png?size=10", "size", "WIDTHxHEIGHT"),
        ("png?size=10x20x30", "size", "WIDTHxHEIGHT"),
        ("png?size=-5x20", "size", "WIDTHxHEIGHT"),
        ("png?size=5000x10", "size", "4096"),
        ("png?size=4096x1025", "size", "4194304 pixels"),
        ("png?layer=depth", "layer", "mask"),
        ("jpg?layer=mask", "format", "webp"),
        ("tif", "format", "webp"),
        ("png?light=moon", "light", "sun, lamp"),
        ("png?seconds=soon", "seconds", "number"),
        ("png?seconds=nan", "seconds", "finite"),
        ("png?seconds=1e300", "seconds", "1000000000"),
        ("png?azimuth=10", "altitude", "missing"),
        ("png?time=yesterday", "time", "offset"),
        ("png?map_size=63", "map_size", "64"),
        ("png?depth_bits=17", "depth_bits", "24"),
        ("png?filter=4", "filter", "5"),
        ("png?stencil=three_pass", "stencil", "two_pass"),
        ("png?counting=z_both", "counting", "z_fail"),
        ("png?mask=paper", "mask", "original"),
        ("png?bounds=1,2,3,4", "bounds", "size"),
        ("png?view=across&view=low", "view", "more than once"),
        ("png?algorithm=truth", "algorithm", "shadow_map"),
        ("png?algorithm=lamp%3Dtruth", "algorithm", "shadow_map"),
        ("png?algorithm=meshes%3Dtruth,lamp%3Dshadow_map", "algorithm", "shadow_map"),
        ("png?algorithm=moon%3Dshadow_map", "algorithm", "lamp"),
    ],
)
def test_wrong_parameters_are_422(yard_client: Client, query: str, parameter: str, expected_text: str):
    problem = check_problem(yard_client.get(f"{YARD}.{query}"), 422, "invalid_parameter", parameter)
    assert parameter in problem["detail"] and expected_text in problem["detail"]


def test_an_unknown_level_is_404(yard_client: Client):
    check_problem(yard_client.get("/levels/attic/snapshot.png"), 404, "not_found", "level")


def test_openapi_lists_all_parameters(yard_client: Client):
    operation = yard_client.get("/openapi.json").json()["paths"]["/levels/{level}/snapshot.{format}"]["get"]
    assert {parameter["name"] for parameter in operation["parameters"]} == {
        "level", "format", "view", "size", "layer", "light", "seconds",
        "time", "azimuth", "altitude", "style", "slope_exaggeration", "sky", "ramp", "local_light", "generalisation",
        "eye", "target", "fov",
        "algorithm", "map_size", "depth_bits", "filter", "bias", "culling",
        "stencil", "counting", "mask",
    }  # fmt: skip


def test_plans_reject_ray_traced_truth(yard_client: Client):
    check_problem(yard_client.get("/levels/yard/plan?view=across&algorithm=lamp%3Dtruth"), 422, "invalid_parameter", "algorithm")


def test_a_level_lists_its_views_and_lights(yard_client: Client):
    yard, cellar = (yard_client.get(f"/levels/{name}").json() for name in ("yard", "cellar"))
    assert yard["views"] == ["across", "low"]
    assert yard["view_kinds"] == {name: {"kind": "perspective", "size": [WIDTH, HEIGHT]} for name in ("across", "low")}
    assert cellar["view_kinds"]["map"] == {"kind": "map", "size": [90, 70]}
    assert yard["lights"] == {"sun": {"kind": "sun"}, "lamp": {"kind": "spot"}}
    assert cellar["lights"] == {"lamp": {"kind": "spot"}}


def test_pixels_are_bounded_by_a_setting(serve_with):
    client = serve_with(fake_workers.scripted, max_snapshot_pixels=10_000)
    for query in ("", "?size=101x100"):  # the view's own size is bounded too
        problem = check_problem(client.get(f"/levels/hills/snapshot.png{query}"), 422, "invalid_parameter", "size")
        assert "10000" in problem["detail"] and "SKUGGA_MAX_SNAPSHOT_PIXELS" in problem["detail"]
    assert entity_tag(client, "/levels/hills/snapshot.png?size=100x100")


def test_a_snapshot_that_takes_too_long_is_504(serve_with):
    client = serve_with(fake_workers.hanging, render_timeout_s=0.3)
    check_problem(client.get("/levels/hills/snapshot.png"), 504, "render_timeout", None)


def test_a_full_queue_refuses_until_a_client_leaves(serve_with):
    client = serve_with(fake_workers.never_ready, queue_work_s=0.1)
    pool = client.service.pool
    with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
        connection.sendall(b"GET /levels/hills/snapshot.png HTTP/1.1\r\nHost: x\r\n\r\n")
        while pool.queued_count < 1:
            client.get("/healthz")
        refusal = client.get("/levels/hills/snapshot.png?size=64x64")
        check_problem(refusal, 503, "busy", None)
        assert int(refusal.headers["retry-after"]) >= 1
    while pool.queued_count:
        client.get("/healthz")
    assert pool.counters.jobs_abandoned == 1


def test_a_view_that_cannot_be_drawn_is_logged_at_start(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """The service still serves the level. The log names the view at once."""
    outside = {"kind": "perspective", "eye": [5000, 0, 10], "target": [0, 0, 0]}
    levels = ServedLevels([write_yard(tmp_path, views={**LEVEL["views"], "outside": outside})])
    assert levels.reload_if_changed("yard").view_sizes == {
        "map": (1024, 1024),
        "across": (WIDTH, HEIGHT),
        "low": (WIDTH, HEIGHT),
        "outside": None,
    }
    assert "views.outside.eye" in caplog.text


def test_a_changed_forest_changes_the_entity_tag(tmp_path: Path):
    forest_file = tmp_path / "stand.geojson"
    tree = {"type": "Feature", "properties": {"h": 9}, "geometry": {"type": "Point", "coordinates": [20, 5]}}
    forest_file.write_text(json.dumps({"type": "FeatureCollection", "features": [tree]}), encoding="utf-8")
    path = write_yard(tmp_path, forest=[{"source": forest_file.name, "height": "h"}])
    with running(create_app(Settings(workers=1, level_check_s=0), [path], fake_workers.scripted)) as client:
        while not client.service.pool.is_ready:
            client.get("/readyz")
        address = f"{YARD}.png?view=across"
        before = entity_tag(client, address)
        assert entity_tag(client, address) == before
        mtime_ns = forest_file.stat().st_mtime_ns + 10**9
        os.utime(forest_file, ns=(mtime_ns, mtime_ns))
        after = entity_tag(client, address)
    assert after != before


def test_a_process_over_its_limit_keeps_one_level(tmp_path: Path):
    process_has_grown = False
    scenes = SceneCache(process_bytes=lambda: MAX_PROCESS_BYTES + 1 if process_has_grown else 0)
    keys = [LevelKey(path=write_yard(tmp_path, name), version="1") for name in ("a", "b")]
    first, second = (scenes.get(key) for key in keys)
    assert scenes.get(keys[0]) is first
    process_has_grown = True
    assert scenes.get(keys[1]) is second
    assert len(scenes) == 1
    assert scenes.get(keys[1]) is second  # a single level stays, whatever its size


def test_resident_bytes_measures_an_allocation():
    before = resident_bytes()
    if not before:
        pytest.skip("this system has no /proc")
    size = 2**27
    # A mapping of its own: an array may come from freed memory that is resident already.
    with mmap(-1, size) as block:
        block[::PAGESIZE] = b"\1" * (size // PAGESIZE)
        assert 0.9 * size < resident_bytes() - before < 1.5 * size
