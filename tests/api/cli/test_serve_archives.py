"""Tile archives on the command line of ``skugga serve``."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from skugga.api.http.server import server
from tests.api.conftest import PNG, write_level, write_tiles


def _patch(content: bytes, offset: int, struct_format: str, value: int) -> bytes:
    """Return the content of an archive with a value, packed by ``struct_format``, at a byte offset."""
    changed = bytearray(content)
    struct.pack_into(struct_format, changed, offset, value)
    return bytes(changed)


def _break_root_directory(content: bytes) -> bytes:
    """Return the content of an archive whose root directory is zero after its first 12 bytes."""
    offset, length = struct.unpack_from("<QQ", content, 8)
    return content[: offset + 12] + bytes(length - 12) + content[offset + length :]


CORRUPTIONS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "cut in its tiles": (lambda content: content[:-1], "truncated: its tiles end at byte"),
    "cut in its header": (lambda content: content[:100], "truncated: it ends in its header"),
    "empty": (lambda content: b"", "not a PMTiles archive"),
    "a picture": (lambda content: PNG, "not a PMTiles archive"),
    "version 2": (lambda content: b"PM\x02\x00" + content[4:], "of an earlier version"),
    "version 4": (lambda content: _patch(content, 7, "<B", 4), "of version 4"),
    "vector tiles": (lambda content: _patch(content, 99, "<B", 1), "vector tiles, which are not served"),
    "tiles of no kind": (lambda content: _patch(content, 99, "<B", 0), "unknown kind"),
    "a type that there is not": (lambda content: _patch(content, 99, "<B", 77), "its header is wrong"),
    "zstd": (lambda content: _patch(content, 97, "<B", 4), "directories are compressed by zstd"),
    "gzipped tiles": (lambda content: _patch(content, 98, "<B", 2), "tiles are compressed by gzip"),
    "zooms": (lambda content: _patch(content, 100, "<B", 9), "zooms from 9 to"),
    "a root that is no gzip": (lambda content: _patch(content, 127, "<B", 0), "broken directories"),
    "a root of nothing": (_break_root_directory, "broken directories"),
    "metadata": (lambda content: _patch(content, 24, "<Q", 127), "metadata are no"),
}


@pytest.mark.parametrize("corruption", CORRUPTIONS)
def test_a_wrong_archive_is_one_line_and_status_2(run, tmp_path: Path, corruption: str, monkeypatch):
    corrupt, expected_text = CORRUPTIONS[corruption]
    monkeypatch.setattr("skugga.api.cli.commands.serve.forbid_remote_reads", lambda: None)
    path = write_tiles(tmp_path / "a.pmtiles", {(2, 0, 0): PNG, (2, 1, 1): PNG})
    path.write_bytes(corrupt(path.read_bytes()))
    status, out, err = run("serve", str(path))
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert str(path) in err and expected_text in err and "a whole PMTiles archive" in err
    level = write_level(tmp_path, "hills", archive="a.pmtiles")
    status, out, err = run("serve", str(level))
    assert (status, out, err.count("\n")) == (2, "", 1) and str(path) in err and expected_text in err


def test_raster_options_are_refused_for_archives(run, tmp_path: Path, monkeypatch):
    monkeypatch.setattr("skugga.api.cli.commands.serve.forbid_remote_reads", lambda: None)
    path = write_tiles(tmp_path / "a.pmtiles", {(2, 0, 0): PNG})
    status, out, err = run("serve", str(path), "--nodata", "0")
    assert (status, out, err.count("\n")) == (2, "", 1) and "--nodata" in err


def test_archives_are_served_beside_levels_or_alone(run, tmp_path: Path, monkeypatch):
    calls: list[tuple[list[str], list[str]]] = []
    monkeypatch.setattr("skugga.api.cli.commands.serve.forbid_remote_reads", lambda: None)
    monkeypatch.setattr(
        server, "serve", lambda settings, levels, archives, _: calls.append(([source.path.name for source in levels], archives))
    )
    archive = write_tiles(tmp_path / "a.PMTiles", {(2, 0, 0): PNG})
    level = write_level(tmp_path, "hills")
    assert run("serve", str(archive)) == (0, "", "")
    assert run("serve", str(archive), str(level)) == (0, "", "")
    assert calls == [([], [archive]), (["hills.yaml"], [archive])]
