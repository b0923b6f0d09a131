"""Planes of facets: coplanar facets are one, opposite sides are two, and curved bodies have none."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from skugga.terrain.gbuffer import facet_planes
from skugga.terrain.gbuffer.facet_planes import MAX_BODY_PLANES, VisibleFacets, curved_triangle_mask, group_facets
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene


def facets_of(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return corners rounded to float32, normals and areas of a mesh's facets."""
    corners = np.asarray(mesh.triangles, np.float32).astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    return corners, normal / length[:, None], length / 2.0


@pytest.mark.parametrize("offset_m", [0.0, 30.0, 4000.0])
@pytest.mark.parametrize("turn_deg", [0.0, 17.3])
def test_group_facets_of_a_turned_box(offset_m, turn_deg):
    """A box has six planes, also with facets cut into 4, turned, and rounded to float32 far from the origin."""
    box = trimesh.creation.box(extents=(8.0, 6.0, 5.0)).subdivide()
    box.apply_transform(trimesh.transformations.rotation_matrix(np.radians(turn_deg), [0.3, 0.2, 1.0]))
    box.apply_translation([offset_m, -offset_m, 3.0])
    corners, normal, area = facets_of(box)
    planes = group_facets(corners, normal, area)
    assert len(planes) == 6 and planes.is_complete and sorted(np.bincount(planes.plane_of_facet)) == [8] * 6
    for index, facet_normal in enumerate(planes.normal_frame):
        members = planes.plane_of_facet == index
        assert (normal[members] @ facet_normal > 0.99).all()
        assert np.abs((corners[members] - planes.point_frame_m[index]) @ facet_normal).max() <= planes.error_m < 0.02


def test_group_facets_parts_steps_and_sides():
    """Parallel planes a millimetre apart are two. The sides of a sheet are two, since they face opposite ways."""
    square = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])
    corners = np.array([square, square + [9, 9, 0], square + [0, 0, 0.001], square[::-1]])
    up = np.array([0.0, 0.0, 1.0])
    planes = group_facets(corners, np.array([up, up, up, -up]), np.full(4, 8.0))
    assert planes.plane_of_facet.tolist() == [0, 0, 1, 2]


def test_group_facets_stops_at_its_bound():
    corners, normal, area = facets_of(trimesh.creation.icosphere(subdivisions=1))
    bounded, complete = group_facets(corners, normal, area, 79), group_facets(corners, normal, area, 80)
    assert (len(bounded), bounded.is_complete, (bounded.plane_of_facet < 0).sum()) == (79, False, 1)
    assert (len(complete), complete.is_complete) == (80, True)


def test_group_facets_leaves_out_facets_without_area():
    corners = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 0], [1, 1, 1], [2, 2, 2]]])
    planes = group_facets(corners, np.array([[0.0, 0, 1], [0, 0, 0]]), np.array([0.5, 0.0]))
    assert planes.plane_of_facet.tolist() == [0, -1] and planes.is_complete


def test_visible_planes_go_by_pixels():
    """A table of 128 small facets fills more of the view than slats of one large facet each. Samples at edges do not count."""
    table = trimesh.Trimesh([[0, 0, 1], [2, 0, 1], [2, 1, 1], [0, 1, 1]], [[0, 1, 2], [0, 2, 3]], process=False)
    for _ in range(3):
        table = table.subdivide()
    slats = [trimesh.Trimesh([[0, 0, z], [9, 0, z], [0, 9, z]], [[0, 1, 2]], process=False) for z in (2.0, 3.0, 4.0)]
    corners, normal, area = (np.concatenate(parts) for parts in zip(*map(facets_of, [table, *slats]), strict=True))
    facet_of_view_pixel = np.concatenate([np.repeat(np.arange(128), 2), np.repeat([128, 129, 130], [100, 80, 60])])
    facet_of_sample = np.full(5000, 130)
    facet_of_pixel = np.concatenate([facet_of_view_pixel, facet_of_sample])
    facets = VisibleFacets(
        corners, normal, area, np.zeros(131, np.bool_), np.arange(len(facet_of_pixel)), facet_of_pixel, len(facet_of_view_pixel)
    )
    heights_m = [facets.group(count).point_frame_m[:, 2] for count in (1, 2, 4)]
    assert [list(heights) for heights in heights_m] == [[1.0], [1.0, 2.0], [1.0, 2.0, 3.0, 4.0]]
    kept = facets.group(2).plane_of_facet
    assert (kept[:128] == 0).all() and list(kept[128:]) == [1, -1, -1]


def test_curved_triangle_mask_near_its_bound(tmp_path):
    """A prism of 62 sides has 64 planes with its ends. One of 63 sides is curved but for its ends, a fifth of its area each."""
    expected: list[bool] = []
    for sides in (MAX_BODY_PLANES - 2, MAX_BODY_PLANES - 1):
        prism = trimesh.creation.cylinder(radius=3.0, height=4.0, sections=sides)
        prism.export(tmp_path / f"prism{sides}.obj")
        normal_z = facets_of(trimesh.load(tmp_path / f"prism{sides}.obj", process=False))[1][:, 2]
        expected += ((np.abs(normal_z) < 0.5) & (sides == MAX_BODY_PLANES - 1)).tolist()
    meshes = "".join(
        f"\n  - {{source: prism{sides}.obj, at: [{sides}, 0]}}" for sides in (MAX_BODY_PLANES - 2, MAX_BODY_PLANES - 1)
    )
    terrain = "terrain: {flat: {size: [200, 200], cells: [10, 10]}}"
    (tmp_path / "level.yaml").write_text(f"version: 1\n{terrain}\nmeshes:{meshes}\n", encoding="utf-8")
    mask = curved_triangle_mask(build_scene(load_level(tmp_path / "level.yaml")).objects)
    assert mask.tolist() == expected and mask.sum() == 2 * (MAX_BODY_PLANES - 1)


def test_curved_triangle_mask_groups_large_curved_bodies_by_rounding(tmp_path, monkeypatch):
    """A dome of thousands of planes over a flat foot is curved, but not its foot. Exact groups would take time for each plane."""
    monkeypatch.setattr(facet_planes, "group_facets", None)
    dome = trimesh.creation.icosphere(subdivisions=4, radius=9.0).slice_plane([0, 0, 0], [0, 0, 1], cap=True)
    dome.export(tmp_path / "dome.obj")
    (tmp_path / "level.yaml").write_text(
        "version: 1\nterrain: {flat: {size: [200, 200], cells: [10, 10]}}\nmeshes: [{source: dome.obj, at: [0, 0]}]\n",
        encoding="utf-8",
    )
    objects = build_scene(load_level(tmp_path / "level.yaml")).objects
    mask = curved_triangle_mask(objects)
    (placed,) = objects.placement.visible_bodies
    low_z = placed.body.vertices_m[placed.body.triangles][..., 2].max(axis=1) < placed.body.vertices_m[:, 2].min() + 1e-6
    assert 0 < low_z.sum() < mask.sum() and (mask == ~low_z).all()
