"""Compute true cast shadows of terrain from arrays, rasters and level files.

    import skugga

    dark = skugga.shadow(height_m, 30.0, azimuth_deg=250.0, altitude_deg=12.0)
    with skugga.open_level("dem.tif") as level:
        mask = level.shade("mask", time="2024-03-21T09:00:00+01:00")
        hours = level.sun_hours("2024-03-21")
        day = level.point(7.45, 46.02, date="2024-12-21").day

With xarray and rioxarray installed, ``import skugga`` gives every DataArray of heights the accessor ``da.skugga``.

The public names are those of ``__all__``, ``__version__`` and the accessor. Modules inside the package may change without notice.
Each name is imported on first use, so ``import skugga`` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from skugga.api.library.register_accessor import register_accessor
from skugga.terrain.level.gdal_guard import limit_gdal_caches

if TYPE_CHECKING:
    __version__: str
    from skugga.api.library.arrays import horizon, horizons, shadow, sky_view, sunlit
    from skugga.api.library.arrays import sun_hours_of_array as sun_hours
    from skugga.api.library.opened_level import OpenLevel, open_heights, open_level
    from skugga.terrain.errors import SkuggaError
else:
    # Public names, each with the module and the name there from which it is imported.
    _SOURCES = {
        "OpenLevel": ("skugga.api.library.opened_level", "OpenLevel"),
        "SkuggaError": ("skugga.terrain.errors", "SkuggaError"),
        "horizon": ("skugga.api.library.arrays", "horizon"),
        "horizons": ("skugga.api.library.arrays", "horizons"),
        "open_heights": ("skugga.api.library.opened_level", "open_heights"),
        "open_level": ("skugga.api.library.opened_level", "open_level"),
        "shadow": ("skugga.api.library.arrays", "shadow"),
        "sky_view": ("skugga.api.library.arrays", "sky_view"),
        "sun_hours": ("skugga.api.library.arrays", "sun_hours_of_array"),
        "sunlit": ("skugga.api.library.arrays", "sunlit"),
    }

    def __getattr__(name: str) -> object:
        """Import the public name ``name`` on its first use, and return it. Raises ``AttributeError`` for other names."""
        if name == "__version__":
            from importlib.metadata import version  # slow to import

            value = globals()[name] = version("skugga")
            return value
        if name not in _SOURCES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, attribute = _SOURCES[name]
        value = globals()[name] = getattr(import_module(module), attribute)
        return value

    def __dir__() -> list[str]:
        """Return the names of the module, with the public names that are not imported yet."""
        return sorted({*globals(), *__all__})


__all__ = [
    "OpenLevel", "SkuggaError", "horizon", "horizons", "open_heights", "open_level", "shadow", "sky_view", "sun_hours", "sunlit",
]  # fmt: skip

limit_gdal_caches()  # before the importing code opens a raster, or starts a process that opens one
register_accessor()
