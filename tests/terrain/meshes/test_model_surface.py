"""Materials of model files: textures, samplers, colours of vertices, gloss, and warnings of what is ignored."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh
from PIL import Image

from skugga.terrain.errors import SourceError
from skugga.terrain.level.level import load_level
from skugga.terrain.meshes.models import read_model
from skugga.terrain.meshes.surface import WRAP_CLAMP, WRAP_MIRROR, WRAP_REPEAT
from skugga.terrain.scene import build_scene
from tests.model_files import board, checker, normal_map, write_gltf


def test_texture_and_normal_map_are_read_with_their_samplers(tmp_path):
    def change(described):
        described["samplers"] = [{"wrapS": 33071, "wrapT": 33648}]
        described["textures"][described["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"]]["sampler"] = 0
        described["materials"][0]["normalTexture"]["scale"] = 0.5

    mesh = board(
        baseColorTexture=checker(8), normalTexture=normal_map(0.3, 0.0), baseColorFactor=[255, 128, 64, 255],
        roughnessFactor=0.4, metallicFactor=0.0,
    )  # fmt: skip
    write_gltf(tmp_path / "board.gltf", mesh, change)
    body = read_model(str(tmp_path / "board.gltf"))
    (material,) = body.surface.materials
    assert material.texture.wrap == (WRAP_CLAMP, WRAP_MIRROR) and material.normal_map.wrap == (WRAP_REPEAT, WRAP_REPEAT)
    assert material.factor == pytest.approx((1.0, 128 / 255, 64 / 255), abs=1e-3)
    assert (material.roughness, material.metallic, material.normal_scale, material.is_glossy) == (0.4, 0.0, 0.5, True)
    assert body.warnings == ()
    np.testing.assert_array_equal(material.texture.levels[0], np.asarray(checker(8)))
    assert body.albedo[:, 0] == pytest.approx(0.5, abs=0.03)  # the mean of black and white, and not a texel of it
    assert body.surface.uv.min() == 0.0 and body.surface.uv.max() == 1.0


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_embedded_and_separate_pictures_give_the_same_texture(tmp_path, suffix):
    picture = Image.fromarray(np.full((16, 16, 3), (200, 60, 20), np.uint8))
    picture.save(tmp_path / f"picture{suffix}")
    mesh = board(baseColorTexture=Image.open(tmp_path / f"picture{suffix}"))
    mesh.export(tmp_path / "embedded.glb")
    write_gltf(tmp_path / "separate.gltf", mesh, lambda described: described["images"][0].update(uri=f"picture{suffix}"))
    levels = [read_model(str(tmp_path / name)).surface.materials[0].texture.levels for name in ("embedded.glb", "separate.gltf")]
    for level in levels:
        assert np.abs(level[0].astype(int) - (200, 60, 20)).max() <= 3
    np.testing.assert_allclose(*(level[0].astype(int) for level in levels), atol=3)


def test_each_mesh_has_its_own_material(tmp_path):
    """The order of meshes in trimesh is that of the file, also for instances of one mesh and between several primitives."""
    scene, colors = trimesh.Scene(), np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255]])
    for number in (2, 0, 1, 0, 2):
        step = np.eye(4)
        step[0, 3] = 10.0 * (number + 3 * len(scene.graph.nodes_geometry))
        scene.add_geometry(board(baseColorFactor=colors[number], roughnessFactor=0.2 + 0.1 * number), transform=step)
    scene.export(tmp_path / "boards.glb")
    body = read_model(str(tmp_path / "boards.glb"))
    number = np.rint(body.vertices_m[body.triangles].mean(axis=1)[:, 0] / 10.0).astype(int) % 3
    assert len(number) == 60
    for triangle, material in enumerate(body.surface.material):
        expected = body.surface.materials[material]
        assert expected.roughness == pytest.approx(0.2 + 0.1 * number[triangle]) and expected.factor[number[triangle]] == 1.0
    np.testing.assert_allclose(body.albedo, np.eye(3)[number], atol=1e-6)


def test_colours_of_vertices_are_interpolated(tmp_path):
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    mesh.visual.vertex_colors = [[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255]]
    mesh.export(tmp_path / "painted.glb")
    body = read_model(str(tmp_path / "painted.glb"))
    np.testing.assert_allclose(body.surface.color[0], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(body.albedo, [[1 / 3] * 3], atol=1e-6)


def test_plain_models_have_no_surface(tmp_path):
    trimesh.creation.box().export(tmp_path / "plain.obj")
    board(baseColorFactor=[200, 100, 50, 255]).export(tmp_path / "metal.glb")  # the default material of glTF, a rough metal
    assert read_model(str(tmp_path / "plain.obj")).surface is None
    assert read_model(str(tmp_path / "metal.glb")).surface is None


def test_textures_of_obj_files_are_read(tmp_path):
    checker(8).save(tmp_path / "paint.png")
    (tmp_path / "a.mtl").write_text("newmtl paint\nKd 1 1 1\nmap_Kd paint.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl paint\nf 1/1 2/2 3/3\n"
    )
    body = read_model(str(tmp_path / "a.obj"))
    assert body.surface.materials[0].texture is not None and not body.surface.materials[0].is_glossy
    np.testing.assert_allclose(sorted(map(tuple, body.surface.uv[0])), [(0.0, 0.0), (0.0, 1.0), (1.0, 1.0)])  # from the top


@pytest.mark.parametrize(
    ("change", "expected_text"),
    [
        (lambda material: material.update(alphaMode="MASK"), "alphaMode MASK, which is ignored"),
        (lambda material: material["pbrMetallicRoughness"]["baseColorTexture"].update(texCoord=1), "coordinates 1, which are not"),
        (
            lambda material: material["pbrMetallicRoughness"]["baseColorTexture"].update(
                extensions={"KHR_texture_transform": {"scale": [2, 2]}}
            ),
            "with a transform",
        ),
        (lambda material: material.update(emissiveFactor=[1, 0, 0]), "emits light"),
    ],
)
def test_what_is_ignored_is_told_once(tmp_path, change, expected_text):
    scene = trimesh.Scene()
    for side in (4, 8):
        step = np.eye(4)
        step[0, 3] = 10.0 * side
        scene.add_geometry(board(baseColorTexture=checker(side), name=f"checker {side}"), transform=step)
    write_gltf(tmp_path / "two.gltf", scene, lambda described: [change(material) for material in described["materials"]])
    (warning,) = read_model(str(tmp_path / "two.gltf")).warnings
    assert expected_text in warning and "'checker 4' (and 1 more)" in warning
    level = {
        "version": 1,
        "terrain": {"flat": {"size": [50, 50], "cells": [5, 5]}},
        "sun": "none",
        "meshes": [{"source": "two.gltf"}],
    }
    (tmp_path / "level.json").write_text(json.dumps(level))
    (told,) = build_scene(load_level(tmp_path / "level.json")).objects.warnings
    assert told == f"two.gltf: {warning}"


def test_broken_picture_is_an_error_in_one_line(tmp_path):
    write_gltf(
        tmp_path / "board.gltf", board(baseColorTexture=checker(8)), lambda described: described["images"][0].update(uri="x.png")
    )
    described = json.loads((tmp_path / "board.gltf").read_text())
    del described["images"][0]["bufferView"]
    (tmp_path / "board.gltf").write_text(json.dumps(described))
    checker(8).save(tmp_path / "x.png")
    (tmp_path / "x.png").write_bytes((tmp_path / "x.png").read_bytes()[:80])
    with pytest.raises(SourceError, match="board.gltf") as caught:
        read_model(str(tmp_path / "board.gltf"))
    assert "\n" not in str(caught.value)


def test_a_colour_of_the_level_replaces_textures(tmp_path):
    board(baseColorTexture=checker(8)).export(tmp_path / "board.glb")
    level = {
        "version": 1, "terrain": {"flat": {"size": [50, 50], "cells": [5, 5]}}, "sun": "none",
        "meshes": [{"source": "board.glb", "color": [0.5, 0.5, 0.5]}],
    }  # fmt: skip
    (tmp_path / "level.json").write_text(json.dumps(level))
    assert build_scene(load_level(tmp_path / "level.json")).objects.surface is None
