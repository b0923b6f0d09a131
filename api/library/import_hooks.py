"""Call functions after a module has been imported, without importing it."""

from __future__ import annotations

import importlib.util
import sys
import threading
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

Hook = Callable[[ModuleType], object]
"""Function that is called once with a module that has been imported."""


def call_after_import(name: str, hook: Hook) -> Callable[[], None]:
    """Call ``hook`` with a module as soon as it is imported, or now if it is imported already.

    Parameters
    ----------
    name
        The full name of the module, which need not be installed.
    hook
        Function that is called once with the module. Errors that it raises pass through the import.

    Returns
    -------
    Callable
        Function that cancels the hook if it has not been called yet.
    """
    module = sys.modules.get(name)
    if module is not None:
        hook(module)
        return lambda: None
    _FINDER.add_hook(name, hook)
    return lambda: _FINDER.cancel_hook(name, hook)


class _Finder(MetaPathFinder):
    """Import finder that wraps the loaders of modules with hooks, so that the hooks are called after the import."""

    def __init__(self) -> None:
        self._hooks: dict[str, list[Hook]] = {}
        self._thread_state = threading.local()

    def add_hook(self, name: str, hook: Hook) -> None:
        """Call ``hook`` with the module ``name`` after its import."""
        self._hooks.setdefault(name, []).append(hook)
        if self not in sys.meta_path:
            sys.meta_path.insert(0, self)

    def cancel_hook(self, name: str, hook: Hook) -> None:
        """Do not call ``hook`` after the import of the module ``name``. Does nothing if it has been called."""
        if hook in self._hooks.get(name, ()):
            self._hooks[name].remove(hook)

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the spec that the other finders find, with a loader that calls the hooks; ``None`` for modules without hooks."""
        if not self._hooks.get(name) or getattr(self._thread_state, "name", None) == name:
            return None
        self._thread_state.name = name
        try:
            spec = importlib.util.find_spec(name)  # by all other finders
        finally:
            self._thread_state.name = None
        if spec is not None and hasattr(spec.loader, "exec_module"):
            spec.loader = _HookedLoader(spec.loader, lambda module: self._call_hooks(name, module))
        return spec

    def _call_hooks(self, name: str, module: ModuleType) -> None:
        """Call the hooks of the module ``name`` once, in the order in which they were added."""
        for hook in self._hooks.pop(name, ()):
            hook(module)


_FINDER = _Finder()


class _HookedLoader(Loader):
    """Loader that loads a module with the module's own loader, and then calls a function.

    The module gets its own loader as ``__loader__``, so nothing else sees this one.
    """

    def __init__(self, loader: Any, on_loaded: Hook) -> None:
        self._loader, self._on_loaded = loader, on_loaded

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None
        module.__loader__ = module.__spec__.loader = self._loader
        self._loader.exec_module(module)
        self._on_loaded(module)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)
