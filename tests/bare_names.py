"""Refuse imports of a folder of the repository by its bare name. Such an import would load a second copy of a module of
``skugga``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

PACKAGE_FOLDERS = frozenset({"api", "configs", "selector", "shadows", "terrain"})
"""Folders that are packages inside ``skugga``."""


class BareNameFinder(MetaPathFinder):
    """Import finder that raises an error for every bare name, before any other finder searches for it."""

    def find_spec(self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname.partition(".")[0] in PACKAGE_FOLDERS:
            raise ImportError(f"{fullname} would be a second copy of skugga.{fullname}. Import skugga.{fullname}.", name=fullname)
        return None


def refuse_bare_names() -> None:
    """Refuse imports by bare names in this process."""
    sys.meta_path.insert(0, BareNameFinder())
