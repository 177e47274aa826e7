"""Heads read from Blender objects deform as Blender deforms them."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")

sys.path.insert(0, str(Path(__file__).parents[2]))

import bpy

from pav_blender.bridge import mesh as bridge_mesh
from pav_blender.bridge import rig
from pav_blender.bridge.heads import head_from_object, open_object
from pav_blender.cli import main
from pav_blender.core.collection import read_collection
from pav_blender.core.errors import InputError
from pav_blender.core.evaluation.check import check
from pav_blender.core.head import builtin_head, read_head
from pav_blender.core.rendering.render import render
from pav_blender.core.training.frames import load_frames
from pav_blender.core.training.train import train
from tools.other_head import blend, shape
from tools.other_head.film import film


def evaluated(object_):
    bpy.context.view_layer.update()
    found = object_.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return bridge_mesh.evaluated_vertices(found)


@pytest.fixture
def formula(scene):
    return blend.build()


@pytest.fixture(scope="module")
def formula_path(registered, tmp_path_factory):
    """The .blend of the formula head, and the directions of its vertices."""
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    directions = blend.directions(blend.build())
    path = tmp_path_factory.mktemp("formula") / "formula.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path, directions


def with_uvs(object_):
    """Any atlas will do where none is looked at: xatlas takes seconds."""
    object_.data.uv_layers.new(name="UVMap")
    return object_


def test_the_built_in_head_comes_back_from_its_rig(scene):
    head = builtin_head()
    rng = np.random.default_rng(0)
    count = 9 * (len(head.joint_names) - 1)
    basis = rng.normal(0, 0.003, (count, *head.template.shape)).astype(np.float32)
    head = dataclasses.replace(head, pose_basis=basis)
    made = rig.build_rig(head, np.zeros(0, np.float32), "Head", scene.collection)
    back = head_from_object(made.mesh)
    assert back.name == "Head"
    assert back.joint_names == head.joint_names
    assert back.expression_names == head.expression_names
    np.testing.assert_array_equal(back.joint_parents, head.joint_parents)
    np.testing.assert_array_equal(back.triangles, head.triangles)
    np.testing.assert_allclose(back.template, head.template, atol=1e-6)
    np.testing.assert_allclose(back.uvs[back.uv_triangles], head.uvs[head.uv_triangles], atol=1e-6)
    assert {k: v.tolist() for k, v in back.regions.items()} == {
        k: v.tolist() for k, v in head.regions.items()
    }
    expression = rng.uniform(0, 1, (2, len(head.expression_names)))
    pose, move = rng.normal(0, 0.3, (2, 5, 3)), rng.normal(0, 0.1, (2, 3))
    expected = head.pose([], expression, pose, move)
    np.testing.assert_allclose(back.pose([], expression, pose, move), expected, atol=5e-5)


def test_a_foreign_rig_deforms_as_in_blender(formula):
    with_uvs(formula)
    armature = rig.find_armature(formula)
    # the artist's scene: scaled, turned and moved, in centimetres
    scene = bpy.context.scene
    scene.unit_settings.scale_length = 0.01
    holder = bpy.data.objects.new("holder", None)
    scene.collection.objects.link(holder)
    holder.scale, holder.location = (110, 110, 110), (3, -20, 160)
    formula.parent = armature.parent = holder
    bpy.context.view_layer.update()
    head = head_from_object(formula, joints=shape.JOINTS)
    assert head.joint_names == ("root", "neck", "jaw")
    assert head.joint_parents.tolist() == [-1, 0, 1]
    assert len(head.triangles) == 20480
    size = head.template.max(0) - head.template.min(0)
    assert 0.3 < size[1] < 0.45
    keys = formula.data.shape_keys.key_blocks
    keys["jawOpen"].value, keys["smile"].value = 0.7, 0.4
    expression = [[0.7, 0.4, 0.0]]
    pose = np.zeros((1, 3, 3))
    pose[0, 1, 1], pose[0, 2, 0] = 0.4, 0.2
    from mathutils import Matrix

    for joint, bone_name, axis in ((1, "skull", "Z"), (2, "chin", "X")):
        bone = armature.pose.bones[bone_name]
        angle = pose[0, joint].sum()
        turn = Matrix.Rotation(angle, 3, axis)  # core y is Blender's z
        rest = bone.bone.matrix_local.to_3x3()
        bone.rotation_mode = "QUATERNION"
        bone.rotation_quaternion = (rest.inverted() @ turn @ rest).to_quaternion()
    seen = evaluated(formula)
    matrix = np.array(formula.matrix_world) * 0.01
    world = seen[:, [0, 2, 1]] * (1, -1, 1) @ matrix[:3, :3].T + matrix[:3, 3]
    expected = head.pose([], expression, pose, np.zeros((1, 3)))[0].numpy()
    np.testing.assert_allclose(world[:, [0, 2, 1]] * (1, 1, -1), expected, atol=2e-5)
    assert np.abs(expected - head.template).max() > 0.01


def test_masks_mutes_and_loose_vertices(formula):
    with_uvs(formula)
    keys = formula.data.shape_keys.key_blocks
    keys["smile"].vertex_group = "chin"
    keys["browUp"].mute = True
    formula.vertex_groups.remove(formula.vertex_groups["spine"])
    head = head_from_object(formula, regions={"chin": "chin"})
    assert head.expression_names == ("jawOpen", "smile")
    # nothing hangs on the spine now: a root of its own holds the neck's end, which does not move
    assert head.joint_names == ("root", "skull", "chin")
    assert head.joint_parents.tolist() == [-1, 0, 1]
    low = head.template[:, 1] < -0.195
    pose = np.zeros((1, 3, 3))
    pose[0, 1] = 0.3
    moved = head.pose([], np.zeros((1, 2)), pose, np.zeros((1, 3)))[0].numpy() - head.template
    assert np.abs(moved[low]).max() < 1e-6 < 0.01 < np.abs(moved).max()
    assert {"face", "scalp", "lips", "chin"} == set(head.regions)
    full = shape.keys(blend.directions(formula))["smile"] - head.template
    mask = shape.weights(blend.directions(formula))["chin"][:, None]
    np.testing.assert_allclose(head.expression_basis[1], full * mask, atol=1e-4)


def test_what_is_no_head_is_refused(formula, tmp_path):
    with_uvs(formula)
    with pytest.raises(InputError, match="no bone 'DEF-jaw'"):
        head_from_object(formula, joints={"jaw": "DEF-jaw"})
    with pytest.raises(InputError, match="vertex group"):
        head_from_object(formula, regions={"face": "Face"})
    formula.modifiers[0].use_deform_preserve_volume = True
    with pytest.raises(InputError, match="preserves volume"):
        head_from_object(formula)
    formula.modifiers[0].use_deform_preserve_volume = False
    modifier = formula.modifiers.new("Soft", "SUBSURF")
    with pytest.raises(InputError, match="'Soft'"):
        head_from_object(formula)
    modifier.show_viewport = False
    formula.scale = (100, 100, 100)
    bpy.context.view_layer.update()
    with pytest.raises(InputError, match="life size"):
        head_from_object(formula)
    camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
    with pytest.raises(InputError, match="no mesh"):
        head_from_object(camera)
    with pytest.raises(InputError, match=blend.NAME):
        open_object(None, "Suzanne")
    with pytest.raises(InputError, match="no such Blender file"):
        open_object(tmp_path / "none.blend", None)
    (tmp_path / "text.blend").write_text("no blend")
    with pytest.raises(InputError, match="not a Blender file"):
        open_object(tmp_path / "text.blend", None)


def test_the_operator_writes_what_the_verb_writes(formula, tmp_path):
    with_uvs(formula)
    bpy.context.view_layer.objects.active = formula
    by_hand = tmp_path / "a.npz"
    assert bpy.ops.pav.save_head(filepath=str(by_hand)) == {"FINISHED"}
    assert main(["head", "--object", blend.NAME, "--out", str(tmp_path / "b.npz")]) == 0
    assert read_head(by_hand).fingerprint == read_head(tmp_path / "b.npz").fingerprint
    assert main(["head", "--out", str(tmp_path / "c.txt")]) == 2
    assert main(["head", "--joint", "jaw", "--out", str(tmp_path / "c.npz")]) == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz"]


@pytest.mark.slow
def test_from_a_blend_to_a_picture(formula_path, small_config, tmp_path, capsys):
    """A head without UVs goes all the way: head file, collection, training, picture."""
    path, directions = formula_path
    renames = [word for pair in shape.JOINTS.items() for word in ("--joint", "=".join(pair))]
    assert main(["head", str(path), *renames, "--out", str(tmp_path / "head.npz")]) == 0
    assert "root, neck, jaw" in capsys.readouterr().out
    film(tmp_path / "clips", tmp_path / "head.npz", directions, frames=7, size=64)
    collection = read_collection(tmp_path / "clips")
    assert check(collection).problems == []
    config = dataclasses.replace(small_config, iterations=60)
    avatar = train(collection, tmp_path / "formula.pav", config)
    frame = load_frames(collection, collection.clips[0], np.array([3]), targets=False)[0]
    assert collection.clips[0].split[3] == "test"
    own, other = (
        render(avatar, frame.vertices, frame.camera, name).rgba for name in avatar.appearances
    )
    truth = frame.rgba / 255
    solid = truth[..., 3] > 0.5
    assert (own[solid, 3] > 0.5).mean() > 0.9
    assert (own[truth[..., 3] == 0, 3] < 0.5).mean() > 0.9
    error, mistaken = (np.abs(p[solid, :3] - truth[solid, :3]).mean() for p in (own, other))
    assert error < 0.1
    assert mistaken > 2 * error
