"""The lock file holds versions of all packages in ``pyproject.toml``, and no information about the machine that made it."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]


def locked() -> list[Requirement]:
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    return [Requirement(line) for line in lines if not line.startswith("#")]


def named() -> list[Requirement]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    parts = [project["dependencies"], *project["optional-dependencies"].values()]
    return [asked for part in parts for asked in map(Requirement, part) if asked.name != project["name"]]


def test_every_dependency_is_locked_within_its_bounds():
    versions: dict[str, list[str]] = {}
    for lock in locked():
        (bound,) = lock.specifier
        assert bound.operator == "==", lock
        versions.setdefault(canonicalize_name(lock.name), []).append(bound.version)
    for asked in named():
        found = versions.get(canonicalize_name(asked.name))
        assert found, f"{asked.name} is missing: make lock"
        assert all(version in asked.specifier for version in found), f"{asked} is locked at {found}: make lock"


def test_the_lock_file_has_no_urls_or_paths():
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    assert not re.search(r"://|(^|\s)(/|\.\.?/)|--", text)
