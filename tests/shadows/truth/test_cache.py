"""Cache of truth: one computation for the same content, another for any other content."""

from __future__ import annotations

from dataclasses import replace
from io import BytesIO

import numpy as np

from skugga.shadows.truth import cache
from skugga.shadows.truth.cache import cached_truth, content_key
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.geometry import map_geometry
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene


def test_cached_truth_is_computed_once_per_content(tmp_path, monkeypatch):
    scene = build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=237, altitude=10))
    view = scene.view(size=(60, 64))
    frame = scene.world.frame_near(view.grid.crs, *view.centre)
    buffer = map_geometry(scene.surface(view.grid), view, frame)
    casters = find_casters(scene, buffer)
    calls = []

    def make(*args, **keys):
        from skugga.shadows.truth.truth import trace_truth

        calls.append(args)
        return trace_truth(*args, **keys)

    first = cached_truth(buffer, scene, casters, 4, folder=tmp_path, compute=make)
    second = cached_truth(buffer, scene, casters, 4, folder=tmp_path, compute=make)
    assert len(calls) == 1 and first.decidable.any()
    for name in ("lit", "attached_shadow_mask", "decidable", "valid"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    (stored,) = tmp_path.glob("*.npz")
    other_archive = BytesIO()
    np.savez(other_archive, something=np.zeros(3))
    for count, damaged in enumerate((b"damaged", stored.read_bytes()[:-30], other_archive.getvalue()), start=2):
        stored.write_bytes(damaged)
        cached_truth(buffer, scene, casters, 4, folder=tmp_path, compute=make)
        assert len(calls) == count
    assert buffer.surface is not None
    # the same nodes, but cut along the lower diagonals
    flipped_buffer = replace(buffer, surface=replace(buffer.surface, height_m=-buffer.surface.height_m))
    assert (flipped_buffer.surface.sheet.is_cut_nw_se != buffer.surface.sheet.is_cut_nw_se).any()
    keys = {
        content_key(buffer, scene, casters, 4),
        content_key(buffer, scene, casters, 16),
        content_key(buffer, scene.with_sun(SunSpec(azimuth=237, altitude=10.001)), casters, 4),
        content_key(buffer, scene, Casters((), casters.reach), 4) if casters.patches else "no patches",
        content_key(flipped_buffer, scene, casters, 4),
    }
    monkeypatch.setattr(cache, "DEFINITION_VERSION", cache.DEFINITION_VERSION - 1)
    keys.add(content_key(buffer, scene, casters, 4))
    assert len(keys) == 6


def test_content_key_depends_on_the_lamp():
    scene = build_scene(load_level("configs/thesis_street.yaml"))
    (name,) = scene.lamps
    lamp = scene.lamps[name]
    view = scene.view("main", size=(32, 24))
    buffer = geometry_buffer(scene, view)
    casters = find_casters(scene, buffer)
    keys = set()
    for changed_lamp in (lamp, replace(lamp, radius_m=lamp.radius_m + 0.1), replace(lamp, cutoff_deg=lamp.cutoff_deg - 1.0)):
        scene.lamps[name] = changed_lamp
        keys.add(content_key(buffer, scene, casters, 4, name))
    assert len(keys) == 3
