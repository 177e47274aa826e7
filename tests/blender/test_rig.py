"""The rig in Blender deforms as the head model does."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy

from pav_blender.bridge import mesh, rig
from pav_blender.bridge.motion import Motion, apply_motion, curves, to_quaternions
from pav_blender.bridge.pose_keys import POSE_KEYS, pose_keys
from pav_blender.core.head import builtin_head

TOLERANCE_M = 5e-5
CORE_TESTS = str(Path(__file__).resolve().parents[1] / "core")


@pytest.fixture(scope="module")
def head():
    return builtin_head()


def random_track(head, rng, frames):
    return (
        rng.uniform(0, 1, (frames, len(head.expression_names))).astype(np.float32),
        rng.normal(0, 0.35, (frames, len(head.joint_names), 3)).astype(np.float32),
        rng.normal(0, 0.2, (frames, 3)).astype(np.float32),
    )


def evaluated(object_, frame):
    bpy.context.scene.frame_set(frame)
    depsgraph = bpy.context.evaluated_depsgraph_get()
    found = object_.evaluated_get(depsgraph)
    return mesh.evaluated_vertices(found)


def test_evaluated_mesh_equals_the_posed_head(scene, head):
    rng = np.random.default_rng(0)
    betas = rng.normal(0, 1, len(head.shape_basis)).astype(np.float32)
    made = rig.build_rig(head, betas, "Head", scene.collection)
    expression, pose, translation = random_track(head, rng, 6)
    pose[0] = 0
    frames = np.array([3.0, 4, 5, 10, 11, 12])
    apply_motion(
        made.mesh,
        made.armature,
        head.expression_names,
        head.joint_names,
        Motion(expression, pose, translation, frames),
    )
    expected = head.pose(betas, expression, pose, translation).numpy()
    for frame, vertices in zip(frames, expected, strict=True):
        distance = np.linalg.norm(evaluated(made.mesh, int(frame)) - vertices, axis=1)
        assert distance.max() < TOLERANCE_M, f"frame {frame}: {distance.max()} m"
    # the poses differ by far more than the tolerance, so the comparison can fail
    assert np.abs(expected[1] - expected[2]).max() > 0.01


def test_between_frames_values_are_linear(scene, head):
    made = rig.build_rig(head, np.zeros(0, np.float32), "Head", scene.collection)
    expression, pose, translation = random_track(head, np.random.default_rng(1), 2)
    motion = Motion(expression, pose, translation, np.array([0.0, 4.0]))
    apply_motion(made.mesh, made.armature, head.expression_names, head.joint_names, motion)
    scene.frame_set(1)
    key = made.mesh.data.shape_keys.key_blocks[head.expression_names[0]]
    assert key.value == pytest.approx(0.75 * expression[0, 0] + 0.25 * expression[1, 0], abs=1e-6)
    bone = made.armature.pose.bones["root"]
    expected = 0.75 * translation[0] + 0.25 * translation[1]
    np.testing.assert_allclose(bone.location, expected, atol=1e-6)


def test_a_new_track_replaces_the_old_one(scene, head):
    made = rig.build_rig(head, np.zeros(0, np.float32), "Head", scene.collection)
    for length in (5, 2):
        expression, pose, translation = random_track(head, np.random.default_rng(2), length)
        motion = Motion(expression, pose, translation, np.arange(length, dtype=float))
        apply_motion(made.mesh, made.armature, head.expression_names, head.joint_names, motion)
    lengths = {len(curve.keyframe_points) for curve in curves(made.mesh.data.shape_keys)}
    assert lengths == {2}


def test_mesh_has_uvs_groups_and_open_sliders(scene, head):
    made = rig.build_rig(head, np.zeros(0, np.float32), "Head", scene.collection)
    data = made.mesh.data
    np.testing.assert_array_equal(mesh.triangles(data), head.triangles)
    uvs = np.empty(len(data.loops) * 2, np.float32)
    data.uv_layers.active.data.foreach_get("uv", uvs)
    np.testing.assert_allclose(uvs.reshape(-1, 3, 2), head.uvs[head.uv_triangles], atol=1e-7)
    for region, members in head.regions.items():
        group = made.mesh.vertex_groups[rig.REGION_PREFIX + region].index
        inside = [any(g.group == group for g in v.groups) for v in data.vertices]
        np.testing.assert_array_equal(inside, members)
    for name in head.expression_names:
        key = data.shape_keys.key_blocks[name]
        assert (key.value, key.slider_min, key.slider_max) == (0, -10, 10)
    # an unposed rig is the neutral head
    np.testing.assert_allclose(evaluated(made.mesh, 1), head.shaped([]), atol=1e-6)


def test_pose_correctives_follow_the_bones(scene, head):
    from dataclasses import replace

    rng = np.random.default_rng(4)
    count = 9 * (len(head.joint_names) - 1)
    basis = rng.normal(0, 0.003, (count, *head.template.shape)).astype(np.float32)
    corrected = replace(head, pose_basis=basis)
    made = rig.build_rig(corrected, np.zeros(0, np.float32), "Head", scene.collection)
    expression, pose, translation = random_track(head, rng, 2)
    motion = Motion(expression, pose, translation, np.array([1.0, 2.0]))
    names = (corrected.expression_names, corrected.joint_names)
    apply_motion(made.mesh, made.armature, *names, motion)
    expected = corrected.pose(np.zeros(1), expression, pose, translation).numpy()
    for frame in (1, 2):
        distance = np.linalg.norm(evaluated(made.mesh, frame) - expected[frame - 1], axis=1)
        assert distance.max() < TOLERANCE_M


def test_quaternions_do_not_jump():
    angles = np.linspace(0, 3 * np.pi, 40)
    quaternions = to_quaternions(np.stack([angles, 0 * angles, 0 * angles], 1))
    assert (np.sum(quaternions[1:] * quaternions[:-1], 1) > 0.9).all()
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1)


def test_placement_splits_move_scale_and_stretch():
    from pav_blender.bridge import axes

    rng = np.random.default_rng(6)
    matrix = np.eye(4)
    matrix[:3, :3] = rng.normal(size=(3, 3))
    matrix[:3, 3] = rng.normal(size=3)
    rigid, stretch, scale = mesh.placement(matrix)
    points = rng.normal(size=(7, 3))
    expected = axes.points_to_core(points @ matrix[:3, :3].T + matrix[:3, 3])
    local = scale * axes.points_to_core(points) @ stretch.T
    np.testing.assert_allclose(local @ rigid[:3, :3].T + rigid[:3, 3], expected, atol=1e-9)
    assert np.linalg.det(rigid[:3, :3]) == pytest.approx(1)
    assert abs(np.linalg.det(stretch)) == pytest.approx(1)
    with pytest.raises(ValueError, match="zero"):
        mesh.placement(np.diag([1.0, 0, 1, 1]))


def total_pose(head, pose, values):
    """[J, 3] axis-angle: the bones' own turns [J, 3] after those of pose keys {name: value}."""
    from scipy.spatial.transform import Rotation

    total = []
    for joint, own in zip(head.joint_names, pose, strict=True):
        turn = np.zeros(3)  # degrees about x, y, z
        for name, value in values.items():
            if joint in POSE_KEYS[name].joints:
                turn[POSE_KEYS[name].axis] += value * POSE_KEYS[name].degrees
        x, y, z = (
            Rotation.from_rotvec(a * d, degrees=True) for a, d in zip(turn, np.eye(3), strict=True)
        )
        total.append((y * x * z * Rotation.from_rotvec(own)).as_rotvec())
    return np.array(total)


@pytest.fixture(scope="module")
def flame_head(tmp_path_factory):
    if CORE_TESTS not in sys.path:
        sys.path.append(CORE_TESTS)
    from flame_fixture import write_companions, write_model

    from pav_blender.core.head.flame import find_flame, read_flame

    folder = tmp_path_factory.mktemp("flame")
    write_model(folder / "generic_model.pkl")
    write_companions(folder)
    return read_flame(find_flame(folder, "2020"))


@pytest.mark.parametrize("which", ["head", "flame_head"])
def test_pose_keys_turn_the_joints_with_the_bones(scene, which, request, capfd):
    head = request.getfixturevalue(which)
    rng = np.random.default_rng(7)
    betas = rng.normal(0, 1, len(head.shape_basis)).astype(np.float32)
    made = rig.build_rig(head, betas, "Head", scene.collection)
    blocks = made.mesh.data.shape_keys.key_blocks
    assert pose_keys(made.mesh, made.armature) == list(POSE_KEYS)
    expression, pose, translation = random_track(head, rng, 4)
    frames = np.arange(4.0)
    motion = Motion(expression, pose, translation, frames)
    apply_motion(made.mesh, made.armature, head.expression_names, head.joint_names, motion)
    for frame in range(4):
        values = {n: float(rng.uniform(k.lowest, 1)) for n, k in POSE_KEYS.items()}
        for name, value in values.items():
            blocks[name].value = value
            blocks[name].keyframe_insert("value", frame=frame)
        total = total_pose(head, pose[frame], values)
        expected = head.pose(
            betas, expression[frame : frame + 1], total[None], translation[frame : frame + 1]
        )[0].numpy()
        distance = np.linalg.norm(evaluated(made.mesh, frame) - expected, axis=1)
        assert distance.max() < TOLERANCE_M, f"frame {frame}: {distance.max()} m"
        still = head.pose(
            betas, expression[frame : frame + 1], pose[frame][None], translation[frame : frame + 1]
        )
        assert np.abs(expected - still[0].numpy()).max() > 0.01
    drivers = [*made.armature.animation_data.drivers]
    drivers += [*(made.mesh.data.shape_keys.animation_data.drivers)]
    # short enough to be whole, and simple: evaluated without Python, so in files not trusted too
    assert all(len(curve.driver.expression) < 250 for curve in drivers)
    assert all(curve.driver.is_simple_expression for curve in drivers)
    said = capfd.readouterr()
    assert "ycle" not in said.out + said.err  # no dependency cycle


def test_pose_keys_say_what_they_do(scene, head):
    made = rig.build_rig(head, np.zeros(0, np.float32), "Head", scene.collection)
    blocks = made.mesh.data.shape_keys.key_blocks
    rest = evaluated(made.mesh, 1)
    face = head.regions["face"]
    chin = np.argmin(np.where(face, rest[:, 1], 1))
    nose = np.argmax(np.where(face, rest[:, 2], -1))
    top = np.argmax(rest[:, 1])
    pupil = np.argmax(np.where(head.regions["eyeballs"], rest[:, 2], -1))
    for name, vertex, axis, sign in (
        ("jaw_open", chin, 1, -1),
        ("jaw_left", chin, 0, 1),
        ("neck_turn", nose, 0, 1),
        ("neck_nod", nose, 1, -1),
        ("neck_tilt", top, 0, 1),
        ("eyes_left", pupil, 0, 1),
        ("eyes_up", pupil, 1, 1),
    ):
        blocks[name].value = 1.0
        moved = evaluated(made.mesh, 1) - rest
        assert moved[vertex, axis] * sign > 0.003, name
        blocks[name].value = 0.0
    np.testing.assert_allclose(evaluated(made.mesh, 1), rest, atol=1e-6)


def test_a_new_track_puts_pose_keys_to_rest(scene, head):
    made = rig.build_rig(head, np.zeros(0, np.float32), "Head", scene.collection)
    block = made.mesh.data.shape_keys.key_blocks["neck_turn"]
    block.value = 0.7
    block.keyframe_insert("value", frame=1)
    expression, pose, translation = random_track(head, np.random.default_rng(2), 2)
    motion = Motion(expression, pose, translation, np.array([1.0, 2.0]))
    apply_motion(made.mesh, made.armature, head.expression_names, head.joint_names, motion)
    scene.frame_set(1)
    assert block.value == 0


def test_heads_without_a_joint_or_with_its_key_go_without_pose_keys(scene, head):
    from pav_blender.core.head import head_from_shape_keys

    points, faces = head.template.astype(float), head.triangles
    plain = head_from_shape_keys(
        points, faces, {"smile": points + 0.01}, uvs=head.uvs, uv_triangles=head.uv_triangles
    )
    made = rig.build_rig(plain, np.zeros(0, np.float32), "Plain", scene.collection)
    assert pose_keys(made.mesh, made.armature) == []
    assert [k.name for k in made.mesh.data.shape_keys.key_blocks] == ["Basis", "smile"]
    named = head_from_shape_keys(
        points,
        faces,
        {"jaw_open": points + 0.01},
        uvs=head.uvs,
        uv_triangles=head.uv_triangles,
        joint_names=("root", "jaw"),
        joint_parents=(-1, 0),
        joint_positions=head.joints([])[[0, 2]],
        skinning_weights=np.stack(
            [1 - head.skinning_weights[:, 2], head.skinning_weights[:, 2]], 1
        ),
    )
    made = rig.build_rig(named, np.zeros(0, np.float32), "Named", scene.collection)
    assert pose_keys(made.mesh, made.armature) == ["jaw_left"]
    made.mesh.data.shape_keys.key_blocks["jaw_open"].value = 1.0
    moved = evaluated(made.mesh, 1) - named.template
    np.testing.assert_allclose(moved, 0.01, atol=1e-6)


def test_files_older_than_pose_keys_still_move(scene, head):
    made = rig.build_rig(head, np.zeros(0, np.float32), "Head", scene.collection)
    for name in pose_keys(made.mesh, made.armature):
        made.mesh.shape_key_remove(made.mesh.data.shape_keys.key_blocks[name])
    made.armature.animation_data_clear()
    assert pose_keys(made.mesh, made.armature) == []
    expression, pose, translation = random_track(head, np.random.default_rng(2), 1)
    motion = Motion(expression, pose, translation, np.array([1.0]))
    apply_motion(made.mesh, made.armature, head.expression_names, head.joint_names, motion)
    expected = head.pose(np.zeros(1), expression, pose, translation)[0].numpy()
    assert np.linalg.norm(evaluated(made.mesh, 1) - expected, axis=1).max() < TOLERANCE_M


def test_flame_expressions_keep_their_names(scene, flame_head):
    made = rig.build_rig(flame_head, np.zeros(0, np.float32), "Head", scene.collection)
    names = [key.name for key in made.mesh.data.shape_keys.key_blocks]
    assert names[1:4] == ["exp_000", "exp_001", "exp_002"]
    assert names[100] == "exp_099"


def test_materials_follow_the_regions(scene, head):
    made = rig.build_rig(head, np.zeros(0, np.float32), "Head", scene.collection)
    data = made.mesh.data
    slots = np.empty(len(data.polygons), np.int32)
    data.polygons.foreach_get("material_index", slots)
    names = np.array([material.name for material in data.materials])[slots]
    teeth = head.regions["teeth"][head.triangles].all(1)
    assert set(names[teeth]) == {"PAV teeth"}
    eyes = head.regions["eyeballs"][head.triangles].all(1)
    assert set(names[eyes]) == {"PAV eyes", "PAV iris", "PAV pupil"}
    for side in (1, -1):  # both eyes have a pupil, in front
        middles = head.template[head.triangles].mean(1)
        mine = (names == "PAV pupil") & (middles[:, 0] * side > 0)
        assert mine.sum() > 10
        assert middles[mine, 2].min() > 0.01
    count = len(bpy.data.materials)
    rig.build_rig(head, np.zeros(0, np.float32), "Second", scene.collection)
    assert len(bpy.data.materials) == count
