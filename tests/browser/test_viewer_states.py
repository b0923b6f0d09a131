"""What the viewer says while it waits, where something fails, and where there is nothing to see; and how one goes on from there."""

from __future__ import annotations

import re
from collections.abc import Callable
from io import BytesIO

import numpy as np
from PIL import Image
from playwright.sync_api import Route, expect

from tests.browser.conftest import WINDOW, Viewer
from tests.browser.map_clients import served_tiles


def test_a_service_that_does_not_answer(viewer: Viewer):
    viewer.forgiven = re.compile("ERR_FAILED")
    viewer.page.route(re.compile("/levels$"), lambda route: route.abort())
    viewer.page.goto(viewer.address)
    veil = viewer.page.locator("#veil")
    expect(veil).to_contain_text("The service does not answer.")
    viewer.page.unroute(re.compile("/levels$"))
    veil.get_by_role("button", name="Try again").click()
    expect(veil).to_be_hidden()
    viewer.shown()


def test_a_tile_that_fails(viewer: Viewer):
    """The page says why, and what failed is asked for again."""
    viewer.forgiven = re.compile("500")
    viewer.page.route(re.compile("/tiles/"), lambda route: route.fulfill(status=500, json={"detail": "The worker is gone."}))
    viewer.page.goto(viewer.address)
    status = viewer.page.locator("#status.failed")
    expect(status).to_contain_text("The worker is gone. (500)")
    viewer.page.unroute(re.compile("/tiles/"))
    status.get_by_role("button", name="Try again").click()
    expect(status).to_be_hidden()
    assert len(np.unique(viewer.shown().pixels.reshape(-1, 3), axis=0)) > 5000


def test_a_slow_service(viewer: Viewer):
    """A line runs along the top; after a while words say so; both go when all is there."""
    waiting: list[Route] = []
    slow = [True]
    viewer.hide_preparations()
    viewer.page.route(re.compile("/tiles/"), lambda route: waiting.append(route) if slow else route.continue_())
    viewer.page.goto(viewer.address)
    expect(viewer.page.locator("body.working")).to_be_attached()
    expect(viewer.page.locator("#status")).to_contain_text("Still drawing")
    slow.clear()
    for route in waiting:
        route.continue_()
    viewer.shown()
    expect(viewer.page.locator("#status")).to_be_hidden()
    expect(viewer.page.locator("body.working")).not_to_be_attached()


def test_a_place_without_data_has_a_way_back(viewer: Viewer):
    viewer.page.goto(f"{viewer.address}/#map=10/10/10")
    veil = viewer.page.locator("#veil")
    expect(veil).to_contain_text("Nothing is known here. Jacksboro fault, Tennessee lies elsewhere.")
    veil.get_by_role("button", name="Take me there").click()
    expect(veil).to_be_hidden()
    assert len(np.unique(viewer.shown().pixels.reshape(-1, 3), axis=0)) > 5000


def test_a_base_map_that_is_pasted(make_viewer: Callable[..., Viewer]):
    """Shadows lie over it; what is no address of tiles is refused in words."""
    red = BytesIO()
    Image.new("RGB", (256, 256), (220, 60, 60)).save(red, "PNG")
    with served_tiles(red.getvalue()) as address:
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
        pixels = viewer.shown().pixels.astype(int)
        assert (pixels[..., 0] >= pixels[..., 1]).all(), "nothing but red and shadow"
        assert (np.abs(pixels - (220, 60, 60)).max(axis=2) < 3).mean() > 0.2, "light is the base map alone"
        assert (pixels[..., 0] < 150).mean() > 0.15, "shadows are dark"
        outside = viewer.pixels()[100, WINDOW["width"] - 150]
        assert np.abs(outside.astype(int) - (220, 60, 60)).max() < 3, "it goes on beyond the level"

        viewer.page.get_by_role("button", name="Remove the base map").click()
        assert not (np.abs(viewer.shown().pixels.astype(int) - (220, 60, 60)).max(axis=2) < 3).any()


def test_hours_of_sun_have_a_legend(viewer: Viewer):
    """The service's colours and numbers. (The tiles are made up: the first ones of a level take a while.)"""
    viewer.page.route(re.compile("/tiles/.*sunhours"), lambda route: route.fulfill(status=204))
    viewer.open()
    viewer.page.get_by_text("Hours of sun", exact=True).first.click()
    legend = viewer.page.locator(".legend")
    expect(legend).to_contain_text("Hours of sun, 21 October 2024")
    expect(legend.locator(".scale-ticks span").first).to_have_text("0")
    expect(viewer.page.get_by_label("Time of day")).to_be_disabled()
    viewer.page.get_by_label("Quantity").select_option("first")
    expect(legend).to_contain_text("First sun, 21 October 2024")
    viewer.settled()
    viewer.page.get_by_label("Day of the year").fill("172")
    expect(legend).to_contain_text("First sun, 20 June 2024")
    viewer.settled()
    assert any("layer=sunhours&date=2024-06-20" in each and "quantity=first" in each for each in viewer.asked if "/tiles/" in each)


def test_the_ground_in_three_dimensions(viewer: Viewer):
    """It rises from the service's heights, and the shaded layer lies on it."""
    flat = viewer.open()
    viewer.page.get_by_label("Three dimensions").check()
    viewer.settled()
    viewer.page.wait_for_function("() => location.hash.includes('solid=1') && /map=.*\\/55\\.0/.test(location.hash)")
    viewer.settled()
    assert any("layer=terrain-rgb" in each for each in viewer.asked)
    whole = viewer.pixels()[: WINDOW["height"] // 2]
    assert len(np.unique(whole.reshape(-1, 3), axis=0)) > 5000
    viewer.page.get_by_label("Three dimensions").uncheck()
    viewer.page.wait_for_function("() => !location.hash.includes('solid') && !/map=.*\\/.*\\/.*\\//.test(location.hash)")
    viewer.settled()
    assert np.array_equal(viewer.shown().pixels, flat.pixels), "and flat again"
