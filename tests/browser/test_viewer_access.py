"""Accessibility of the viewer: keyboard, accessible names (axe), contrast and phones."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Locator, Page, ViewportSize, expect

from tests.browser.conftest import Viewer, skip_missing
from tests.browser.map_clients import CLIENTS

AXE = CLIENTS / "node_modules" / "axe-core" / "axe.min.js"

PHONE = {"viewport": ViewportSize(width=390, height=844), "has_touch": True, "is_mobile": True}

LANDSCAPE = {"viewport": ViewportSize(width=844, height=390), "has_touch": True, "is_mobile": True}
SMALL_LANDSCAPE = {"viewport": ViewportSize(width=667, height=375), "has_touch": True, "is_mobile": True}
"""Phones in landscape; the second is no wider than some phones in portrait."""

FAILING_IMPACTS = {"serious", "critical"}
"""The impacts of axe's violations that fail a test."""


def axe_violations(page: Page) -> list[str]:
    """Return the serious and critical violations that axe finds on a page."""
    if not AXE.is_file():
        skip_missing(f"there is no {AXE}: 'make test-browser' installs it")
    # The page's policy allows no foreign scripts, so axe is evaluated from outside.
    page.evaluate(AXE.read_text())
    violations = page.evaluate("() => axe.run(document, {resultTypes: ['violations']})")["violations"]
    return [
        f"{violation['id']}: {node['html'][:120]} {node['failureSummary']}"
        for violation in violations
        if violation["impact"] in FAILING_IMPACTS
        for node in violation["nodes"]
    ]


@pytest.mark.parametrize("colors", ["light", "dark"])
def test_axe_finds_no_serious_violation(make_viewer: Callable[..., Viewer], colors: str):
    viewer = make_viewer(color_scheme=colors)
    viewer.open()
    for panel in viewer.page.get_by_role("tab").all():
        panel.click()
        viewer.wait_until_settled()
        assert not axe_violations(viewer.page), panel.inner_text()
    viewer.page.get_by_role("button", name="By direction").click()
    viewer.wait_until_settled()
    assert not axe_violations(viewer.page)


def test_axe_finds_a_removed_label(viewer: Viewer):
    """This proves that the other tests can fail."""
    viewer.open()
    viewer.page.evaluate("() => document.getElementById('minutes').removeAttribute('aria-label')")
    assert any("label" in fault for fault in axe_violations(viewer.page))


def test_viewer_works_by_keyboard(viewer: Viewer):
    """Tab reaches every control with a visible focus; arrows move the sun; space plays the day."""
    viewer.open()
    reached: list[str] = []
    for _ in range(60):
        viewer.page.keyboard.press("Tab")
        name, outlined = viewer.page.evaluate("""() => {
          const at = document.activeElement, style = getComputedStyle(at);
          const shown = style.outlineStyle !== 'none' || getComputedStyle(at.nextElementSibling ?? at).outlineStyle !== 'none';
          return [at.id || at.className || at.tagName, shown];
        }""")
        if name == "BODY" or name in reached[:1]:
            break
        assert outlined, f"the focused control has no visible outline: {name}"
        reached.append(name)
    assert {"skip", "level", "theme", "play", "clock", "date", "minutes", "days", "solid"} <= set(reached), reached
    assert any("canvas" in control for control in reached), "the map itself can be reached"

    viewer.page.locator("#minutes").focus()
    viewer.page.keyboard.press("ArrowLeft")
    assert viewer.wait_until_drawn().queries == {(("time", "2024-10-21T17:40:00-04:00"),)}
    viewer.page.locator("#days").focus()
    viewer.page.keyboard.press("ArrowRight")
    assert viewer.wait_until_drawn().queries == {(("time", "2024-10-22T17:40:00-04:00"),)}
    viewer.page.evaluate("() => document.activeElement.blur()")
    viewer.page.keyboard.press("Space")
    expect(viewer.page.get_by_role("button", name="Pause the day")).to_be_visible()
    viewer.page.keyboard.press("Space")
    expect(viewer.page.get_by_role("button", name="Play the day")).to_be_visible()


def test_values_have_texts_for_screen_readers(viewer: Viewer):
    """The texts are those of the sliders and of the sun's direction."""
    viewer.open()
    expect(viewer.page.get_by_role("slider", name="Time of day")).to_have_attribute("aria-valuetext", "17:45")
    expect(viewer.page.get_by_role("slider", name="Day of the year")).to_have_attribute("aria-valuetext", "21 October 2024")
    expect(viewer.page.get_by_role("button", name="Play the day")).to_have_attribute("aria-pressed", "false")
    viewer.page.get_by_role("button", name="By direction").click()
    expect(viewer.page.get_by_role("slider", name="Azimuth, clockwise from north")).to_have_attribute("aria-valuetext", "315° · NW")


def test_phone_panel_is_a_sheet(make_viewer: Callable[..., Viewer]):
    """The map is free until the sheet is opened, and nothing is wider than the screen."""
    viewer = make_viewer(**PHONE)
    viewer.page.goto(viewer.address)
    viewer.wait_until_settled()
    width, height = PHONE["viewport"]["width"], PHONE["viewport"]["height"]
    assert viewer.page.evaluate("() => document.documentElement.scrollWidth") <= width
    for part in ("#side header", "#sun"):
        box = viewer.page.locator(part).bounding_box()
        assert box is not None
        assert box["x"] >= 0 and box["x"] + box["width"] <= width
        assert box["y"] > height / 2, "panel and dock leave the upper half of the screen to the map"
        assert box["y"] + box["height"] <= height + 1
    solid = viewer.page.get_by_label("Three dimensions")
    expect(solid).to_be_hidden()
    viewer.page.get_by_role("button", name="Open the panel").click()
    expect(solid).to_be_in_viewport()
    assert not axe_violations(viewer.page)
    viewer.page.get_by_role("button", name="Close the panel").click()
    expect(solid).to_be_hidden()
    level = viewer.pixels()[120:440, 40:340]
    assert len(np.unique(level.reshape(-1, 3), axis=0)) > 5000


def test_color_theme_can_be_chosen(viewer: Viewer):
    """Light, dark, or the system's theme; the address keeps the choice."""
    viewer.open()
    corner = viewer.pixels()[700, 100].astype(int).sum()
    viewer.page.get_by_role("button", name="Colours: as the system").click()
    viewer.page.get_by_role("button", name="Colours: light").click()
    expect(viewer.page).to_have_url(re.compile("theme=dark"))
    viewer.wait_until_settled()
    assert viewer.pixels()[700, 100].astype(int).sum() < corner / 4
    viewer.page.reload()
    viewer.wait_until_settled()
    assert viewer.pixels()[700, 100].astype(int).sum() < corner / 4


@pytest.mark.parametrize("window", [LANDSCAPE, SMALL_LANDSCAPE], ids=["wide", "small"])
def test_landscape_phone_keeps_its_map(make_viewer: Callable[..., Viewer], window: dict[str, Any]):
    """Dock and panel leave most of the window to the map, which shows all of the level; the panel is a drawer."""
    viewer = make_viewer(**window)
    viewer.hide_preparations()
    viewer.page.goto(viewer.address)
    viewer.wait_until_settled()
    width, height = window["viewport"]["width"], window["viewport"]["height"]
    side, dock = (viewer.page.locator(part).bounding_box() for part in ("#side", "#sun"))
    assert side is not None and dock is not None
    assert dock["y"] > 0.75 * height and dock["x"] >= 0 and dock["x"] + dock["width"] <= width
    assert viewer.page.locator("#sun").evaluate("each => each.scrollWidth <= each.clientWidth"), (
        "the content of the dock does not overflow it"
    )
    free_px = dock["y"] * width - side["width"] * side["height"]
    assert free_px > 0.7 * width * height
    for part in ("#play", "#clock", "#date", "#minutes", "#by"):
        expect(viewer.page.locator(part)).to_be_in_viewport(ratio=1)
    map_pixels = viewer.pixels()[8 : int(dock["y"]) - 40, int(side["width"]) + 60 : width - 60]
    assert (map_pixels != (0xE9, 0xE6, 0xDD)).any(axis=2).mean() > 0.4, "the map shows the level"
    assert not axe_violations(viewer.page)

    drawer = viewer.page.get_by_role("button", name="Open the panel")
    solid = viewer.page.get_by_label("Three dimensions")
    expect(solid).to_be_hidden()
    drawer.click()
    expect(solid).to_be_in_viewport()
    expect(viewer.page.locator("#play")).to_be_in_viewport(ratio=1)
    panel = viewer.page.locator("#side").bounding_box()
    assert panel is not None and panel["y"] + panel["height"] <= dock["y"], (
        "the open panel does not cover the dock with the sun's controls"
    )
    assert not axe_violations(viewer.page)
    viewer.page.get_by_role("button", name="Close the panel").click()
    expect(solid).to_be_hidden()


@pytest.mark.parametrize("window", [PHONE, LANDSCAPE], ids=["upright", "across"])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_tapped_place_stays_visible(make_viewer: Callable[..., Viewer], window: dict[str, Any], share: float):
    """The panel with the answer does not cover it, however long its text is."""
    viewer = make_viewer(**window)
    viewer.hide_preparations()
    viewer.page.goto(viewer.address)
    viewer.wait_until_settled()
    dock = viewer.page.locator("#sun").bounding_box()
    assert dock is not None
    viewer.page.touchscreen.tap(share * window["viewport"]["width"], max(share, 0.3) * (dock["y"] - 60))
    expect(viewer.page.locator(".point-answer")).to_have_attribute("aria-busy", "false")
    expect(viewer.page.locator(".point-answer .note, .point-answer .light, .point-answer .fail").first).to_be_visible()
    viewer.wait_until_settled()
    is_visible = viewer.page.locator(".point-mark").evaluate("""each => {
      const {left, top, width, height} = each.getBoundingClientRect();
      return document.elementsFromPoint(left + width / 2, top + height / 2)[0] === each;
    }""")
    assert is_visible


@pytest.mark.parametrize("colors", ["light", "dark"])
def test_day_bar_colors_have_contrast(make_viewer: Callable[..., Viewer], colors: str):
    """Night, shadow and sun differ by their contrast (WCAG 2, 1.4.11: 3 to 1); an edge separates night from the panel."""
    viewer = make_viewer(color_scheme=colors)
    viewer.hide_preparations()
    viewer.open("#point=-84.25,36.3&panel=point")
    bar = viewer.page.locator(".day-bar")
    expect(bar).to_be_visible()
    lights = {name: _luminance(bar.locator(f".{name}").first) for name in ("night", "shadow", "lit")}
    for part, other in (("night", "shadow"), ("shadow", "lit"), ("night", "lit")):
        low, high = sorted((lights[part], lights[other]))
        assert (high + 0.05) / (low + 0.05) > (3 if "night" not in (part, other) or colors == "dark" else 1.3), (part, other)
    assert bar.evaluate("each => getComputedStyle(each).boxShadow") != "none"


def _luminance(part: Locator) -> float:
    """Return WCAG's relative luminance of an element's background."""
    color = part.evaluate("each => getComputedStyle(each).backgroundColor")
    srgb = np.array([int(channel) for channel in re.findall(r"\d+", color)[:3]]) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))
