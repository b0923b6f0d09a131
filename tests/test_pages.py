"""Pages of the documentation: numbers equal their scripts' output, and examples import existing names."""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from benchmarks.peers import figures as peer_figures
from benchmarks.peers.pages import format_page, format_summary, short_table
from benchmarks.report_pages import PROVENANCE_PATTERN, REPORTS, write_between_marks
from benchmarks.seeds import __main__ as seeds
from benchmarks.sun_questions.figures import SunComparison
from benchmarks.sun_questions.page import format_summary as format_sun_summary
from benchmarks.sun_questions.page import format_sun_page
from scripts.draw_gallery import COMMANDS_WITHOUT_OUTPUT, LEVEL_FOLDER, OTHER_SCRIPTS, gallery_pictures
from scripts.markdown_tables import anchor
from scripts.reference_pages import REFERENCE_FILES
from skugga.api.cli.main import app
from skugga.terrain.level.level import load_level

ROOT = Path(__file__).parent.parent
BENCHMARKS, DOCS = ROOT / "benchmarks", ROOT / "docs"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *(ROOT / "examples").rglob("*.md")])

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))


def stored_figures(name: str) -> dict:
    """Return the figures of a JSON file below ``benchmarks``."""
    return json.loads((BENCHMARKS / name).read_text(encoding="utf-8"))


def test_the_page_of_seeds_is_up_to_date():
    figures = stored_figures("seeds/seeds.json")
    assert list(next(iter(figures.values()))["experiments"]) == list(seeds.EXPERIMENTS), "every experiment was made"
    assert (REPORTS / "seeds.md").read_text(encoding="utf-8") == seeds.format_page(figures)
    assert seeds.format_summary(figures) in (DOCS / "seeds.md").read_text(encoding="utf-8")


def test_the_page_of_peers_is_up_to_date():
    figures = peer_figures.PeerComparison.read(stored_figures("peers/peers.json"))
    assert (REPORTS / "peers.md").read_text(encoding="utf-8") == format_page(figures, "../images/peers.webp")
    table = "\n".join(short_table(figures))
    assert table in (ROOT / "README.md").read_text(encoding="utf-8")
    assert format_summary(figures) in (DOCS / "peers.md").read_text(encoding="utf-8")


def test_the_page_of_sun_questions_is_up_to_date():
    figures = SunComparison.read(stored_figures("sun_questions/sun_questions.json"))
    assert (REPORTS / "sun-questions.md").read_text(encoding="utf-8") == format_sun_page(figures)
    assert format_sun_summary(figures) in (DOCS / "sun-questions.md").read_text(encoding="utf-8")


def test_writing_between_marks_is_idempotent(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- measured -->\nold\n<!-- end of measured -->\nafter\n", encoding="utf-8")
    for _ in range(2):
        write_between_marks(page, "new")
        assert page.read_text(encoding="utf-8") == "before\n<!-- measured -->\n\nnew\n\n<!-- end of measured -->\nafter\n"
    page.write_text("a page without any", encoding="utf-8")
    with pytest.raises(ValueError, match="marks are missing"):
        write_between_marks(page, "new")


def test_no_peer_is_both_faster_and_more_accurate():
    """This holds by either clock, in every raster under every sun and in the means off the axes."""
    figures = peer_figures.PeerComparison.read(stored_figures("peers/peers.json"))
    assert len(figures.tools) - sum(tool.ours for tool in figures.tools) >= 5
    for clock in peer_figures.CLOCKS:
        assert peer_figures.unmatched_results(figures, clock) == []


REPORTS_WITHOUT_PROVENANCE = {"algorithms", "comparisons", "hard-cases", "seeds"}
"""Reports whose figures have several origins, which are told beside their tables."""


@pytest.mark.parametrize(
    "page",
    [path for path in sorted(REPORTS.glob("*.md")) if path.stem not in REPORTS_WITHOUT_PROVENANCE],
    ids=lambda path: path.name,
)
def test_reports_state_their_provenance(page):
    text = page.read_text(encoding="utf-8")
    assert len(PROVENANCE_PATTERN.findall(text)) == len(re.findall(r"^Command: ", text, re.MULTILINE)) > 0


def test_every_report_is_linked_from_a_page():
    pages = "".join(path.read_text(encoding="utf-8") for path in DOCS.glob("*.md"))
    assert [path.name for path in REPORTS.glob("*.md") if f"](reports/{path.name}" not in pages] == []


def anchors_of(page: Path) -> set[str]:
    """Return the anchors of a page's headings; of equal ones the later have a number."""
    text = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    names = [anchor(re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)) for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]
    return {name if (count := names[:index].count(name)) == 0 else f"{name}_{count}" for index, name in enumerate(names)}


@each_page
def test_links_of_pages_exist(page: Path) -> None:
    """A link into ``docs/reference`` leads to a page that exists in the built site only."""
    generated = {(DOCS / "reference" / name).resolve() for name in REFERENCE_FILES}
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        target, _, anchor_of_link = link.partition("#")
        if not re.match(r"[a-z]+:", link) and target:
            assert (page.parent / target).exists() or (page.parent / target).resolve() in generated, link
        if (
            anchor_of_link
            and not re.match(r"[a-z]+:", link)
            and (page.parent / target).resolve() not in generated
            and not target.endswith(".html")
        ):
            assert anchor_of_link in anchors_of(page.parent / target if target else page), link


def code_blocks(page: str, language: str) -> list[str]:
    """Return the code blocks of a page in a language; ``""`` stands for those that name none."""
    blocks = re.findall(r"^```([\w-]*)\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    return [text for block_language, text in blocks if block_language == language]


def commands_of(page: str) -> list[list[str]]:
    """Return the words of each ``skugga`` command in the shell examples of a page."""
    examples = "\n".join([*code_blocks(page, "sh"), *code_blocks(page, "")]).replace("\\\n", " ")
    return [shlex.split(line, comments=True)[1:] for line in examples.splitlines() if line.startswith("skugga ")]


PARSERS: dict[str, Callable[[str], object]] = {
    "python": ast.parse,
    "json": lambda block: json.loads(block if block.startswith(("{", "[")) else f"{{{block}}}"),  # or members of an object
    "yaml": YAML(typ="safe").load,
    "sh": lambda block: subprocess.run(["bash", "-n"], input=block, text=True, check=True),
    "js": lambda block: parse_javascript(block),
}
"""Function that raises an error for code that does not parse, by the language of a code block."""


def parse_javascript(block: str) -> None:
    """Parse a block by Node. Raises ``subprocess.CalledProcessError``; skips the test where there is no Node."""
    node = shutil.which("node", path=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}")
    if node is None:
        pytest.skip("no Node: pip install '.[viewer]'")
    subprocess.run([node, "--check", "--input-type=module", "-"], input=block, text=True, check=True)


@each_page
def test_code_blocks_parse(page: Path) -> None:
    text = page.read_text("utf-8")
    for language, parse in PARSERS.items():
        for block in code_blocks(text, language):
            parse(block)


@pytest.mark.parametrize(
    ("language", "wrong"), [("python", "a ="), ("json", "{a: 1}"), ("yaml", "a: [1"), ("sh", "if true"), ("js", "let a = ;")]
)
def test_wrong_code_does_not_parse(language: str, wrong: str) -> None:
    with pytest.raises((ValueError, SyntaxError, YAMLError, subprocess.CalledProcessError)):
        PARSERS[language](wrong)


@each_page
def test_targets_of_make_exist(page: Path) -> None:
    """Targets are those in code: in a block, or between backticks."""
    text = page.read_text("utf-8")
    named = re.findall(r"`make ([a-z-]+)", text) + re.findall(r"^make ([a-z-]+)", "\n".join(code_blocks(text, "sh")), re.MULTILINE)
    assert set(named) <= set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))


@each_page
def test_commands_in_examples_use_existing_options(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands are parsed, not run. An unknown command or option is a usage error."""
    group: Any = typer.main.get_command(app)
    monkeypatch.chdir(tmp_path)
    for name, *arguments in commands_of(page.read_text("utf-8")):
        for raster in (word for word in arguments if re.fullmatch(r"[\w-]+\.(tif|vrt)", word)):
            Path(raster).touch()
        group.commands[name].make_context(name, arguments)


def test_the_first_page_shows_commands() -> None:
    assert {arguments[0] for arguments in commands_of((ROOT / "README.md").read_text("utf-8"))} >= {"shade", "serve", "render"}


def imported_names(page: str) -> list[tuple[str, str]]:
    """Return module and name of everything that the Python examples of a page import from a module."""
    examples = code_blocks(page, "python")
    nodes = [node for example in examples for node in ast.walk(ast.parse(example)) if isinstance(node, ast.ImportFrom)]
    return [(node.module or "", alias.name) for node in nodes for alias in node.names]


@each_page
def test_examples_import_existing_names(page: Path) -> None:
    missing = [
        f"{module}.{name}"
        for module, name in imported_names(page.read_text("utf-8"))
        if not hasattr(importlib.import_module(module), name)
    ]
    assert not missing


def test_at_least_one_example_has_an_import() -> None:
    assert imported_names((DOCS / "effects.md").read_text("utf-8"))


MIN_GALLERY_PICTURES = 24
MAX_GALLERY_BYTES = 3_000_000


def test_the_gallery_has_a_command_below_each_picture() -> None:
    """The command names an output, which ``scripts/draw_gallery.py`` makes the picture of."""
    pictures = gallery_pictures((DOCS / "gallery.md").read_text("utf-8"))
    assert len({picture.name for picture in pictures}) == len(pictures) >= MIN_GALLERY_PICTURES
    without_output = [
        picture.name
        for picture in pictures
        if not picture.arguments or not (picture.output or picture.arguments[0] in COMMANDS_WITHOUT_OUTPUT)
    ]
    assert without_output == []
    assert set(OTHER_SCRIPTS) <= {picture.name for picture in pictures}
    sizes = [(DOCS / "images" / f"{picture.name}.webp").stat().st_size for picture in pictures]
    assert sum(sizes) <= MAX_GALLERY_BYTES


def test_the_gallery_finds_pictures_without_commands() -> None:
    page = "![A](images/a.webp)\n\n![B](images/b.webp)\n\n```sh\nskugga render dem.tif \\\n  -o b.png\nskugga serve c.tif\n```\n"
    first, second = gallery_pictures(page)
    assert (first.name, first.arguments, first.output) == ("a", (), None)
    assert (second.name, second.output, second.inputs) == ("b", "b.png", {"dem.tif"})


@pytest.mark.parametrize("file", sorted(LEVEL_FOLDER.glob("*.yaml")), ids=lambda path: path.stem)
def test_level_files_of_the_gallery_are_valid(file: Path) -> None:
    """Each is named by a command, whose view it has."""
    commands = [
        picture.arguments for picture in gallery_pictures((DOCS / "gallery.md").read_text("utf-8")) if file.name in picture.inputs
    ]
    views = load_level(file).level.views
    assert commands
    assert {words[words.index("--view") + 1] for words in commands if "--view" in words} <= set(views)
