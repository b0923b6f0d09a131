"""Import hooks: each is called once, by any way of import, and never causes the import itself."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from skugga.api.library.import_hooks import call_after_import

NAME = "a_module_to_wait_for"


@pytest.fixture
def module_file(tmp_path, monkeypatch):
    """Yield the file of a module that has not been imported."""
    file = tmp_path / f"{NAME}.py"
    file.write_text("VALUE = 7\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield file
    sys.modules.pop(NAME, None)


def test_hook_is_called_once_the_module_is_complete(module_file: Path) -> None:
    calls: list[ModuleType] = []
    call_after_import(NAME, lambda module: calls.append(module.VALUE))
    assert NAME not in sys.modules and calls == []
    module = importlib.import_module(NAME)
    assert calls == [7]
    importlib.reload(module)
    assert calls == [7]


def test_hook_of_an_imported_module_is_called_at_once(module_file: Path) -> None:
    module = importlib.import_module(NAME)
    calls: list[ModuleType] = []
    call_after_import(NAME, calls.append)
    assert calls == [module]


def test_all_hooks_of_a_module_are_called_in_order(module_file: Path) -> None:
    calls: list[int] = []
    for number in range(3):
        call_after_import(NAME, lambda _, number=number: calls.append(number))
    importlib.import_module(NAME)
    assert calls == [0, 1, 2]


def test_cancelled_hook_is_not_called(module_file: Path) -> None:
    calls: list[ModuleType] = []
    call_after_import(NAME, calls.append)()
    importlib.import_module(NAME)
    assert calls == []
    call_after_import(NAME, calls.append)()  # too late: the hook has been called
    assert len(calls) == 1


def test_module_keeps_its_loader(module_file: Path) -> None:
    """Tools that read the sources and data of a module use its loader."""
    call_after_import(NAME, lambda module: None)
    spec = importlib.util.find_spec(NAME)
    assert spec is not None and spec.loader is not None and spec.loader.get_filename(NAME) == str(module_file)  # type: ignore[attr-defined]
    module = importlib.import_module(NAME)
    assert type(module.__loader__).__name__ == type(module.__spec__.loader).__name__ == "SourceFileLoader"
    assert Path(module.__file__) == module_file


def test_looking_for_a_module_does_not_call_its_hooks(module_file: Path) -> None:
    calls: list[ModuleType] = []
    call_after_import(NAME, calls.append)
    assert importlib.util.find_spec(NAME) is not None
    assert calls == [] and NAME not in sys.modules
    importlib.import_module(NAME)
    assert len(calls) == 1


def test_missing_or_broken_module_raises_its_usual_error(module_file: Path) -> None:
    calls: list[ModuleType] = []
    cancel = call_after_import("no_module_of_this_name", calls.append)
    with pytest.raises(ModuleNotFoundError, match="no_module_of_this_name"):
        importlib.import_module("no_module_of_this_name")
    cancel()
    call_after_import(NAME, calls.append)
    module_file.write_text("raise ZeroDivisionError", encoding="utf-8")
    with pytest.raises(ZeroDivisionError):
        importlib.import_module(NAME)
    assert calls == []
    module_file.write_text("VALUE = 12345678", encoding="utf-8")
    importlib.invalidate_caches()
    importlib.import_module(NAME)
    assert len(calls) == 1


def test_hook_of_a_submodule_waits_for_the_submodule(tmp_path, monkeypatch) -> None:
    package = tmp_path / "a_package_to_wait_for"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "part.py").write_text("VALUE = 7\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    calls: list[str] = []
    call_after_import("a_package_to_wait_for.part", lambda module: calls.append(module.__name__))
    importlib.import_module("a_package_to_wait_for")
    assert calls == []
    importlib.import_module("a_package_to_wait_for.part")
    assert calls == ["a_package_to_wait_for.part"]
