"""Caster culling omits only ground that provably casts no shadow on a block: no ray meets it, for any block and sun."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from skugga.shadows.passes import PassLog
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.sweep.sweep import fill_visibility
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, lit_mask, ray_scene
from skugga.terrain.casters.caster_culling import block_ground_casts_no_shadow, culled_patches
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import caster_sheets
from skugga.terrain.casters.facet_rises import RISE_DIRECTIONS, rise_support
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from skugga.terrain.level.level import SUN
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING

SIDE_CELLS = 900
"""Cells along each side of the ground, each 10 m wide: a block within it has patches on all sides."""

HILLS_SIDE_CELLS = 560
"""Cells along each side of the rolling hills."""

height_arrays = arrays.arrays(np.float32, (5, 4), elements=st.floats(-100.0, 100.0, width=32))


@given(height_arrays)
def test_rises_bound_every_triangle_of_every_diagonal(height):
    bounds = rise_support(height)
    for i in range(height.shape[0] - 1):
        for j in range(height.shape[1] - 1):
            a, b, c, d = height[i, j], height[i, j + 1], height[i + 1, j], height[i + 1, j + 1]
            for rise in ((b - a, d - b), (d - c, c - a), (b - a, c - a), (d - c, d - b)):
                for (right, down), bound in zip(RISE_DIRECTIONS, bounds, strict=True):
                    assert right * float(rise[0]) + down * float(rise[1]) <= bound + 1e-3


def rolling_hills(seed: int, relief_m: float, waves: int) -> np.ndarray:
    """Return smooth hills, with wavelengths from the whole side down to ``waves`` waves per side."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[0:HILLS_SIDE_CELLS, 0:HILLS_SIDE_CELLS] * (2.0 * np.pi / HILLS_SIDE_CELLS)
    out = np.zeros((HILLS_SIDE_CELLS, HILLS_SIDE_CELLS))
    for wave in range(1, waves + 1):
        wave_vector, phase = random.normal(size=2) * wave, random.uniform(0.0, 6.3)
        out += np.sin(wave_vector[0] * x + wave_vector[1] * y + phase) / wave
    return ((out - out.min()) * (relief_m / np.ptp(out))).astype(np.float32)


@pytest.fixture
def make_block(write_raster, make_scene):
    """Return a factory of a scene, the buffer of a block of rolling ground, and its casters with their culled patches."""

    def make(seed: int, relief_m: float, waves: int, azimuth: float, altitude: float, corner: tuple[int, int], crs: str):
        raster = write_raster(rolling_hills(seed, relief_m, waves), crs, 500_000.0, 5_300_000.0, 10.0, name=f"{seed}.tif")
        scene = make_scene(raster, azimuth, altitude)
        west, north = 500_000.0 + 10.0 * corner[0], 5_300_000.0 - 10.0 * corner[1]
        view = scene.view(bounds=(west, north - 1600.0, west + 1600.0, north), size=(160, 160))
        buffer = geometry_buffer(scene, view)
        casters = find_casters(scene, buffer)
        return scene, buffer, replace(casters, culled_patches=culled_patches(scene, buffer, casters.patches))

    return make


def lit_at_altitude(scene: Scene, buffer, casters: Casters, altitude_deg: float) -> np.ndarray:
    """Return whether each point sees a sun of another altitude past the casters' ground (rows, cols)."""
    assert scene.sun is not None
    other = scene.with_sun(SunSpec(azimuth=scene.sun.azimuth_deg, altitude=altitude_deg))
    return lit_mask(buffer, other, SUN, ray_scene(buffer, scene, casters, ALL_CASTER_KINDS))  # cached: the same under each sun


@settings(max_examples=16, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.integers(0, 10_000), st.floats(5.0, 900.0), st.integers(1, 9), st.floats(0.0, 360.0), st.floats(1.5, 60.0),
    st.tuples(st.integers(100, 300), st.integers(100, 300)), st.sampled_from([ENGINEERING, "EPSG:32633"]),
)  # fmt: skip
def test_no_ray_to_the_sun_s_disc_meets_culled_ground(make_block, seed, relief, waves, azimuth, altitude, corner, crs):
    """Rays go to the disc's middle and to near its lowest point. A block without casters whose own ground is clear is fully lit."""
    scene, buffer, casters = make_block(seed, relief, waves, azimuth, altitude, corner, crs)
    unculled_casters = Casters(casters.patches, casters.reach)
    for sun_deg in (altitude, altitude - 0.95 * SUN_RADIUS_DEG):
        lit = lit_at_altitude(scene, buffer, unculled_casters, sun_deg)
        assert np.array_equal(lit, lit_at_altitude(scene, buffer, casters, sun_deg))
        if not casters.casting_patches and block_ground_casts_no_shadow(scene, buffer):
            assert lit[buffer.valid].all()


def test_culling_omits_gentle_ground_and_keeps_casters(make_block):
    """A high sun culls all ground beside a block of gentle hills. A low sun culls less, and shadows fall into the block."""
    scene, buffer, high_sun_casters = make_block(5, 600.0, 6, 215.0, 50.0, (200, 200), "EPSG:32633")
    assert high_sun_casters.patches and not high_sun_casters.casting_patches and block_ground_casts_no_shadow(scene, buffer)
    scene, buffer, low_sun_casters = make_block(5, 600.0, 6, 215.0, 6.0, (200, 200), "EPSG:32633")
    assert low_sun_casters.casting_patches and not block_ground_casts_no_shadow(scene, buffer)
    empty_casters = Casters((), low_sun_casters.reach)
    assert (
        lit_at_altitude(scene, buffer, low_sun_casters, 6.0) != lit_at_altitude(scene, buffer, empty_casters, 6.0)
    ).mean() > 0.01
    assert len([*caster_sheets(scene, buffer, low_sun_casters, ("relief",))]) == 1 + len(low_sun_casters.casting_patches)


def test_culling_keeps_high_ground_behind_a_nodata_gap(write_raster, make_scene):
    """A plateau behind a gap in the data has no facet that faces away from the sun, but it shades the ground below.

    Culling keeps the plateau's edge, which is enough for a sweep.
    """
    height = np.zeros((SIDE_CELLS, SIDE_CELLS), np.float32)
    height[700:] = 120.0
    height[550:700] = np.nan
    scene = make_scene(write_raster(height, ENGINEERING, 0.0, 9000.0, 10.0, nodata=np.nan), 180.0, 3.0)
    view = scene.view(bounds=(3000.0, 3600.0, 5000.0, 5000.0), size=(200, 140))
    buffer = geometry_buffer(scene, view)
    unculled_casters = find_casters(scene, buffer)
    casters = replace(unculled_casters, culled_patches=culled_patches(scene, buffer, unculled_casters.patches))
    unculled_light, culled_light = (
        fill_visibility(buffer, scene, SUN, ("relief",), tested_casters, SweepSettings(), PassLog())
        for tested_casters in (unculled_casters, casters)
    )
    assert casters.culled_patches and 0.05 < (unculled_light == 0.0).mean() < 0.95
    assert np.array_equal(unculled_light, culled_light)


@pytest.mark.parametrize(("wall_m", "casts"), [(100.0, True), (20.0, False)])
def test_culling_keeps_a_wall_only_if_its_shadow_reaches(write_raster, make_scene, wall_m, casts):
    """The wall is 1000 m from a block under a sun of 5 degrees: 100 m of wall cast 1143 m of shadow, 20 m cast 229 m."""
    height = np.zeros((SIDE_CELLS, SIDE_CELLS), np.float32)
    height[690:700] = wall_m
    scene = make_scene(write_raster(height, ENGINEERING, 0.0, 9000.0, 10.0), 180.0, 5.0)
    view = scene.view(bounds=(3000.0, 3100.0, 5000.0, 4600.0), size=(200, 150))
    buffer = geometry_buffer(scene, view)
    casters = find_casters(scene, buffer)
    casters = replace(casters, culled_patches=culled_patches(scene, buffer, casters.patches))
    lit = lit_at_altitude(scene, buffer, Casters(casters.patches, casters.reach), 5.0)
    assert bool(casters.casting_patches) == casts == (not lit.all())
    assert np.array_equal(lit, lit_at_altitude(scene, buffer, casters, 5.0))
