"""Checks of the packages, OpenGL devices and caches of this machine."""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files

from skugga.api.cli.graphics_card import CardPlaces, find_cards, unused_card_reason
from skugga.terrain.errors import NoOpenGLError, SkuggaError
from skugga.terrain.gl.egl_devices import AUTO_DEVICE, EGL_DEVICE_VARIABLE, EglDevice, ProbedDevice, egl_devices, probe_device

CHECKED_PACKAGES = ("moderngl", "PyOpenGL", "numpy", "numba", "rasterio", "pyproj", "pvlib", "fastapi", "uvicorn", "pydantic")


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes
    ----------
    subject
        What was checked.
    ok
        Whether it works.
    detail
        A detail, or the remedy.
    """

    subject: str
    ok: bool
    detail: str


def run_checks() -> list[Finding]:
    """Return the findings of all checks; never raises."""
    devices = _probe_egl_devices()
    return [
        Finding("Python", sys.version_info >= (3, 11), f"{platform.python_version()} on {platform.machine()}"),
        *map(_check_package, CHECKED_PACKAGES),
        _check_opengl(),
        *_check_egl_devices(devices),
        *_check_graphics_card(devices, CardPlaces()),
        _check_calibration(),
        _render_test_map(),
        _check_compiled_loops(),
        _check_viewer(),
    ]


def _check_package(name: str) -> Finding:
    """Check that a Python package is installed, and report its version."""
    try:
        return Finding(name, True, version(name))
    except PackageNotFoundError:
        return Finding(name, False, f"not installed: pip install {name}")


def _check_opengl() -> Finding:
    """Check that this process gets an OpenGL device, and report its renderer, version and texture size."""
    from skugga.terrain.gl.device import device

    try:
        gl = device()
    except NoOpenGLError as error:
        return Finding("OpenGL", False, f"{error}. On Debian: apt-get install libegl1 libgl1 libgl1-mesa-dri")
    except SkuggaError as error:
        return Finding("OpenGL", False, str(error))
    return Finding("OpenGL", True, f"{gl.renderer}, {gl.version}, textures up to {gl.max_size}")


def _probe_egl_devices() -> list[tuple[EglDevice, ProbedDevice]]:
    """Return EGL's devices with their probes; empty without EGL."""
    try:
        return [(egl_device, probe_device(egl_device.index)) for egl_device in egl_devices()]
    except SkuggaError:
        return []


def _check_egl_devices(devices: Sequence[tuple[EglDevice, ProbedDevice]]) -> list[Finding]:
    """Return a finding for each EGL device. A device that cannot render is not reported as a fault, because another may."""
    from skugga.terrain.gl.device import device

    try:
        used_index = device().egl_device.index
    except SkuggaError:
        used_index = None
    findings = []
    for egl_device, probe in devices:
        details = [f"no OpenGL 4.3 context ({probe.fault})" if probe.fault else f"{probe.renderer}, {probe.version}"]
        details += (
            ["in software"] * egl_device.is_software
            + [egl_device.name] * bool(egl_device.name)
            + ["in use"] * (egl_device.index == used_index)
        )
        findings.append(Finding(f"EGL device {egl_device.index}", True, ", ".join(details)))
    if len(devices) > 1:
        findings.append(Finding("several devices", True, f"{EGL_DEVICE_VARIABLE} selects the devices to use"))
    return findings


def _check_graphics_card(devices: Sequence[tuple[EglDevice, ProbedDevice]], places: CardPlaces) -> list[Finding]:
    """Return a finding if the machine has a graphics card and OpenGL does not draw with one.

    A render node of another vendor than NVIDIA is no fault: virtual displays without 3D have one, too.
    """
    from skugga.terrain.gl.device import device

    cards = find_cards(places)
    try:
        gl = device()
    except SkuggaError:
        renderer = "nothing"
    else:
        if not gl.egl_device.is_software:
            return []
        renderer = gl.renderer
    if not cards:
        return []
    card, setting = cards[0], os.environ.get(EGL_DEVICE_VARIABLE, "").strip().lower() or AUTO_DEVICE
    if setting != AUTO_DEVICE:
        return [Finding("graphics card", True, f"{card.name} is not used: {EGL_DEVICE_VARIABLE} is '{setting}'")]
    faults = [probe.fault for egl_device, probe in devices if probe.fault and not egl_device.is_software]
    reason = unused_card_reason(card, places, os.environ, faults=faults)
    return [Finding("graphics card", not card.is_nvidia, f"{card.name} is present, but {renderer} draws: {reason}")]


def _check_calibration() -> Finding:
    """Check the calibration, which predictions use. A missing one is no fault, because algorithms are chosen without it, too."""
    from skugga.selector.cost.device_profile import load_profile, missing_profile_reason
    from skugga.terrain.gl.device import device

    try:
        gl = device()
    except SkuggaError:
        return Finding("calibration", True, "no OpenGL device to calibrate")
    profile = load_profile(gl.renderer, gl.version)
    text = (
        missing_profile_reason(gl.renderer, gl.version)
        if profile is None
        else f"{profile.renderer}, {profile.version}, "
        f"{'estimated' if profile.is_estimate else 'measured'} on {profile.measured:%Y-%m-%d}"
        + ("; skugga calibrate measures it" if profile.is_estimate else "")
    )
    return Finding("calibration", True, text or "")


def _render_test_map() -> Finding:
    """Render a small map whose shadow is known. This checks every step from loading a level to drawing a frame."""
    from skugga.api.catalogue import find_level
    from skugga.api.cli.snapshot import snapshot
    from skugga.api.products.mask import MASK_LIT, MASK_SHADOW
    from skugga.api.request import ProductRequest
    from skugga.terrain.level.parts import SunSpec

    try:
        request = ProductRequest(product="mask", sun=SunSpec(azimuth=237, altitude=10))
        mask = snapshot(find_level("jacksboro"), "map", request, {"filter": 1}, size=(64, 64)).computed.array
    except SkuggaError as error:
        return Finding("a shadowed map", False, str(error))
    share = float((mask == MASK_SHADOW).sum() / max(((mask == MASK_SHADOW) | (mask == MASK_LIT)).sum(), 1))
    return Finding("a shadowed map", 0.05 < share < 0.6, f"{100 * share:.0f} % in shadow")


def _check_compiled_loops() -> Finding:
    """Check the on-disk cache of compiled loops. Call it after ``_render_test_map``, which compiles some."""
    from skugga.terrain.compiling.loop_cache import loop_store

    store = loop_store()
    return Finding("compiled loops", store.problem is None, store.problem or f"stored in {store.folder}")


def _check_viewer() -> Finding:
    """Check that the web viewer has been built. Tiles are served without it."""
    built = files("skugga.api").joinpath("static", "index.html").is_file()
    return Finding("viewer", built, "built" if built else "not built: make viewer (tiles are served without it)")
