"""Fixture that runs the command line in this process."""

from __future__ import annotations

import sys

import pytest

from skugga.api.cli import main as cli


@pytest.fixture
def run(monkeypatch, capsys):
    """Return ``run("render", ...)``, which returns the exit status, standard output and standard error."""

    def call(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["skugga", *arguments])
        with pytest.raises(SystemExit) as exit_info:
            cli.main()
        out, err = capsys.readouterr()
        return exit_info.value.code, out, err

    return call
