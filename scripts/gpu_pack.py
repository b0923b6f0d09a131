"""Pack what ``gpu_check.py run`` needs on a machine without internet: wheels, and libglvnd's OpenGL loader.

The archive is compressed as a whole, with a filter for machine code: two thirds of the wheels' own size. It has some 30 MiB (47
wheels), and takes 3.6 minutes of a core to compress; with ``--provided ''`` and ``--preset 0`` it has 125 MiB. What no check reads
is left out: the HTTP service, Embree, tests of packages and debug symbols. Without ``VECTOR_PACKAGE`` (32 MiB), which
``--with-vectors`` packs, ``benchmarks.frames`` draws a street instead of the SpatialAce level.

On the other machine loops are compiled first, on all cores: those of the stored pictures need 200 seconds of one core.
``NUMBA_CACHE_DIR`` keeps them for a second run.
"""

from __future__ import annotations

import argparse
import json
import lzma
import struct
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from scripts.gpu_check import ARCHIVE, LIBRARIES_FOLDER, MANIFEST, ROOT, TARGET_PYTHON, WHEELS_FOLDER, CheckError
from skugga.api.cli.graphics_card import NVIDIA_VENDOR, NVIDIA_VENDOR_FILE

PACKAGES: tuple[str, ...] = (
    "moderngl", "glcontext", "pyopengl", "numpy", "scipy", "numba", "llvmlite", "pillow", "rasterio", "affine", "attrs",
    "certifi", "click", "pyproj", "shapely", "mapbox-earcut", "trimesh", "pydantic", "pydantic-core", "pydantic-settings",
    "annotated-types", "typing-extensions", "typing-inspection", "python-dotenv", "morecantile", "ruamel-yaml", "pvlib",
    "pandas", "python-dateutil", "pytz", "tzdata", "six", "h5py", "requests", "urllib3", "idna", "charset-normalizer",
    "matplotlib", "typer", "annotated-doc", "rich", "shellingham", "markdown-it-py", "mdurl", "pytest", "pytest-timeout",
    "pluggy", "iniconfig", "packaging", "pygments", "pyyaml", "hypothesis", "sortedcontainers",
)  # fmt: skip
"""Packages that the checks import, with their dependencies, as a run with these alone showed."""

VECTOR_PACKAGE = "pyogrio"
"""Package that reads the trees of the bundled levels. It has a GDAL of its own, which makes it the largest that is not provided."""

USUALLY_PROVIDED = ("numpy", "scipy", "numba", "llvmlite", "pillow", "pandas", "h5py")
"""Packages that a Python for scientific work has, and that would fill the folder: 140 of 245 MB of wheels."""

DROPPED_FILES = {"*": ("*/tests/*",), "pvlib": ("pvlib/data/*",)}
"""Files of wheels that no check reads, by package; ``*``: of all packages."""

KEPT_FILES = {"matplotlib": ("matplotlib/mpl-data/sample_data/jacksboro_fault_dem.npz",)}
"""The only files that checks read, beside the metadata, of packages that they do not import."""

GLIBC_MINORS = (17, 24, 26, 27, 28, 31, 34)
"""Minor versions of glibc 2 of the platform tags ``manylinux_2_N_x86_64`` that are accepted."""

LOADER_LIBRARIES = ("libEGL.so.1", "libGL.so.1", "libOpenGL.so.0")
"""Libraries of libglvnd, which load a driver; packed with those that they need."""

NVIDIA_NEEDS = ("libXext.so.6",)
"""Libraries that some of NVIDIA's drivers need beside the loader."""

SYSTEM_LIBRARIES = ("libc.so", "libm.so", "libdl.so", "libpthread.so", "librt.so", "ld-linux")
"""Libraries of glibc, which have to be those of the machine."""

ELF_LOADED_SEGMENT = 1

MAX_MIB = 64.0


def pinned_versions(lock: str, python: str) -> dict[str, str]:
    """Return the versions that a lock file pins for a version of Python on x86-64 Linux, by canonical name."""
    environment = {
        "python_version": python, "python_full_version": f"{python}.0", "sys_platform": "linux", "platform_machine": "x86_64",
        "platform_system": "Linux", "os_name": "posix", "implementation_name": "cpython",
        "platform_python_implementation": "CPython",
    }  # fmt: skip
    versions: dict[str, str] = {}
    for line in lock.splitlines():
        if line and not line.startswith("#"):
            requirement = Requirement(line)
            if requirement.marker is None or requirement.marker.evaluate(environment):
                (pin,) = requirement.specifier
                versions[canonicalize_name(requirement.name)] = pin.version
    return versions


def is_needed(package: str, name: str) -> bool:
    """Return whether checks need the file ``name`` of a package's wheel."""
    if package in KEPT_FILES:
        return ".dist-info/" in name or name in KEPT_FILES[package]
    patterns = (*DROPPED_FILES["*"], *DROPPED_FILES.get(package, ()))
    return not any(fnmatch(name, pattern) for pattern in patterns)


def is_loadable(library: bytes) -> bool:
    """Return whether the segments of a shared library (ELF, 64 bits) are aligned as the dynamic linker requires."""
    (offset,) = struct.unpack_from("<Q", library, 32)
    size, count = struct.unpack_from("<HH", library, 54)
    for number in range(count):
        start = offset + number * size
        kind, _, position, address = struct.unpack_from("<IIQQ", library, start)
        (alignment,) = struct.unpack_from("<Q", library, start + 48)
        if kind == ELF_LOADED_SEGMENT and (address - position) % max(alignment, 1):
            return False
    return True


def strip_library(content: bytes) -> bytes:
    """Return a shared library without its symbols for debuggers, a quarter of some wheels.

    It is unchanged without the tool ``strip``, or if that breaks it: libraries that were patched for wheels lose their alignment.
    """
    with tempfile.TemporaryDirectory() as name:
        path = Path(name, "library.so")
        path.write_bytes(content)
        try:
            run = subprocess.run(["strip", "--strip-unneeded", str(path)], capture_output=True, check=False)
        except OSError:
            return content
        stripped = path.read_bytes()
        return stripped if run.returncode == 0 and is_loadable(stripped) else content


def slim_wheel(wheel: Path, target: Path) -> None:
    """Write a copy of a wheel without files that no check reads, symbols for debuggers, and compression.

    Its list of files (``RECORD``) has the remaining ones, without digests.
    """
    package = canonicalize_name(wheel.name.split("-")[0])
    with zipfile.ZipFile(wheel) as source, zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as copy:
        for info in source.infolist():
            if info.is_dir() or not is_needed(package, info.filename):
                continue
            content = source.read(info)
            if info.filename.endswith(".dist-info/RECORD"):
                lines = content.decode().splitlines()
                rows = [line.rsplit(",", 2)[0] for line in lines]
                content = "".join(f"{name},,\n" for name in rows if is_needed(package, name.strip('"'))).encode()
            elif ".so" in Path(info.filename).name and content.startswith(b"\x7fELF"):
                content = strip_library(content)
            info.compress_type = zipfile.ZIP_STORED
            copy.writestr(info, content)


def needed_libraries(
    names: Iterable[str], find: Callable[[str], Path | None], needs: Callable[[Path], Iterable[str]]
) -> list[Path]:
    """Return the files of some libraries and of all that they need, without glibc's.

    ``find`` returns a library's file by its name, and ``needs`` the names that a file needs. Raises ``CheckError`` without one.
    """
    found: dict[str, Path] = {}
    waiting = list(names)
    while waiting:
        name = waiting.pop(0)
        if name in found or name.startswith(SYSTEM_LIBRARIES):
            continue
        path = find(name)
        if path is None:
            raise CheckError(f"{name}: not found on this machine. On Debian: apt-get install libegl1 libgl1 libopengl0 libxext6.")
        found[name] = path
        waiting += needs(path)
    return list(found.values())


def _library_finder() -> Callable[[str], Path | None]:
    """Return a function that returns a library's file, from the cache of the dynamic linker."""
    listing = _output(["ldconfig", "-p"])
    paths: dict[str, Path] = {}
    for line in listing.splitlines():
        name, _, path = line.strip().partition(" => ")
        if path and "x86-64" in name:
            paths.setdefault(name.split(" ")[0], Path(path))
    return paths.get


def _needed_names(path: Path) -> Iterator[str]:
    """Yield the names of the libraries that a library needs itself or through others."""
    for line in _output(["ldd", str(path)]).splitlines():
        if "=>" in line:
            yield line.split("=>")[0].strip()


def _output(command: Sequence[str]) -> str:
    """Return what a command prints. Raises ``CheckError`` with its last line if it fails or is missing."""
    try:
        run = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise CheckError(f"{command[0]}: {error.strerror}.") from None
    if run.returncode:
        raise CheckError(f"{' '.join(command[:4])} ...: {(run.stderr.strip() or run.stdout.strip()).rpartition(chr(10))[2]}")
    return run.stdout


def download_wheels(versions: dict[str, str], folder: Path) -> list[Path]:
    """Download wheels of some versions for the target's Python, and pip's; return their paths."""
    platforms = [f"manylinux_2_{minor}_x86_64" for minor in GLIBC_MINORS] + ["manylinux2014_x86_64", "manylinux1_x86_64"]
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "-q", "--no-deps", "--only-binary=:all:"]
    target = ["--python-version", TARGET_PYTHON, "--implementation", "cp"]
    target += [part for platform in platforms for part in ("--platform", platform)]
    _output([*pip, *target, "-d", str(folder), "pip", *(f"{name}=={version}" for name, version in versions.items())])
    return sorted(folder.glob("*.whl"))


def compress(folder: Path, archive: Path, preset: int) -> None:
    """Write an xz-compressed tar archive of a folder's content. Machine code is filtered first, since it compresses better then."""
    filters = [{"id": lzma.FILTER_X86}, {"id": lzma.FILTER_LZMA2, "preset": preset, "dict_size": 2**26}]
    with lzma.open(archive, "wb", filters=filters) as stream, tarfile.open(fileobj=stream, mode="w|") as tar:
        for path in sorted(folder.iterdir()):
            tar.add(path, path.name)


def pack(folder: Path, provided: Sequence[str], with_vectors: bool, max_mib: float, preset: int) -> str:
    """Write the archive and its manifest into a folder, and return a summary.

    Parameters
    ----------
    folder
        The folder to write, which is created.
    provided
        Packages that the other machine's Python has, and that are not packed.
    with_vectors
        Whether to pack what draws the bundled levels with trees.
    max_mib
        Maximum size of the folder, MiB.
    preset
        Effort of the compression, 0 to 9.

    Raises
    ------
    CheckError
        If a package of ``provided`` is unknown, a library or a wheel is missing, or the folder exceeds ``max_mib``.
    """
    if unknown := sorted(set(provided) - set(PACKAGES)):
        raise CheckError(f"--provided {unknown[0]}: not a package of the checks. Allowed: {', '.join(PACKAGES)}.")
    locked = pinned_versions((ROOT / "requirements.lock").read_text(encoding="utf-8"), TARGET_PYTHON)
    packages = [*PACKAGES, *[VECTOR_PACKAGE] * with_vectors]
    versions = {name: locked[name] for name in packages if name not in provided}
    libraries = needed_libraries((*LOADER_LIBRARIES, *NVIDIA_NEEDS), _library_finder(), _needed_names)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        downloads, content = Path(name, "downloads"), Path(name, "content")
        (content / WHEELS_FOLDER).mkdir(parents=True)
        (content / LIBRARIES_FOLDER).mkdir()
        wheels = download_wheels(versions, downloads)
        for wheel in wheels:
            slim_wheel(wheel, content / WHEELS_FOLDER / wheel.name)
        for library in libraries:
            (content / LIBRARIES_FOLDER / library.name).write_bytes(library.read_bytes())
        (content / LIBRARIES_FOLDER / NVIDIA_VENDOR_FILE).write_text(json.dumps(NVIDIA_VENDOR) + "\n", encoding="utf-8")
        compress(content, folder / ARCHIVE, preset)
        sizes = {wheel.name: wheel.stat().st_size for wheel in wheels}
    manifest = {
        "commit": _output(["git", "-C", str(ROOT), "describe", "--always", "--dirty"]).strip(),
        "python": TARGET_PYTHON,
        "packed": versions,
        "provided": {name: locked[name] for name in provided},
        "libraries": [library.name for library in libraries],
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    size_mib = sum(path.stat().st_size for path in folder.iterdir()) / 2**20
    largest_wheels = sorted(sizes, key=lambda name: -sizes[name])[:5]
    largest = ", ".join(f"{name.split('-')[0]} {sizes[name] / 2**20:.0f}" for name in largest_wheels)
    summary = (
        f"{folder}: {size_mib:.1f} MiB, {len(wheels)} wheels, {len(libraries)} libraries. Left to the other machine's Python: "
        f"{', '.join(provided) or 'nothing'}. Largest wheels (MiB, before the archive): {largest}."
    )
    if size_mib > max_mib:
        raise CheckError(f"{summary} That is more than --max-mib {max_mib:g}: name packages that it has with --provided.")
    return summary


def main(arguments: Sequence[str] | None = None) -> int:
    """Pack the folder that the command line names, and return the exit status."""
    parser = argparse.ArgumentParser(prog="gpu_check.sh pack", description="Pack what 'gpu_check.sh run' needs without internet.")
    parser.add_argument("folder", type=Path, help="the folder to write")
    parser.add_argument(
        "--provided",
        default=",".join(USUALLY_PROVIDED),
        help="packages that the other machine's Python has, separated by commas; '' packs all (default: %(default)s)",
    )
    parser.add_argument("--with-vectors", action="store_true", help="pack also what draws levels with trees, a wheel of 32 MiB")
    parser.add_argument("--max-mib", type=float, default=MAX_MIB, help="maximum size of the folder; default %(default)g")
    parser.add_argument("--preset", type=int, choices=range(10), default=6, help="effort of the compression; default %(default)s")
    values = parser.parse_args(arguments)
    provided = [name.strip() for name in values.provided.split(",") if name.strip()]
    try:
        print(pack(values.folder, provided, values.with_vectors, values.max_mib, values.preset))
    except CheckError as error:
        parser.exit(1, f"gpu_check: {error}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
