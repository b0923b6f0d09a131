"""``import skugga``: lazily imported names are available, and so is xarray's accessor."""

from __future__ import annotations

import ast
import importlib
import pickle
import pydoc
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import skugga

ROOT = Path(__file__).parents[1]


def run_python(code: str) -> str:
    """Return the output of a new Python process.

    Warnings are errors there, except for those of affine, which rioxarray causes.
    """
    process = subprocess.run(
        [sys.executable, "-W", "error", "-W", "ignore::PendingDeprecationWarning", "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


def names_for_type_checkers() -> dict[str, tuple[str, str]]:
    """Return the names of ``skugga`` as type checkers see them: module and name there."""
    (block,) = (node for node in ast.parse((ROOT / "skugga" / "__init__.py").read_text("utf-8")).body if isinstance(node, ast.If))
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.asname or alias.name: (str(node.module), alias.name) for node in imports for alias in node.names}


def test_every_name_is_the_one_that_type_checkers_see():
    typed = names_for_type_checkers()
    assert sorted(typed) == sorted(skugga.__all__)
    for name, (module, attribute) in typed.items():
        assert getattr(skugga, name) is getattr(importlib.import_module(module), attribute), name


def test_names_are_listed_before_they_are_used():
    """``dir`` lists them, and so does completion in a shell."""
    assert run_python("import skugga; print(set(skugga.__all__) <= set(dir(skugga)), 'shadow' in vars(skugga))") == "True False"


def test_version_is_that_of_the_installation():
    assert run_python("import skugga; print(skugga.__version__)") == version("skugga")


def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'skugga' has no attribute 'shadows_of'"):
        skugga.shadows_of  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'shadows_of' from 'skugga'"):
        exec("from skugga import shadows_of")


def test_names_are_imported_by_star():
    names: dict[str, object] = {}
    exec("from skugga import *", names)
    assert names["shadow"] is skugga.shadow and names["OpenLevel"] is skugga.OpenLevel


def test_help_shows_every_name():
    text = pydoc.plain(pydoc.render_doc(skugga))
    for name in ("class OpenLevel", "open_level(", "shadow(", "sunlit("):
        assert name in text, name


def test_names_survive_pickling():
    for name in skugga.__all__:
        value = getattr(skugga, name)
        assert pickle.loads(pickle.dumps(value)) is value


def test_xarray_is_not_imported_for_its_accessor():
    assert run_python("import skugga, sys; print('xarray' in sys.modules)") == "False"


USE_ACCESSOR = """
import importlib, numpy, sys
name = "skugga.api.library.accessor"
was_imported = name in sys.modules
heights = numpy.zeros((20, 20), "float32"); heights[10, 10] = 50
array = xarray.DataArray(heights, dims=("y", "x"), coords={"y": 600.0 - 30 * numpy.arange(20), "x": 30.0 * numpy.arange(20)})
shadow = array.rio.write_crs("EPSG:32633").skugga.shadow(azimuth=180, altitude=20)
importlib.reload(skugga)
print(was_imported, int(shadow.sum()) > 2, type(array.skugga).__name__, xarray.DataArray.skugga.__name__)
"""


def test_accessor_is_imported_when_it_is_used():
    """It is registered once, even after a reload. Warnings are errors."""
    pytest.importorskip("rioxarray")
    assert run_python(f"import skugga, xarray\n{USE_ACCESSOR}") == "False True SkuggaAccessor _accessor"


@pytest.mark.parametrize("imports", ["import xarray, skugga", "import skugga, rioxarray, xarray"])
def test_accessor_is_registered_for_each_order_of_imports(imports):
    pytest.importorskip("rioxarray")
    assert run_python(f"{imports}; print(hasattr(xarray.DataArray, 'skugga'))") == "True"


def test_there_is_no_accessor_without_rioxarray():
    pytest.importorskip("xarray")
    assert (
        run_python("import sys; sys.modules['rioxarray'] = None; import skugga, xarray; print(hasattr(xarray.DataArray, 'skugga'))")
        == "False"
    )


def test_xarray_need_not_be_installed():
    assert run_python("import sys; sys.modules['xarray'] = None; import skugga; print(skugga.shadow.__name__)") == "shadow"
