"""Graphics cards of this machine, and what keeps OpenGL from drawing with them.

EGL is a loader (libglvnd). It reads vendor files, JSON files that each name the library of one driver. So a card draws only if its
device files can be opened, its driver has an EGL library, and a vendor file names that library. Containers often lack one of these.
EGL does not report that: it lists Mesa's software rasteriser alone.

The module imports only the standard library, so ``scripts/gpu_check.py`` can use it on a machine without packages.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from skugga.terrain.gl.egl_devices import LIBEGL

NVIDIA_LIBRARY = "libEGL_nvidia.so.0"
"""EGL library of NVIDIA's driver."""

NVIDIA_VENDOR_FILE = "10_nvidia.json"
NVIDIA_VENDOR = {"file_format_version": "1.0.0", "ICD": {"library_path": NVIDIA_LIBRARY}}
"""Name and content of the vendor file that NVIDIA's driver installs."""

VENDOR_FILES_VARIABLE, VENDOR_FOLDERS_VARIABLE = "__EGL_VENDOR_LIBRARY_FILENAMES", "__EGL_VENDOR_LIBRARY_DIRS"
"""Variables that replace libglvnd's vendor files, and its folders of them."""

NVIDIA_SMI_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class CardPlaces:
    """Places that show the graphics cards of a machine and their drivers.

    Attributes
    ----------
    proc
        Folder of NVIDIA's kernel driver.
    dev
        Folder of device files.
    nvidia_smi
        The command ``nvidia-smi``, or a path to it.
    library_folders
        Folders in which NVIDIA's libraries are looked up.
    vendor_folders
        Folders in which EGL looks up vendor files.
    extra_vendor_folders
        Folders of vendor files in which EGL does not look, but containers of some platforms have them.
    """

    proc: Path = Path("/proc/driver/nvidia")
    dev: Path = Path("/dev")
    nvidia_smi: str = "nvidia-smi"
    library_folders: tuple[Path, ...] = (
        Path("/usr/lib/x86_64-linux-gnu"),
        Path("/usr/lib/aarch64-linux-gnu"),
        Path("/usr/lib64"),
        Path("/usr/lib"),
        Path("/usr/lib/x86_64-linux-gnu/nvidia/current"),
        Path("/usr/local/nvidia/lib64"),
        Path("/usr/local/nvidia/lib"),
        Path("/run/opengl-driver/lib"),
    )
    vendor_folders: tuple[Path, ...] = (Path("/etc/glvnd/egl_vendor.d"), Path("/usr/share/glvnd/egl_vendor.d"))
    extra_vendor_folders: tuple[Path, ...] = (
        Path("/usr/local/nvidia/share/glvnd/egl_vendor.d"),
        Path("/run/opengl-driver/share/glvnd/egl_vendor.d"),
    )


@dataclass(frozen=True)
class Card:
    """A graphics card.

    Attributes
    ----------
    name
        Its model, or the name of its device file.
    is_nvidia
        Whether NVIDIA's driver is loaded for it. Cards of others are known only as render nodes (``/dev/dri/renderD*``), which
        virtual displays without 3D have, too.
    node
        Its device file; ``None`` if there is none.
    """

    name: str
    is_nvidia: bool
    node: Path | None


def find_cards(places: CardPlaces) -> list[Card]:
    """Return the graphics cards of a machine: NVIDIA's cards if there are any, else the render nodes of others."""
    nodes = sorted(places.dev.glob("nvidia[0-9]*"))
    models = _kernel_models(places.proc) or (_smi_models(places.nvidia_smi) if nodes else [])
    if nodes or models:
        count = max(len(nodes), len(models))
        return [
            Card(
                models[index] if index < len(models) else f"NVIDIA card {nodes[index].name}",
                True,
                nodes[index] if index < len(nodes) else None,
            )
            for index in range(count)
        ]
    return [Card(f"graphics card {node.name}", False, node) for node in sorted((places.dev / "dri").glob("renderD*"))]


def _kernel_models(proc: Path) -> list[str]:
    """Return the models of the cards that NVIDIA's kernel driver lists."""
    models = []
    for path in sorted(proc.glob("gpus/*/information")):
        try:
            lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError:
            continue
        models += [line.partition(":")[2].strip() for line in lines if line.startswith("Model:")]
    return models


def _smi_models(command: str) -> list[str]:
    """Return the models that ``nvidia-smi`` lists; empty if it fails or is missing."""
    query = [command, "--query-gpu=name", "--format=csv,noheader"]
    try:
        run = subprocess.run(query, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=NVIDIA_SMI_TIMEOUT_S)
    except (OSError, subprocess.TimeoutExpired):
        return []
    return [line.strip() for line in run.stdout.splitlines() if line.strip()] if run.returncode == 0 else []


def find_library_folder(name: str, folders: Iterable[Path]) -> Path | None:
    """Return the first of some folders that has the library ``name``."""
    return next((folder for folder in folders if (folder / name).is_file()), None)


def find_nvidia_vendor_file(folders: Iterable[Path]) -> Path | None:
    """Return the first vendor file of some folders that names NVIDIA's EGL library."""
    return next((path for folder in folders for path in sorted(folder.glob("*.json")) if names_nvidia(path)), None)


def names_nvidia(vendor_file: Path) -> bool:
    """Return whether a vendor file names NVIDIA's EGL library; false also if it cannot be read."""
    try:
        library = json.loads(vendor_file.read_text(encoding="utf-8"))["ICD"]["library_path"]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return Path(str(library)).name.startswith("libEGL_nvidia.so")


def can_load_library(name: str) -> bool:
    """Return whether the dynamic linker finds and loads a library."""
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def unused_card_reason(
    card: Card,
    places: CardPlaces,
    environment: Mapping[str, str],
    can_load: Callable[[str], bool] = can_load_library,
    faults: Sequence[str] = (),
) -> str:
    """Return what keeps OpenGL from drawing with a card, and the remedy, in two sentences.

    Parameters
    ----------
    card
        A card of ``find_cards``.
    places
        Places of this machine.
    environment
        Environment variables of the process that draws.
    can_load
        Function that returns whether a library can be loaded.
    faults
        Faults of the devices that EGL lists beside the software rasteriser.
    """
    if card.node is None:
        return (
            f"{places.dev} has no device file of it. Pass it to the container (docker run --gpus all), or load its driver "
            "(modprobe nvidia)."
        )
    if not os.access(card.node, os.R_OK | os.W_OK):
        return f"this user cannot open {card.node}. Add the user to the group of that file (ls -l {card.node})."
    if not can_load(LIBEGL):
        return f"{LIBEGL}, the loader of EGL drivers, is missing. On Debian: apt-get install libegl1 libgl1."
    if card.is_nvidia:
        missing = _missing_nvidia_part(places, environment, can_load)
        if missing:
            return missing
    if faults:
        return f"EGL gives no OpenGL 4.3 context on it ({'; '.join(faults)}). Update its driver."
    if card.is_nvidia:
        return "EGL does not list it. nvidia-smi says whether its driver works."
    return "Mesa has no driver for it. A virtual display has no 3D; for a card on Debian: apt-get install libgl1-mesa-dri."


def _missing_nvidia_part(places: CardPlaces, environment: Mapping[str, str], can_load: Callable[[str], bool]) -> str:
    """Return which part of NVIDIA's driver for EGL is missing, and the remedy; empty if none is."""
    if not can_load(NVIDIA_LIBRARY):
        folder = find_library_folder(NVIDIA_LIBRARY, places.library_folders)
        if folder is not None:
            return f"{folder / NVIDIA_LIBRARY}, its driver, cannot be loaded. Set LD_LIBRARY_PATH={folder}."
        return (
            f"{NVIDIA_LIBRARY}, the OpenGL part of its driver, is missing. In a container set "
            "NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility; elsewhere install libegl-nvidia0 (Debian) or "
            "libnvidia-gl-VERSION (Ubuntu)."
        )
    if files := _split_paths(environment.get(VENDOR_FILES_VARIABLE, "")):
        if any(map(names_nvidia, files)):
            return ""
        return f"{VENDOR_FILES_VARIABLE} names no file of NVIDIA's driver. Unset it, or add {NVIDIA_VENDOR_FILE}."
    folders = _split_paths(environment.get(VENDOR_FOLDERS_VARIABLE, "")) or places.vendor_folders
    if find_nvidia_vendor_file(folders) is not None:
        return ""
    if extra := find_nvidia_vendor_file(places.extra_vendor_folders):
        return f"EGL does not look for vendor files in {extra.parent}. Set {VENDOR_FILES_VARIABLE}={extra}."
    return f"no vendor file names {NVIDIA_LIBRARY}. Write {folders[-1] / NVIDIA_VENDOR_FILE}: {json.dumps(NVIDIA_VENDOR)}"


def _split_paths(value: str) -> list[Path]:
    """Return the paths of a variable in which colons separate them."""
    return [Path(part) for part in value.split(":") if part]
