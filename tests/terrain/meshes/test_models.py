"""Model files: round trips through trimesh, axes and colours of each format, and rejected input."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image

from skugga.terrain.errors import SourceError
from skugga.terrain.meshes import models
from skugga.terrain.meshes.body import NEUTRAL_GRAY, srgb_albedo
from skugga.terrain.meshes.models import is_model, read_model

TALL_BOX = (2.0, 4.0, 6.0)


def tall_box() -> trimesh.Trimesh:
    """Return a box of 2 m east, 4 m north and 6 m up, with its centre 1 m east of and 10 m above its origin."""
    mesh = trimesh.creation.box(extents=TALL_BOX)
    mesh.apply_translation((1.0, 0.0, 10.0))
    return mesh


def to_y_up(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh with the axes of glTF: (east, up, south)."""
    turned = mesh.copy()
    turned.apply_transform([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    return turned


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb", ".gltf"])
def test_read_model_is_upright_on_its_base(tmp_path, suffix):
    path = tmp_path / f"box{suffix}"
    mesh = tall_box() if suffix in (".obj", ".ply") else to_y_up(tall_box())
    if suffix == ".gltf":
        for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
            (tmp_path / (name if name != "model.gltf" else path.name)).write_bytes(data)
    else:
        mesh.export(path)
    body = read_model(str(path))
    np.testing.assert_allclose(body.vertices_m.min(axis=0), [0, -2, 0], atol=1e-6)
    np.testing.assert_allclose(body.vertices_m.max(axis=0), [2, 2, 6], atol=1e-6)
    assert body.is_closed and body.volume_m3 == pytest.approx(48)


def test_front_of_a_gltf_model_faces_south(tmp_path):
    trimesh.Trimesh([[0, 0, 5], [1, 0, 5], [0, 1, 5]], [[0, 1, 2]]).export(tmp_path / "front.glb")
    body = read_model(str(tmp_path / "front.glb"))
    np.testing.assert_allclose(body.corner_normals()[0], [[0, -1, 0]] * 3, atol=1e-6)
    np.testing.assert_allclose(body.vertices_m[:, 1], -5)


def test_scenes_are_flattened_with_their_transforms(tmp_path):
    scene = trimesh.Scene()
    for k in range(3):
        step = np.eye(4)
        step[0, 3] = 10.0 * k
        scene.add_geometry(trimesh.creation.box(), transform=step)
    mirrored = np.diag([-1.0, 1.0, 1.0, 1.0])
    mirrored[0, 3] = 30.0
    scene.add_geometry(trimesh.creation.box(), transform=mirrored)
    scene.export(tmp_path / "row.glb")
    body = read_model(str(tmp_path / "row.glb"))
    assert len(body.triangles) == 48 and body.is_closed
    assert body.volume_m3 == pytest.approx(4)  # the mirrored box faces outwards, too
    assert np.ptp(body.vertices_m[:, 0]) == pytest.approx(31)


def test_colours_follow_the_rules_of_the_format(tmp_path):
    srgb = np.array([200, 100, 50, 255], np.uint8)
    painted = tall_box()
    painted.visual.vertex_colors = np.tile(srgb, (8, 1))
    painted.export(tmp_path / "painted.ply")
    decoded = srgb_albedo(srgb[:3] / 255)
    np.testing.assert_allclose(read_model(str(tmp_path / "painted.ply")).albedo, np.tile(decoded, (12, 1)), atol=1e-6)

    (tmp_path / "a.mtl").write_text("newmtl red\nKd 0.8 0.2 0.1\nnewmtl blue\nKd 0.1 0.2 0.8\n")
    faces = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl red\nf 1 2 3\nusemtl blue\nf 1 2 4\n"
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{faces}")
    albedo = read_model(str(tmp_path / "a.obj")).albedo
    expected = srgb_albedo([[0.8, 0.2, 0.1], [0.1, 0.2, 0.8]])
    np.testing.assert_allclose(sorted(map(tuple, albedo)), sorted(map(tuple, expected)), atol=4e-3)

    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[0.5, 0.25, 0.1, 1.0])
    metal = tall_box()
    metal.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
    metal.export(tmp_path / "metal.glb")
    albedo = read_model(str(tmp_path / "metal.glb")).albedo  # linear by the definition of glTF
    np.testing.assert_allclose(albedo, np.tile([0.5, 0.25, 0.1], (12, 1)), atol=4e-3)

    tall_box().export(tmp_path / "plain.obj")
    np.testing.assert_allclose(read_model(str(tmp_path / "plain.obj")).albedo, np.tile(srgb_albedo(NEUTRAL_GRAY), (12, 1)))


def test_textures_are_sampled_and_tinted(tmp_path):
    picture = Image.fromarray(np.array([[[255, 0, 0], [0, 0, 188]]], np.uint8).repeat(4, axis=1).repeat(8, axis=0))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, baseColorFactor=[1.0, 1.0, 0.5, 1.0])
    mesh = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0]], [[0, 1, 2], [3, 4, 5]], process=False
    )
    uv = np.repeat([[0.25, 0.5], [0.75, 0.5]], 3, axis=0)
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh.export(tmp_path / "sign.glb")
    albedo = read_model(str(tmp_path / "sign.glb")).albedo
    np.testing.assert_allclose(albedo, [[1, 0, 0], [0, 0, 0.5 * srgb_albedo(188 / 255)]], atol=4e-3)


def test_changed_file_is_read_again(tmp_path):
    path = tmp_path / "box.ply"
    trimesh.creation.box().export(path)
    assert len(read_model(str(path)).triangles) == 12
    trimesh.creation.icosphere(subdivisions=1).export(path)
    assert len(read_model(str(path)).triangles) == 80


def write_points_only(path):
    """Write a model without triangles."""
    trimesh.PointCloud(np.eye(3)).export(path)


def write_nan_vertex(path):
    """Write a model with a vertex that is not a number."""
    path.write_text("v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n")


def write_degenerate_triangle(path):
    """Write a model whose triangle has no area."""
    path.write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")


def write_truncated_glb(path):
    """Write a binary glTF file without content."""
    path.write_bytes(b"glTF\x02\x00\x00\x00\xff\xff\xff\xffrubbish")


@pytest.mark.parametrize(
    "name, write, expected_text",
    [
        ("none.glb", lambda path: None, "no such file"),
        ("broken.glb", write_truncated_glb, "cannot be read"),
        ("empty.obj", lambda path: path.write_text(""), ""),
        ("rubbish.ply", lambda path: path.write_text("no model"), ""),
        ("points.ply", write_points_only, "no triangle"),
        ("nan.obj", write_nan_vertex, "vertices that are not finite"),
        ("line.obj", write_degenerate_triangle, "no triangle with an area"),
    ],
)
def test_invalid_model_is_rejected_in_one_line(tmp_path, capfd, name, write, expected_text):
    write(tmp_path / name)
    with pytest.raises(SourceError) as caught:
        read_model(str(tmp_path / name))
    message = str(caught.value)
    assert name in message and expected_text in message and "\n" not in message, message
    assert capfd.readouterr() == ("", "")


def test_model_with_too_many_triangles_is_rejected(tmp_path, monkeypatch):
    trimesh.creation.box().export(tmp_path / "box.ply")
    monkeypatch.setattr(models, "MAX_MODEL_TRIANGLES", 11)
    with pytest.raises(SourceError, match="12 triangles, more than the limit of 11"):
        read_model(str(tmp_path / "box.ply"))


def test_is_model_checks_the_file_suffix():
    assert is_model("A/B.GLB") and is_model("x.obj") and not is_model("x.geojson") and not is_model("obj")
