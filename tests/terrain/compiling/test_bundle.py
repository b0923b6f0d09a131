"""Bundled loops of a wheel are used if the versions and the processor match those that they were compiled for."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from skugga.terrain.compiling.bundle import NUMBA_TARGET, VERSIONS_FILE, X86_64_V3_CPU_FLAGS, installed_versions, use_bundled_loops


@pytest.fixture
def bundle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder like that of compiled loops in a wheel, on a fake processor that can run them."""
    for name in NUMBA_TARGET:
        monkeypatch.setenv(name, "")  # so that it is restored
        monkeypatch.delenv(name)
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    (tmp_path / VERSIONS_FILE).write_text(json.dumps(installed_versions()), encoding="utf-8")
    (tmp_path / "cpuinfo").write_text(
        f"processor : 0\nflags\t\t: sse4_2 {' '.join(sorted(X86_64_V3_CPU_FLAGS))} avx512f\n", encoding="ascii"
    )
    return tmp_path


def test_matching_bundled_loops_are_used(bundle: Path) -> None:
    assert use_bundled_loops(bundle, bundle / "cpuinfo")
    assert {name: os.environ[name] for name in NUMBA_TARGET} == NUMBA_TARGET
    assert use_bundled_loops(bundle, bundle / "cpuinfo"), "in a child process, too"


def test_bundled_loops_of_another_version_are_ignored(bundle: Path) -> None:
    (bundle / VERSIONS_FILE).write_text(json.dumps(installed_versions() | {"numba": "0.1"}), encoding="utf-8")
    assert not use_bundled_loops(bundle, bundle / "cpuinfo") and not set(NUMBA_TARGET) & set(os.environ)


def test_bundled_loops_need_the_processor_s_instructions(bundle: Path) -> None:
    text = (bundle / "cpuinfo").read_text(encoding="ascii")
    (bundle / "cpuinfo").write_text(text.replace(" avx2 ", " "), encoding="ascii")
    assert not use_bundled_loops(bundle, bundle / "cpuinfo") and not set(NUMBA_TARGET) & set(os.environ)


def test_bundled_loops_need_x86_64_and_a_bundle(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not use_bundled_loops(bundle / "none", bundle / "cpuinfo")
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert not use_bundled_loops(bundle, bundle / "cpuinfo") and not set(NUMBA_TARGET) & set(os.environ)


def test_bundled_loops_respect_the_user_s_cpu_settings(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    assert not use_bundled_loops(bundle, bundle / "cpuinfo")
    assert os.environ["NUMBA_CPU_NAME"] == "generic" and "NUMBA_CPU_FEATURES" not in os.environ
