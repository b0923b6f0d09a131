"""Check Skugga on a machine with a graphics card, without internet: pictures within their tolerance, and short benchmarks.

    scripts/gpu_check.sh run FOLDER OUT [--allow-software] [--minutes 9.5]

``scripts/gpu_pack.py`` writes ``FOLDER``. ``OUT`` gets ``report.json`` and ``report.md``, which are written after each step, and
``pictures.zip`` with the pictures that differ. A step that fails or exceeds its time limit is recorded with the last lines of its
output. If OpenGL does not draw with a card, the steps that draw are left out, unless software is allowed.

The script itself needs only the standard library: it makes the virtual environment that the steps run in.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from skugga.api.cli.graphics_card import (
    NVIDIA_LIBRARY,
    NVIDIA_VENDOR_FILE,
    VENDOR_FILES_VARIABLE,
    CardPlaces,
    find_cards,
    find_library_folder,
    find_nvidia_vendor_file,
)

ROOT = Path(__file__).resolve().parents[1]

TARGET_PYTHON = "3.12"
"""Version of Python whose wheels are packed."""

ARCHIVE, MANIFEST, WHEELS_FOLDER, LIBRARIES_FOLDER = "packed.tar.xz", "manifest.json", "wheels", "libraries"
"""Files of the folder, and folders of the archive."""

TAIL_LINES = 40
"""Last lines of a failed step's output that are reported."""

EXIT_REMARKS = ("Error in sys.excepthook:", "Original exception was:")

MINUTES = 9.5
"""Time limit of all steps, minutes: below ten with the time that the report takes. Limits of single steps are in proportion."""

STANDARD_LIBRARY_FOLDERS = tuple(map(Path, ("/lib", "/lib64", "/usr/lib", "/usr/lib64", "/usr/lib/x86_64-linux-gnu")))
"""Folders that the dynamic linker searches anyway."""

PROBE_CODE = """
import json
from skugga.terrain.gl.device import device
gl = device()
print(json.dumps({"renderer": gl.renderer, "version": gl.version, "device": str(gl.egl_device),
                  "is_software": gl.egl_device.is_software}))
"""
"""Code of the process that prints what OpenGL draws with."""

COMPILE_CODE = """
from skugga.terrain.compiling.ahead_of_time import MAPS, MAPS_OF_CASTERS, MASKS, PICTURES, VIEWS, compile_ahead
from skugga.terrain.cores import usable_cores
compile_ahead([VIEWS, MAPS_OF_CASTERS, MAPS, PICTURES, MASKS], usable_cores())
"""
"""Code of the process that compiles the loops of pictures, on all cores. Those that it leaves are compiled on their first call."""

VERSIONS_CODE = """
import importlib.metadata, json, sys
versions = {}
for name in json.loads(sys.argv[1]):
    try:
        versions[name] = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        versions[name] = None
print(json.dumps(versions))
"""
"""Code of the process that prints the versions of installed packages, ``null`` for a missing one."""

Report = dict[str, Any]
"""What ``report.json`` has: ``steps``, the machine, its OpenGL, and the figures of the benchmarks."""


class CheckError(Exception):
    """An error of the check, as one line for the user."""


@dataclass(frozen=True)
class Outcome:
    """How a command ended.

    Attributes
    ----------
    status
        Its exit status; ``None`` if it was ended at its time limit.
    seconds
        Time it took.
    output
        What it printed.
    """

    status: int | None
    seconds: float
    output: str


def run_command(command: Sequence[str], environment: Mapping[str, str], limit_s: float) -> Outcome:
    """Run a command in the repository's root, and end it and its processes at its time limit."""
    start = time.monotonic()
    with tempfile.TemporaryFile() as file:
        process = subprocess.Popen(
            command, cwd=ROOT, env=dict(environment), stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip
        try:
            status: int | None = process.wait(limit_s)
        except subprocess.TimeoutExpired:
            status = None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        file.seek(0)
        output = file.read().decode(errors="replace")
    return Outcome(status, time.monotonic() - start, output)


def last_lines(output: str) -> list[str]:
    """Return the last lines of an output, without empty ones and without Python's remarks on finalisers that fail at its exit."""
    lines = [line for line in output.splitlines() if line.strip() and line not in EXIT_REMARKS]
    return lines[-TAIL_LINES:]


@dataclass
class Recorder:
    """The report, which is written after each step.

    Attributes
    ----------
    out
        The folder of the report.
    minutes
        Time limit of all steps.
    deadline
        Time (``time.monotonic``) at which the last step has to end.
    report
        The report so far.
    """

    out: Path
    minutes: float
    deadline: float
    report: Report

    def run(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str],
        limit_s: float,
        describe: Callable[[Outcome], str] = lambda outcome: "",
        may_end_early: bool = False,
    ) -> Outcome:
        """Run a step within its time limit and the time that is left, record it, and return its outcome.

        ``limit_s`` is its limit if all steps have ``MINUTES``; with more or less time it is longer or shorter in proportion.
        ``describe`` returns a detail for the report. It may raise ``CheckError``, which makes the step a failed one. With
        ``may_end_early`` a step that is ended at its limit is no failure.
        """
        limit_s = min(limit_s * self.minutes / MINUTES, max(self.deadline - time.monotonic(), 1.0))
        outcome = run_command(command, environment, limit_s)
        try:
            detail = describe(outcome) if outcome.status is not None else f"ended at its limit of {limit_s:.0f} s"
            is_ok = outcome.status == 0 or (outcome.status is None and may_end_early)
        except CheckError as error:
            detail, is_ok = str(error), False
        self.add(name, is_ok, detail, outcome.seconds, [] if is_ok else last_lines(outcome.output))
        return outcome

    def add(self, name: str, is_ok: bool, detail: str, seconds: float = 0.0, tail: Sequence[str] = ()) -> None:
        """Record a step, write the report, and print a line."""
        step = {"name": name, "ok": is_ok, "detail": detail, "seconds": round(seconds, 1), "tail": list(tail)}
        self.report["steps"].append(step)
        self.write()
        print(f"{'ok    ' if is_ok else 'FAILED'}  {name}: {detail} ({seconds:.1f} s)", flush=True)

    def write(self) -> None:
        """Write the report as JSON and as a page."""
        (self.out / "report.json").write_text(json.dumps(self.report, indent=1) + "\n", encoding="utf-8")
        (self.out / "report.md").write_text(report_page(self.report), encoding="utf-8")

    @property
    def is_ok(self) -> bool:
        """Whether all steps so far have passed."""
        return all(step["ok"] for step in self.report["steps"])


def opengl_environments(libraries: Path, places: CardPlaces, environment: Mapping[str, str]) -> list[tuple[str, dict[str, str]]]:
    """Return the ways to load OpenGL in the order in which they are tried: a description, and variables of the environment.

    The machine's own libraries come first; then its loader with a vendor file that names NVIDIA's driver, which containers often
    lack; then the packed loader, which machines for computing lack.

    Parameters
    ----------
    libraries
        Folder of the packed loader, with a vendor file.
    places
        Places of the machine's driver.
    environment
        The machine's environment variables.
    """
    driver_folder = find_library_folder(NVIDIA_LIBRARY, places.library_folders)
    vendor_file = find_nvidia_vendor_file((*places.vendor_folders, *places.extra_vendor_folders)) or libraries / NVIDIA_VENDOR_FILE
    own_folders = [driver_folder] if driver_folder is not None and driver_folder not in STANDARD_LIBRARY_FOLDERS else []

    def variables(folders: Sequence[Path]) -> dict[str, str]:
        paths = [*map(str, folders), *filter(None, environment.get("LD_LIBRARY_PATH", "").split(":"))]
        return {VENDOR_FILES_VARIABLE: str(vendor_file)} | ({"LD_LIBRARY_PATH": ":".join(paths)} if paths else {})

    return [
        ("the machine's libraries", {}),
        ("the machine's loader with a vendor file", variables(own_folders)),
        ("the packed loader", variables([libraries, *own_folders])),
    ]


def choose_opengl(tried: Sequence[Report], allow_software: bool) -> Report:
    """Return the first of the tried ways that draws with a card; with ``allow_software`` else the first that draws.

    ``tried`` has the answers of ``PROBE_CODE`` or an ``error`` each. Raises ``CheckError`` without one.
    """
    answers = [answer for answer in tried if "renderer" in answer]
    for answer in answers:
        if not answer["is_software"]:
            return answer
    if answers and allow_software:
        return answers[0]
    if answers:
        raise CheckError(f"{answers[0]['renderer']} draws instead of a card. With --allow-software it is accepted.")
    raise CheckError(f"OpenGL draws with nothing: {'; '.join(answer['error'] for answer in tried)}")


def last_json(output: str) -> Report:
    """Return the JSON object on the last line of an output. Raises ``CheckError`` with that line without one."""
    line = (output.strip().splitlines() or [""])[-1]
    try:
        return dict(json.loads(line))
    except (ValueError, TypeError):
        raise CheckError(line or "no output") from None


def describe_versions(installed: Mapping[str, str | None], manifest: Report) -> str:
    """Return how the installed packages compare with the locked versions. Raises ``CheckError`` if some are missing."""
    if missing := [name for name, version in installed.items() if version is None]:
        raise CheckError(f"missing: {', '.join(missing)}. Pack the folder without them in --provided.")
    locked = {**manifest["packed"], **manifest["provided"]}
    others = [f"{name} {version} (locked: {locked[name]})" for name, version in installed.items() if version != locked[name]]
    return f"{len(installed)} packages; {', '.join(others) or 'all as locked'}"


def describe_tests(junit_file: Path) -> str:
    """Return the number of passed and skipped tests, the names of the failed ones and the first reason, from a JUnit file."""
    try:
        cases = list(ElementTree.parse(junit_file).iter("testcase"))
    except (OSError, ElementTree.ParseError):
        return "no results"
    names = {
        kind: [case.get("name", "") for case in cases if case.find(kind) is not None] for kind in ("failure", "error", "skipped")
    }
    failed = [*names["failure"], *names["error"]]
    passed = len(cases) - len(failed) - len(names["skipped"])
    text = f"{passed} passed, {len(names['skipped'])} skipped, {len(failed)} failed"
    messages = [element.get("message", "") for case in cases for kind in ("failure", "error") for element in case.iter(kind)]
    return f"{text}: {', '.join(failed)}. The first: {messages[0]}" if failed else text


def report_page(report: Report) -> str:
    """Return the report as a Markdown page."""
    steps, opengl = report["steps"], report.get("opengl", {})
    failed = [step for step in steps if not step["ok"]]
    lines = [
        f"# GPU check: {opengl.get('renderer', 'no OpenGL')}",
        "",
        f"{len(steps) - len(failed)} of {len(steps)} steps passed. Commit {report['commit']}, {report['started']}. "
        f"Python {report['python']}, {report['cores']} cores. Cards: {', '.join(report['cards']) or 'none found'}.",
        "",
    ]
    if opengl:
        variables = " ".join(f"{name}={value}" for name, value in opengl["environment"].items())
        lines += [f"OpenGL {opengl['version']}, device {opengl['device']}, by {opengl['libraries']}.", ""]
        lines += [f"Environment: `{variables}`", ""] * bool(variables)
    lines += ["| step | result | seconds | detail |", "| --- | --- | --- | --- |"]
    for step in steps:
        detail = " ".join(step["detail"].replace("|", "\\|").split())
        lines.append(f"| {step['name']} | {'passed' if step['ok'] else '**failed**'} | {step['seconds']:.1f} | {detail} |")
    for name, text in report.get("tables", {}).items():
        lines += ["", f"## {name}", "", text.strip()]
    for step in failed:
        if step["tail"]:
            tail = "\n".join(step["tail"]).replace("```", "'''")
            lines += ["", f"## Last lines of {step['name']}", "", "```", tail, "```"]
    return "\n".join(lines) + "\n"


def _install(recorder: Recorder, manifest: Report, folder: Path, work: Path, environment: Mapping[str, str]) -> Path | None:
    """Make a virtual environment with the packed wheels, and return its Python; ``None`` if that fails.

    Packages that are left to this machine come from the folders of the Python that runs this script. They are searched after the
    environment's own.
    """
    start = time.monotonic()
    try:
        with tarfile.open(folder / ARCHIVE) as tar:
            tar.extractall(work, filter="data")
    except (OSError, tarfile.TarError, EOFError) as error:
        recorder.add("unpack", False, f"{folder / ARCHIVE}: {error}")
        return None
    recorder.add("unpack", True, "", time.monotonic() - start)
    venv = work / "venv"
    outcome = recorder.run("virtual environment", [sys.executable, "-m", "venv", "--without-pip", str(venv)], environment, 60)
    if outcome.status != 0:
        return None
    paths = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")] if manifest["provided"] else []
    packages = venv / "lib" / f"python{platform.python_version().rpartition('.')[0]}" / "site-packages"
    (packages / "gpu_check.pth").write_text("".join(f"{path}\n" for path in [str(ROOT), *paths]), encoding="utf-8")
    python = venv / "bin" / "python"
    wheels = sorted((work / WHEELS_FOLDER).glob("*.whl"))
    pip = next(wheel for wheel in wheels if wheel.name.startswith("pip-"))
    install = [str(python), f"{pip}/pip", "install", "-q", "--no-index", "--no-deps", "--no-compile", "--no-cache-dir"]
    if recorder.run("install", [*install, *map(str, wheels)], environment, 120).status != 0:
        return None
    names = json.dumps([*manifest["packed"], *manifest["provided"]])

    def describe(outcome: Outcome) -> str:
        recorder.report["packages"] = last_json(outcome.output)
        return describe_versions(recorder.report["packages"], manifest)

    recorder.run("packages", [str(python), "-c", VERSIONS_CODE, names], environment, 30, describe)
    return python if recorder.is_ok else None


def _find_opengl(recorder: Recorder, python: Path, libraries: Path, environment: Mapping[str, str], allow_software: bool) -> bool:
    """Try the ways to load OpenGL, record the chosen one as ``opengl``, and return whether there is one."""
    start, tried = time.monotonic(), recorder.report["opengl_tried"]
    for description, variables in opengl_environments(libraries, CardPlaces(), environment):
        outcome = run_command([str(python), "-c", PROBE_CODE], {**environment, **variables}, 60)
        try:
            answer = last_json(outcome.output)
        except CheckError as error:
            answer = {"error": str(error)}
        tried.append({"libraries": description, "environment": variables, **answer})
        if answer.get("is_software") is False:
            break
    try:
        recorder.report["opengl"] = choose_opengl(tried, allow_software)
    except CheckError as error:
        recorder.add("OpenGL", False, str(error), time.monotonic() - start, [json.dumps(answer) for answer in tried])
        return False
    recorder.add("OpenGL", True, recorder.report["opengl"]["renderer"], time.monotonic() - start)
    return True


def _described_tests(junit_file: Path, outcome: Outcome) -> str:
    """Return the results of a run of tests, whose file of results is written at its end."""
    return describe_tests(junit_file)


def _draw(recorder: Recorder, python: Path, work: Path, environment: Mapping[str, str]) -> None:
    """Compare pictures with the stored ones, and run the benchmarks."""
    output_folder = ROOT / "tests" / "output"
    renderer = {"SKUGGA_EXPECT_RENDERER": recorder.report["opengl"]["renderer"], "CI": "true"}
    pytest = [str(python), "-m", "pytest", "-v", "--tb=short", "-p", "pytest_timeout", "-o", f"cache_dir={work / 'pytest'}"]
    start = time.time()
    recorder.run("compile loops", [str(python), "-c", COMPILE_CODE], environment, 120, may_end_early=True)
    for name, tests_path, limit_s in (
        ("pictures", "tests/shadows/test_snapshots.py", 200),
        ("OpenGL tests", "tests/terrain/gl", 100),
    ):
        junit_file = work / f"{Path(tests_path).stem}.xml"
        tests = [*pytest, f"--junitxml={junit_file}", tests_path]
        recorder.run(name, tests, {**environment, **renderer}, limit_s, partial(_described_tests, junit_file))
    pictures = [path for path in sorted(output_folder.glob("*.png")) if path.stat().st_mtime >= start]
    if pictures:
        with zipfile.ZipFile(recorder.out / "pictures.zip", "w") as archive:
            for path in pictures:
                archive.write(path, path.name)
    picture = "SpatialAce" if "pyogrio" in recorder.report["packages"] else "street"
    benchmarks = {
        "frames": ["--pictures", picture, "--repeats", "3", "--no-first"],
        "algorithms": ["thesis", "--scenes", "thesis_boxgrid", "thesis_street_sun", "--size", "640x512", "--repeats", "3"],
    }
    for name, arguments in benchmarks.items():
        figures, table = work / f"{name}.json", work / f"{name}.md"
        command = [str(python), "-m", f"benchmarks.{name}", *arguments, "--json", str(figures), "--markdown", str(table)]
        outcome = recorder.run(f"benchmarks.{name}", command, environment, 120)
        if outcome.status == 0:
            recorder.report["figures"][name] = json.loads(figures.read_text(encoding="utf-8"))
            recorder.report["tables"][f"benchmarks.{name} {' '.join(arguments)}"] = table.read_text(encoding="utf-8")
            recorder.write()


def check(folder: Path, out: Path, allow_software: bool, minutes: float) -> bool:
    """Run all steps, write the report, and return whether all have passed.

    Raises ``CheckError`` if the folder is not a packed one, or this Python is not that of its wheels.
    """
    start = time.monotonic()
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckError(f"{folder / MANIFEST}: {error}. Write the folder with scripts/gpu_check.sh pack.") from None
    version = platform.python_version()
    if version.rpartition(".")[0] != manifest["python"]:
        raise CheckError(f"Python {version}: the wheels are for {manifest['python']}. Name such a Python with PYTHON=...")
    out.mkdir(parents=True, exist_ok=True)
    report: Report = {
        "commit": manifest["commit"], "started": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()), "python": version,
        "cores": len(os.sched_getaffinity(0)), "cards": [card.name for card in find_cards(CardPlaces())], "manifest": manifest,
        "packages": {}, "opengl_tried": [], "steps": [], "figures": {}, "tables": {},
    }  # fmt: skip
    recorder = Recorder(out, minutes, start + 60.0 * minutes, report)
    with tempfile.TemporaryDirectory(prefix="gpu-check-") as name:
        work = Path(name)
        environment = {key: value for key, value in os.environ.items() if not key.startswith(("SKUGGA_", "PIP_", "PYTEST_"))}
        environment |= {
            "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "XDG_CACHE_HOME": str(work / "cache"),
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        }  # fmt: skip
        python = _install(recorder, manifest, folder.resolve(), work, environment)
        if python is not None and _find_opengl(recorder, python, work / LIBRARIES_FOLDER, environment, allow_software):
            environment |= report["opengl"]["environment"]
            _draw(recorder, python, work, environment)
        elif python is not None:
            doctor = "from skugga.api.cli.main import main; main()"
            recorder.run("skugga doctor", [str(python), "-c", doctor, "doctor"], environment, 60)
    return recorder.is_ok


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the check that the command line names, and return the exit status."""
    parser = argparse.ArgumentParser(prog="gpu_check.sh run", description="Check Skugga on a machine with a graphics card.")
    parser.add_argument("folder", type=Path, help="the folder that 'gpu_check.sh pack' wrote")
    parser.add_argument("out", type=Path, help="the folder for report.json and report.md")
    parser.add_argument("--allow-software", action="store_true", help="accept a software rasteriser where no card draws")
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"time limit of all steps; default {MINUTES}")
    values = parser.parse_args(arguments)
    try:
        is_ok = check(values.folder, values.out, values.allow_software, values.minutes)
    except CheckError as error:
        parser.exit(2, f"gpu_check: {error}\n")
    print(f"{values.out / 'report.md'}: {'all steps passed' if is_ok else 'some steps failed'}")
    return 0 if is_ok else 1


if __name__ == "__main__":
    sys.exit(main())
