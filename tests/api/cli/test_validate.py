"""``skugga validate``: notes on the expected time of a level's maps and views."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from skugga.api import picture_cost

SPOT = {"kind": "spot", "position": [-84.31, 36.36, 12], "target": [-84.309, 36.361, 0], "cutoff": 35, "radius": 0.2}
"""The lamp of docs/levels.md."""

NEAR_VIEW = {
    "kind": "perspective", "eye": [-84.311, 36.3605, 10], "target": [-84.309, 36.361, 0], "fov": 50, "size": [1280, 1024],
}  # fmt: skip


def notes_on_cost(run, path: Path, **keys: object) -> list[str]:
    """Validate a level of the bundled ground; return the notes on times."""
    path.write_text(json.dumps({"version": 1, "terrain": {"source": "jacksboro"}, **keys}))
    status, out, err = run("validate", str(path))
    assert (status, err) == (0, "")
    return [line.removeprefix("  note: ") for line in out.splitlines() if "expected to take" in line]


def test_validate_tells_the_cost_of_maps_and_views_of_a_ball(gl, run, tmp_path):
    """The penumbrae are narrower than a pixel of the map, and wide in a view beside the lamp."""
    note, view_note = notes_on_cost(run, tmp_path / "lamp.yaml", lights={"lamp": SPOT}, views={"near": NEAR_VIEW})
    assert note.startswith("a map is expected to take ") and " a block; penumbrae of lamps are narrower than a pixel" in note
    assert view_note.startswith("view near is expected to take ")
    assert "; lights.lamp.radius: 0 makes shadows hard, which need 1 sample point of a lamp instead of " in view_note


def test_validate_is_silent_on_quick_pictures(gl, run, tmp_path):
    assert not notes_on_cost(run, tmp_path / "plain.yaml", views={"near": NEAR_VIEW})
    assert not notes_on_cost(run, tmp_path / "point.yaml", lights={"lamp": SPOT | {"radius": 0}})


def test_validate_tells_which_pictures_are_slow(gl, run, tmp_path, monkeypatch: pytest.MonkeyPatch):
    """The note names pictures that a service refuses."""
    monkeypatch.setattr(picture_cost, "SLOW_PICTURE_MS", 1e-4)
    notes = notes_on_cost(run, tmp_path / "slow.yaml", views={"near": NEAR_VIEW})
    assert [note.partition(" is ")[0] for note in notes] == ["a map", "view near"]
    assert not any("refuses" in note or ";" in note for note in notes)
    monkeypatch.setenv("SKUGGA_RENDER_TIMEOUT_S", "1e-7")
    notes = notes_on_cost(run, tmp_path / "slow.yaml")
    assert len(notes) == 1 and "; a service refuses it" in notes[0] and " a block; " in notes[0]
