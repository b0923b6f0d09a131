"""Controls of the viewer: the range of colours, base maps that are offered, the search for coordinates, sharing."""

from __future__ import annotations

import re
from collections.abc import Callable
from io import BytesIO
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page, expect
from pyproj import Transformer

from tests.api.conftest import Client
from tests.browser.conftest import LEVEL, Viewer
from tests.browser.test_viewer_access import PHONE, axe_violations

TIME = "2024-10-21T17:45:00-04:00"

BASE_TILES = "static/base/{z}/{x}/{y}.png"
BASE_COLOR = 220, 60, 60


def fulfil_tiles(page: Page, pattern: str, color: tuple[int, int, int]) -> None:
    """Answer requests for tiles with one colour."""
    picture = BytesIO()
    Image.new("RGB", (256, 256), color).save(picture, "PNG")
    page.route(re.compile(pattern), lambda route: route.fulfill(body=picture.getvalue(), content_type="image/png"))


def color_ranges(viewer: Viewer) -> set[str | None]:
    """Return the ranges of the tiles of hours of sun that were requested, and forget them."""
    urls = [url for url in viewer.requested_urls if "/tiles/" in url and "layer=sunhours" in url]
    viewer.requested_urls.clear()
    return {parse_qs(urlsplit(url).query).get("color_range", [None])[0] for url in urls}


def test_color_range_of_hours_of_sun(viewer: Viewer):
    """The range of the date is the default. The legend and the panel say the range; a wrong one is told in place."""
    fulfil_tiles(viewer.page, "/tiles/.*layer=sunhours", (90, 90, 90))
    viewer.open(f"#level={LEVEL}&time={TIME}&layer=sunhours")
    page = viewer.page
    note = page.locator("#range-note")
    expect(note).to_have_text(re.compile(r"^Colours from 0 to 1[12] hours, as the sun of the date allows[.]$"))
    page.get_by_role("combobox", name="Colours").select_option("fixed")
    expect(note).to_have_text("Colours from 0 to 24 hours.")
    expect(page.locator(".scale-ticks span").last).to_have_text("24")
    viewer.wait_until_settled()
    expect(page).to_have_url(re.compile("range=fixed"))
    assert "fixed" in color_ranges(viewer)

    page.get_by_role("combobox", name="Colours").select_option("day")
    expect(note).to_contain_text("as the sun of the date allows")
    page.get_by_role("combobox", name="Colours").select_option("own")
    low, high = page.get_by_label("Hours of the darkest colour"), page.get_by_label("Hours of the brightest colour")
    expect(low).to_be_focused()
    expect(note).to_have_text(re.compile(r"^Colours from [56] to 1[12] hours[.]$"))
    low.fill("7.5")
    high.fill("10")
    high.press("Enter")
    expect(note).to_have_text("Colours from 7.5 to 10 hours.")
    viewer.wait_until_settled()
    assert "7.5,10" in color_ranges(viewer)
    low.fill("11")
    low.press("Enter")
    expect(note).to_have_text("Hours from 0 to 24, the first below the second.")
    expect(low).to_have_attribute("aria-invalid", "true")
    assert not axe_violations(page)


@pytest.fixture
def base_viewer(make_viewer: Callable[..., Viewer]) -> Callable[[bool], Viewer]:
    """Return a function that makes a viewer of a service with one base map; its argument says whether others are forbidden."""

    def make(only: bool) -> Viewer:
        viewer = make_viewer()
        base_map = {"title": "Streets", "tiles": BASE_TILES, "attribution": "© the mappers", "maxzoom": 17}
        viewer.page.route(re.compile("/base-maps.json$"), lambda route: route.fulfill(json={"base_maps": [base_map], "only": only}))
        fulfil_tiles(viewer.page, "/static/base/", BASE_COLOR)
        return viewer

    return make


def test_offered_base_map_is_one_click_away(base_viewer: Callable[[bool], Viewer]):
    """It lies under the shadows with its attribution, and the address has it."""
    viewer = base_viewer(False)
    viewer.open(f"#level={LEVEL}&time={TIME}")
    page = viewer.page
    expect(page.get_by_role("radio", name="None")).to_be_checked()
    page.get_by_text("Streets", exact=True).click()
    pixels = viewer.wait_until_drawn().pixels.astype(int)
    assert (np.abs(pixels - BASE_COLOR).max(axis=2) < 3).mean() > 0.2, "lit ground shows the base map"
    expect(page.locator(".maplibregl-ctrl-attrib")).to_contain_text("© the mappers")
    expect(page).to_have_url(re.compile("base=static/base/"))
    expect(page.get_by_text("Another base map")).to_be_visible()
    assert not axe_violations(page)
    page.get_by_text("None", exact=True).click()
    viewer.wait_until_settled()
    expect(page.get_by_role("radio", name="Shaded")).to_be_checked()
    expect(page.locator(".maplibregl-ctrl-attrib")).not_to_contain_text("© the mappers")


def test_other_base_maps_can_be_forbidden(base_viewer: Callable[[bool], Viewer]):
    """Nothing is requested of a server in the address then, and the page says so."""
    viewer = base_viewer(True)
    viewer.open(f"#level={LEVEL}&time={TIME}&base=https://tiles.invalid/{{z}}/{{x}}/{{y}}.png")
    expect(viewer.page.locator("#notice")).to_contain_text("this service shows its own base maps only")
    expect(viewer.page.get_by_label("Address of XYZ tiles")).to_have_count(0)
    assert not [url for url in viewer.requested_urls if "tiles.invalid" in url]


def test_service_offers_no_base_map_by_itself(viewer: Viewer):
    viewer.open(f"#level={LEVEL}&time={TIME}")
    expect(viewer.page.get_by_text("Base map", exact=True)).to_be_visible()
    expect(viewer.page.locator(".base-maps")).to_have_count(0)


def marker_place(viewer: Viewer) -> tuple[float, float]:
    """Return longitude and latitude of the point in the page's address."""
    match = re.search(r"point=(-?[\d.]+),(-?[\d.]+)", viewer.page.url)
    assert match, viewer.page.url
    return float(match[1]), float(match[2])


def test_search_finds_coordinates(viewer: Viewer, service: Client):
    """Degrees and the level's own grid set the marker, and the map goes there. Faults are told in place."""
    viewer.open(f"#level={LEVEL}&time={TIME}&panel=point")
    page, note = viewer.page, viewer.page.locator("#place-note")
    field = page.get_by_label("Find coordinates")
    field.fill("36\N{DEGREE SIGN}18'N 84\N{DEGREE SIGN}15'W")
    field.press("Enter")
    expect(page.locator(".point-mark")).to_be_visible()
    viewer.wait_until_settled()
    assert marker_place(viewer) == pytest.approx((-84.25, 36.3), abs=1e-5)

    crs = service.get(f"/levels/{LEVEL}/location?x=1&y=1").json()
    x, y = Transformer.from_crs("OGC:CRS84", crs["crs"], always_xy=True).transform(-84.2, 36.35)
    if abs(y) > 90:
        field.fill(f"{x:.2f} {y:.2f}")
        page.get_by_role("button", name="Find").click()
        expect(note).to_have_text(f"Read as {crs['crs_name']}.")
        viewer.wait_until_settled()
        assert marker_place(viewer) == pytest.approx((-84.2, 36.35), abs=1e-5)

    for text, words in (("Innsbruck", "Latitude and longitude"), ("47.1, 11.3", "lies outside of")):
        field.fill(text)
        field.press("Enter")
        expect(note).to_contain_text(words)
        expect(field).to_have_attribute("aria-invalid", "true")
    assert not axe_violations(page)
    field.fill("-84.3, 36.25")
    field.press("Enter")
    expect(note).to_have_text("Read as longitude, latitude.")
    viewer.wait_until_settled()
    assert marker_place(viewer) == pytest.approx((-84.3, 36.25), abs=1e-5)


@pytest.mark.parametrize("window", [{}, PHONE], ids=["wide", "phone"])
def test_share_copies_the_address(make_viewer: Callable[..., Viewer], window: dict):
    """Of the present state, also where the page's own address is behind."""
    viewer = make_viewer(**window)
    page = viewer.page
    page.add_init_script("""
      window.copied = [];
      Object.defineProperty(navigator, 'share', {value: undefined});
      Object.defineProperty(navigator, 'clipboard', {value: {writeText: async text => { window.copied.push(text); }}});
    """)
    page.goto(f"{viewer.address}/#level={LEVEL}&time={TIME}")
    viewer.wait_until_settled()
    page.get_by_role("button", name="Share what is seen").click()
    shared = page.locator("#shared")
    expect(shared).to_have_text("The address is copied. It shows what you see.")
    expect(page.locator("#said")).to_have_text("The address is copied. It shows what you see.")
    assert page.evaluate("() => window.copied") == [page.url]
    assert not axe_violations(page)
    expect(shared).to_be_hidden()


def test_share_uses_the_dialog_of_the_system(viewer: Viewer):
    viewer.page.add_init_script("""
      window.shared = [];
      Object.defineProperty(navigator, 'share', {value: async what => { window.shared.push(what); }});
    """)
    viewer.open(f"#level={LEVEL}&time={TIME}")
    viewer.page.get_by_role("button", name="Share what is seen").press("Enter")
    expect(viewer.page.locator("#shared")).to_have_text("The address is shared.")
    (shared,) = viewer.page.evaluate("() => window.shared")
    assert shared["url"] == viewer.page.url and "Skugga" in shared["title"]
