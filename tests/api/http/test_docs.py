"""The interactive documentation on ``/docs``, which loads nothing from other hosts."""

from __future__ import annotations

import re
from urllib.parse import urljoin, urlsplit

import pytest

from tests.api.conftest import Client
from tests.api.http.test_level_page import LinkParser
from tests.api.workers import fake_workers


def test_docs_load_all_parts_from_the_service(serve_with):
    client: Client = serve_with(fake_workers.scripted)
    page = client.get("/docs")
    assert page.status_code == 200 and page.headers["content-type"].startswith("text/html")
    parts = LinkParser(page.text).urls
    assert {part.rpartition(".")[2] for part in parts} == {"css", "js", "json"}
    for part in parts:
        assert not urlsplit(part).netloc, "the address is relative"
        answer = client.get(urljoin(str(page.url), part))
        assert answer.status_code == 200, part
        if part.endswith(".css"):
            loaded = re.findall(r"url\(\s*['\"]?([^'\")]+)", answer.text)
            assert all(address.startswith(("data:", "#")) for address in loaded)
            assert "@import" not in answer.text


@pytest.mark.parametrize("address", ["/docs", "/docs/start.js"])
def test_docs_name_no_other_host(serve_with, address: str):
    assert not re.search(r"https?:|//[a-z]", serve_with(fake_workers.scripted).get(address).text)


def test_docs_share_the_content_security_policy(serve_with):
    client: Client = serve_with(fake_workers.scripted)
    policy = client.get("/docs").headers["content-security-policy"]
    assert policy == client.get("/levels/hills.html").headers["content-security-policy"]
    directives = dict(directive.split(maxsplit=1) for directive in policy.split("; "))
    assert directives["default-src"] == "'self'" and "script-src" not in directives
