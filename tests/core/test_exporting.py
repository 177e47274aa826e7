"""Exported layouts, read back by a reader that knows nothing of ours but the formats' own rules."""

import dataclasses
import json
import sys

import numpy as np
import pytest
from test_cli import pav

from pav_blender.cli import main
from pav_blender.core.collection import Clip
from pav_blender.core.errors import InputError
from pav_blender.core.exporting import export_insta, export_meshes, export_vhap
from pav_blender.core.images import read_gray, read_rgba
from pav_blender.core.rendering.cameras import Camera

CLOSE = 0.1  # pixels


@pytest.fixture(scope="module")
def clips(toy):
    """Both clips, off-centre, with unequal focal lengths and a held-out camera at the side."""
    made = []
    for clip in toy.clips:
        intrinsics = clip.intrinsics.copy()
        intrinsics[:, 0, 2] += 3.25
        intrinsics[:, 1, 2] -= 1.5
        intrinsics[:, 1, 1] *= 1.1
        camera_to_world = clip.camera_to_world.copy()
        turn = np.array([[np.cos(0.6), 0, np.sin(0.6)], [0, 1, 0], [-np.sin(0.6), 0, np.cos(0.6)]])
        camera_to_world[-1, :3] = turn @ camera_to_world[-1, :3]
        split = clip.split.copy()
        split[-1] = "view"
        made.append(
            dataclasses.replace(
                clip, intrinsics=intrinsics, camera_to_world=camera_to_world, split=split
            )
        )
    return made


@pytest.fixture(scope="module")
def insta(toy, clips, tmp_path_factory):
    out = tmp_path_factory.mktemp("insta") / "out"
    assert export_insta(toy, clips, out) == sum(map(len, clips))
    return out


@pytest.fixture(scope="module")
def vhap(toy, clips, tmp_path_factory):
    out = tmp_path_factory.mktemp("vhap") / "out"
    assert export_vhap(toy, clips, out) == sum(map(len, clips))
    return out


def ours(toy, clip: Clip, row: int) -> np.ndarray:
    camera = Camera(clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row])
    return camera.project(toy.posed(clip, np.array([row]))[0])[0]


def obj_vertices(path) -> np.ndarray:
    lines = [line.split() for line in path.read_text().splitlines()]
    return np.array([line[1:] for line in lines if line[0] == "v"], float)


def opencv_pixels(points, frame, lens):
    world_to_camera = np.linalg.inv(np.array(frame["transform_matrix"]))
    x, y, z = (points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]).T
    assert (z > 0).all()
    return np.stack([lens["fl_x"] * x / z + lens["cx"], lens["fl_y"] * y / z + lens["cy"]], 1)


def opengl_pixels(points, frame):
    world_to_camera = np.linalg.inv(np.array(frame["transform_matrix"]))
    x, y, z = (points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]).T
    assert (z < 0).all()
    u = frame["cx"] + frame["fl_x"] * x / -z
    v = frame["cy"] - frame["fl_y"] * y / -z
    return np.stack([u, v], 1)


def test_insta_meshes_project_where_the_collection_says(toy, clips, insta):
    for clip in clips:
        top = json.loads((insta / clip.name / "transforms.json").read_text())
        assert (top["w"], top["h"], len(top["frames"])) == (clip.width, clip.height, len(clip))
        assert top["x_fov"] == pytest.approx(np.degrees(top["camera_angle_x"]))
        focal = clip.width / 2 / np.tan(top["camera_angle_x"] / 2)
        assert focal == pytest.approx(clip.intrinsics[0, 0, 0])
        for row, frame in enumerate(top["frames"]):
            points = obj_vertices(insta / clip.name / frame["mesh_path"])
            pixels = opencv_pixels(points, frame, top)
            assert np.abs(pixels - ours(toy, clip, row)).max() < CLOSE
            rotation = np.array(frame["transform_matrix"])[:3, :3]
            np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-5)


def test_insta_heads_rest_where_the_canonical_one_is(toy, clips, insta):
    skull = toy.head.regions["scalp"]
    folder = insta / clips[0].name
    canonical = obj_vertices(folder / "canonical.obj")
    np.testing.assert_allclose(canonical, toy.head.canonical(toy.betas), atol=1e-6)
    moved = toy.posed(clips[0], np.arange(len(clips[0])))[:, skull]
    assert np.abs(moved - canonical[skull]).max() > 0.02  # it did move in the collection
    for path in sorted((folder / "meshes").iterdir()):
        assert np.median(np.abs(obj_vertices(path)[skull] - canonical[skull])) < 0.001


def test_insta_pictures_depth_parts_and_coefficients(toy, clips, insta):
    clip, folder = clips[1], insta / clips[1].name
    frame = json.loads((folder / "transforms.json").read_text())["frames"][2]
    picture = read_rgba(folder / frame["file_path"])
    np.testing.assert_array_equal(picture, read_rgba(toy.image_path(clip, 2)))
    depth = read_gray(folder / frame["depth_path"]) * 0.001
    world_to_camera = np.linalg.inv(np.array(frame["transform_matrix"]))
    points = obj_vertices(folder / frame["mesh_path"])
    z = points @ world_to_camera[2, :3] + world_to_camera[2, 3]
    assert z.min() - 1e-3 <= depth[depth > 0].min() < z.mean() < z.max()
    parts = read_rgba(folder / frame["seg_mask_path"])[..., 0]
    assert set(np.unique(parts)) <= {0, 80, 90, 110, 130, 140, 180, 210, 250}
    assert {0, 80, 250} <= set(np.unique(parts))
    np.testing.assert_array_equal(parts > 0, picture[..., 3] > 127)
    coefficients = np.loadtxt(folder / frame["exp_path"])
    assert coefficients.shape == (100,)
    count = clip.expression.shape[1]
    np.testing.assert_allclose(coefficients[:count], clip.expression[2], atol=1e-7)
    assert not coefficients[count:].any()


def test_vhap_vertices_project_where_the_collection_says(toy, clips, vhap):
    for clip in clips:
        frames = json.loads((vhap / clip.name / "transforms.json").read_text())["frames"]
        assert [frame["timestep_index"] for frame in frames] == list(range(len(clip)))
        assert [frame["camera_index"] for frame in frames] == [0] * (len(clip) - 1) + [1]
        for row, frame in enumerate(frames):
            stored = np.load(vhap / clip.name / frame["flame_param_path"], allow_pickle=False)
            pixels = opengl_pixels(stored["vertices"][0].astype(float), frame)
            assert np.abs(pixels - ours(toy, clip, row)).max() < CLOSE
            mask = read_gray(vhap / clip.name / frame["fg_mask_path"])
            picture = read_rgba(vhap / clip.name / frame["file_path"])
            np.testing.assert_array_equal(mask, picture[..., 3])
            assert frame["file_path"] == f"images/{row:05d}_{frame['camera_index']:02d}.png"


def test_vhap_parameters_pose_the_head(toy, clips, vhap):
    folder = vhap / clips[0].name / "flame_param"
    head = toy.head
    for row in (0, 5):
        stored = dict(np.load(folder / f"{row:05d}.npz", allow_pickle=False))
        assert stored["shape"].shape == (300,)
        assert stored["expr"].shape == (1, 100)
        assert stored["eyes_pose"].shape == (1, 6)
        joints = [stored["rotation"], stored["neck_pose"], stored["jaw_pose"]]
        joints += [stored["eyes_pose"][:, :3], stored["eyes_pose"][:, 3:]]
        betas = stored["shape"][: len(head.shape_basis)]
        expression = stored["expr"][:, : len(head.expression_names)]
        posed = head.pose(betas, expression, np.stack(joints, 1), stored["translation"])
        np.testing.assert_allclose(posed, stored["vertices"], atol=1e-6)
    rest = np.load(folder.parent / "canonical_flame_param.npz", allow_pickle=False)
    np.testing.assert_allclose(rest["jaw_pose"], [[0.3, 0, 0]])


def test_splits_are_kept(clips, insta, vhap):
    for out in (insta, vhap):
        for clip in clips:
            found = {}
            for name in ("", "_train", "_test", "_val"):
                content = json.loads((out / clip.name / f"transforms{name}.json").read_text())
                found[name] = [frame["file_path"] for frame in content["frames"]]
            counts = [len(found[name]) for name in ("_train", "_test", "_val")]
            assert counts == [len(clip.indices(s)) for s in ("train", "test", "view")]
            assert found[""] == found["_train"] + found["_test"] + found["_val"]


def test_a_lens_that_the_layout_cannot_hold_is_refused(toy, clips, tmp_path):
    zooming = clips[0].intrinsics.copy()
    zooming[3, 0, 0] += 5
    with pytest.raises(InputError, match="one lens a clip"):
        export_insta(toy, [dataclasses.replace(clips[0], intrinsics=zooming)], tmp_path / "out")
    skewed = clips[0].intrinsics.copy()
    skewed[:, 0, 1] = 2
    for export in (export_insta, export_vhap):
        with pytest.raises(InputError, match="skewed"):
            export(toy, [dataclasses.replace(clips[0], intrinsics=skewed)], tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError, match="exists already"):
        export_meshes(toy, clips, tmp_path / "out", "ply")


def test_the_command_writes_meshes_that_a_library_reads(toy, toy_path, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    done = pav("export", f"{toy_path}:plain", "--to", "obj", "--out", tmp_path / "obj")
    assert "8 frames" in done.stdout
    pav("export", toy_path, "--to", "ply", "--out", tmp_path / "ply")
    assert sorted(p.name for p in (tmp_path / "ply").iterdir()) == ["bushy", "plain"]
    clip = toy.clip("plain")
    posed = toy.posed(clip, np.array([5]))[0]
    ply = trimesh.load(tmp_path / "ply" / "plain" / "000005.ply", process=False)
    np.testing.assert_array_equal(ply.vertices, posed)
    np.testing.assert_array_equal(ply.faces, toy.head.triangles)
    obj = trimesh.load(tmp_path / "obj" / "plain" / "000005.obj", process=False)
    corners = obj.vertices[obj.faces]
    np.testing.assert_allclose(corners, posed[toy.head.triangles], atol=1e-6)
    np.testing.assert_allclose(
        obj.visual.uv[obj.faces], toy.head.uvs[toy.head.uv_triangles], atol=1e-6
    )


def test_wrong_words_are_one_line(toy_path, tmp_path, capsys):
    out = tmp_path / "out"

    def refused(*words):
        assert main([str(word) for word in words]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    assert "choose from" in refused("export", toy_path, "--to", "nerf", "--out", out)
    assert "no clip named" in refused("export", f"{toy_path}:x", "--to", "ply", "--out", out)
    assert "no such collection" in refused("export", tmp_path / "x", "--to", "ply", "--out", out)
    assert "takes one clip" in refused("export", toy_path, "--to", "abc", "--out", out)
    line = refused("export", f"{toy_path}:plain", "--to", "usd", "--out", tmp_path / "a.abc")
    assert ".usd" in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [["export", "{toy}:plain", "--to", "abc"], ["head"]])
def test_without_blender_the_message_says_so(words, toy_path, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "bpy", None)  # importing it raises ImportError
    suffix = {"export": "abc", "head": "npz"}[words[0]]
    words = [word.format(toy=toy_path) for word in words]
    assert main([*words, "--out", str(tmp_path / f"a.{suffix}")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "blender" in line
    assert "pip install bpy" in line
    assert list(tmp_path.iterdir()) == []
