"""The documentation site: pages that are written from the code, links, and the notebook as a page."""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
import typer
from pydantic import BaseModel
from ruamel.yaml import YAML

from scripts.algorithm_reference import algorithms_page, setting_rows
from scripts.build_site import LINK, PUBLISHED, notebook_files, published_paths, site_path, with_site_links
from scripts.effect_reference import effect_conditions, effects_page
from scripts.level_reference import key_paths, level_page, level_schema
from scripts.markdown_tables import anchor, code, escape, table
from scripts.module_reference import module_folders, modules_of, modules_page, summary_of
from scripts.reference_pages import (
    REFERENCE_FILES,
    command_line_page,
    http_page,
    openapi_document,
    pass_layer_values,
    products_page,
    rule_condition,
    rule_thresholds,
    rules_page,
)  # fmt: skip
from skugga.api.cli.lazy_commands import COMMANDS
from skugga.api.cli.main import app
from skugga.api.products import PRODUCTS
from skugga.selector.planner import advice_rules
from skugga.shadows.passes import PassLayer
from skugga.shadows.registry import ALGORITHM_MODULES
from skugga.terrain.effects import EFFECTS
from skugga.terrain.effects.effect import Verdict
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.level import Level, Shadows

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    """The OpenAPI document."""
    return openapi_document()


def section(page: str, heading: str) -> str:
    """Return the part of a page from a heading of the second level to the next one."""
    return page.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]


def test_every_option_of_every_command_is_listed() -> None:
    page = command_line_page()
    group: Any = typer.main.get_command(app)
    for name in COMMANDS:
        command = group.commands[name].loaded_command
        options = [option for parameter in command.params for option in parameter.opts if option.startswith("--")]
        listed = re.findall(
            r"(?<![\w-])--[\w-]+",
            "\n".join(re.findall(r"^\| ((?:`|<code>).*?(?:`|</code>)) \|", section(page, name), re.MULTILINE)),
        )
        assert set(options) <= set(listed), name


def test_every_key_of_a_level_file_is_listed() -> None:
    page, schema = level_page(), level_schema()
    paths = key_paths(schema)
    assert set(paths) == {"Level", *schema["$defs"]}, "every part is reached by keys"
    assert len(set(paths.values())) == len(paths), "no two parts have the same heading"
    for name, path in paths.items():
        part = schema if name == "Level" else schema["$defs"][name]
        listed = re.findall(r"^\| `(\w+)` \|", section(page, path or "The file"), re.MULTILINE)
        assert listed == list(part["properties"]), name


def test_keys_have_the_models_limits_and_defaults() -> None:
    page = level_page()
    assert "| `exaggeration` | number (> 0, ≤ 100) | `1.0` |" in section(page, "terrain")
    assert "| `terrain` | [terrain](#terrain) | required |" in section(page, "The file")
    assert "| `bounds` | list of 4: number | - |" in section(page, "terrain")
    assert "| `species` | `conifer`, `broadleaf`, `mixed` | `mixed` |" in section(page, "forest[]")


def test_the_schema_accepts_bundled_levels() -> None:
    """The schema's properties are the keys that the model knows; a file with others is refused by both."""
    schema = level_schema()
    assert set(schema["properties"]) == set(Level.model_fields) and schema["additionalProperties"] is False
    models = {model.__name__: model for model in _all_subclasses(BaseModel)}
    assert all(set(part["properties"]) == set(models[name].model_fields) for name, part in schema["$defs"].items())


def _all_subclasses(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    """Yield the direct and indirect subclasses of a model."""
    for subclass in model.__subclasses__():
        yield subclass
        yield from _all_subclasses(subclass)


def test_every_address_and_parameter_is_listed(document: dict[str, Any]) -> None:
    page = http_page(document)
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            part = page.partition(f"\n### {method.upper()} `{path}`\n")[2].partition("\n### ")[0]
            assert all(f"`{parameter['name']}`" in part for parameter in operation.get("parameters", [])), path


def test_shared_parameters_are_described_once(document: dict[str, Any]) -> None:
    page = http_page(document)
    shared = re.findall(r"^### (\w+)$", section(page, "Shared query parameters"), re.MULTILINE)
    assert {"time", "azimuth", "altitude"} <= set(shared) and len(shared) == len(set(shared))
    assert "`azimuth` (query)" not in page.partition("### GET `/levels/{level}/tiles/")[2].partition("\n### ")[0]
    assert all(f"(#{anchor(name)})" in page for name in shared)


def test_no_environment_variable_changes_the_reference(monkeypatch: pytest.MonkeyPatch, document: dict[str, Any]) -> None:
    monkeypatch.setenv("SKUGGA_API_TOKEN", "a secret token")
    assert openapi_document() == document


def test_every_rule_has_a_condition_in_words() -> None:
    page = rules_page()
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \| `(\w+)` \| ([^|]+) \|", page, re.MULTILINE)
    assert [(name, algorithm) for _, name, algorithm, _ in rows] == [(rule.name, rule.algorithm) for rule in advice_rules.RULES]
    assert all(len(condition.split()) >= 4 for *_, condition in rows)


def test_a_rule_without_a_condition_is_an_error() -> None:
    def silent(case: advice_rules.RuleInput) -> str | None:
        """Return nothing of use."""
        return None

    with pytest.raises(ValueError, match="plain: the docstring"):
        rule_condition(advice_rules.Rule("plain", "sweep", silent, "nowhere"))


def test_all_thresholds_of_the_rules_are_listed() -> None:
    numbers = {name: value for name, value in vars(advice_rules).items() if name.isupper() and type(value) in (int, float)}
    assert {name: value for name, value, _ in rule_thresholds()} == numbers
    assert all(len(text.split()) >= 5 for _, _, text in rule_thresholds())


def test_every_effect_states_where_it_is_needed() -> None:
    page = effects_page()
    for name, effect in EFFECTS.items():
        needed, left_out = effect_conditions(name, effect)
        assert f"| needed | {escape(needed)} |" in section(page, name) and len(left_out.split()) >= 2, name


def test_an_effect_without_conditions_is_an_error() -> None:
    def silent(descriptor: Descriptor) -> Verdict:
        """Return no."""
        return Verdict(False, "never")

    with pytest.raises(ValueError, match="haze: the predicate's docstring"):
        effect_conditions("haze", dataclasses.replace(EFFECTS["haze"], judge=silent))


def test_every_option_of_every_product_is_listed() -> None:
    page = products_page()
    for product in PRODUCTS.values():
        for name in product.options.model_fields:
            assert f"| `{name}` |" in section(page, product.name), product.name


def test_the_values_of_every_intermediate_picture_are_described() -> None:
    values = pass_layer_values()
    assert set(values) == set(get_args(PassLayer))
    assert all(f"| {escape(text)} |" in section(products_page(), "Layers of views") for text in values.values())


def test_every_folder_and_module_is_listed() -> None:
    page = modules_page()
    folders = [str(folder.relative_to(ROOT)) for folder in module_folders()]
    assert {"api/http/tiles", "selector", "shadows/maps", "terrain/effects", "benchmarks", "viewer/src/point"} <= set(folders)
    for folder in module_folders():
        part = section(page, str(folder.relative_to(ROOT)))
        assert re.findall(r"^\| `([\w.]+)` \|", part, re.MULTILINE) == [path.name for path in modules_of(folder)], folder


def test_a_module_without_a_docstring_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scripts.module_reference.ROOT", tmp_path)
    python, typescript = '"""Do ``skugga.api.b``.\n\nMore."""', "/**\n * Does this.\n *\n * More.\n */"
    for name, text, expected in (("a.py", python, "Do `api.b`."), ("a.ts", typescript, "Does this.")):
        (tmp_path / name).write_text(text, encoding="utf-8")
        assert summary_of(tmp_path / name) == expected
        (tmp_path / name).write_text("a = 1", encoding="utf-8")
        with pytest.raises(ValueError, match="a docstring is missing"):
            summary_of(tmp_path / name)


@pytest.mark.parametrize("module", ALGORITHM_MODULES, ids=lambda module: module.ALGORITHM.name)
def test_every_setting_of_an_algorithm_is_listed(module: Any) -> None:
    """Settings that a level can set have a description; refusals and layers stand in the same section."""
    algorithm = module.ALGORITHM
    part = section(algorithms_page(), algorithm.name)
    keys = {name for settings_type in algorithm.settings_types for name in settings_type.model_fields}
    described = [name for name, _, _ in setting_rows(algorithm)]
    assert keys & set(Shadows.model_fields) <= set(described) and len(described) == len(set(described))
    assert all(f"| `{name}` |" in part for name in described)
    assert all(escape(reason) in part for reason in algorithm.refusals.values())
    assert all(f"`{layer}`" in part for layer in algorithm.layers)


def test_every_page_is_in_the_navigation_once() -> None:
    named = re.findall(r"^ +- (?:[\w ]+: )?([\w/.-]+\.md)$", (ROOT / "mkdocs.yml").read_text("utf-8"), re.MULTILINE)
    pages = [site_path(path) for path in published_paths() if path.endswith(".md")]
    generated = [f"reference/{name}" for name in REFERENCE_FILES if name.endswith(".md")]
    assert sorted(named) == sorted([*pages, *generated, "a-winters-day.md"])


def test_published_files_exist() -> None:
    assert all((ROOT / name).exists() for name in PUBLISHED)


@pytest.mark.parametrize(
    ("path", "link", "expected"),
    [
        ("docs/python.md", "levels.md#views", "levels.md#views"),
        ("docs/python.md", "../examples/README.md", "examples/README.md"),
        ("docs/python.md", "a-winters-day.ipynb", "a-winters-day.md"),
        ("examples/README.md", "../docs/films.md#camera-paths", "../films.md#camera-paths"),
        ("examples/README.md", "garden.py", "garden.py"),
        ("docs/reports/speed.md", "../speed.md", "../speed.md"),
        ("docs/python.md", "#below", "#below"),
        ("docs/python.md", "https://example.org/docs/levels.md", "https://example.org/docs/levels.md"),
        ("docs/python.md", "../terrain/scene.py", "../terrain/scene.py"),
    ],
)
def test_links_lead_to_where_the_site_has_a_file(path: str, link: str, expected: str) -> None:
    pages = ["docs/python.md", "docs/levels.md", "docs/films.md", "docs/speed.md", "docs/a-winters-day.ipynb"]
    published = [*pages, "examples/README.md", "examples/garden.py"]
    assert with_site_links(f"A [link]({link}).", path, published) == f"A [link]({expected})."


def test_links_in_text_alone_are_changed() -> None:
    assert LINK.findall("[a](b.md) (c.md) [d](http://e.md) `f(g.md)`") == [("b.md", "")]


def test_a_notebook_becomes_a_page_with_its_output(tmp_path: Path) -> None:
    output = [{"output_type": "stream", "text": ["12\n"]}, {"output_type": "display_data", "data": {"image/png": "iVBORw0KGgo="}}]
    cells = [
        {"cell_type": "markdown", "source": ["# A day"]},
        {"cell_type": "code", "source": ["print(12)"], "outputs": output},
    ]
    notebook = tmp_path / "day.ipynb"
    notebook.write_text(json.dumps({"cells": cells}), encoding="utf-8")
    files = notebook_files(notebook)
    assert files["images/day-1.png"] == b"\x89PNG\r\n\x1a\n"
    assert files["day.md"] == (
        "# A day\n\n```python\nprint(12)\n```\n\n```text\n12\n```\n\n![Drawn by the code above](images/day-1.png)\n"
    )


def test_text_without_markup_stays_as_it_is() -> None:
    assert escape("``a|b`` [x] 2*3 <tag> a|b") == r"`a|b` \[x\] 2\*3 &lt;tag> a&#124;b"
    assert table(("a",), [(code("x|y"),)]) == "| a |\n| --- |\n| <code>x&#124;y</code> |\n"
    assert code(True) == "`true`" and anchor("GET `/levels/{level}`") == "get-levelslevel"


def test_the_citation_has_the_projects_version_and_licence() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    citation = YAML(typ="safe").load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    assert citation["authors"] == project["authors"] and citation["cff-version"] == "1.2.0"


def test_classifiers_name_the_versions_of_python_that_are_tested() -> None:
    """All tests and ``make test-lowest`` run with the first version, ``make test-newest`` with the others."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    named = [
        name.rpartition(" ")[2]
        for name in project["classifiers"]
        if re.fullmatch(r"Programming Language :: Python :: 3\.\d+", name)
    ]
    makefile = (ROOT / "Makefile").read_text("utf-8")
    assert named == ["3.11", "3.12", "3.13"] and project["requires-python"] == ">=3.11"
    assert "PYTHON=python3.11" in makefile and "python3.13 python3.12" in makefile


def test_issue_forms_are_complete() -> None:
    for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("[!c]*.yml"):
        form = YAML(typ="safe").load(path.read_text("utf-8"))
        ids = [field["id"] for field in form["body"]]
        assert form["name"] and form["description"] and len(ids) == len(set(ids)), path.name
        assert all(field["attributes"]["label"] for field in form["body"]), path.name


def test_a_copy_without_git_publishes_the_same_files(monkeypatch: pytest.MonkeyPatch) -> None:
    expected = published_paths()
    monkeypatch.setenv("PATH", "/nonexistent")
    assert published_paths() == expected and "docs/index.md" in expected
