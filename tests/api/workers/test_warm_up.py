import pytest

from skugga.api.workers import warm_up as module
from skugga.api.workers.warm_up import warm_up
from skugga.terrain.errors import GraphicsError


def test_warm_up_accepts_a_renderer_with_correct_shadows(gl):
    assert warm_up() == gl.renderer
    assert warm_up(gl.renderer[:4]) == gl.renderer


def test_another_renderer_is_refused(gl):
    with pytest.raises(GraphicsError, match="no such renderer"):
        warm_up("no such renderer")


@pytest.mark.parametrize("visibilities", [(0.0, 0.0), (1.0, 1.0), (0.0, 1.0), (float("nan"), float("nan"))])
def test_a_renderer_that_draws_wrong_shadows_is_refused(gl, monkeypatch: pytest.MonkeyPatch, visibilities: tuple[float, float]):
    monkeypatch.setattr(module, "_visibility_beside_wall", lambda algorithm: visibilities)
    with pytest.raises(GraphicsError, match="wrong shadows"):
        warm_up()
