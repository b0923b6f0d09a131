"""The benchmark of frames: its arithmetic, its alternation of sides on a tiny picture, and a yardstick that shows the same
scene.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.frame_tables import (
    BASE_SIDE,
    NOW_SIDE,
    TABLES_BEGIN,
    TABLES_END,
    YARDSTICK_SIDE,
    FrameKey,
    Target,
    format_report,
    frame_targets,
    paired_ratio,
    replace_between_marks,
)
from benchmarks.frames import PICTURES, ROOT, FrameMeasurements, _commit_description, frame_process, main, measure_interleaved
from benchmarks.yardstick import Yardstick
from skugga.api.catalogue import find_level
from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene

TINY_PICTURE = replace(
    PICTURES["SpatialAce"],
    size=(64, 48),
    plans={"planned": {"algorithm": "shadow_map"}},
    changes={"planned": ("new", "sun", "resting")},
)


def cost_row(ms: float, **other_figures: Any) -> dict[str, Any]:
    """Return the costs of a frame of ``ms`` milliseconds. ``other_figures`` replace or add figures."""
    return {"ms": ms, "cpu_ms": 2.0 * ms, "reads": 1, "read_mib": 2.0, "draws": 3, "passes_ms": {"geometry": ms}, **other_figures}


def test_a_ratio_is_the_median_of_paired_ratios():
    """Other load slows both frames of the middle turn equally. The ratio of the medians would be 3."""
    assert paired_ratio([cost_row(10.0), cost_row(90.0), cost_row(30.0)], [cost_row(5.0), cost_row(45.0), cost_row(10.0)]) == 2.0


def test_targets_are_met_at_their_limit():
    key = FrameKey("SpatialAce", "planned", "new")
    frames = {key: {NOW_SIDE: [cost_row(35.0)], BASE_SIDE: [cost_row(100.0)]}}
    (counting_target,) = (target for target in frame_targets(frames, {}) if target.is_required)
    assert (counting_target.value, counting_target.cpu_value, counting_target.upper_bound, counting_target.is_met) == (
        0.35,
        0.35,
        0.35,
        True,
    )
    assert (
        counting_target.summary == "met    SpatialAce as planned, sun and camera moved / before: 0.35 (CPU time 0.35), at most 0.35"
    )
    frames[key][NOW_SIDE] = [cost_row(36.0)]
    (counting_target,) = (target for target in frame_targets(frames, {}) if target.is_required)
    assert not counting_target.is_met and counting_target.summary.startswith("MISSED")


def test_the_target_uses_the_yardstick_of_one_tap():
    sticks = {FrameKey("SpatialAce", "yardstick", name): {YARDSTICK_SIDE: [cost_row(ms)]} for name, ms in
              (("unshadowed", 1.0), ("512, 1 tap", 10.0), ("512, 3 x 3 taps", 20.0))}  # fmt: skip
    frames = {FrameKey("SpatialAce", "planned", "new"): {NOW_SIDE: [cost_row(40.0)]}, **sticks}
    ratios = {target.is_required: target.value for target in frame_targets(frames, {})}
    assert ratios == {True: 4.0, False: 2.0}


def test_a_first_frame_is_compared_with_warm_ones():
    first = {"ms": 30.0, "cpu_ms": 40.0, "answer_ms": 130.0, "cpu_answer_ms": 140.0}
    warm = {"ms": 10.0, "cpu_ms": 10.0, "answer_ms": 20.0, "cpu_answer_ms": 20.0}
    targets = frame_targets({}, {"valley": {NOW_SIDE: [{"first": first, "warm": warm}]}})
    assert [(target.value, target.cpu_value, target.is_required) for target in targets] == [(3.0, 4.0, True), (6.5, 7.0, False)]


def test_the_memory_target_uses_the_peak_of_all_frames():
    million = FrameKey("a million trees", "planned", "new")
    targets = frame_targets({million: {NOW_SIDE: [cost_row(1.0, peak_gb=1.1), cost_row(1.0, peak_gb=1.3)]}}, {})
    assert targets == [Target("a million trees: peak memory", 1.2, 1.3, unit=" GB")] and not targets[0].is_met


def test_writing_tables_between_marks_is_idempotent():
    page = f"before\n{TABLES_BEGIN}\nold\n{TABLES_END}\nafter\n"
    written_page = replace_between_marks(page, "| new |\n")
    assert written_page == f"before\n{TABLES_BEGIN}\n\n| new |\n\n{TABLES_END}\nafter\n"
    assert replace_between_marks(written_page, "| new |") == written_page
    with pytest.raises(ValueError, match="no marks"):
        replace_between_marks("a page without any", "table")
    assert replace_between_marks((ROOT / "docs" / "reports" / "frames.md").read_text(encoding="utf-8"), "table")


@pytest.mark.long
def test_alternating_sides_of_equal_code_draw_equal_frames():
    """Both sides are this checkout. With a moved sun and camera everything is drawn again. Without changes the map is cached."""
    measurements = FrameMeasurements()
    measure_interleaved(
        "SpatialAce", TINY_PICTURE, "spatialace", {NOW_SIDE: ROOT, BASE_SIDE: ROOT, YARDSTICK_SIDE: ROOT}, 2, measurements
    )
    moves = [FrameKey("SpatialAce", "planned", move) for move in ("new", "sun", "resting")]
    assert set(measurements.frames) == {*moves, *(FrameKey("SpatialAce", "yardstick", name) for name in
                                           ("unshadowed", "512, 1 tap", "512, 3 x 3 taps"))}  # fmt: skip
    for key in moves:
        sides = measurements.frames[key]
        assert [len(sides[side_name]) for side_name in (NOW_SIDE, BASE_SIDE)] == [2, 2]
        assert measurements.differences[key] == {"frames": 2, "color": 2, "visibility": 2, "pixels": 0, "most": 0, "classes": 0}
        for frame_row in sides[NOW_SIDE]:
            assert frame_row["cpu_ms"] > 0.0 and 0.05 < frame_row["peak_gb"] < 4.0
            assert sum(frame_row["passes_ms"].values()) == pytest.approx(frame_row["ms"])
    new, sun, resting = (measurements.frames[key][NOW_SIDE] for key in moves)
    assert all(frame_row["reads"] > 0 and frame_row["draws"] > 0 for frame_row in new)
    assert len({frame_row["color"] for frame_row in (*new, *sun)}) == 4  # no position is drawn twice
    assert [frame_row["color"] for frame_row in resting] == [frame_row["color"] for frame_row in sun]
    assert resting[0]["draws"] < sun[0]["draws"]
    assert [
        frame_row["reads"] for frame_row in measurements.frames[FrameKey("SpatialAce", "yardstick", "unshadowed")][YARDSTICK_SIDE]
    ] == [1, 1]
    header = {"renderer": "x", "cpus": 1, "load": 1.5, "repeats": 2, "base": "y", "plans": measurements.plans}
    table = format_report(header, measurements.frames, {}, measurements.differences)
    assert "| SpatialAce | planned | the sun |" in table and "2 of 2 | 2 of 2 |" in table
    assert "* SpatialAce is planned as shadow_map. A new view's plan: " in table


def test_an_error_in_a_side_is_raised():
    with frame_process(ROOT, TINY_PICTURE, "spatialace") as process, pytest.raises(RuntimeError, match="KeyError: 'nothing'"):
        process.request("frame", plan="nothing")


@pytest.mark.parametrize("wrong_options", [["--base", "/nowhere"], ["--repeats", "0"], ["--scale", "2"]])
def test_wrong_options_are_named(wrong_options, capsys):
    with pytest.raises(SystemExit):
        main(wrong_options)
    assert wrong_options[0] in capsys.readouterr().err.splitlines()[-1]


def test_the_yardstick_shows_the_same_scene():
    """Sky and surface agree, and so do shadows on ground near the eye, within the texels of 0.8 m."""
    scene = build_scene(load_level(find_level("spatialace")))
    view = scene.view("main", size=(200, 150))
    assert isinstance(view, PerspectiveView) and scene.sun is not None
    plan = make_plan(describe(scene, view, "main"), scene.loaded.level, {"algorithm": "shadow_map"})
    frame = render_frame(scene, view, plan)
    plain, shadowed_picture = (Yardstick(scene, view, size).draw(scene, view)[..., :3].astype(int) for size in (0, 512))
    sky = (plain == plain[0, 0]).all(axis=2)
    assert np.mean(sky == ~frame.valid) > 0.99
    buffer = geometry_buffer(scene, view)
    eye, _ = view.in_frame(buffer.frame)
    near = (buffer.surface_kind == RELIEF) & (np.linalg.norm(buffer.position_frame_m - eye, axis=2) < 150.0)
    near &= buffer.normal_frame @ scene.sun.in_frame(buffer.frame) > 0.1
    darker, dark = (plain - shadowed_picture).max(axis=2)[near] > 20, frame.visibility[near] < 0.5
    assert 0.05 < dark.mean() < 0.9
    assert (darker & dark).sum() / (darker | dark).sum() > 0.8
    assert not (plain != shadowed_picture).any(axis=2)[sky].any()


def test_a_commit_without_git_is_unknown(monkeypatch, tmp_path):
    assert _commit_description(tmp_path) == "unknown", "not a checkout"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert _commit_description(ROOT) == "unknown"
