"""The lock file holds versions of all packages in ``pyproject.toml``, and no information about the machine that made it."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]


def locked_requirements() -> list[Requirement]:
    """Return the requirements of the lock file."""
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    return [Requirement(line) for line in lines if not line.startswith("#")]


def declared_requirements() -> list[Requirement]:
    """Return the requirements of the project and of its extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirement_lists = [project["dependencies"], *project["optional-dependencies"].values()]
    return [
        requirement
        for requirement_list in requirement_lists
        for requirement in map(Requirement, requirement_list)
        if requirement.name != project["name"]
    ]


def test_every_dependency_is_locked_within_its_bounds():
    versions: dict[str, list[str]] = {}
    for locked_requirement in locked_requirements():
        (pin,) = locked_requirement.specifier
        assert pin.operator == "==", locked_requirement
        versions.setdefault(canonicalize_name(locked_requirement.name), []).append(pin.version)
    for requirement in declared_requirements():
        locked_versions = versions.get(canonicalize_name(requirement.name))
        assert locked_versions, f"{requirement.name} is missing: make lock"
        assert all(version in requirement.specifier for version in locked_versions), (
            f"{requirement} is locked at {locked_versions}: make lock"
        )


def test_the_lock_file_has_no_urls_or_paths():
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    assert not re.search(r"://|(^|\s)(/|\.\.?/)|--", text)
