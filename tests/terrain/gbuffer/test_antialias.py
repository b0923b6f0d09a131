"""Anti-aliased pictures: samples at edges, means of linear light, and data layers without samples."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation, maximum_filter, minimum_filter

from skugga.api.catalogue import find_level
from skugga.shadows import render as render_module
from skugga.shadows.render import Frame
from skugga.terrain.describe import describe
from skugga.terrain.facts.coarse_view import COARSE_STEP_PX, coarse_view_of
from skugga.terrain.gbuffer.antialias import MultisampledBuffer, edge_mask_of_neighbours, multisampled
from skugga.terrain.gbuffer.resolve import MESHES, NO_SURFACE, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.shading import encode_srgb, shade
from tests.rasters import ENGINEERING
from tests.render import render


@pytest.fixture
def floor(write_raster) -> Path:
    """File of a raster of level ground."""
    return write_raster(np.zeros((41, 41), np.float32), ENGINEERING, -205.0, 205.0, 10.0)


@pytest.fixture
def tower(floor, make_scene, tmp_path) -> Scene:
    """Return a white tower against the sky, seen from its foot and leaning, turned so that it shows two faces."""
    trimesh.creation.box(extents=(20.0, 20.0, 60.0)).export(tmp_path / "tower.obj")
    views = {"eye": {"kind": "perspective", "eye": [-60, -70, 1], "target": [3, 0, 38], "fov": 45, "size": [128, 96]}}
    meshes = [{"source": "tower.obj", "at": [0, 0], "turn": 17, "color": [0.95, 0.95, 0.95]}]
    return make_scene(floor, 250.0, 30.0, meshes=meshes, views=views)


def render_unsampled(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> Frame:
    """Render the frame with one point per pixel."""
    with monkeypatch.context() as patch:
        patch.setattr(
            render_module, "picture_buffer", lambda scene, part: MultisampledBuffer(geometry_buffer(scene, part), part.rows)
        )
        return render(scene, scene.view("eye"))


def mesh_share(scene: Scene, view: PerspectiveView) -> np.ndarray:
    """Return the share of each pixel that shows a mesh, from 16 x 16 points."""
    fine_mesh_mask = geometry_buffer(scene, view.finer(16)).surface_kind == MESHES
    return fine_mesh_mask.reshape(view.rows, 16, view.cols, 16).mean(axis=(1, 3))


def test_edge_pixels_are_blended_and_face_interiors_plain(gl, tower, monkeypatch):
    """On the outline against the sky, colours lie between the sky's and the wall's. The interior of a face has one colour."""
    view = tower.view("eye")
    frame, unsampled_frame, buffer = render(tower, view), render_unsampled(monkeypatch, tower), geometry_buffer(tower, view)
    wall, sky = buffer.surface_kind == MESHES, buffer.surface_kind == NO_SURFACE
    assert 0.1 < wall.mean() < 0.9 and sky.mean() > 0.1
    share = mesh_share(tower, view)
    partly = (share > 0.2) & (share < 0.8) & binary_dilation(sky) & ~binary_dilation(buffer.surface_kind == RELIEF)
    low, high = minimum_filter(unsampled_frame.color[..., 0], 5), maximum_filter(unsampled_frame.color[..., 0], 5)
    contrast = partly & (high.astype(int) - low > 40)
    assert contrast.sum() > 40
    between = (frame.color[..., 0] > low + 2) & (frame.color[..., 0] < high - 2)
    assert between[contrast].mean() > 0.9
    normal = buffer.normal_frame
    faces = {tuple(np.round(n, 3)) for n in normal[wall]}
    assert len(faces) >= 2
    for axis in faces:
        face = wall & (np.abs(normal - axis).max(axis=-1) < 0.01)
        inside = face & ~binary_dilation(~face, iterations=2) & (frame.visibility == 1.0)
        assert not inside.any() or (np.ptp(frame.color[inside].astype(int), axis=0) <= 1).all()


def test_edge_means_match_the_covered_share_of_the_pixel(gl, tower):
    """Compared with 16 x 16 points per pixel, the means are far nearer than one point is, and unbiased."""
    view = tower.view("eye")
    picture = multisampled(tower, view)
    row, col = picture.sampled_pixels
    assert len(row) > 100 and picture.sample_count == 4
    mesh_samples = (picture.buffer.surface_kind == MESHES).astype(float)[..., None]
    sample_means = picture.average_samples(mesh_samples)[..., 0]
    covered_share = mesh_share(tower, view)
    single_samples = mesh_samples[: view.rows, :, 0]
    is_partly_covered = (covered_share > 0.02) & (covered_share < 0.98)
    assert is_partly_covered.sum() > 80
    error, single_sample_error = (
        np.sqrt(((sample_means - covered_share)[is_partly_covered] ** 2).mean()),
        np.sqrt(((single_samples - covered_share)[is_partly_covered] ** 2).mean()),
    )
    assert (
        error < 0.5 * single_sample_error and error < 0.17 and abs((sample_means - covered_share)[is_partly_covered].mean()) < 0.03
    )
    np.testing.assert_array_equal(
        sample_means[~binary_dilation(is_partly_covered, iterations=2)],
        single_samples[~binary_dilation(is_partly_covered, iterations=2)],
    )


def test_samples_lie_inside_their_pixels(gl, tower):
    """Seen from the eye, the samples' points lie within half a pixel of the pixel's middle, at the four places of the grid."""
    view = tower.view("eye")
    picture = multisampled(tower, view)
    buffer = picture.buffer
    row, col = np.nonzero(buffer.valid)
    below = row >= view.rows
    row, col = row[below], col[below]
    eye, camera = view.in_frame(buffer.frame)
    camera_points = (buffer.position_frame_m[row, col] - eye) @ camera.T
    sample_px = np.column_stack([camera_points[:, 1], camera_points[:, 0]]) / camera_points[:, 2:] * view.focal_px - [
        view.row0,
        view.col0,
    ]
    pixel_px = np.column_stack(picture.pixels_of_points(row, col))
    offset_px = sample_px - pixel_px
    assert len(offset_px) > 300 and np.quantile(np.abs(np.abs(offset_px) - 0.25), 0.95) < 1e-6
    assert {(a, b) for a, b in np.sign(offset_px).astype(int).tolist()} == {(1, 1), (1, -1), (-1, 1), (-1, -1)}


def test_samples_leave_data_layers_unchanged(gl, tower, monkeypatch):
    """Visibility, heights and positions equal those of a frame without samples. Colours do so away from edges."""
    view = tower.view("eye")
    sampled_frame = render(tower, view)
    pixels = multisampled(tower, view).sampled_pixels
    unsampled_frame = render_unsampled(monkeypatch, tower)
    assert (unsampled_frame.visibility == 0.0).any() and (unsampled_frame.visibility == 1.0).any()
    np.testing.assert_array_equal(sampled_frame.height_m, unsampled_frame.height_m)
    np.testing.assert_array_equal(sampled_frame.position_earth_m, unsampled_frame.position_earth_m)
    np.testing.assert_array_equal(sampled_frame.visibility < 0.5, unsampled_frame.visibility < 0.5)
    np.testing.assert_allclose(sampled_frame.visibility, unsampled_frame.visibility, atol=1e-4)
    is_different = (sampled_frame.color != unsampled_frame.color).any(axis=-1)
    allowed = np.zeros(is_different.shape, bool)
    allowed[pixels] = True
    assert is_different.any() and not (is_different & ~allowed).any() and allowed.mean() < 0.2


def test_a_floor_alone_needs_no_samples(gl, floor, make_scene):
    """Its triangles meet, but no surface ends between them. At the floor's rim against the sky the surface ends."""
    down = {"eye": {"kind": "perspective", "eye": [0, 0, 100], "target": [0, 1, 0], "fov": 50, "size": [64, 48]}}
    scene = make_scene(floor, views=down)
    picture = multisampled(scene, scene.view("eye"))
    assert not len(picture.sampled_pixels[0]) and picture.pixel_buffer is picture.buffer and picture.buffer.valid.all()
    slanting = {"eye": {"kind": "perspective", "eye": [0, -150, 60], "target": [0, 50, 25], "fov": 50, "size": [40, 400]}}
    scene = make_scene(floor, views=slanting)
    picture = multisampled(scene, scene.view("eye"))
    valid = picture.pixel_buffer.valid
    is_sampled = np.zeros(valid.shape, bool)
    is_sampled[picture.sampled_pixels] = True
    rim = valid & binary_dilation(~valid) | ~valid & binary_dilation(valid)
    assert rim.any() and (is_sampled == rim).all()


def test_edge_means_are_of_linear_light(gl, tower):
    """Light is averaged, not bytes: edge pixels of the picture are the mean of their points' linear colours."""
    view = tower.view("eye")
    picture = multisampled(tower, view)
    frame = render(tower, view)
    visibility = np.where(picture.buffer.valid, 1.0, 0.0).astype(np.float32)
    colours = shade(picture.buffer, tower, visibility)
    row, col = picture.sampled_pixels
    valid_samples = picture.buffer.valid.copy()
    extra_samples_valid = valid_samples[view.rows :].ravel()[: len(row) * picture.sample_count].reshape(-1, picture.sample_count)
    is_opaque = extra_samples_valid.all(axis=1) & valid_samples[row, col]  # no sky in them
    expected = encode_srgb(picture.average_samples(colours))[row[is_opaque], col[is_opaque]].astype(int)
    is_lit = frame.visibility[row[is_opaque], col[is_opaque]] == 1.0
    is_equal = np.abs(frame.color[row[is_opaque], col[is_opaque]].astype(int) - expected).max(axis=1) <= 1
    assert is_opaque.sum() > 30 and is_equal[is_lit].mean() > 0.5


def test_averages_in_closed_form():
    """Two pixels of 2 x 3 have four samples each, and the last row is padded: the means are of five values."""
    picture = np.arange(6, dtype=np.float32).reshape(2, 3, 1)
    samples = np.array([10, 20, 30, 40, 100, 100, 100, 100, 999], np.float32).reshape(3, 3, 1)
    averages = MultisampledBuffer(None, 2, (np.array([0, 1]), np.array([1, 2])), 4).average_samples(
        np.concatenate([picture, samples])
    )  # type: ignore[arg-type]
    expected = picture.copy()
    expected[0, 1], expected[1, 2] = (1 + 100) / 5, (5 + 400) / 5
    np.testing.assert_allclose(averages, expected)


def test_coarse_views_of_all_pixels_find_the_sampled_edges(gl, tower):
    """A coarse view samples every eighth pixel.

    The 64 coarse views, each shifted by a pixel, together find the edges that the picture's own triangles give.
    """
    view = tower.view("eye")
    padded_buffer = multisampled(tower, view.part(-1, -1, view.rows + 2, view.cols + 2))
    is_sampled = np.zeros((view.rows + 2, view.cols + 2), bool)
    is_sampled[padded_buffer.sampled_pixels] = True
    edge_mask, shares = np.zeros((view.rows, view.cols), bool), []
    for row in range(COARSE_STEP_PX):
        for col in range(COARSE_STEP_PX):
            coarse_view = coarse_view_of(tower, view.shifted(row, col))
            edge_samples = coarse_view.edge_samples
            edge_mask[edge_samples.row + row, edge_samples.col + col] = edge_mask_of_neighbours(
                edge_samples.triangle_number, edge_samples.distance_m, edge_samples.ground_triangle_count, edge_samples.face_normals
            )
            shares.append(coarse_view.edge_share)
    is_sampled = is_sampled[1:-1, 1:-1]
    assert 0.02 < is_sampled.mean() < 0.2 and (edge_mask != is_sampled).mean() < 1e-3
    assert np.mean(shares) == pytest.approx(edge_mask.mean())


def test_a_coarse_view_of_sky_alone_samples_every_pixel(gl, tower):
    """The first of a few pixels at the tower's outline shows the sky.

    The coarse view then samples all of them and finds their edges.
    """
    view = tower.view("eye")
    wall = geometry_buffer(tower, view).surface_kind == MESHES
    row = int(np.flatnonzero(wall.any(axis=1))[0]) + 12
    part = view.part(row, int(np.flatnonzero(wall[row])[0]) - 4, 7, 7)
    valid = geometry_buffer(tower, part).valid
    assert not valid[0, 0] and valid.any()
    assert coarse_view_of(tower, part).edge_share == pytest.approx(len(multisampled(tower, part).sampled_pixels[0]) / 49)


def test_descriptor_s_edge_share_is_the_sampled_share(gl, tower, floor, make_scene):
    """The edge share is about the share of sampled pixels. It is 0 in a map and on a floor alone."""
    view = tower.view("eye", size=(512, 384))
    sampled_share = len(multisampled(tower, view).sampled_pixels[0]) / (view.rows * view.cols)
    assert describe(tower, view).edge_share == pytest.approx(sampled_share, abs=0.01) and sampled_share > 0.01
    assert describe(tower, tower.view("map")).edge_share == 0.0
    down = {"eye": {"kind": "perspective", "eye": [0, 0, 100], "target": [0, 1, 0], "fov": 50, "size": [64, 48]}}
    scene = make_scene(floor, views=down)
    assert describe(scene, scene.view("eye")).edge_share == 0.0


def test_edge_pixel_share_counts_leaf_edges_with_few_rays(gl):
    """Most edges in a park are those of its trees, which no coarse view shows.

    With them the edge share is about the sampled share.
    """
    scene = build_scene(load_level(find_level("spatialace")))
    view = scene.view("overview", size=(320, 256))
    sampled_share = len(multisampled(scene, view).sampled_pixels[0]) / (view.rows * view.cols)
    coarse_share, described_share = coarse_view_of(scene, view).edge_share, describe(scene, view).edge_share
    assert coarse_share < 0.5 * sampled_share and described_share == pytest.approx(sampled_share, abs=0.04)
