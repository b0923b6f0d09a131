"""How often a probe draws an option to measure its time."""

from dataclasses import replace

import pytest

from skugga.api.catalogue import find_level
from skugga.selector.cost.typical_device import typical_device
from skugga.selector.measure import scene_prober
from skugga.selector.measure.scene_prober import MAX_REPEATED_MS, MAX_WARM_REPEATED_MS, ProbedPictures, SceneProber, draw_count
from skugga.selector.planner.planner import planner_of
from skugga.selector.predict import plan_options
from skugga.terrain.describe import describe
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.scene import build_scene


def test_only_quick_drawings_are_repeated_once_an_algorithm_has_drawn():
    assert [draw_count(ms, is_warm=True) for ms in (MAX_WARM_REPEATED_MS - 1.0, MAX_WARM_REPEATED_MS)] == [2, 1]
    assert [draw_count(ms, is_warm=False) for ms in (MAX_WARM_REPEATED_MS, MAX_REPEATED_MS - 1.0, MAX_REPEATED_MS)] == [2, 2, 1]


@pytest.fixture
def street_prober() -> SceneProber:
    """A prober of a bundled level's view."""
    scene = build_scene(load_level(find_level("thesis_street_sun")))
    view = scene.view("main", size=(64, 48))
    options = plan_options(planner_of(describe(scene, view, "main", "points"), scene.loaded.level), typical_device())
    return SceneProber(ProbedPictures(scene, view, ()), options.planner, SUN, options.lights[SUN])


@pytest.fixture
def drawing_times(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Milliseconds that the following drawings seem to take, in order; each drawing removes its own."""
    times: list[float] = []
    draw = scene_prober.run_light
    monkeypatch.setattr(scene_prober, "run_light", lambda *args: replace(draw(*args), times=(times.pop(0), {})))
    return times


def test_one_time_work_does_not_count_as_time_of_the_first_drawing(street_prober, drawing_times):
    """The first drawing took longer than the limit of repeated ones, but was expected to take 0.1 s: the second one counts."""
    drawing_times += [MAX_REPEATED_MS + 1000.0, 70.0]
    assert street_prober.draw(0) == 70.0
    assert drawing_times == []


def test_a_slow_drawing_with_a_known_algorithm_is_not_repeated(street_prober, drawing_times):
    assert street_prober._options.options[0].algorithm_family == street_prober._options.options[1].algorithm_family
    drawing_times += [70.0, 70.0, MAX_WARM_REPEATED_MS + 1.0, 60.0, 50.0]
    street_prober.draw(0)
    assert street_prober.draw(1) == MAX_WARM_REPEATED_MS + 1.0
    assert street_prober.draw(2) == 50.0, "a quick one is repeated"
    assert drawing_times == []


def test_drawings_take_as_many_seconds_as_they_are_repeated(street_prober, drawing_times):
    assert street_prober.draw_s(0, 200.0) == pytest.approx(0.4)
    drawing_times += [70.0, 70.0]
    street_prober.draw(0)
    assert street_prober.draw_s(1, 200.0) == pytest.approx(0.2)
    assert street_prober.draw_s(1, 100.0) == pytest.approx(0.2)
