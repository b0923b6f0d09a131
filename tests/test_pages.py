"""Pages of the documentation: numbers equal their scripts' output, and examples import existing names."""

from __future__ import annotations

import ast
import importlib
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

from benchmarks.peers import figures as peer_figures
from benchmarks.peers.pages import format_page, short_table
from benchmarks.seeds import __main__ as seeds
from benchmarks.sun_questions.figures import SunComparison
from benchmarks.sun_questions.page import format_sun_page
from skugga.api.cli.main import app

ROOT = Path(__file__).parent.parent
BENCHMARKS, DOCS = ROOT / "benchmarks", ROOT / "docs"


def stored_figures(name: str) -> dict:
    """Return the figures of a JSON file below ``benchmarks``."""
    return json.loads((BENCHMARKS / name).read_text(encoding="utf-8"))


def test_the_page_of_seeds_is_up_to_date():
    figures = stored_figures("seeds/seeds.json")
    assert list(next(iter(figures.values()))["experiments"]) == list(seeds.EXPERIMENTS), "every experiment was made"
    assert (DOCS / "seeds.md").read_text(encoding="utf-8") == seeds.format_page(figures)


def test_the_page_of_peers_is_up_to_date():
    figures = peer_figures.PeerComparison.read(stored_figures("peers/peers.json"))
    assert (DOCS / "peers.md").read_text(encoding="utf-8") == format_page(figures, "images/peers.webp")
    table = "\n".join(short_table(figures))
    assert table in (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_page_of_sun_questions_is_up_to_date():
    figures = SunComparison.read(stored_figures("sun_questions/sun_questions.json"))
    assert (DOCS / "sun-questions.md").read_text(encoding="utf-8") == format_sun_page(figures)


def test_no_peer_is_both_faster_and_more_accurate():
    """This holds by either clock, in every raster under every sun and in the means off the axes."""
    figures = peer_figures.PeerComparison.read(stored_figures("peers/peers.json"))
    assert len(figures.tools) - sum(tool.ours for tool in figures.tools) >= 5
    for clock in peer_figures.CLOCKS:
        assert peer_figures.unmatched_results(figures, clock) == []


@pytest.mark.parametrize("page", sorted([*DOCS.glob("*.md"), ROOT / "README.md"]), ids=lambda path: path.name)
def test_links_of_pages_exist(page):
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        target, _, anchor = link.partition("#")
        if not re.match(r"[a-z]+:", link) and target:
            assert (page.parent / target).exists(), link


def commands_of(page: str) -> list[list[str]]:
    """Return the words of each ``skugga`` command in the shell examples of a page."""
    examples = "\n".join(re.findall(r"```sh\n(.*?)```", page, re.DOTALL)).replace("\\\n", " ")
    lines = [shlex.split(line, comments=True) for line in examples.splitlines()]
    return [arguments[1:] for arguments in lines if arguments[:1] == ["skugga"]]


@pytest.mark.parametrize("path", [ROOT / "README.md", *sorted(DOCS.glob("*.md"))], ids=lambda path: path.name)
def test_commands_in_examples_use_existing_options(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands are parsed, not run. An unknown command or option is a usage error."""
    group: Any = typer.main.get_command(app)
    monkeypatch.chdir(tmp_path)
    for name, *arguments in commands_of(path.read_text("utf-8")):
        for raster in (word for word in arguments if re.fullmatch(r"[\w-]+\.(tif|vrt)", word)):
            Path(raster).touch()
        group.commands[name].make_context(name, arguments)


def test_the_first_page_shows_commands() -> None:
    assert {arguments[0] for arguments in commands_of((ROOT / "README.md").read_text("utf-8"))} >= {"shade", "serve", "render"}


def imported_names(page: str) -> list[tuple[str, str]]:
    """Return module and name of everything that the Python examples of a page import from a module."""
    examples = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    nodes = [node for example in examples for node in ast.walk(ast.parse(example)) if isinstance(node, ast.ImportFrom)]
    return [(node.module or "", alias.name) for node in nodes for alias in node.names]


@pytest.mark.parametrize("path", [ROOT / "README.md", *sorted(DOCS.glob("*.md"))], ids=lambda path: path.name)
def test_examples_import_existing_names(path: Path) -> None:
    missing = [
        f"{module}.{name}"
        for module, name in imported_names(path.read_text("utf-8"))
        if not hasattr(importlib.import_module(module), name)
    ]
    assert not missing


def test_at_least_one_example_has_an_import() -> None:
    assert imported_names((DOCS / "effects.md").read_text("utf-8"))
