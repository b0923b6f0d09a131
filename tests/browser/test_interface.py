"""The interactive documentation on ``/docs`` in a browser."""

from __future__ import annotations

from playwright.sync_api import expect

from tests.api.conftest import Client
from tests.browser.watched_page import WatchedPage

WAIT_MS = 60_000


def test_docs_show_and_execute_operations(service_page: WatchedPage, service: Client):
    document = service.get("/openapi.json").json()
    operations = [method for path in document["paths"].values() for method in path]
    service_page.page.goto("/docs")
    expect(service_page.page.locator(".opblock")).to_have_count(len(operations), timeout=WAIT_MS)
    expect(service_page.page.locator(".info .title")).to_contain_text("Skugga")

    levels = service_page.page.locator("#operations-levels-levels_levels_get")
    levels.locator(".opblock-summary-control").click()
    levels.get_by_role("button", name="Try it out").click()
    levels.get_by_role("button", name="Execute").click()
    answer = levels.locator(".live-responses-table .response")
    expect(answer.locator(".response-col_status")).to_contain_text("200", timeout=WAIT_MS)
    expect(answer).to_contain_text("Jacksboro fault")
    assert {address.partition("?")[0].removeprefix(str(service.base_url)) for address in service_page.requested_urls} == {
        "/docs", "/docs/assets/swagger-ui.css", "/docs/assets/swagger-ui-bundle.js", "/docs/start.js", "/openapi.json", "/levels",
    }  # fmt: skip
