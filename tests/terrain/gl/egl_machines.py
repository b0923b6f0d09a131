"""A machine with twice its EGL devices: EGL loads a second copy of Mesa as if it were another driver."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

VENDOR_FOLDER = Path("/usr/share/glvnd/egl_vendor.d")


def duplicate_mesa_environment(folder: Path) -> dict[str, str]:
    """Return the environment of a process for which EGL lists Mesa's devices twice; write its files to a folder."""
    driver = next((path for path in Path("/usr/lib").glob("*/libEGL_mesa.so.0")), None)
    mesa = VENDOR_FOLDER / "50_mesa.json"
    if driver is None or not mesa.is_file():
        pytest.skip("EGL is not of Mesa and GLVND")
    second = folder / "libEGL_second.so.0"
    shutil.copy(driver, second)
    vendor = folder / "60_second.json"
    vendor.write_text(json.dumps({"file_format_version": "1.0.0", "ICD": {"library_path": str(second)}}))
    return {"__EGL_VENDOR_LIBRARY_FILENAMES": f"{mesa}:{vendor}"}
