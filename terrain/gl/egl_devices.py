"""EGL device selection: the devices that EGL lists, and the one that a process uses (setting ``SKUGGA_EGL_DEVICE``).

EGL lists graphics cards first and Mesa's software rasteriser last. A device's OpenGL name is known only after it has created a
context, and a process creates one context. So ``probe_device`` queries each further device in a subprocess. A driver that crashes
or hangs there does not harm this process.
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from skugga.terrain.errors import GraphicsError, InputError, NoOpenGLError, Problem

if TYPE_CHECKING:
    import moderngl

EGL_DEVICE_VARIABLE = "SKUGGA_EGL_DEVICE"
AUTO_DEVICE, SOFTWARE_DEVICE = "auto", "software"
EGL_DEVICE_VALUES = "auto, software, or numbers of devices, separated by commas"

LIBEGL, LIBGL = "libEGL.so.1", "libGL.so.1"
"""Full library names: searching for them needs ldconfig or a compiler, which slim images lack."""

OPENGL_VERSION = 430

NO_OPENGL_RENDERER = "no OpenGL"
"""The renderer's name on a machine without OpenGL."""

PROBE_TIMEOUT_S = 60.0
"""Timeout of a device probe."""

_EXTENSIONS, _DRM_DEVICE_FILE, _RENDERER = 0x3055, 0x3233, 0x335F
"""Enumerants of EGL and its extensions."""
_GLCONTEXT_VARIABLE = "GLCONTEXT_DEVICE_INDEX"

log = logging.getLogger("skugga")


@dataclass(frozen=True)
class EglDevice:
    """A device of EGL's list.

    Attributes
    ----------
    index
        Its number in the list.
    is_software
        Whether it is Mesa's software rasteriser.
    name
        Its driver's name for it; empty if the driver has none.
    """

    index: int
    is_software: bool
    name: str = ""

    def __str__(self) -> str:
        """Return the device's index and name as text, for messages."""
        return f"{self.index} ({self.name or ('software rasteriser' if self.is_software else 'without a name')})"


@dataclass(frozen=True)
class ProbedDevice:
    """Result of a device probe: OpenGL's renderer and version strings, or the ``fault`` that prevents a context."""

    renderer: str = ""
    version: str = ""
    fault: str = ""


DeviceProbe = Callable[[int], ProbedDevice]

_process_number = 0


def set_process_number(number: int) -> None:
    """Set the number of this process among those that share the devices. Call it before the device is created."""
    global _process_number
    _process_number = number


def egl_devices() -> tuple[EglDevice, ...]:
    """Return EGL's device list. Raises ``NoOpenGLError`` without EGL, or if EGL lists no devices."""
    try:
        egl = ctypes.CDLL(LIBEGL)
    except OSError as error:
        raise no_opengl_error(str(error)) from None
    egl.eglGetProcAddress.restype, egl.eglGetProcAddress.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    query_devices = _function(egl, b"eglQueryDevicesEXT", ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)
    query_string = _function(egl, b"eglQueryDeviceStringEXT", ctypes.c_char_p, ctypes.c_void_p, ctypes.c_int)
    count = ctypes.c_int()
    if query_devices is None or not query_devices(0, None, ctypes.byref(count)):
        raise no_opengl_error("EGL cannot list devices without EGL_EXT_device_enumeration")
    handles = (ctypes.c_void_p * max(count.value, 1))()
    if not query_devices(count, handles, ctypes.byref(count)) or not count.value:
        raise no_opengl_error("EGL finds no driver")

    def text(handle: int | None, attribute: int) -> str:
        value = None if query_string is None else query_string(handle, attribute)
        return "" if value is None else value.decode(errors="replace")

    devices = []
    for index, handle in enumerate(handles[: count.value]):
        extensions = text(handle, _EXTENSIONS).split()
        name = text(handle, _RENDERER) if "EGL_EXT_device_query_name" in extensions else ""
        name = name or (text(handle, _DRM_DEVICE_FILE) if "EGL_EXT_device_drm" in extensions else "")
        devices.append(EglDevice(index, "EGL_MESA_device_software" in extensions, name))
    return tuple(devices)


def _function(egl: ctypes.CDLL, name: bytes, result: Any, *arguments: Any) -> Callable[..., Any] | None:
    """Return a function of EGL or of an extension by its name; ``None`` if EGL lacks it.

    ``result`` and ``arguments`` are the ctypes types of its result and of its arguments.
    """
    address = egl.eglGetProcAddress(name)
    return ctypes.CFUNCTYPE(result, *arguments)(address) if address else None


def no_opengl_error(reason: str) -> NoOpenGLError:
    """Return the error for a machine on which no OpenGL context can be created, with the reason."""
    return NoOpenGLError(
        f"OpenGL: no OpenGL 4.3 context through EGL ({reason}). Without it only terrain without objects can be drawn, under the "
        "sun. Run 'skugga doctor' to see what is missing"
    )


def parse_device_setting(value: str) -> str | tuple[int, ...]:
    """Parse the setting ``SKUGGA_EGL_DEVICE``: ``auto``, ``software`` or device numbers. Raises ``InputError``."""
    text = value.strip().lower() or AUTO_DEVICE
    if text in (AUTO_DEVICE, SOFTWARE_DEVICE):
        return text
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isascii() and part.isdigit() for part in parts):
        raise InputError(EGL_DEVICE_VARIABLE, value, EGL_DEVICE_VALUES)
    return tuple(map(int, parts))


def candidate_devices(value: str, devices: Sequence[EglDevice], process_number: int, probe: DeviceProbe) -> list[EglDevice]:
    """Return the devices that a process tries in order, until one creates a context.

    - ``auto`` prefers graphics cards. Processes are distributed (round robin by ``process_number``) over the cards that have the
      same renderer and version as the first working one. The reason: pictures of different drivers differ, and a service measures
      the speed of one device only.
    - ``software`` means Mesa's software rasteriser.
    - Device numbers are distributed round robin in the order of the setting; each process tries one device only.

    Parameters
    ----------
    value
        The setting.
    devices
        EGL's device list.
    process_number
        The number of this process.
    probe
        Function that probes a device by its number.

    Raises
    ------
    InputError
        If a device does not exist.
    GraphicsError
        If devices named together differ in renderer or version.
    """
    setting = parse_device_setting(value)
    if setting == AUTO_DEVICE:
        cards = [device for device in devices if not device.is_software]
        return [*_round_robin(cards, process_number, probe), *(device for device in devices if device.is_software)]
    if setting == SOFTWARE_DEVICE:
        software_devices = [device for device in devices if device.is_software]
        if not software_devices:
            raise _no_such_device_error(value, devices)
        return software_devices
    assert not isinstance(setting, str)
    if max(setting) >= len(devices):
        raise _no_such_device_error(value, devices)
    chosen = setting[process_number % len(setting)]
    if chosen != setting[0]:
        first, chosen_kind = probe(setting[0]), probe(chosen)
        if not first.fault and not chosen_kind.fault and first != chosen_kind:
            raise GraphicsError(
                f"{EGL_DEVICE_VARIABLE}: '{value}' names devices of two kinds, which draw different pictures: {setting[0]} is "
                f"{first.renderer}, {first.version}; {chosen} is {chosen_kind.renderer}, {chosen_kind.version}. Name "
                f"devices of one kind."
            )
    return [devices[chosen]]


def _round_robin(cards: list[EglDevice], process_number: int, probe: DeviceProbe) -> list[EglDevice]:
    """Return the graphics cards in the order in which the process with number ``process_number`` tries them.

    The first process tries all cards. Others try the cards with the same renderer and version as the first working one.
    """
    if not process_number or len(cards) < 2:
        return cards
    kinds = {card: probe(card.index) for card in cards}
    drawing = [card for card in cards if not kinds[card].fault]
    equal = [card for card in drawing if kinds[card] == kinds[drawing[0]]]
    return equal[process_number % len(equal) :] + equal[: process_number % len(equal)] if equal else []


def _no_such_device_error(value: str, devices: Sequence[EglDevice]) -> InputError:
    """Return the error of the setting ``value``, which names a device that EGL does not list."""
    listing = ", ".join(map(str, devices))
    return InputError(
        EGL_DEVICE_VARIABLE,
        Problem(f"'{value}' names a device that does not exist"),
        f"Allowed: {EGL_DEVICE_VALUES}. Devices: {listing}",
    )


def open_context() -> tuple[moderngl.Context, EglDevice]:
    """Create a context on the device that the setting selects, and make it current in this thread.

    Raises
    ------
    NoOpenGLError
        If no device creates a context (setting ``auto``).
    GraphicsError
        If a device that the setting names creates none.
    InputError
        If the setting is wrong.
    """
    value = os.environ.get(EGL_DEVICE_VARIABLE, AUTO_DEVICE)
    setting, devices = parse_device_setting(value), egl_devices()
    faults = []
    for device in candidate_devices(value, devices, _process_number, probe_device):
        try:
            context = create_egl_context(device.index)
        except Exception as error:  # glcontext raises bare exceptions of several kinds
            faults.append(f"device {device}: {' '.join(str(error).split())}")
            continue
        if faults:
            log.warning("EGL: %s. Device %s is used instead.", "; ".join(faults), device)
        return context, device
    if setting != AUTO_DEVICE:
        raise GraphicsError(
            f"{EGL_DEVICE_VARIABLE}: '{value}' gives no OpenGL 4.3 context: {'; '.join(faults)}. "
            f"Name another device, or use {AUTO_DEVICE}."
        )
    raise no_opengl_error("; ".join(faults))


def create_egl_context(index: int) -> moderngl.Context:
    """Create a context of one device, current in this thread. Raises glcontext's exceptions, which are of several types."""
    import moderngl

    settings: dict[str, Any] = {"backend": "egl", "libgl": LIBGL, "libegl": LIBEGL, "device_index": index}
    with _unset_variable(_GLCONTEXT_VARIABLE):  # glcontext prefers this variable to its argument; Skugga has one setting
        return moderngl.create_context(standalone=True, require=OPENGL_VERSION, **settings)


@contextmanager
def _unset_variable(variable: str) -> Iterator[None]:
    """Remove an environment variable within the block."""
    value = os.environ.pop(variable, None)
    try:
        yield
    finally:
        if value is not None:
            os.environ[variable] = value


def probe_device(index: int) -> ProbedDevice:
    """Probe a device in a subprocess, which takes a fraction of a second."""
    code = f"from skugga.terrain.gl.egl_devices import print_probe_result; print_probe_result({index})"
    try:
        process = subprocess.run(
            [sys.executable, "-c", code], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S
        )
        return ProbedDevice(**json.loads(process.stdout))
    except subprocess.TimeoutExpired:
        return ProbedDevice(fault=f"no answer within {PROBE_TIMEOUT_S:g} s")
    except (OSError, ValueError, TypeError):
        return ProbedDevice(fault="its driver ended the probe process")


def print_probe_result(index: int) -> None:
    """Print the probe of a device as JSON: the main function of the subprocess."""
    try:
        context = create_egl_context(index)
    except Exception as error:
        answer = {"fault": " ".join(str(error).split())}
    else:
        answer = {"renderer": context.info["GL_RENDERER"], "version": context.info["GL_VERSION"]}
    print(json.dumps(answer))
