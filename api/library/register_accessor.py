"""``da.skugga`` as xarray knows it: registered once xarray is there, and imported once it is used."""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

from skugga.api.library.import_hooks import call_after_import

if TYPE_CHECKING:
    import xarray

    from skugga.api.library.accessor import SkuggaAccessor


def register_accessor() -> None:
    """Give DataArrays ``da.skugga`` as soon as somebody imports xarray, now if somebody has; xarray is not imported for it."""
    call_after_import("xarray", _register)


def _register(xarray: ModuleType) -> None:
    """Register the accessor, and ``da.rio``, which tells the CRS of its arrays; neither where rioxarray is not installed."""
    try:
        import rioxarray  # noqa: F401  # registers ``da.rio``
    except ImportError:
        return
    if getattr(xarray.DataArray, "skugga", None) is not _accessor:  # ``skugga`` may be imported anew
        xarray.register_dataarray_accessor("skugga")(_accessor)


def _accessor(array: xarray.DataArray) -> SkuggaAccessor:
    """Questions of sun to heights (y, x), metres, with a CRS by ``rio.write_crs``: ``shadow``, ``sun_hours`` and ``horizon``."""
    from skugga.api.library.accessor import SkuggaAccessor

    return SkuggaAccessor(array)
