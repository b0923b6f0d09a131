"""The check of a machine with a graphics card: what is packed, how OpenGL is found, and what is reported."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import struct
import subprocess
import sys
import tarfile
import time
import zipfile
from pathlib import Path

import pytest

from scripts import gpu_pack
from scripts.gpu_check import (
    ARCHIVE,
    MANIFEST,
    MINUTES,
    ROOT,
    TAIL_LINES,
    CheckError,
    Recorder,
    check,
    choose_opengl,
    describe_tests,
    describe_versions,
    last_json,
    last_lines,
    opengl_environments,
    report_page,
    run_command,
)
from scripts.gpu_pack import (
    PACKAGES,
    USUALLY_PROVIDED,
    VECTOR_PACKAGE,
    compress,
    is_loadable,
    is_needed,
    needed_libraries,
    pinned_versions,
    slim_wheel,
    strip_library,
)
from skugga.api.cli.graphics_card import NVIDIA_LIBRARY, NVIDIA_VENDOR, NVIDIA_VENDOR_FILE, CardPlaces

SCRIPT = ROOT / "scripts" / "gpu_check.sh"
LOCK = """# comment
numpy==2.4.6 ; python_full_version < '3.12'
numpy==2.5.5 ; python_full_version >= '3.12'
PyOpenGL==3.1.10
colorama==0.4.6 ; sys_platform == 'win32'
"""


def empty_report() -> dict:
    """Return a report without steps."""
    return {"commit": "abc1234", "started": "2026-11-28 12:00 UTC", "python": "3.12.3", "cores": 16, "cards": [], "steps": []}


# What is packed.


def test_versions_are_those_of_the_target_s_python():
    assert pinned_versions(LOCK, "3.12") == {"numpy": "2.5.5", "pyopengl": "3.1.10"}
    assert pinned_versions(LOCK, "3.11")["numpy"] == "2.4.6"


def test_every_packed_package_is_locked():
    locked = pinned_versions((ROOT / "requirements.lock").read_text(encoding="utf-8"), "3.12")
    assert {*PACKAGES, VECTOR_PACKAGE} <= set(locked) and set(USUALLY_PROVIDED) <= set(PACKAGES)


@pytest.mark.parametrize(
    ("package", "name", "needed"),
    [
        ("numpy", "numpy/core.py", True),
        ("numpy", "numpy/linalg/tests/test_linalg.py", False),
        ("numpy", "numpy/testing/utils.py", True),
        ("pvlib", "pvlib/data/tmy.csv", False),
        ("pvlib", "pvlib/spa.py", True),
        ("matplotlib", "matplotlib/pyplot.py", False),
        ("matplotlib", "matplotlib/mpl-data/sample_data/jacksboro_fault_dem.npz", True),
        ("matplotlib", "matplotlib-3.11.2.dist-info/METADATA", True),
    ],
)
def test_files_that_no_check_reads_are_dropped(package, name, needed):
    assert is_needed(package, name) is needed


def make_wheel(folder: Path) -> Path:
    """Write a wheel with a module, a test of it, and a program."""
    wheel = folder / "hills-1.0-py3-none-any.whl"
    files = {
        "hills/__init__.py": "HEIGHT_M = 7\n",
        "hills/tests/__init__.py": "",
        "hills-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: hills\nVersion: 1.0\n",
        "hills-1.0.dist-info/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    record = "".join(f"{name},,\n" for name in [*files, "hills-1.0.dist-info/RECORD"])
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in {**files, "hills-1.0.dist-info/RECORD": record}.items():
            archive.writestr(name, text)
    return wheel


def test_a_slim_wheel_lists_and_installs_its_own_files(tmp_path):
    (tmp_path / "slim").mkdir()
    slim = tmp_path / "slim" / "hills-1.0-py3-none-any.whl"
    slim_wheel(make_wheel(tmp_path), slim)
    with zipfile.ZipFile(slim) as archive:
        assert {info.compress_type for info in archive.infolist()} == {zipfile.ZIP_STORED}
        names = set(archive.namelist())
        record = {line.split(",")[0] for line in archive.read("hills-1.0.dist-info/RECORD").decode().splitlines()}
    assert names == record and "hills/__init__.py" in names and "hills/tests/__init__.py" not in names
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-index", "--no-deps", "--target", str(tmp_path / "site"), str(slim)]
    assert subprocess.run(pip, capture_output=True, check=False).returncode == 0
    assert (tmp_path / "site" / "hills" / "__init__.py").is_file()


def test_a_stripped_library_keeps_what_it_exports(tmp_path, monkeypatch):
    source, library = tmp_path / "a.c", tmp_path / "a.so"
    source.write_text("static int seven(void) { return 7; }\nint height(void) { return seven(); }\n")
    for tool in ("gcc", "strip"):
        if shutil.which(tool) is None:
            pytest.skip(f"no {tool}")
    subprocess.run(["gcc", "-g", "-shared", "-fPIC", "-o", library, source], check=True)
    content = library.read_bytes()
    library.with_name("b.so").write_bytes(strip_library(content))
    assert library.with_name("b.so").stat().st_size < len(content)
    assert ctypes.CDLL(str(library.with_name("b.so"))).height() == 7
    assert strip_library(b"no library") == b"no library"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert strip_library(content) == content


def elf_library(address: int) -> bytes:
    """Return the headers of a shared library with one segment at offset 0x1000, which is loaded at an address."""
    header = struct.pack("<16sHHIQQQIHHHHHH", b"\x7fELF\x02\x01\x01", 3, 62, 1, 0, 64, 0, 0, 64, 56, 1, 64, 0, 0)
    return header + struct.pack("<IIQQQQQQ", 1, 5, 0x1000, address, address, 64, 64, 0x1000)


def test_a_library_that_stripping_breaks_is_packed_as_it_is(monkeypatch):
    assert is_loadable(elf_library(0x5000)) and not is_loadable(elf_library(0x5010))

    def strip(command, **options):
        Path(command[-1]).write_bytes(broken)
        return subprocess.CompletedProcess(command, 0)

    broken = elf_library(0x5010)
    monkeypatch.setattr(gpu_pack.subprocess, "run", strip)
    assert strip_library(elf_library(0x5000)) == elf_library(0x5000)
    broken = elf_library(0x6000)
    assert strip_library(elf_library(0x5000)) == broken


def test_libraries_come_with_those_that_they_need():
    needs = {"libEGL.so.1": ["libGLdispatch.so.0", "libc.so.6"], "libGLdispatch.so.0": ["libc.so.6", "ld-linux-x86-64.so.2"]}
    libraries = needed_libraries(["libEGL.so.1"], lambda name: Path("/lib", name), lambda path: needs[path.name])
    assert [library.name for library in libraries] == ["libEGL.so.1", "libGLdispatch.so.0"]
    with pytest.raises(CheckError, match=r"libEGL.so.1: not found .* apt-get install libegl1"):
        needed_libraries(["libEGL.so.1"], lambda name: None, lambda path: [])


def test_an_archive_is_read_back(tmp_path):
    (tmp_path / "content" / "wheels").mkdir(parents=True)
    code = bytes(range(256)) * 400 + b"\xe8\x10\x00\x00\x00" * 1000  # calls, which the filter for machine code rewrites
    (tmp_path / "content" / "wheels" / "a.whl").write_bytes(code)
    compress(tmp_path / "content", tmp_path / ARCHIVE, 0)
    with tarfile.open(tmp_path / ARCHIVE) as archive:
        archive.extractall(tmp_path / "back", filter="data")
    assert (tmp_path / "back" / "wheels" / "a.whl").read_bytes() == code
    assert (tmp_path / ARCHIVE).stat().st_size < len(code) / 4


def pack_small_folder(monkeypatch, tmp_path: Path, max_mib: float = 64.0, provided: tuple[str, ...] = ()) -> str:
    """Pack a folder with one small wheel in place of all."""
    monkeypatch.setattr(gpu_pack, "needed_libraries", lambda *arguments: [])
    monkeypatch.setattr(gpu_pack, "_library_finder", lambda: None)

    def download_wheels(versions: dict[str, str], folder: Path) -> list[Path]:
        folder.mkdir()
        return [make_wheel(folder)]

    monkeypatch.setattr(gpu_pack, "download_wheels", download_wheels)
    return gpu_pack.pack(tmp_path / "folder", provided, False, max_mib, 0)


def test_the_manifest_says_what_is_packed_and_what_is_left_out(monkeypatch, tmp_path):
    assert "Left to the other machine's Python: numpy, scipy." in pack_small_folder(
        monkeypatch, tmp_path, provided=("numpy", "scipy")
    )
    manifest = json.loads((tmp_path / "folder" / MANIFEST).read_text())
    assert set(manifest["provided"]) == {"numpy", "scipy"} and set(manifest["packed"]) == set(PACKAGES) - {"numpy", "scipy"}


def test_a_folder_that_is_too_big_is_an_error(monkeypatch, tmp_path):
    with pytest.raises(CheckError, match=r"more than --max-mib 0.001: name packages .* --provided"):
        pack_small_folder(monkeypatch, tmp_path, 0.001)
    with pytest.raises(CheckError, match=r"--provided cupy: not a package of the checks"):
        pack_small_folder(monkeypatch, tmp_path, provided=("cupy",))


# How OpenGL is found.


@pytest.fixture
def places(tmp_path: Path) -> CardPlaces:
    """Return the places of a machine without a driver."""
    for name in ("standard", "own", "vendor", "extra"):
        (tmp_path / name).mkdir()
    return CardPlaces(
        tmp_path / "proc", tmp_path / "dev", "/none", (tmp_path / "standard", tmp_path / "own"),
        (tmp_path / "vendor",), (tmp_path / "extra",),
    )  # fmt: skip


def test_the_machine_s_libraries_are_tried_before_packed_ones(places, tmp_path):
    libraries = tmp_path / "packed"
    own, with_vendor_file, packed = (variables for _, variables in opengl_environments(libraries, places, {}))
    vendor_file = {"__EGL_VENDOR_LIBRARY_FILENAMES": str(libraries / NVIDIA_VENDOR_FILE)}
    assert own == {} and with_vendor_file == vendor_file
    assert packed == {**vendor_file, "LD_LIBRARY_PATH": str(libraries)}


def test_the_driver_s_own_folder_is_searched_after_the_packed_one(places, tmp_path, monkeypatch):
    (tmp_path / "own" / NVIDIA_LIBRARY).touch()
    (tmp_path / "extra" / "10_nvidia.json").write_text(json.dumps(NVIDIA_VENDOR))
    environments = opengl_environments(tmp_path / "packed", places, {"LD_LIBRARY_PATH": "/opt/a:"})
    _, with_vendor_file, packed = (variables for _, variables in environments)
    assert with_vendor_file["LD_LIBRARY_PATH"] == f"{tmp_path / 'own'}:/opt/a"
    assert packed["LD_LIBRARY_PATH"] == f"{tmp_path / 'packed'}:{tmp_path / 'own'}:/opt/a"
    assert with_vendor_file["__EGL_VENDOR_LIBRARY_FILENAMES"] == str(tmp_path / "extra" / "10_nvidia.json"), "the driver's own file"
    (tmp_path / "standard" / NVIDIA_LIBRARY).touch()
    monkeypatch.setattr("scripts.gpu_check.STANDARD_LIBRARY_FOLDERS", (tmp_path / "standard",))
    assert opengl_environments(tmp_path / "packed", places, {})[2][1]["LD_LIBRARY_PATH"] == str(tmp_path / "packed")


CARD = {"renderer": "NVIDIA H200/PCIe/SSE2", "is_software": False}
SOFTWARE = {"renderer": "llvmpipe (LLVM 15.0.6, 256 bits)", "is_software": True}
ERROR = {"error": "no OpenGL 4.3 context"}


@pytest.mark.parametrize("allow_software", [False, True])
def test_a_card_is_chosen_before_software(allow_software):
    assert choose_opengl([ERROR, SOFTWARE, CARD], allow_software) is CARD


def test_software_is_a_failure_unless_it_is_allowed():
    assert choose_opengl([ERROR, SOFTWARE], True) is SOFTWARE
    with pytest.raises(CheckError, match="llvmpipe .* draws instead of a card"):
        choose_opengl([ERROR, SOFTWARE], False)
    with pytest.raises(CheckError, match="draws with nothing: no OpenGL 4.3 context"):
        choose_opengl([ERROR], True)


# What is reported.


def test_a_command_is_ended_at_its_limit_with_its_processes(tmp_path):
    pid_file = tmp_path / "pid"
    start = time.monotonic()
    outcome = run_command(["sh", "-c", f"echo begun; sleep 60 & echo $! > {pid_file}; wait"], os.environ, 1.0)
    assert outcome.status is None and outcome.output == "begun\n" and time.monotonic() - start < 30
    state = Path(f"/proc/{pid_file.read_text().strip()}/stat")
    end = time.monotonic() + 20
    while state.exists() and state.read_text().split()[2] != "Z":
        assert time.monotonic() < end, "the process that it started has ended, too"
        time.sleep(0.05)


@pytest.fixture
def recorder(tmp_path: Path) -> Recorder:
    """Return a recorder without steps, with a minute left."""
    return Recorder(tmp_path, MINUTES, time.monotonic() + 60, empty_report())


def test_a_failed_step_is_recorded_with_its_last_lines(recorder, tmp_path):
    code = "for number in range(99): print('line', number)\nraise SystemExit(3)"
    recorder.run("noise", [sys.executable, "-c", code], os.environ, 30)
    (step,) = json.loads((tmp_path / "report.json").read_text())["steps"]
    assert not step["ok"] and step["tail"] == [f"line {number}" for number in range(99 - TAIL_LINES, 99)]
    page = (tmp_path / "report.md").read_text()
    assert "0 of 1 steps passed" in page and "line 98" in page and not recorder.is_ok


def test_a_passed_step_is_recorded_without_its_output(recorder, tmp_path):
    recorder.run("true", [sys.executable, "-c", "print(7)"], os.environ, 30, lambda outcome: outcome.output.strip())
    (step,) = json.loads((tmp_path / "report.json").read_text())["steps"]
    assert step["ok"] and step["detail"] == "7" and step["tail"] == []


def test_steps_share_the_time_that_is_left(recorder):
    recorder.deadline = time.monotonic() + 1.0
    recorder.run("slow", ["sleep", "60"], os.environ, 50)
    assert recorder.report["steps"][0]["detail"] == "ended at its limit of 1 s"


def test_limits_of_steps_are_in_proportion_to_that_of_all(recorder):
    recorder.minutes = MINUTES / 50
    recorder.run("slow", ["sleep", "60"], os.environ, 50)
    assert recorder.report["steps"][0]["detail"] == "ended at its limit of 1 s"


def test_a_warm_up_may_be_ended_at_its_limit(recorder):
    recorder.run("warm-up", ["sleep", "60"], os.environ, 0.2, may_end_early=True)
    recorder.run("warm-up that fails", ["false"], os.environ, 30, may_end_early=True)
    assert [step["ok"] for step in recorder.report["steps"]] == [True, False]


def test_remarks_at_the_exit_do_not_hide_the_last_lines():
    output = "Traceback\nValueError: 7\n" + 50 * "Error in sys.excepthook:\n\nOriginal exception was:\n"
    assert last_lines(output) == ["Traceback", "ValueError: 7"]


def test_a_description_may_make_a_step_a_failed_one(recorder):
    recorder.run("json", ["echo", "no json"], os.environ, 30, lambda outcome: str(last_json(outcome.output)))
    assert recorder.report["steps"][0]["detail"] == "no json" and not recorder.is_ok


def test_missing_packages_are_named():
    manifest = {"packed": {"moderngl": "5.13.0"}, "provided": {"numpy": "2.5.5"}}
    assert describe_versions({"moderngl": "5.13.0", "numpy": "2.5.5"}, manifest) == "2 packages; all as locked"
    assert describe_versions({"numpy": "2.5.2"}, manifest) == "1 packages; numpy 2.5.2 (locked: 2.5.5)"
    with pytest.raises(CheckError, match="missing: numpy. Pack the folder without them in --provided"):
        describe_versions({"moderngl": "5.13.0", "numpy": None}, manifest)


def test_failed_tests_are_named(tmp_path):
    junit = tmp_path / "junit.xml"
    junit.write_text(
        '<testsuites><testsuite><testcase name="a"/><testcase name="b"><skipped/></testcase>'
        '<testcase name="c[1]"><failure message="x"/></testcase><testcase name="d"><error/></testcase></testsuite></testsuites>'
    )
    assert describe_tests(junit) == "1 passed, 1 skipped, 2 failed: c[1], d. The first: x"
    assert describe_tests(tmp_path / "none.xml") == "no results"


def test_the_page_has_renderer_steps_and_tables():
    report = empty_report() | {
        "opengl": {
            "renderer": "H200",
            "version": "4.6",
            "device": "0",
            "libraries": "the packed loader",
            "environment": {"A": "b"},
        },
        "steps": [{"name": "pictures", "ok": True, "detail": "a | b", "seconds": 61.04, "tail": []}],
        "tables": {"benchmarks.frames": "| picture |\n| --- |\n"},
    }
    page = report_page(report)
    assert page.startswith("# GPU check: H200\n") and "1 of 1 steps passed. Commit abc1234" in page
    assert "Environment: `A=b`" in page and "| pictures | passed | 61.0 | a \\| b |" in page
    assert "## benchmarks.frames\n\n| picture |" in page
    assert "# GPU check: no OpenGL" in report_page(empty_report())


def test_a_folder_that_was_not_packed_is_one_line(tmp_path):
    with pytest.raises(CheckError, match=r"manifest.json: .* Write the folder with scripts/gpu_check.sh pack"):
        check(tmp_path, tmp_path / "out", False, 1)
    (tmp_path / MANIFEST).write_text(json.dumps({"python": "2.7"}))
    with pytest.raises(CheckError, match=r"the wheels are for 2.7. Name such a Python with PYTHON="):
        check(tmp_path, tmp_path / "out", False, 1)
    assert not (tmp_path / "out").exists()


def test_a_broken_archive_is_recorded(tmp_path):
    version = f"{sys.version_info[0]}.{sys.version_info[1]}"
    (tmp_path / MANIFEST).write_text(json.dumps({"python": version, "commit": "abc", "packed": {}, "provided": {}}))
    (tmp_path / ARCHIVE).write_bytes(b"\xfd7zXZ\x00 not an archive")
    assert check(tmp_path, tmp_path / "out", False, 1) is False
    (step,) = json.loads((tmp_path / "out" / "report.json").read_text())["steps"]
    assert step["name"] == "unpack" and ARCHIVE in step["detail"]


def test_the_shell_script_explains_itself():
    run = subprocess.run([SCRIPT], capture_output=True, text=True, check=False)
    assert run.returncode == 2 and "gpu_check.sh pack FOLDER" in run.stderr and "gpu_check.sh run FOLDER OUT" in run.stderr
    run = subprocess.run(
        [SCRIPT, "run", "/none", "/none"], env={**os.environ, "PYTHON": sys.executable}, capture_output=True, text=True, check=False
    )
    assert run.returncode == 2 and run.stderr.startswith("gpu_check: /none/manifest.json") and run.stderr.count("\n") == 1
