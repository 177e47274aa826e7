"""The float64 numpy twin of the torch pose: loops, written from the formulas, for the tests."""

from __future__ import annotations

import numpy as np

from .model import HeadModel


def rotation_matrix(rotation: np.ndarray) -> np.ndarray:
    """Axis-angle [3] (radians) -> [3,3]."""
    rotation = np.asarray(rotation, np.float64)
    angle = np.linalg.norm(rotation)
    if angle == 0:
        return np.eye(3)
    x, y, z = rotation / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + 2 * np.sin(angle / 2) ** 2 * (cross @ cross)


def pose(head: HeadModel, betas, expression, pose, translation) -> np.ndarray:
    """One frame: betas [B], expression [E], pose [J,3], translation [3] -> [V,3] float64."""
    shaped = head.template.astype(np.float64)
    for value, direction in zip(np.asarray(betas, np.float64), head.shape_basis, strict=False):
        shaped = shaped + value * direction.astype(np.float64)
    joints = head.joint_regressor.astype(np.float64) @ shaped
    vertices = shaped.copy()
    for value, direction in zip(
        np.asarray(expression, np.float64), head.expression_basis, strict=False
    ):
        vertices += value * direction.astype(np.float64)
    if head.joints_follow_expression:
        joints = head.joint_regressor.astype(np.float64) @ vertices
    rotations = [rotation_matrix(r) for r in pose]
    if len(head.pose_basis):
        features = np.concatenate([(r - np.eye(3)).ravel() for r in rotations[1:]])
        for value, direction in zip(features, head.pose_basis, strict=True):
            vertices += value * direction.astype(np.float64)
    motions: list[np.ndarray] = []
    for joint, parent in enumerate(head.joint_parents):
        local = np.eye(4)
        local[:3, :3] = rotations[joint]
        local[:3, 3] = joints[joint] - rotations[joint] @ joints[joint]
        motions.append(local if parent < 0 else motions[parent] @ local)
    weights = head.skinning_weights.astype(np.float64)
    result = np.zeros_like(vertices)
    for joint, motion in enumerate(motions):
        moved = vertices @ motion[:3, :3].T + motion[:3, 3]
        result += weights[:, joint, None] * moved
    return result + np.asarray(translation, np.float64)
