"""The viewer's panels: reports at a point, views, comparisons, the plan, and exports of the map."""

from __future__ import annotations

import base64
import io
import re
import subprocess
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import FloatRect, expect
from rasterio.io import MemoryFile

from skugga.terrain.level.parts import PerspectiveSpec
from tests.api.conftest import Client
from tests.browser.conftest import LEVEL, WINDOW_SIZE_PX, Viewer, skip_missing
from tests.browser.test_viewer_access import axe_violations

MODULES = Path(__file__).parents[2] / "viewer"
NODE = Path(__file__).parents[2] / ".venv" / "bin" / "node"

TIME = "2024-10-21T17:45:00-04:00"
POINT = "-84.25,36.3"
EYE, TARGET = "-84.26,36.29,300", "-84.24,36.32,0"
ANSWER_MS = 60_000

LEFT_PX = 400
"""Left edge of the compared part of the map, right of the panel."""

COVERED_PX = 364
"""Width of the map under the panel; the divider moves over the rest."""

LIGHT_TEXTS = {True: "In the sun", False: "In shadow"}


def open_panel(viewer: Viewer, panel: str, **settings: str) -> Viewer:
    """Open the viewer at an address with a panel open, and return it."""
    parts = "".join(f"&{name}={value}" for name, value in settings.items())
    viewer.open(f"#level={LEVEL}&time={TIME}&panel={panel}{parts}")
    return viewer


def point_report(service: Client, lon_lat: str, time: str = TIME, **parameters: str) -> dict[str, Any]:
    """Return the service's report of a point. ``lon_lat`` is longitude and latitude, joined by a comma."""
    lon, lat = lon_lat.split(",")
    return service.get(f"/levels/{LEVEL}/point", params={"lon": lon, "lat": lat, "time": time, **parameters}).json()


def shown_times(viewer: Viewer, selector: str) -> list[str]:
    """Return the instants in the ``time`` elements of a part of the page."""
    return viewer.page.locator(f"{selector} time").evaluate_all("found => found.map(each => each.dateTime)")


def shown_intervals(viewer: Viewer) -> list[tuple[str, str]]:
    """Return the begin and end times of the intervals of sun that the viewer shows."""
    times = shown_times(viewer, ".intervals")
    return list(zip(times[::2], times[1::2], strict=True))


def test_click_shows_the_intervals_of_the_service(viewer: Viewer, service: Client):
    viewer.open(f"#level={LEVEL}&time={TIME}")
    viewer.page.mouse.click(820, 300)
    expect(viewer.page.locator(".light")).to_be_visible(timeout=ANSWER_MS)
    expect(viewer.page).to_have_url(re.compile("point="))  # the address follows a moment after the answer
    match = re.search(r"point=(-?[\d.]+,[\d.]+)", viewer.page.url)
    assert match, viewer.page.url
    report = point_report(service, match[1])
    day, point_now = report["day"], report["now"]
    expect(viewer.page.locator(".light")).to_contain_text(LIGHT_TEXTS[point_now["lit"]])
    assert shown_intervals(viewer) == [(entry["begin"], entry["end"]) for entry in day["sunlit"]]

    at = datetime.fromisoformat(TIME)
    begins, ends = ([datetime.fromisoformat(entry[key]) for entry in day["sunlit"]] for key in ("begin", "end"))
    edges = sorted([*begins, *ends, *(datetime.fromisoformat(day[key]) for key in ("sunrise", "sunset"))])
    enclosing_edges = max(entry for entry in edges if entry <= at), min(entry for entry in edges if entry > at)
    assert tuple(map(datetime.fromisoformat, shown_times(viewer, ".reasons"))) == enclosing_edges, (
        "the panel shows when the present state of the light began and when it will end"
    )

    reasons = viewer.page.locator(".reasons")
    expect(reasons).to_contain_text("ridge")
    if not point_now["lit"]:
        expect(reasons).to_contain_text(f"{point_now['by']['elevation']:.1f}° high")
    expect(viewer.page.get_by_role("img", name=re.compile("^The day: night midnight to"))).to_be_visible()
    expect(viewer.page.get_by_role("img", name=re.compile("^Horizon: highest in the"))).to_be_visible()
    assert not axe_violations(viewer.page)


def test_sky_drawing_equals_the_sky_of_the_service(viewer: Viewer, service: Client):
    open_panel(viewer, "point", point=POINT)
    lon, lat = POINT.split(",")
    sky = service.get(f"/levels/{LEVEL}/point/sun.json", params={"lon": lon, "lat": lat, "time": TIME}).json()
    drawing = viewer.page.locator("svg.sky")
    expect(drawing).to_be_visible(timeout=ANSWER_MS)
    highest = max(sky["horizon"]["relief"])
    expect(drawing).to_have_attribute(
        "aria-label", re.compile(f"with {highest:.1f}°.*climbs to {max(s['altitude'] for s in sky['path']):.1f}°")
    )
    outline = drawing.locator("path.relief").get_attribute("d") or ""
    x, y = (float(number) for number in re.findall(r"[ML](-?[\d.]+) (-?[\d.]+)", outline.partition("ZM")[2].join(["M", ""]))[180])
    horizon_distance = 100 * (1 - sky["horizon"]["relief"][180] / 90)
    assert (x, y) == pytest.approx((horizon_distance, 0.0), abs=0.01), "the 180th of 720 directions is east"
    point_count = sum(len((line.get_attribute("points") or "").split()) // 2 for line in drawing.locator("polyline").all())
    changes = sum(a["lit"] != b["lit"] for a, b in zip(sky["path"], sky["path"][1:], strict=False))
    assert point_count == len(sky["path"]) + changes, "adjacent runs share their end point"


def test_point_by_keyboard_follows_the_time(viewer: Viewer, service: Client):
    open_panel(viewer, "point")
    viewer.page.get_by_role("tab", name="Point").focus()
    for _ in range(4):
        viewer.page.keyboard.press("Tab")
        if viewer.page.evaluate("() => document.activeElement.textContent") == "Ask at the middle of the map":
            break
    viewer.page.keyboard.press("Enter")
    light = viewer.page.locator(".light")
    expect(light).to_be_visible(timeout=ANSWER_MS)
    expect(viewer.page).to_have_url(re.compile("point="))  # the address follows a moment after the answer
    match = re.search(r"point=(-?[\d.]+,[\d.]+)", viewer.page.url)
    assert match
    viewer.page.get_by_label("Time", exact=True).fill("09:00")
    expect(light).to_contain_text("at 09:00", timeout=ANSWER_MS)
    viewer.wait_until_settled()
    point_now = point_report(service, match[1], "2024-10-21T09:00:00-04:00")["now"]
    expect(light).to_contain_text(LIGHT_TEXTS[point_now["lit"]])


def test_point_off_the_data_shows_the_remark(viewer: Viewer):
    open_panel(viewer, "point", point="-83.9,36.3")
    expect(viewer.page.locator(".point-answer .fail")).to_contain_text("No ground here", timeout=ANSWER_MS)


def test_views_open_from_their_thumbnails(viewer: Viewer):
    open_panel(viewer, "views")
    view = viewer.page.get_by_role("button", name="Map", exact=True)
    expect(view.locator("img")).to_be_visible(timeout=ANSWER_MS)
    view.click()
    dialog = viewer.page.get_by_role("dialog")
    expect(dialog.locator("img")).to_be_visible(timeout=ANSWER_MS)
    assert dialog.locator("img").evaluate("each => [each.naturalWidth, each.naturalHeight]") == [974, 1024]
    assert not axe_violations(viewer.page)
    with viewer.page.expect_download() as saved:
        dialog.get_by_role("button", name="Save").click()
    assert Image.open(io.BytesIO(Path(saved.value.path()).read_bytes())).size == (974, 1024)
    assert saved.value.suggested_filename == f"{LEVEL}-map.png"
    viewer.page.keyboard.press("Escape")
    expect(dialog).not_to_be_visible()
    expect(view).to_be_focused()


def test_custom_view_equals_the_services_snapshot(viewer: Viewer, service: Client):
    """The preview equals the service's snapshot, and its lines are valid in a level file."""
    import yaml

    open_panel(viewer, "views", **{"views-eye": EYE, "views-target": TARGET, "views-fov": "40"})
    preview = viewer.page.locator(".preview img")
    expect(preview).to_be_visible(timeout=ANSWER_MS)
    lines = viewer.page.get_by_label("Lines for the level’s file", exact=True).inner_text()
    spec = yaml.safe_load(lines)["views"]["my_view"]
    assert PerspectiveSpec(**spec) == PerspectiveSpec(
        kind="perspective", eye=(-84.26, 36.29, 300), target=(-84.24, 36.32, 0), fov=40, size=(1280, 1024)
    )
    preview_base64 = preview.evaluate("""each => {
      const canvas = Object.assign(document.createElement('canvas'), {width: each.naturalWidth, height: each.naturalHeight});
      canvas.getContext('2d').drawImage(each, 0, 0);
      return canvas.toDataURL('image/png').split(',')[1];
    }""")
    parameters = {"eye": EYE, "target": TARGET, "fov": "40", "size": "400x320", "time": TIME}
    snapshot = service.get(f"/levels/{LEVEL}/snapshot.webp", params=parameters).content
    picture, other = (
        np.asarray(Image.open(io.BytesIO(encoded)).convert("RGB")) for encoded in (base64.b64decode(preview_base64), snapshot)
    )
    assert picture.shape == (320, 400, 3) and np.array_equal(picture, other)
    assert not axe_violations(viewer.page)

    height = viewer.page.get_by_label("Eye, metres above the ground")
    height.fill("900")
    expect(viewer.page).to_have_url(re.compile(r"views-eye=-84\.26,36\.29,900"))
    viewer.page.get_by_role("button", name="Look there").click()
    viewer.page.mouse.click(900, 250)
    expect(viewer.page).not_to_have_url(re.compile(re.escape(f"views-target={TARGET}")))
    assert "&point=" not in viewer.page.url, "the click set the view's target, not the point of the point report"


def test_comparison_shows_two_times(viewer: Viewer):
    """The map is unchanged left of the divider, and shows the other time right of it; keys move the divider."""
    open_panel(viewer, "compare")
    single_picture = _map_picture(viewer)
    viewer.page.get_by_label("Compare with another").select_option("time")
    viewer.page.get_by_label("On the right, at").fill("09:30")
    viewer.page.get_by_label("On the right, at").press("Tab")
    divider = viewer.page.get_by_role("slider", name="Divider of the comparison")
    expect(divider).to_have_attribute("aria-valuetext", "50 %: 17:45 on the left, 09:30 on the right")
    split_picture = _map_picture(viewer)
    middle = (COVERED_PX + WINDOW_SIZE_PX["width"]) // 2 - LEFT_PX
    assert _differing_share(single_picture[:, : middle - 40], split_picture[:, : middle - 40]) < 0.01
    assert _differing_share(single_picture[:, middle + 40 :], split_picture[:, middle + 40 :]) > 0.1
    assert not axe_violations(viewer.page)

    divider.focus()
    viewer.page.keyboard.press("End")
    expect(divider).to_have_attribute("aria-valuenow", "100")
    assert _differing_share(single_picture[:, 40:-60], _map_picture(viewer)[:, 40:-60]) < 0.01
    viewer.page.keyboard.press("PageDown")
    expect(divider).to_have_attribute("aria-valuenow", "90")
    viewer.page.get_by_role("button", name="End the comparison").first.click()
    expect(divider).to_have_count(0)
    expect(viewer.page).not_to_have_url(re.compile("&compare"))


def test_comparison_shows_two_algorithms(viewer: Viewer):
    """Each side has its own algorithm and requests its own tiles."""
    open_panel(viewer, "compare", compare="algorithm:none")
    viewer.page.get_by_label("On the left").select_option("sweep")
    viewer.wait_until_drawn()
    expect(viewer.page).to_have_url(
        re.compile("compare=algorithm:none.*plan-algorithm=sweep|plan-algorithm=sweep.*compare=algorithm:none")
    )
    slider = viewer.page.get_by_role("slider", name="Divider of the comparison")
    expect(slider).to_have_attribute("aria-valuetext", "50 %: sweep on the left, none on the right")
    viewer.page.mouse.move(640, 400)
    box = slider.bounding_box()
    assert box is not None
    viewer.page.mouse.move(box["x"] + box["width"] / 2, 200)
    viewer.page.mouse.down()
    viewer.page.mouse.move(900, 200, steps=3)
    viewer.page.mouse.up()
    expect(slider).to_have_attribute("aria-valuenow", "59")


def test_plan_panel_explains_and_sets_the_algorithm(viewer: Viewer):
    open_panel(viewer, "plan")
    plan = viewer.page.locator(".plan")
    expect(plan.get_by_text("Shadows of ridges, houses and trees")).to_be_visible(timeout=ANSWER_MS)
    algorithms = viewer.page.locator("details.algorithms")
    expect(algorithms).not_to_have_attribute("open", "")
    algorithms.locator("summary").first.click()
    expect(algorithms.get_by_text("Relief by sweep")).to_be_visible()
    algorithms.get_by_label("Draw shadows by").select_option("none")
    viewer.wait_until_settled()
    expect(algorithms.get_by_text("Relief casts nothing")).to_be_visible(timeout=ANSWER_MS)
    assert not axe_violations(viewer.page)


def test_plan_panel_leaves_calibration_to_the_service(viewer: Viewer):
    """A service that calibrates itself needs no command of the user. The panel cites no file that a user cannot open."""
    states = ["running"]
    viewer.page.route(
        re.compile("/readyz$"), lambda route: route.fulfill(json={"status": "ready", "preparing": None, "calibration": states[-1]})
    )
    open_panel(viewer, "plan")
    algorithms = viewer.page.locator("details.algorithms")
    algorithms.locator("summary").first.click()
    cost = algorithms.locator("p.note").first
    expect(cost).to_contain_text("The service is measuring it, which takes a minute or two", timeout=ANSWER_MS)
    for summary in algorithms.locator("summary").all()[1:]:
        summary.click()
    text = viewer.page.locator(".plan").inner_text()
    assert "of the cast shadow wrong" in text and "docs/" not in text and ".md" not in text and "skugga calibrate" not in text
    states.append("off")
    viewer.page.get_by_label("Time", exact=True).fill("16:00")
    expect(cost).to_contain_text("skugga calibrate measures them", timeout=ANSWER_MS)


def test_intermediate_layers_can_be_shown(viewer: Viewer):
    open_panel(viewer, "plan", **{"plan-algorithm": "shadow_map"})
    viewer.page.get_by_text("Layers in between").click()
    viewer.page.locator("#between-layer").select_option("shadow-map")
    viewer.page.get_by_role("button", name="Look at it").click()
    expect(viewer.page.get_by_role("dialog").locator("img")).to_be_visible(timeout=ANSWER_MS)


def test_map_can_be_saved(viewer: Viewer):
    """As a picture, and as a GeoTIFF with the bounds of the map."""
    open_panel(viewer, "use")
    for name, suffix in (("PNG picture", "png"), ("GeoTIFF", "tif")):
        with viewer.page.expect_download(timeout=ANSWER_MS) as saved:
            viewer.page.get_by_role("button", name=name).click()
        assert saved.value.suggested_filename == f"{LEVEL}-color.{suffix}"
        content = Path(saved.value.path()).read_bytes()
        if suffix == "png":
            assert Image.open(io.BytesIO(content)).size[0] == 1280
            continue
        with MemoryFile(content) as file, file.open() as dataset:
            assert dataset.crs.to_epsg() == 3857
            map_url = next(item for item in reversed(viewer.requested_urls) if "/map.tif" in item)
            bbox = [float(item) for item in (re.search(r"bbox=([^&]+)", map_url) or [""])[1].replace("%2C", ",").split(",")]
            np.testing.assert_allclose(dataset.bounds, bbox, atol=0.01)
            assert dataset.read().std() > 20
    expect(viewer.page.get_by_text("Saved.")).to_be_visible()


def test_client_lines_equal_those_of_the_service(viewer: Viewer, service: Client):
    open_panel(viewer, "use")
    lines = service.get(f"/levels/{LEVEL}/lines.json", params={"time": TIME}).json()
    for line in lines:
        viewer.page.locator(".clients summary").get_by_text(line["client"], exact=True).click()
        expect(viewer.page.get_by_label(f"Lines for {line['client']}", exact=True)).to_have_text(line["text"])
    assert {"MapLibre", "Leaflet", "OpenLayers", "GDAL"} <= {line["client"] for line in lines}
    assert any("QGIS" in line["client"] for line in lines)
    assert not axe_violations(viewer.page)


def test_viewer_modules_pass_their_own_tests():
    """Node runs the tests of the viewer's modules."""
    if not (MODULES / "node_modules").is_dir() or not NODE.exists():
        skip_missing("the viewer's modules are not installed: 'make viewer' does it")
    process = subprocess.run(
        [NODE, "--test", *sorted(MODULES.glob("test/*.test.mjs"))], cwd=MODULES, capture_output=True, text=True, timeout=300
    )
    assert process.returncode == 0, process.stdout[-4000:]


def _map_picture(viewer: Viewer) -> np.ndarray:
    """Return the map between the panel and the controls, above the dock, once it is still."""
    viewer.wait_until_drawn()
    return viewer.pixels(FloatRect(x=LEFT_PX, y=60, width=800, height=400))


def _differing_share(picture: np.ndarray, other: np.ndarray) -> float:
    """Return the share of pixels that differ by more than 32 of 255 in any channel."""
    return float((np.abs(picture.astype(int) - other).max(axis=2) > 32).mean())
