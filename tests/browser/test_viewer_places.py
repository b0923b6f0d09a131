"""The viewer of scenes and rasters that are not georeferenced, and of rasters without a sun."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from playwright.sync_api import Browser, Route, expect

from skugga.api.catalogue import find_level
from tests.api.conftest import Client, write_level
from tests.browser.conftest import WINDOW_SIZE_PX, Viewer, ready_service, viewer_factory
from tests.browser.test_viewer_access import PHONE, axe_violations
from tests.browser.test_viewer_start import ServiceReadiness
from tests.rasters import ENGINEERING

STREET, LAMPS = "thesis_street_sun", "thesis_boxgrid"

EVENING = "2026-06-21T20:00:00Z"

SECOND_DRAW_MS = 500
"""The page draws again well before this many milliseconds after the service is ready."""

LEFT_PX = 400
"""Left edge of the examined part of the map, right of the panel."""


@pytest.fixture(scope="session")
def levels_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """Yield a service of five levels.

    ``bare`` is a raster without a sun, ``directed`` has a sun by direction, and ``site`` is a raster that is not georeferenced.
    Of two scenes, one is lit by a lamp alone.
    """
    folder: Path = tmp_path_factory.mktemp("places")
    levels = [write_level(folder, "bare", sun=None), write_level(folder, "directed"), write_level(folder, "site", ENGINEERING)]
    with ready_service([*levels, find_level(STREET), find_level(LAMPS)]) as client:
        yield client


@pytest.fixture
def make_levels_viewer(chromium: Browser, levels_service: Client) -> Iterator[Callable[..., Viewer]]:
    """Yield a factory of viewers of the service ``levels_service``."""
    with viewer_factory(chromium, levels_service) as make:
        yield make


@pytest.fixture
def levels_viewer(make_levels_viewer: Callable[..., Viewer]) -> Viewer:
    """Return a viewer of the service ``levels_service``."""
    return make_levels_viewer()


def open_at(viewer: Viewer, fragment: str) -> Viewer:
    """Open the viewer at a URL fragment, wait until all is drawn, and return it."""
    viewer.hide_preparations()
    viewer.page.goto(f"{viewer.address}/{fragment}")
    viewer.wait_until_settled()
    return viewer


def snapshot_queries(viewer: Viewer) -> list[dict[str, list[str]]]:
    """Return the queries of all full-size snapshots so far, without the panel's thumbnails."""
    snapshot_urls = [url for url in viewer.requested_urls if "/snapshot.png" in url]
    return [parse_qs(urlsplit(url).query) for url in snapshot_urls]


def count_stage_colors(viewer: Viewer) -> int:
    """Return how many colours the picture on the stage has."""
    box = viewer.page.locator("#stage .shot img").bounding_box()
    assert box is not None
    return len(np.unique(viewer.pixels(box).reshape(-1, 3), axis=0))


def test_scene_without_a_georeference_shows_its_views(levels_viewer: Viewer):
    """It can be chosen and explains why it has no map; the sliders' sun lights its views."""
    open_at(levels_viewer, "#level=bare")
    level = levels_viewer.page.get_by_label("Level", exact=True)
    expect(level.locator("optgroup")).to_have_attribute("label", "Without a map: pictures of their views")
    expect(level.locator("option:disabled")).to_have_count(0)
    level.select_option(STREET)
    stage = levels_viewer.page.locator("#stage")
    expect(stage).to_contain_text("This level is not georeferenced: there is no map of it, and no sun by date and time.")
    levels_viewer.wait_until_settled()
    assert count_stage_colors(levels_viewer) > 1000
    (first,) = snapshot_queries(levels_viewer)
    assert (first["view"], first["azimuth"], first["altitude"]) == (["main"], ["117"], ["32"])
    assert levels_viewer.page.get_by_role("tab").all_inner_texts() == ["Views", "Why"]
    expect(levels_viewer.page.locator("#map")).to_be_hidden()
    expect(levels_viewer.page.locator("#play")).to_be_hidden()
    expect(levels_viewer.page.locator("#by")).to_be_hidden()

    stage.get_by_text("Overview").click()
    levels_viewer.wait_until_settled()
    expect(levels_viewer.page).to_have_url(re.compile(f"level={STREET}.*azimuth=117&altitude=32.*view=overview"))
    levels_viewer.page.get_by_label("Height above the horizon").fill("12")
    levels_viewer.wait_until_settled()
    assert snapshot_queries(levels_viewer)[-1]["view"] == ["overview"] and snapshot_queries(levels_viewer)[-1]["altitude"] == ["12"]
    levels_viewer.page.get_by_role("tab", name="Why").click()
    expect(levels_viewer.page.locator(".plan")).to_contain_text("Shadows of ridges, houses and trees")
    assert not axe_violations(levels_viewer.page)

    level.select_option("bare")
    levels_viewer.wait_until_settled()
    expect(stage).to_be_hidden()
    expect(levels_viewer.page.get_by_role("tab", name="Point")).to_be_visible()
    assert any("/tiles/" in url for url in levels_viewer.requested_urls)


def test_scene_of_lamps_needs_no_sun(levels_viewer: Viewer):
    open_at(levels_viewer, f"#level={LAMPS}&view=close")
    (query,) = snapshot_queries(levels_viewer)
    assert query["view"] == ["close"] and not {"time", "azimuth", "altitude"} & set(query)
    expect(levels_viewer.page.locator("#sun")).to_contain_text("lit by lamps of its own")
    expect(levels_viewer.page.get_by_label("Height above the horizon")).to_be_hidden()
    expect(levels_viewer.page.locator("#notice")).to_be_hidden()
    assert count_stage_colors(levels_viewer) > 500


def test_raster_without_a_georeference_shows_its_map_view(make_levels_viewer: Callable[..., Viewer]):
    """The view fits on a phone, too."""
    viewer = open_at(make_levels_viewer(**PHONE), "#level=site&time=2024-06-21T12:00:00Z")
    (query,) = snapshot_queries(viewer)
    assert query["view"] == ["map"]
    expect(viewer.page.locator("#notice")).to_contain_text("there is no sun by time without a place on the earth")
    box = viewer.page.locator("#stage .shot").bounding_box()
    dock = viewer.page.locator("#sun").bounding_box()
    assert box is not None and dock is not None
    assert box["width"] > 350 and box["height"] > 300 and box["y"] + box["height"] <= dock["y"]


def test_picture_requested_again_while_it_loads_is_shown(levels_viewer: Viewer):
    """A service that becomes ready makes the page draw again: the same picture, whose request is still under way."""
    levels_viewer.allowed_faults = re.compile("503")
    readiness = ServiceReadiness(levels_viewer.page)
    readiness.starting()
    held_routes: list[Route] = []
    levels_viewer.page.route(re.compile("/snapshot.png"), lambda route: held_routes.append(route))
    levels_viewer.page.goto(f"{levels_viewer.address}/#level={LAMPS}&view=close")
    expect(levels_viewer.page.locator("#stage .picture.busy")).to_be_visible()
    readiness.ready()
    with levels_viewer.page.expect_request(re.compile("/snapshot.png")):
        pass
    levels_viewer.page.wait_for_timeout(SECOND_DRAW_MS)
    addresses = [route.request.url for route in held_routes]
    assert len(set(addresses)) == len(addresses), "a pending picture is not requested again"
    for route in held_routes:
        route.continue_()
    levels_viewer.wait_until_settled()
    assert count_stage_colors(levels_viewer) > 500


def test_failed_scene_shows_the_error(levels_viewer: Viewer):
    levels_viewer.allowed_faults = re.compile("500")
    levels_viewer.page.route(
        re.compile("/snapshot"), lambda route: route.fulfill(status=500, json={"detail": "The worker is gone."})
    )
    levels_viewer.page.goto(f"{levels_viewer.address}/#level={LAMPS}")
    status = levels_viewer.page.locator("#status.failed")
    expect(status).to_contain_text("The worker is gone. (500)")
    levels_viewer.page.unroute(re.compile("/snapshot"))
    status.get_by_role("button", name="Try again").click()
    expect(status).to_be_hidden()
    levels_viewer.wait_until_settled()
    assert count_stage_colors(levels_viewer) > 500


def test_raster_without_a_sun_opens_in_the_morning(levels_viewer: Viewer, levels_service: Client):
    """By the local clock, under a sun as low as the service's default, with date, play and the day's curve."""
    levels_viewer.page.clock.set_fixed_time(EVENING)
    open_at(levels_viewer, "#level=bare")
    page = levels_viewer.page
    sun = next(level["sun"] for level in levels_service.get("/levels").json() if level["name"] == "bare")
    expect(page.locator("#date")).to_have_value("2026-06-21")
    expect(page.locator("#offset option:checked")).to_have_text("UTC+2 · Zurich")
    minutes = int(page.locator("#minutes").input_value())
    assert 5 * 60 < minutes < 12 * 60
    (time,) = {parse_qs(urlsplit(url).query)["time"][0] for url in levels_viewer.requested_urls if "/tiles/" in url}
    assert time == f"2026-06-21T{minutes // 60:02}:{minutes % 60:02}:00+02:00"
    service_sun = levels_service.get("/levels/bare/WebMercatorQuad/tilejson.json", params={"time": time}).json()["skugga"]["sun"]
    assert service_sun["altitude"] == pytest.approx(sun["altitude"], abs=1.5)
    expect(page.get_by_role("button", name="Play the day")).to_be_enabled()
    expect(page.locator(".height-dial .path")).to_be_visible()
    expect(page.get_by_role("button", name="Sunset")).to_be_visible()
    page.get_by_text("Shadows", exact=True).click()
    levels_viewer.wait_until_settled()
    dark = levels_viewer.pixels()[20 : WINDOW_SIZE_PX["height"] // 2, LEFT_PX:].max(axis=2) < 64
    assert dark.mean() > 0.05, "the picture shows shadows"

    page.get_by_label("Date", exact=True).fill("2026-12-21")
    expect(page.locator("#offset option:checked")).to_have_text("UTC+1 · Zurich")
    levels_viewer.wait_until_settled()
    page.locator("#offset").select_option("+00:00")
    page.get_by_label("Date", exact=True).fill("2026-06-01")
    expect(page.locator("#offset")).to_have_value("+00:00")  # a clock that was chosen stays


def test_sun_by_direction_of_a_level_is_kept(levels_viewer: Viewer):
    open_at(levels_viewer, "#level=directed")
    expect(levels_viewer.page.get_by_label("Azimuth, clockwise from north")).to_have_value("250")
    expect(levels_viewer.page.locator("#play")).to_be_hidden()
    levels_viewer.page.get_by_role("button", name="By date and time").click()
    expect(levels_viewer.page.locator("#offset option:checked")).to_have_text(re.compile("Zurich"))
    levels_viewer.wait_until_settled()
