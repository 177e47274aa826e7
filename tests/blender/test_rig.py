"""The rig in Blender deforms as the head model does."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy

from pav_blender.bridge import mesh, rig
from pav_blender.bridge.motion import Motion, apply_motion, curves, to_quaternions
from pav_blender.core.head import builtin_head

TOLERANCE_M = 5e-5


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
    for key in data.shape_keys.key_blocks[1:]:
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
