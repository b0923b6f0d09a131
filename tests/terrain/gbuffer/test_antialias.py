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
from skugga.terrain.gbuffer.antialias import MultisampledBuffer, edge_mask_of_crosses, multisampled
from skugga.terrain.gbuffer.resolve import MESHES, NO_SURFACE, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.shading import shade, srgb_encoded
from tests.rasters import ENGINEERING
from tests.render import render


@pytest.fixture
def floor(write_raster) -> Path:
    return write_raster(np.zeros((41, 41), np.float32), ENGINEERING, -205.0, 205.0, 10.0)


@pytest.fixture
def tower(floor, make_scene, tmp_path) -> Scene:
    """Return a white tower against the sky, seen from its foot and leaning, turned so that it shows two faces."""
    trimesh.creation.box(extents=(20.0, 20.0, 60.0)).export(tmp_path / "tower.obj")
    views = {"eye": {"kind": "perspective", "eye": [-60, -70, 1], "target": [3, 0, 38], "fov": 45, "size": [128, 96]}}
    meshes = [{"source": "tower.obj", "at": [0, 0], "turn": 17, "color": [0.95, 0.95, 0.95]}]
    return make_scene(floor, 250.0, 30.0, meshes=meshes, views=views)


def unsampled(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> Frame:
    """Render the frame with one point per pixel."""
    with monkeypatch.context() as patch:
        patch.setattr(
            render_module, "picture_buffer", lambda scene, part: MultisampledBuffer(geometry_buffer(scene, part), part.rows)
        )
        return render(scene, scene.view("eye"))


def wall_share(scene: Scene, view: PerspectiveView) -> np.ndarray:
    """Return the share of each pixel that shows a mesh, from 16 x 16 points."""
    fine = geometry_buffer(scene, view.finer(16)).kind == MESHES
    return fine.reshape(view.rows, 16, view.cols, 16).mean(axis=(1, 3))


def test_edge_pixels_are_blended_and_face_interiors_plain(gl, tower, monkeypatch):
    """On the outline against the sky, colours lie between the sky's and the wall's. The interior of a face has one colour."""
    view = tower.view("eye")
    frame, plain, buffer = render(tower, view), unsampled(monkeypatch, tower), geometry_buffer(tower, view)
    wall, sky = buffer.kind == MESHES, buffer.kind == NO_SURFACE
    assert 0.1 < wall.mean() < 0.9 and sky.mean() > 0.1
    share = wall_share(tower, view)
    partly = (share > 0.2) & (share < 0.8) & binary_dilation(sky) & ~binary_dilation(buffer.kind == RELIEF)
    low, high = minimum_filter(plain.color[..., 0], 5), maximum_filter(plain.color[..., 0], 5)
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
    row, col = picture.pixels
    assert len(row) > 100 and picture.each == 4
    tall = (picture.buffer.kind == MESHES).astype(float)[..., None]
    found = picture.averaged(tall)[..., 0]
    exact = wall_share(tower, view)
    own = tall[: view.rows, :, 0]
    partly = (exact > 0.02) & (exact < 0.98)
    assert partly.sum() > 80
    error, plain = np.sqrt(((found - exact)[partly] ** 2).mean()), np.sqrt(((own - exact)[partly] ** 2).mean())
    assert error < 0.5 * plain and error < 0.17 and abs((found - exact)[partly].mean()) < 0.03
    np.testing.assert_array_equal(found[~binary_dilation(partly, iterations=2)], own[~binary_dilation(partly, iterations=2)])


def test_samples_lie_inside_their_pixels(gl, tower):
    """Seen from the eye, the samples' points lie within half a pixel of the pixel's middle, at the four places of the grid."""
    view = tower.view("eye")
    picture = multisampled(tower, view)
    buffer = picture.buffer
    row, col = np.nonzero(buffer.valid)
    below = row >= view.rows
    row, col = row[below], col[below]
    eye, camera = view.in_frame(buffer.frame)
    at = (buffer.position_frame_m[row, col] - eye) @ camera.T
    found = np.column_stack([at[:, 1], at[:, 0]]) / at[:, 2:] * view.focal_px - [view.row0, view.col0]
    own = np.column_stack(picture.pixels_of(row, col))
    off = found - own
    assert len(off) > 300 and np.quantile(np.abs(np.abs(off) - 0.25), 0.95) < 1e-6
    assert {(a, b) for a, b in np.sign(off).astype(int).tolist()} == {(1, 1), (1, -1), (-1, 1), (-1, -1)}


def test_samples_leave_data_layers_unchanged(gl, tower, monkeypatch):
    """Visibility, heights and positions equal those of a frame without samples. Colours do so away from edges."""
    view = tower.view("eye")
    smooth = render(tower, view)
    pixels = multisampled(tower, view).pixels
    plain = unsampled(monkeypatch, tower)
    assert (plain.visibility == 0.0).any() and (plain.visibility == 1.0).any()
    np.testing.assert_array_equal(smooth.height_m, plain.height_m)
    np.testing.assert_array_equal(smooth.position_earth_m, plain.position_earth_m)
    np.testing.assert_array_equal(smooth.visibility < 0.5, plain.visibility < 0.5)
    np.testing.assert_allclose(smooth.visibility, plain.visibility, atol=1e-4)
    differ = (smooth.color != plain.color).any(axis=-1)
    allowed = np.zeros(differ.shape, bool)
    allowed[pixels] = True
    assert differ.any() and not (differ & ~allowed).any() and allowed.mean() < 0.2


def test_a_floor_alone_needs_no_samples(gl, floor, make_scene):
    """Its triangles meet, but no surface ends between them. At the floor's rim against the sky the surface ends."""
    down = {"eye": {"kind": "perspective", "eye": [0, 0, 100], "target": [0, 1, 0], "fov": 50, "size": [64, 48]}}
    scene = make_scene(floor, views=down)
    picture = multisampled(scene, scene.view("eye"))
    assert not len(picture.pixels[0]) and picture.own is picture.buffer and picture.buffer.valid.all()
    slanting = {"eye": {"kind": "perspective", "eye": [0, -150, 60], "target": [0, 50, 25], "fov": 50, "size": [40, 400]}}
    scene = make_scene(floor, views=slanting)
    picture = multisampled(scene, scene.view("eye"))
    valid = picture.own.valid
    marked = np.zeros(valid.shape, bool)
    marked[picture.pixels] = True
    rim = valid & binary_dilation(~valid) | ~valid & binary_dilation(valid)
    assert rim.any() and (marked == rim).all()


def test_edge_means_are_of_linear_light(gl, tower):
    """Light is averaged, not bytes: edge pixels of the picture are the mean of their points' linear colours."""
    view = tower.view("eye")
    picture = multisampled(tower, view)
    frame = render(tower, view)
    lit = np.where(picture.buffer.valid, 1.0, 0.0).astype(np.float32)
    colours = shade(picture.buffer, tower, lit)
    row, col = picture.pixels
    whole = picture.buffer.valid.copy()
    below = whole[view.rows :].ravel()[: len(row) * picture.each].reshape(-1, picture.each)
    solid = below.all(axis=1) & whole[row, col]  # no sky in them
    expected = srgb_encoded(picture.averaged(colours))[row[solid], col[solid]].astype(int)
    bright = frame.visibility[row[solid], col[solid]] == 1.0
    close = np.abs(frame.color[row[solid], col[solid]].astype(int) - expected).max(axis=1) <= 1
    assert solid.sum() > 30 and close[bright].mean() > 0.5


def test_averages_in_closed_form():
    """Two pixels of 2 x 3 have four samples each, and the last row is padded: the means are of five values."""
    picture = np.arange(6, dtype=np.float32).reshape(2, 3, 1)
    samples = np.array([10, 20, 30, 40, 100, 100, 100, 100, 999], np.float32).reshape(3, 3, 1)
    found = MultisampledBuffer(None, 2, (np.array([0, 1]), np.array([1, 2])), 4).averaged(np.concatenate([picture, samples]))  # type: ignore[arg-type]
    expected = picture.copy()
    expected[0, 1], expected[1, 2] = (1 + 100) / 5, (5 + 400) / 5
    np.testing.assert_allclose(found, expected)


def test_coarse_views_of_all_pixels_find_the_sampled_edges(gl, tower):
    """A coarse view samples every eighth pixel.

    The 64 coarse views, each shifted by a pixel, together find the edges that the picture's own triangles give.
    """
    view = tower.view("eye")
    wide = multisampled(tower, view.part(-1, -1, view.rows + 2, view.cols + 2))
    marked = np.zeros((view.rows + 2, view.cols + 2), bool)
    marked[wide.pixels] = True
    found, shares = np.zeros((view.rows, view.cols), bool), []
    for row in range(COARSE_STEP_PX):
        for col in range(COARSE_STEP_PX):
            look = coarse_view_of(tower, view.shifted(row, col))
            its = look.edge_samples
            found[its.row + row, its.col + col] = edge_mask_of_crosses(its.number, its.distance_m, its.ground, its.normals)
            shares.append(look.edge_share)
    marked = marked[1:-1, 1:-1]
    assert 0.02 < marked.mean() < 0.2 and (found != marked).mean() < 1e-3
    assert np.mean(shares) == pytest.approx(found.mean())


def test_a_coarse_view_of_sky_alone_samples_every_pixel(gl, tower):
    """The first of a few pixels at the tower's outline shows the sky.

    The coarse view then samples all of them and finds their edges.
    """
    view = tower.view("eye")
    wall = geometry_buffer(tower, view).kind == MESHES
    row = int(np.flatnonzero(wall.any(axis=1))[0]) + 12
    part = view.part(row, int(np.flatnonzero(wall[row])[0]) - 4, 7, 7)
    valid = geometry_buffer(tower, part).valid
    assert not valid[0, 0] and valid.any()
    assert coarse_view_of(tower, part).edge_share == pytest.approx(len(multisampled(tower, part).pixels[0]) / 49)


def test_descriptor_s_edge_share_is_the_sampled_share(gl, tower, floor, make_scene):
    """The edge share is about the share of sampled pixels. It is 0 in a map and on a floor alone."""
    view = tower.view("eye", size=(512, 384))
    real = len(multisampled(tower, view).pixels[0]) / (view.rows * view.cols)
    assert describe(tower, view).edge_share == pytest.approx(real, abs=0.01) and real > 0.01
    assert describe(tower, tower.view("map")).edge_share == 0.0
    down = {"eye": {"kind": "perspective", "eye": [0, 0, 100], "target": [0, 1, 0], "fov": 50, "size": [64, 48]}}
    scene = make_scene(floor, views=down)
    assert describe(scene, scene.view("eye")).edge_share == 0.0


def test_edge_share_includes_leaf_edges_from_few_rays(gl):
    """Most edges in a park are those of its trees, which no coarse view shows.

    With them the edge share is about the sampled share.
    """
    scene = build_scene(load_level(find_level("spatialace")))
    view = scene.view("overview", size=(320, 256))
    real = len(multisampled(scene, view).pixels[0]) / (view.rows * view.cols)
    bare, found = coarse_view_of(scene, view).edge_share, describe(scene, view).edge_share
    assert bare < 0.5 * real and found == pytest.approx(real, abs=0.04)
