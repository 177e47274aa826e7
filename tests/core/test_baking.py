"""A mesh baked from a field: where it lies, what is on it, and what the file holds."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from pav_blender.cli import main
from pav_blender.core.baking import bake, compare, surface, write_glb
from pav_blender.core.baking.bake import neutral_scene
from pav_blender.core.baking.texture import sample, unwrap
from pav_blender.core.baking.views import camera_at
from pav_blender.core.errors import InputError
from pav_blender.core.field.avatar import head_of
from pav_blender.core.head.geometry import vertex_normals
from pav_blender.core.rendering.rasterise import cover

pytest.importorskip("xatlas")
pytest.importorskip("fast_simplification")


@pytest.fixture(scope="module")
def baked(toy_avatar):
    """Both appearances, from small pictures on a coarse grid."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface, "_PIXELS", 160)
        patch.setattr(surface, "_RING", 6)
        options = {"texture": 128, "triangles": 3000, "spacing": 0.006}
        return {
            name: bake(neutral_scene(toy_avatar, name), **options)
            for name in toy_avatar.appearances
        }


def test_the_surface_is_the_head_and_looks_outward(toy_avatar, baked):
    mesh = baked["plain"]
    assert 0 < len(mesh.triangles) <= 3000
    head = head_of(toy_avatar)
    shape = head.shaped(toy_avatar.betas)
    seen = mesh.vertices[:, 1] > shape[head.regions["face"], 1].min()
    distance = cKDTree(shape).query(mesh.vertices[seen])[0]
    assert np.median(distance) < 0.008
    face = shape[head.regions["face"]]
    front = cKDTree(mesh.vertices).query(face)
    assert np.median(front[0]) < 0.012  # its own vertices are that far apart
    # the face looks along +z, and so does the mesh there
    nose = face[:, 2] > np.quantile(face[:, 2], 0.8)
    assert np.mean(mesh.normals[front[1][nose], 2]) > 0.5
    np.testing.assert_allclose(
        np.linalg.norm(vertex_normals(mesh.vertices, mesh.triangles), axis=1), 1, atol=1e-3
    )


def test_its_pictures_are_like_the_fields_and_not_like_anothers(toy_avatar, baked):
    scene = neutral_scene(toy_avatar, "plain")
    own = compare(scene, baked["plain"], 96)
    other = compare(scene, baked["bushy"], 96)
    assert np.mean([view.inside_psnr for view in own]) > 18
    for a, b in zip(own, other, strict=True):
        assert a.head_psnr > b.head_psnr + 1
    middle = own[0].field[..., 3] > 0.5
    assert (own[0].mesh[..., 3] > 0.5)[middle].mean() > 0.85


def test_the_file_holds_mesh_texture_and_no_light(baked, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh, path = baked["bushy"], tmp_path / "bushy.glb"
    write_glb(path, mesh, "bushy")
    assert [p.name for p in tmp_path.iterdir()] == ["bushy.glb"]
    read = trimesh.load(path, force="mesh", process=False)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(read.faces, mesh.triangles)
    np.testing.assert_allclose(read.visual.uv, mesh.uvs, atol=1e-6)
    image = np.asarray(read.visual.material.baseColorTexture)[..., :3] / 255
    assert np.abs(image - mesh.texture).max() <= 0.5 / 255 + 1e-6
    raw = path.read_bytes()
    tree = json.loads(raw[20 : 20 + int.from_bytes(raw[12:16], "little")])
    assert "KHR_materials_unlit" in tree["materials"][0]["extensions"]
    with pytest.raises(InputError, match="glb"):
        write_glb(tmp_path / "bushy.obj", mesh, "bushy")


def test_texels_and_samples_agree():
    size, rng = 64, np.random.default_rng(0)
    texture = rng.uniform(size=(size, size, 3))
    centres = (np.indices((size, size)).reshape(2, -1).T[:, ::-1] + 0.5) / size
    found = sample(texture, centres[:-1] * (1, -1) + (0, 1))
    inner = (centres[:-1] < 1 - 0.6 / size).all(1)
    np.testing.assert_allclose(found[inner], texture.reshape(-1, 3)[:-1][inner], atol=1e-3)
    corners = np.array([[1.0, 1], [61, 3], [5, 60]])
    triangle, weights = cover(corners, np.array([[0, 1, 2]]), size)
    rows, columns = np.nonzero(triangle == 0)
    assert len(rows) > 1500
    np.testing.assert_allclose(
        weights[rows, columns] @ corners, np.stack([columns, rows], 1) + 0.5, atol=1e-4
    )


def test_charts_do_not_overlap(baked):
    mesh = baked["plain"]
    source, corners, uvs = unwrap(mesh.vertices, mesh.triangles, 128)
    np.testing.assert_array_equal(mesh.vertices[source][corners], mesh.vertices[mesh.triangles])
    edges = uvs[corners][:, 1:] - uvs[corners][:, :1]
    area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum() / 2
    covered = (cover((uvs * (1, -1) + (0, 1)) * 512, corners, 512)[0] >= 0).mean()
    assert covered == pytest.approx(area, rel=0.05)


def test_cameras_look_where_they_should():
    middle = np.array([0.1, -0.2, 0.3])
    front = camera_at(middle, 0, 0, 0.3, 100)
    pixels, depth = front.project(np.stack([middle, middle + np.array([0.05, 0.1, 0])]))
    np.testing.assert_allclose(pixels[0], 50)
    assert pixels[1, 0] > 50 > pixels[1, 1]  # her left is on the picture's right; up is up
    assert depth[0] == pytest.approx(1.5)
    left = camera_at(middle, np.pi / 2, 0, 0.3, 100)
    assert left.origin[0] > middle[0] + 1
    above = camera_at(middle, 0, 0.5, 0.3, 100)
    assert above.origin[1] > middle[1] + 0.5


def test_an_avatar_of_nothing_is_refused(toy_avatar):
    scene = neutral_scene(toy_avatar, "plain")
    bricks, cells = torch.full_like(scene.voxels.bricks, -1), scene.voxels.cells[:0]
    empty = dataclasses.replace(
        scene, voxels=dataclasses.replace(scene.voxels, bricks=bricks, cells=cells)
    )
    with pytest.raises(InputError, match="nothing to bake"):
        bake(empty, texture=64, triangles=1000)


def test_wrong_words_are_one_line(toy_avatar_path, tmp_path, capsys):
    def refused(*words):
        assert main(["bake", str(toy_avatar_path), *map(str, words)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    assert ".glb" in refused("--out", tmp_path / "a.obj")
    assert "no such folder" in refused("--out", tmp_path / "x" / "a.glb")
    out = tmp_path / "a.glb"
    assert "plain, bushy" in refused("--out", out, "--appearance", "bald")
    assert "texture" in refused("--out", out, "--texture", 3)
    assert "triangles" in refused("--out", out, "--triangles", 3)
    assert list(tmp_path.iterdir()) == []
