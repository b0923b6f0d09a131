"""Passes and effects that ran equal the plan in all bundled levels, and no code of an omitted effect runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from skugga import configs
from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.describe import describe
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

LEVELS = sorted(Path(configs.__file__).parent.glob("*.yaml"), key=lambda path: path.stem)

WITHOUT_OPENGL = (" sweep", " silhouettes")
"""Shadow passes without draw calls."""

SIZE = {"map": (96, 72), "perspective": (160, 120)}


@pytest.fixture(scope="module")
def scene_of():
    """A function that returns the scene of a level file. The last scene is cached."""
    scenes: dict[Path, Scene] = {}

    def cached_scene(path: Path) -> Scene:
        if path not in scenes:
            scenes.clear()
            scenes[path] = build_scene(load_level(path))
        return scenes[path]

    return cached_scene


def render_level_view(scene: Scene, name: str) -> Frame:
    """Render a level's view by its own plan, at the size of its kind of view."""
    spec = scene.loaded.level.views.get(name)
    view = scene.view(name, size=SIZE["map" if spec is None else spec.kind])
    return render_frame(scene, view, make_plan(describe(scene, view, name), scene.loaded.level))


def views_of(path: Path) -> list[str]:
    """Return the names of a level's views; ``map`` is always one of them."""
    return list({"map": None, **load_level(path).level.views})


@pytest.mark.parametrize("path", LEVELS, ids=lambda path: path.stem)
@pytest.mark.parametrize("views", [slice(0, 2), pytest.param(slice(2, None), marks=pytest.mark.long)], ids=["two", "more"])
def test_the_record_equals_the_plan(gl, scene_of, path: Path, views: slice):
    """Passes agree by name and order, effects follow from passes and programs, and nothing is drawn or read without an
    effect that needs it.
    """
    scene = scene_of(path)
    for name in views_of(path)[views]:
        frame = render_level_view(scene, name)
        plan, records = frame.plan, {record.name: record for record in frame.passes}
        assert list(records) == plan.passes, name
        assert frame.effects == plan.effect_names, (name, plan.left_out)
        assert plan.effect_names.isdisjoint(effect.name for effect in plan.left_out)
        assert all(item.reason for item in (*plan.effects, *plan.left_out))
        shadows = [record for key, record in records.items() if "/" in key]
        assert all(record.draws > 0 or record.loops for record in shadows if not record.name.endswith(WITHOUT_OPENGL)), name
        depth = [record for record in shadows if record.name.endswith("depth map")]
        if "alpha_test" not in plan.effect_names:
            assert not any(record.textures for record in depth), (name, depth)
        words = {word for record in shadows for label in record.programs for word in label.split()}
        assert "shadows/maps/sun_disc.frag" not in words
        for key in ("snow", "clouds", "sky_view", "lamps", "water", "haze", "outside_casters", "refraction"):
            assert (key in records) == (key in plan.effect_names)


def test_the_sun_filter_of_a_level_uses_the_disc_program(gl, scene_of):
    scene = scene_of(next(path for path in LEVELS if path.stem == "jacksboro"))
    view, overrides = scene.view("map", size=(64, 48)), {"algorithm": "shadow_map", "filter": "sun"}
    frame = render_frame(scene, view, make_plan(describe(scene, view), scene.loaded.level, overrides))
    words = {word for record in frame.passes for label in record.programs for word in label.split()}
    assert "shadows/maps/sun_disc.frag" in words and "soft_edges" in frame.effects
    reason = next(item.reason for item in frame.plan.effects if item.name == "soft_edges")
    assert "filter sun is set" in reason
