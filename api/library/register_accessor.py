"""Register the accessor ``da.skugga`` when xarray is imported. The accessor itself is imported on first use."""

from __future__ import annotations

from types import ModuleType
from typing import TYPE_CHECKING

from skugga.api.library.import_hooks import call_after_import

if TYPE_CHECKING:
    import xarray

    from skugga.api.library.accessor import SkuggaAccessor


def register_accessor() -> None:
    """Register ``da.skugga`` as soon as xarray is imported, or now if it is imported already. This does not import xarray."""
    call_after_import("xarray", _register)


def _register(xarray: ModuleType) -> None:
    """Register the accessor and ``da.rio``, which holds the CRS of arrays; neither if rioxarray is not installed."""
    try:
        import rioxarray  # noqa: F401  # registers ``da.rio``
    except ImportError:
        return
    if getattr(xarray.DataArray, "skugga", None) is not _accessor:  # ``skugga`` may be imported again
        xarray.register_dataarray_accessor("skugga")(_accessor)


def _accessor(array: xarray.DataArray) -> SkuggaAccessor:
    """Compute ``shadow``, ``sun_hours`` and ``horizon`` of heights (y, x) in metres, with a CRS set by ``rio.write_crs``."""
    from skugga.api.library.accessor import SkuggaAccessor

    return SkuggaAccessor(array)
