"""Repeatable pictures: in the same process, in a new one, and, where truth is decidable, with another rasteriser."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from skugga.terrain.cache import clear_caches
from tests.hard_cases.cases import ENGINE, RECORD_PROPERTY, SHADOW_ALGORITHMS, Case, Trial, failures, hard_case
from tests.hard_cases.sites import site, views_of

ROOT = Path(__file__).resolve().parents[2]


def pictures(algorithm: str, folder: Path, px: int) -> list[np.ndarray]:
    """Return the visibility of a site in all views that an algorithm serves."""
    trial = Trial(algorithm, False, folder)
    scene = site(trial)
    return [trial.render_view(scene, view).visibility for view in views_of(trial, scene, px)]


def pictures_of_new_process(algorithm: str, folder: Path, px: int, **environment: str) -> tuple[str, list[np.ndarray]]:
    """Return the renderer's name and ``pictures`` of a new process."""
    code = (
        "import sys; import numpy as np; from pathlib import Path; from skugga.terrain.gl.device import device;"
        "from tests.hard_cases.test_repeatable import pictures;"
        "algorithm, folder, px = sys.argv[1:]; found = pictures(algorithm, Path(folder), int(px));"
        "np.savez(Path(folder) / 'pictures.npz', *found); print(device().renderer)"
    )
    process = subprocess.run(
        [sys.executable, "-c", code, algorithm, str(folder), str(px)],
        cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    if process.returncode != 0:
        raise RuntimeError(process.stderr.strip().splitlines()[-1])
    with np.load(folder / "pictures.npz") as archive:
        return process.stdout.strip().splitlines()[-1], list(archive.values())


def max_differing_share(first: list[np.ndarray], second: list[np.ndarray]) -> float:
    """Return the largest share of values that differ between pictures, to the bit."""
    assert all(0.02 < (picture < 0.5).mean() < 0.98 for picture in first), "light and shadow"
    return max(float((a.view(np.uint32) != b.view(np.uint32)).mean()) for a, b in zip(first, second, strict=True))


@hard_case(
    "H34",
    "The same picture comes out again, to the bit",
    "drawn twice in a process that forgets what it kept, and in a new process",
    {"values that differ": 0.0},
)
def test_the_same_again(trial: Trial) -> dict[str, float]:
    """Only a thorough run starts a new process, since that takes seconds."""
    px = 512 if trial.thorough else 128
    first = pictures(trial.algorithm, trial.folder, px)
    cached = pictures(trial.algorithm, trial.folder, px)
    clear_caches("light")
    repetitions = [cached, pictures(trial.algorithm, trial.folder, px)]
    if trial.thorough:
        repetitions.append(pictures_of_new_process(trial.algorithm, trial.folder, px)[1])
    return {"values that differ": max(max_differing_share(first, other) for other in repetitions)}


@pytest.mark.long
def test_another_rasteriser(tmp_path: Path, record_property: Callable[[str, object], None]) -> None:
    """Shadow masks drawn by graphics hardware equal those of the software rasteriser at all decidable pixels."""
    record = HARDWARE_CASE.run(ENGINE, True, tmp_path)
    record_property(RECORD_PROPERTY, json.dumps(record))
    assert not failures(record)


def _across_rasterisers(trial: Trial) -> Mapping[str, float]:
    """Return the largest share of pixels whose shadow by hardware and by software rendering differs.

    The test is skipped without graphics hardware.
    """
    worst = 0.0
    for algorithm in SHADOW_ALGORITHMS[:-1]:  # the sweep needs no rasteriser
        algorithm_trial = Trial(algorithm, False, trial.folder)
        hardware, hardware_pictures = pictures_of_new_process(algorithm, trial.folder, 256, LIBGL_ALWAYS_SOFTWARE="0")
        if any(name in hardware for name in SOFTWARE_RENDERERS):
            pytest.skip(f"no graphics hardware: {hardware}")
        software, software_pictures = pictures_of_new_process(
            algorithm, trial.folder, 256, LIBGL_ALWAYS_SOFTWARE="1", **MESA_ENVIRONMENT
        )
        assert any(name in software for name in SOFTWARE_RENDERERS), software
        scene = site(algorithm_trial)
        for hardware_picture, software_picture, view in zip(
            hardware_pictures, software_pictures, views_of(algorithm_trial, scene, 256), strict=True
        ):
            truth = algorithm_trial.render_view(scene, view).truth
            worst = max(worst, float(((hardware_picture < 0.5) != (software_picture < 0.5))[truth.decidable].mean()))
    return {"values that differ": worst}


SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast")
MESA_ENVIRONMENT = {"__EGL_VENDOR_LIBRARY_FILENAMES": "/usr/share/glvnd/egl_vendor.d/50_mesa.json"}
"""Makes EGL use Mesa, whose software rasteriser is available everywhere, before a vendor's driver."""

HARDWARE_CASE = Case(
    "H34", "The same picture comes out again, to the bit", "by graphics hardware, where truth is decidable",
    {"values that differ": 0.0}, _across_rasterisers,
)  # fmt: skip
