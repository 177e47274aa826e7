"""The torch pose against its float64 twin, its gradients, and the checks on its arguments."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pav_blender.core.errors import InputError
from pav_blender.core.head import HeadModel, builtin_head, oracle
from pav_blender.core.head.skinning import rotation_matrices

JOINTS = ("root", "neck", "jaw", "left_eye", "right_eye")


def small_head(seed: int = 0) -> HeadModel:
    """12 vertices, 3 identity and 4 expression components, pose correctives."""
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0, 1, (12, 5))
    regressor = rng.uniform(0, 1, (5, 12))
    return HeadModel(
        name="small",
        template=rng.normal(0, 0.1, (12, 3)),
        triangles=rng.permuted(np.tile(np.arange(12), (8, 1)), axis=1)[:, :3],
        uvs=rng.uniform(0, 1, (12, 2)),
        uv_triangles=rng.permuted(np.tile(np.arange(12), (8, 1)), axis=1)[:, :3],
        shape_basis=rng.normal(0, 0.01, (3, 12, 3)),
        expression_basis=rng.normal(0, 0.01, (4, 12, 3)),
        expression_names=("a", "b", "c", "d"),
        pose_basis=rng.normal(0, 0.01, (36, 12, 3)),
        joint_names=JOINTS,
        joint_parents=np.array([-1, 0, 1, 1, 1]),
        joint_regressor=regressor / regressor.sum(1, keepdims=True),
        skinning_weights=weights / weights.sum(1, keepdims=True),
        regions={"face": rng.uniform(size=12) > 0.5},
        landmark_triangles=np.array([3, 1]),
        landmark_barycentrics=np.array([[1, 0, 0], [0.2, 0.3, 0.5]]),
        origin="random",
    )


SMALL = small_head()
numbers = st.floats(-3, 3, width=32)
angles = st.floats(-4, 4, width=32)


@settings(max_examples=40, deadline=None)
@given(
    betas=arrays(np.float32, 3, elements=numbers),
    expression=arrays(np.float32, (2, 4), elements=numbers),
    pose=arrays(np.float32, (2, 5, 3), elements=angles),
    translation=arrays(np.float32, (2, 3), elements=numbers),
)
def test_pose_equals_oracle(betas, expression, pose, translation):
    found = SMALL.pose(betas, expression, pose, translation).numpy()
    for frame in range(2):
        wanted = oracle.pose(SMALL, betas, expression[frame], pose[frame], translation[frame])
        np.testing.assert_allclose(found[frame], wanted, atol=2e-5)


def test_double_precision_pose_equals_oracle_to_rounding():
    rng = np.random.default_rng(1)
    for scale in (0.0, 1e-9, 1e-5, 5e-3, 1e-2, 1.0):
        pose = rng.normal(0, 1, (1, 5, 3)) * scale
        arguments = rng.normal(0, 1, 3), rng.normal(0, 1, (1, 4)), pose, rng.normal(0, 1, (1, 3))
        found = SMALL.pose(*(torch.tensor(a) for a in arguments))[0].numpy()
        wanted = oracle.pose(SMALL, arguments[0], *(a[0] for a in arguments[1:]))
        np.testing.assert_allclose(found, wanted, atol=1e-14)


def test_builtin_pose_equals_oracle():
    head = builtin_head()
    rng = np.random.default_rng(2)
    betas = rng.normal(0, 1, len(head.shape_basis))
    expression = rng.uniform(0, 1, (1, len(head.expression_names)))
    pose = rng.normal(0, 0.4, (1, 5, 3))
    translation = rng.normal(0, 0.3, (1, 3))
    found = head.pose(betas, expression, pose, translation)[0].numpy()
    wanted = oracle.pose(head, betas, expression[0], pose[0], translation[0])
    np.testing.assert_allclose(found, wanted, atol=2e-6)


def test_betas_of_each_frame_and_leading_components():
    rng = np.random.default_rng(3)
    betas = rng.normal(0, 1, (2, 3)).astype(np.float32)
    expression = np.zeros((2, 4), np.float32)
    pose = rng.normal(0, 0.5, (2, 5, 3)).astype(np.float32)
    still = np.zeros((2, 3), np.float32)
    both = SMALL.pose(betas, expression, pose, still)
    for frame in range(2):
        one = SMALL.pose(betas[frame], expression, pose, still)[frame]
        torch.testing.assert_close(both[frame], one)
    short = SMALL.pose(betas[0, :1], expression[:, :2], pose, still)
    padded = SMALL.pose(betas[0] * (1, 0, 0), expression, pose, still)
    torch.testing.assert_close(short, padded)


def test_gradients_pass_gradcheck_away_from_and_at_zero_angles():
    rng = np.random.default_rng(4)
    betas = torch.tensor(rng.normal(0, 1, 3), requires_grad=True)
    expression = torch.tensor(rng.normal(0, 1, (2, 4)), requires_grad=True)
    pose = torch.tensor(rng.normal(0, 1, (2, 5, 3)))
    pose[0] = 0  # a resting frame, every joint at the singular place of the axis-angle chart
    pose[1, 2] = torch.tensor([3e-3, -4e-3, 8.6e-3])  # just inside the series
    pose.requires_grad_()
    translation = torch.tensor(rng.normal(0, 1, (2, 3)), requires_grad=True)
    inputs = (betas, expression, pose, translation)
    assert torch.autograd.gradcheck(SMALL.pose, inputs, fast_mode=True)


def test_single_precision_gradient_is_finite_and_right_at_zero():
    pose = torch.zeros(1, 5, 3, requires_grad=True)
    vertices = SMALL.pose(np.zeros(3), np.zeros((1, 4)), pose, np.zeros((1, 3)))
    vertices[0, :, 1].sum().backward()
    assert torch.isfinite(pose.grad).all()
    step = 1e-6
    moved = np.zeros((5, 3))
    moved[2, 0] = step
    still = oracle.pose(SMALL, [], [], np.zeros((5, 3)), np.zeros(3))
    slope = (oracle.pose(SMALL, [], [], moved, np.zeros(3)) - still)[:, 1].sum() / step
    assert pose.grad[0, 2, 0].item() == pytest.approx(slope, rel=1e-3)


@settings(max_examples=60, deadline=None)
@given(arrays(np.float64, 3, elements=st.floats(-20, 20)))
def test_rotation_matrices_are_rotations(vector):
    matrix = rotation_matrices(torch.tensor(vector)).numpy()
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)
    np.testing.assert_allclose(matrix @ vector, vector, atol=1e-12 * max(1, abs(vector).max()))


def test_joints_follow_identity_and_not_expression():
    betas = np.array([2.0, -1.0, 0.5], np.float32)
    assert np.abs(SMALL.joints(betas) - SMALL.joints([])).max() > 1e-4
    turn = np.zeros((1, 5, 3), np.float32)
    turn[0, 0] = (0, 3.0, 0)
    smile = np.ones((1, 4), np.float32)
    posed = SMALL.pose(betas, smile, turn, np.zeros((1, 3)))[0].numpy()
    root = SMALL.joints(betas)[0]
    # a turn of the root turns everything about the root joint of the shaped, neutral head
    offset = SMALL.pose(betas, smile, turn * 0, np.zeros((1, 3)))[0].numpy() - root
    rotated = offset @ oracle.rotation_matrix(turn[0, 0]).T.astype(np.float32)
    np.testing.assert_allclose(posed, rotated + root, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (("pose", np.zeros((1, 4, 3))), "pose"),
        (("pose", np.zeros((5, 3))), "pose"),
        (("betas", np.zeros(4)), "betas"),
        (("betas", np.zeros((3, 3))), "betas"),
        (("expression", np.zeros((1, 5))), "expression"),
        (("expression", np.zeros(4)), "expression"),
        (("translation", np.zeros((2, 3))), "translation"),
    ],
)
def test_wrong_parameter_shapes_are_named(change, word):
    arguments = {
        "betas": np.zeros(3),
        "expression": np.zeros((1, 4)),
        "pose": np.zeros((1, 5, 3)),
        "translation": np.zeros((1, 3)),
    }
    SMALL.pose(**arguments)
    with pytest.raises(InputError, match=word):
        SMALL.pose(**{**arguments, change[0]: change[1]})


@pytest.mark.parametrize(
    ("field", "value", "word"),
    [
        ("triangles", np.full((8, 3), 12), "indices"),
        ("uv_triangles", np.full((8, 3), -1), "indices"),
        ("template", np.full((12, 3), np.nan), "finite"),
        ("shape_basis", np.zeros((3, 11, 3)), "shape_basis"),
        ("pose_basis", np.zeros((35, 12, 3)), "pose_basis"),
        ("joint_parents", np.array([-1, 0, 3, 1, 1]), "joint_parents"),
        ("skinning_weights", np.ones((12, 5)), "sum to 1"),
        ("expression_names", ("a", "a", "b", "c"), "twice"),
        ("regions", {"face": np.zeros(11, bool)}, "face"),
        ("landmark_triangles", np.array([0, 99]), "indices"),
    ],
)
def test_head_that_does_not_fit_together_is_refused(field, value, word):
    with pytest.raises(InputError, match=word):
        dataclasses.replace(SMALL, **{field: value})


def test_arrays_are_read_only_and_apart_from_the_callers():
    template = SMALL.template.copy()
    head = dataclasses.replace(SMALL, template=template)
    template[:] = 0
    assert np.array_equal(head.template, SMALL.template)
    with pytest.raises(ValueError, match="read-only"):
        head.template[0] = 0


def test_fingerprint_tells_heads_apart():
    again = dataclasses.replace(SMALL, name="other")
    moved = SMALL.template.copy()
    moved[0, 0] += 1e-6
    assert again.fingerprint == SMALL.fingerprint
    assert dataclasses.replace(SMALL, template=moved).fingerprint != SMALL.fingerprint


def test_landmarks_of_arrays_and_tensors_agree():
    vertices = SMALL.pose(np.ones(3), np.ones((2, 4)), np.ones((2, 5, 3)), np.zeros((2, 3)))
    found = SMALL.landmarks(vertices)
    assert found.shape == (2, 2, 3)
    np.testing.assert_allclose(found.numpy(), SMALL.landmarks(vertices.numpy()), atol=1e-6)
    corner = SMALL.triangles[3, 0]
    np.testing.assert_allclose(found[:, 0], vertices[:, corner])
