"""Refuses to import a folder of the repository by its bare name: it would be a second copy of the modules of ``skugga``."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

PARTS = frozenset({"api", "configs", "selector", "shadows", "terrain"})
"""The folders, which are packages inside of ``skugga``."""


class BareNameFinder(MetaPathFinder):
    """Answers every bare name with an error, before anything else looks for it."""

    def find_spec(self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname.partition(".")[0] in PARTS:
            raise ImportError(f"{fullname} is a second copy of skugga.{fullname}; import that", name=fullname)
        return None


def refuse_bare_names() -> None:
    """Refuse them from now on, in this process."""
    sys.meta_path.insert(0, BareNameFinder())
