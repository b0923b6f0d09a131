"""Far from the origin of coordinates, and under suns along the axes, pictures stay the same and nothing degenerates."""

from __future__ import annotations

import numpy as np

from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import RenderedView, Trial, View, hard_case
from tests.hard_cases.sites import differing_share, site, views_of


def _distant_differing_share(trial: Trial, offsets: list[tuple[float, float]]) -> float:
    """Return the largest share of pixels by which a distant site differs from the one at the origin."""
    px = 256 if trial.thorough else 96
    home_site, worst = site(trial), 0.0
    home_pictures = [
        trial.render_view(home_site, view, map_size=2048 if trial.thorough else 512) for view in views_of(trial, home_site, px)
    ]
    for number, offset in enumerate(offsets):
        distant_site = site(trial, offset=offset, name=f"away{number}")
        for home_picture, view in zip(home_pictures, views_of(trial, distant_site, px), strict=True):
            distant_picture = trial.render_view(distant_site, view, map_size=2048 if trial.thorough else 512)
            worst = max(worst, differing_share(home_picture, distant_picture))
    return worst


@hard_case(
    "H4",
    "The picture is the same wherever an engineering CRS puts it",
    "hills with houses at offsets of 0, 500, 6,378 and 6,650 km",
    {"pixels that differ": 0.0},
)
def test_a_site_may_lie_anywhere(trial: Trial) -> dict[str, float]:
    """Doubles hold these offsets exactly: frames, texels and nodes count from the anchor, so pictures are identical to the bit."""
    offsets = [(5e5, 6.65e6), (6.378e6, -5e5), (5e5, 5e5), (-6.65e6, 6.378e6)]
    return {"pixels that differ": _distant_differing_share(trial, offsets if trial.thorough else offsets[:1])}


@hard_case(
    "H5",
    "Digits that a double cannot hold change next to nothing",
    "the same at offsets of seven digits and a tenth of a metre",
    {"pixels that differ": 1e-4},
)
def test_a_site_may_lie_at_odd_digits(trial: Trial) -> dict[str, float]:
    offsets = [(412_345.1, 6_398_765.3), (6_378_137.7, 500_000.1)]
    return {"pixels that differ": _distant_differing_share(trial, offsets if trial.thorough else offsets[:1])}


@hard_case(
    "H8",
    "Suns along the axes and at the zenith are suns like others",
    "azimuths 0, 90, 180, 270 and the zenith, each beside suns a millionth of a degree off",
    {"basis": 1e-12, "pixels that differ": 1e-4},
)
def test_suns_along_the_axes(trial: Trial) -> dict[str, float]:
    """``basis`` is the largest element of R R^T - 1 of the light's axes, for suns on the horizon and at the nadir, too.

    A pixel differs if its sunlight does, by one of a picture's 255 steps. Walls under the zenith turn from attached shadow to light
    within a millionth of a degree, as they should, but that light is invisible. At the zenith the azimuth does not change the sun's
    direction, but texels and lines follow it. Two spellings of that one sun therefore have different grids. So each is compared
    with suns near the zenith at its own azimuth.
    """
    scene, basis = site(trial), 0.0
    for azimuth in (0.0, 90.0, 180.0, 270.0, 360.0):
        for altitude in (-90.0, 0.0, 30.0, 90.0):
            light = scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude)).light_space
            assert light is not None
            basis = max(basis, float(np.abs(light.light_from_earth @ light.light_from_earth.T - np.eye(3)).max()))
    differ, small_deg = 0.0, 1e-6
    suns = [(0.0, 17.0), (90.0, 17.0), (180.0, 17.0), (270.0, 17.0), (0.0, 90.0), (137.0, 90.0)]
    for view in views_of(trial, scene, 256 if trial.thorough else 100):
        for azimuth, altitude in suns if trial.thorough else suns[1:5:3]:
            exact = _render_under_sun(trial, scene, view, azimuth, altitude)
            nearby_suns = [(azimuth + small_deg, altitude), (azimuth, altitude - small_deg), (azimuth - small_deg, altitude)]
            for nearby_sun in nearby_suns if trial.thorough else nearby_suns[:2]:
                differ = max(differ, float(_sunlight_differs(exact, _render_under_sun(trial, scene, view, *nearby_sun)).mean()))
    return {"basis": basis, "pixels that differ": differ}


def _render_under_sun(trial: Trial, scene: Scene, view: View, azimuth: float, altitude: float) -> RenderedView:
    """Render a view under a sun, and check that it shows shadow."""
    rendered = trial.render_view(scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude)), view, map_size=512)
    assert altitude > 89.0 or rendered.dark[rendered.buffer.valid].mean() > 0.02, "shadow"
    return rendered


def _sunlight_differs(first: RenderedView, second: RenderedView) -> np.ndarray:
    """Return where the sunlight on two pictures' points differs visibly.

    Sunlight is visibility times the cosine of incidence, on the facet that faces the sun most.
    """
    lights = []
    for rendered in (first, second):
        assert rendered.scene.sun is not None
        normal = facing_normals(rendered.buffer, rendered.scene.light_position(rendered.light, rendered.buffer.frame)).normal_frame
        cosine = normal @ rendered.scene.sun.in_frame(rendered.buffer.frame)
        lights.append(np.nan_to_num(rendered.visibility * np.maximum(cosine, 0.0)))
    return np.abs(lights[0] - lights[1]) > 1.0 / 255.0
