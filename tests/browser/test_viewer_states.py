"""Waiting, failed and empty states of the viewer, and the ways out of them."""

from __future__ import annotations

import re
from collections.abc import Callable
from io import BytesIO
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Route, expect

from tests.browser.conftest import WINDOW_SIZE_PX, Viewer
from tests.browser.map_clients import serve_single_tile
from tests.browser.test_viewer import BACKGROUND_COLOR
from tests.browser.test_viewer_access import LANDSCAPE, PHONE

SUN_HOURS_COLOR = 240, 160, 20


def test_unreachable_service_can_be_retried(viewer: Viewer):
    viewer.allowed_faults = re.compile("ERR_FAILED")
    viewer.page.route(re.compile("/levels$"), lambda route: route.abort())
    viewer.page.goto(viewer.address)
    veil = viewer.page.locator("#veil")
    expect(veil).to_contain_text("The service does not answer.")
    viewer.page.unroute(re.compile("/levels$"))
    veil.get_by_role("button", name="Try again").click()
    expect(veil).to_be_hidden()
    viewer.wait_until_drawn()


def test_failed_tile_shows_the_error_and_a_retry(viewer: Viewer):
    viewer.allowed_faults = re.compile("500")
    viewer.page.route(re.compile("/tiles/"), lambda route: route.fulfill(status=500, json={"detail": "The worker is gone."}))
    viewer.page.goto(viewer.address)
    status = viewer.page.locator("#status.failed")
    expect(status).to_contain_text("The worker is gone. (500)")
    viewer.page.unroute(re.compile("/tiles/"))
    status.get_by_role("button", name="Try again").click()
    expect(status).to_be_hidden()
    assert len(np.unique(viewer.wait_until_drawn().pixels.reshape(-1, 3), axis=0)) > 5000


@pytest.mark.parametrize("window", [{}, PHONE, LANDSCAPE], ids=["window", "phone", "across"])
def test_long_error_stays_in_its_box(make_viewer: Callable[..., Viewer], window: dict[str, Any]):
    viewer = make_viewer(**window)
    viewer.allowed_faults = re.compile("422")
    detail = f"source: '{'folder/' * 30}{'heights' * 20}.tif' is not allowed. Allowed: {'a_word_without_a_break' * 9}"
    viewer.page.route(re.compile("/tiles/"), lambda route: route.fulfill(status=422, json={"detail": detail}))
    viewer.page.goto(viewer.address)
    box = viewer.page.locator("#status.failed")
    expect(box).to_contain_text("folder/folder/")
    inner, outer, controls = (
        viewer.page.locator(part).bounding_box()
        for part in ("#status p", "#status", ".maplibregl-ctrl-top-right .maplibregl-ctrl-group")
    )
    assert inner is not None and outer is not None and controls is not None
    assert viewer.page.locator("#status p").evaluate("each => each.scrollWidth <= each.clientWidth"), (
        "the text is as wide as its box"
    )
    assert outer["x"] >= 0 and outer["x"] + outer["width"] <= controls["x"]
    assert outer["y"] <= inner["y"] and inner["y"] + inner["height"] <= outer["y"] + outer["height"]
    expect(box.get_by_role("button", name="Try again")).to_be_in_viewport(ratio=1)


@pytest.mark.parametrize(
    ("fragment", "expected_text"),
    [
        ("level=nosuch", "there is no level 'nosuch' here; this is Jacksboro fault, Tennessee"),
        ("time=yesterday", "time=yesterday is not understood: a time is as 2024-06-21T12:00:00+02:00"),
        ("time=2024-02-30T10:00:00-04:00", "time=2024-02-30T10:00:00-04:00 is not understood"),
        ("layer=relief", "this level has no layer 'relief': color, shadow, sunhours"),
        ("azimuth=west&altitude=20", "azimuth=west is not understood"),
        ("style=baroque", "there is no style 'baroque'"),
        ("panel=nosuch", "there is no panel 'nosuch'"),
        ("view=main", "there is no view 'main' to show here"),
        ("point=here", "point=here is not understood: longitude,latitude"),
        ("compare=date:tomorrow", "compare=date:tomorrow is not understood"),
        ("views-eye=1,2&views-target=1,2,3", "views-eye=1,2 is not understood"),
        ("tiem=12:00", "'tiem' means nothing"),
    ],
)
def test_invalid_parts_of_the_address_are_reported(viewer: Viewer, fragment: str, expected_text: str):
    """One line, which can be closed, reports them beside the map."""
    viewer.hide_preparations()
    viewer.open(f"#{fragment}")
    line = viewer.page.locator("#notice")
    expect(line).to_contain_text(expected_text)
    expect(line).to_contain_text("In the address, ")
    expect(viewer.page).to_have_title("Jacksboro fault, Tennessee · Skugga")
    line.get_by_role("button", name="Close").click()
    expect(line).to_be_hidden()


def test_page_understands_its_own_address(viewer: Viewer):
    viewer.hide_preparations()
    viewer.open("#point=-84.25,36.3&point-height=2&theme=dark")
    expect(viewer.page).to_have_url(re.compile("level=jacksboro"))
    expect(viewer.page.locator("#notice")).to_be_hidden()
    viewer.page.evaluate("() => { location.hash = location.hash.replace('level=', 'level=no'); }")
    expect(viewer.page.locator("#notice")).to_contain_text("there is no level 'nojacksboro' here")
    viewer.page.go_back()
    expect(viewer.page.locator("#notice")).to_be_hidden()


def test_slow_service_shows_that_it_works(viewer: Viewer):
    """A line runs along the top, and words follow after a while; both disappear once all is drawn."""
    held_routes: list[Route] = []
    holds_tiles = [True]
    viewer.hide_preparations()
    viewer.page.route(re.compile("/tiles/"), lambda route: held_routes.append(route) if holds_tiles else route.continue_())
    viewer.page.goto(viewer.address)
    expect(viewer.page.locator("body.working")).to_be_attached()
    expect(viewer.page.locator("#status")).to_contain_text("Still drawing")
    holds_tiles.clear()
    for route in held_routes:
        route.continue_()
    viewer.wait_until_drawn()
    expect(viewer.page.locator("#status")).to_be_hidden()
    expect(viewer.page.locator("body.working")).not_to_be_attached()


def test_place_without_data_offers_a_way_back(viewer: Viewer):
    viewer.page.goto(f"{viewer.address}/#map=10/10/10")
    veil = viewer.page.locator("#veil")
    expect(veil).to_contain_text("Nothing is known here. Jacksboro fault, Tennessee lies elsewhere.")
    veil.get_by_role("button", name="Take me there").click()
    expect(veil).to_be_hidden()
    assert len(np.unique(viewer.wait_until_drawn().pixels.reshape(-1, 3), axis=0)) > 5000


def test_pasted_base_map_lies_under_the_shadows(make_viewer: Callable[..., Viewer]):
    """A text that is no address of tiles is refused with an explanation."""
    red = BytesIO()
    Image.new("RGB", (256, 256), (220, 60, 60)).save(red, "PNG")
    with serve_single_tile(red.getvalue()) as address:
        viewer = make_viewer()
        viewer.allow(address)
        viewer.open()
        viewer.page.get_by_text("Base map", exact=True).click()
        field = viewer.page.get_by_label("Address of XYZ tiles")
        field.fill("not an address")
        viewer.page.get_by_role("button", name="Use").click()
        expect(viewer.page.locator("#base-note.fail")).to_contain_text("has to begin with http")

        field.fill(f"{address}/{{z}}/{{x}}/{{y}}.png")
        viewer.page.get_by_role("button", name="Use").click()
        expect(viewer.page.get_by_label("Shadows", exact=True)).to_be_checked()
        pixels = viewer.wait_until_drawn().pixels.astype(int)
        assert (pixels[..., 0] >= pixels[..., 1]).all(), "each pixel shows the red base map or shadow over it"
        assert (np.abs(pixels - (220, 60, 60)).max(axis=2) < 3).mean() > 0.2, "lit ground shows the unchanged base map"
        assert (pixels[..., 0] < 150).mean() > 0.15, "shadows are dark"
        outside = viewer.pixels()[100, WINDOW_SIZE_PX["width"] - 150]
        assert np.abs(outside.astype(int) - (220, 60, 60)).max() < 3, "the base map continues beyond the level"

        viewer.page.get_by_role("button", name="Remove the base map").click()
        assert not (np.abs(viewer.wait_until_drawn().pixels.astype(int) - (220, 60, 60)).max(axis=2) < 3).any()


def test_sun_hours_never_show_under_another_legend(viewer: Viewer):
    """The previous tiles are removed, and a line shows the progress; also for another quantity or date."""
    held_routes: list[Route] = []
    tile = BytesIO()
    Image.new("RGB", (256, 256), SUN_HOURS_COLOR).save(tile, "PNG")
    viewer.hide_preparations()
    viewer.page.route(re.compile("/tiles/.*sunhours"), lambda route: held_routes.append(route))
    viewer.open()
    page, status = viewer.page, viewer.page.locator("#status")

    def color_distance(color: tuple[int, int, int]) -> int:
        """Return the largest difference of the level, below the text at the top, from a colour."""
        return int(np.abs(viewer.pixels(viewer.level_rectangle())[80:].astype(int) - color).max())

    def check_redraw() -> None:
        expect(status).to_contain_text(re.compile(r"^Drawing hours of sun: 0 of \d+ tiles"), timeout=4000)
        page.wait_for_function("() => document.body.classList.contains('working')")
        page.wait_for_timeout(300)
        assert color_distance(BACKGROUND_COLOR) < 3, "the page shows only the background colour"
        for route in held_routes:
            route.fulfill(body=tile.getvalue(), content_type="image/png")
        held_routes.clear()
        viewer.wait_until_drawn()
        expect(status).to_be_hidden()
        assert color_distance(SUN_HOURS_COLOR) < 3

    page.get_by_text("Hours of sun", exact=True).first.click()
    check_redraw()
    page.get_by_label("Quantity").select_option("first")
    check_redraw()
    page.get_by_label("Day of the year").fill("172")
    check_redraw()
    page.get_by_text("Shaded", exact=True).click()
    assert len(np.unique(viewer.wait_until_drawn().pixels.reshape(-1, 3), axis=0)) > 1000


def test_sun_hours_have_a_legend(viewer: Viewer):
    """It has the service's colours and numbers. The tiles are fake, because a level's first ones take a while."""
    viewer.page.route(re.compile("/tiles/.*sunhours"), lambda route: route.fulfill(status=204))
    viewer.open()
    viewer.page.get_by_text("Hours of sun", exact=True).first.click()
    legend = viewer.page.locator(".legend")
    expect(legend).to_contain_text("Hours of sun, 21 October 2024")
    expect(legend.locator(".scale-ticks span").first).to_have_text("0")
    expect(viewer.page.get_by_label("Time of day")).to_be_disabled()
    viewer.page.get_by_label("Quantity").select_option("first")
    expect(legend).to_contain_text("First sun, 21 October 2024")
    viewer.wait_until_settled()
    viewer.page.get_by_label("Day of the year").fill("172")
    expect(legend).to_contain_text("First sun, 20 June 2024")
    viewer.wait_until_settled()
    assert any(
        "layer=sunhours&date=2024-06-20" in url and "quantity=first" in url for url in viewer.requested_urls if "/tiles/" in url
    )


def test_terrain_in_three_dimensions_rises_and_flattens(viewer: Viewer):
    """The terrain rises from the service's heights, and the shaded layer lies on it."""
    flat = viewer.open()
    viewer.page.get_by_label("Three dimensions").check()
    viewer.wait_until_settled()
    viewer.page.wait_for_function("() => location.hash.includes('solid=1') && /map=.*\\/55\\.0/.test(location.hash)")
    viewer.wait_until_settled()
    assert any("layer=terrain-rgb" in url for url in viewer.requested_urls)
    upper_half = viewer.pixels()[: WINDOW_SIZE_PX["height"] // 2]
    assert len(np.unique(upper_half.reshape(-1, 3), axis=0)) > 5000
    viewer.page.get_by_label("Three dimensions").uncheck()
    viewer.page.wait_for_function("() => !location.hash.includes('solid') && !/map=.*\\/.*\\/.*\\//.test(location.hash)")
    viewer.wait_until_settled()
    assert np.array_equal(viewer.wait_until_drawn().pixels, flat.pixels), "the map is flat again and shows the same picture"
