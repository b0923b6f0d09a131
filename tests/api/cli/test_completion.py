"""Completion of the command line, by its functions and in a shell, and the lightweight list of commands."""

from __future__ import annotations

import importlib
import inspect
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from skugga.api.catalogue import bundled_levels
from skugga.api.cli import commands
from skugga.api.cli.completion import complete_level, complete_words
from skugga.api.cli.lazy_commands import COMMANDS

ROOT = Path(__file__).parents[3]


def test_words_are_completed_in_their_order():
    completer = complete_words(["auto", 16, "analysis"])
    assert completer("") == ["auto", "16", "analysis"] and completer("a") == ["auto", "analysis"] and completer("x") == []


def test_levels_are_completed_by_name_and_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("jade.tif", "Jung.TIFF", "jot.txt", "notes.yaml", ".jam.tif"):
        Path(name).touch()
    Path("jars").mkdir()
    names = [path.stem for path in bundled_levels()]
    assert complete_level("") == [*names, "Jung.TIFF", "jade.tif", "jars/", "notes.yaml"]
    assert complete_level("jacksboro_w") == ["jacksboro_wooded"]
    assert complete_level("j") == [*(name for name in names if name[0] == "j"), "jade.tif", "jars/"]
    assert complete_level("Ju") == ["Jung.TIFF"]
    assert complete_level(".j") == [".jam.tif"]


def test_levels_in_a_folder_are_completed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data" / "deep").mkdir(parents=True)
    (tmp_path / "data" / "dem.vrt").touch()
    monkeypatch.setenv("HOME", str(tmp_path))
    for folder in ("data", str(tmp_path / "data"), "~/data"):
        assert complete_level(f"{folder}/") == [f"{folder}/deep/", f"{folder}/dem.vrt"]
        assert complete_level(f"{folder}/dem") == [f"{folder}/dem.vrt"]
    assert complete_level("da") == complete_level("data/de/") == [], (
        "names of folders without a slash are left to the shell's own completion"
    )


@pytest.fixture
def skugga(tmp_path, monkeypatch) -> Path:
    """Put a command ``skugga`` on the path and return its folder."""
    command = tmp_path / "bin" / "skugga"
    command.parent.mkdir()
    program = "from skugga.api.cli.main import main; main()"
    command.write_text(f"#!/bin/sh\nPYTHONPATH='{ROOT}' exec '{sys.executable}' -c \"{program}\" \"$@\"\n", encoding="utf-8")
    command.chmod(0o755)
    monkeypatch.setenv("PATH", str(command.parent), prepend=os.pathsep)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    return tmp_path


BASH = """
source ~/.bashrc
complete_line() {
    COMP_WORDS=("$@" "") COMP_CWORD=$# COMPREPLY=()
    unset 'COMP_WORDS[-1]'; COMP_CWORD=$((${#COMP_WORDS[@]} - 1))
    _skugga_completion skugga
    echo "${COMPREPLY[*]}"
}
complete_line skugga se
complete_line skugga validate jacksboro_
complete_line skugga select jacksboro --pol
complete_line skugga select jacksboro --policy p
complete_line skugga sunhours jacksboro --quantity ""
complete_line skugga point jacksboro --horizon pvgis
complete_line skugga render jacksboro --algorithm s
complete_line skugga render jacksboro --layer sil
complete_line skugga render jacksboro --filter ""
complete_line skugga serve jacksboro thesis_rooms
"""


def test_bash_completes_once_it_is_installed(skugga):
    if shutil.which("bash") is None:
        pytest.skip("there is no bash")
    process = subprocess.run(["skugga", "--install-completion", "bash"], capture_output=True, text=True, check=False)
    assert process.returncode == 0 and "bash completion installed" in process.stdout, process.stderr
    process = subprocess.run(["bash", "-c", BASH], capture_output=True, text=True, cwd=skugga, check=False)
    assert process.stdout.splitlines() == [
        "serve seed select",
        "jacksboro_alpine jacksboro_wooded",
        "--policy",
        "predict probe",
        "hours first last longest days",
        "pvgis-csv pvgis-json pvgis-upload",
        "shadow_map shadow_volume sweep",
        "silhouettes",
        "1 2 3 5 sun",
        "",
    ], process.stderr


def test_zsh_completes_words_with_their_help(skugga):
    """Test the text that zsh evaluates. zsh itself need not be installed."""
    process = subprocess.run(["skugga", "--show-completion", "zsh"], capture_output=True, text=True, check=False)
    assert process.returncode == 0 and process.stdout.startswith("#compdef skugga")
    environment = {**os.environ, "_SKUGGA_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": "skugga val"}
    process = subprocess.run(["skugga"], capture_output=True, text=True, env=environment, check=False)
    assert process.stdout.strip() == """_arguments '*: :(("validate":"Check a level file and the data it names."))'""", (
        process.stderr
    )


@pytest.mark.parametrize("name", COMMANDS)
def test_listed_help_equals_the_command_s_docstring(name):
    function, summary = COMMANDS[name]
    module, _, attribute = function.partition(":")
    command = getattr(importlib.import_module(f"skugga.api.cli.commands.{module}"), attribute)
    assert summary == " ".join(inspect.getdoc(command).split())


def test_every_command_module_is_listed():
    folder = Path(commands.__file__).parent
    modules = {path.stem for path in folder.glob("*.py")} - {"__init__"}
    assert modules == {function.partition(":")[0] for function, _ in COMMANDS.values()}


def test_help_shows_the_full_help_of_each_command(run):
    status, out, err = run("--help")
    help_text = " ".join(out.split())
    assert (status, err) == (0, "") and "Usage: skugga [OPTIONS] COMMAND [ARGS]..." in help_text
    for name, (_, summary) in COMMANDS.items():
        assert f"{name} {summary}" in help_text
    assert run()[1] == out, "skugga without arguments prints the same help"
