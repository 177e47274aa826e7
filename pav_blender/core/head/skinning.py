"""Linear blend skinning in torch: batched, differentiable, any device."""

from __future__ import annotations

import torch

_SMALL = 1e-4  # squared angle below which the series are exact to float64 rounding


def rotation_matrices(rotations: torch.Tensor) -> torch.Tensor:
    """Axis-angle [...,3] (radians) -> rotation matrices [...,3,3], by Rodrigues' formula.

    Smooth at zero: both coefficients are functions of the squared angle and switch to their
    series before a square root could spoil the gradient.
    """
    squared = (rotations * rotations).sum(-1)
    small = squared < _SMALL
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    sine = torch.where(
        small,
        1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42)),
        torch.sin(angle) / angle,
    )
    # 2 sin^2(a/2) / a^2 is (1 - cos a) / a^2 without its cancellation
    half = torch.sin(angle / 2) / angle
    cosine = torch.where(
        small, 0.5 - squared / 24 * (1 - squared / 30 * (1 - squared / 56)), 2 * half * half
    )
    x, y, z = rotations.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1)
    cross = cross.reshape(*rotations.shape[:-1], 3, 3)
    identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
    return identity + sine[..., None, None] * cross + cosine[..., None, None] * (cross @ cross)


def pose_vertices(
    head: dict,
    betas: torch.Tensor,
    expression: torch.Tensor,
    pose: torch.Tensor,
    translation: torch.Tensor,
) -> torch.Tensor:
    """Skinned vertices [F,V,3].

    head: the model's arrays as tensors (``template``, [V,3] or [F,V,3], bases,
    ``joint_regressor``, ``skinning_weights``, ``joint_expression``) and ``joint_parents`` as a
    list. The other arguments are those of :meth:`pav_blender.core.head.model.HeadModel.pose`.
    """
    frames, joint_count = pose.shape[:2]
    shaped = head["template"] + _blend(betas, head["shape_basis"])
    joints = head["joint_regressor"] @ shaped
    if len(head["joint_expression"]):
        joints = joints + _blend(expression, head["joint_expression"])
    joints = joints.expand(frames, joint_count, 3)
    rotations = rotation_matrices(pose)
    vertices = shaped + _blend(expression, head["expression_basis"])
    if len(head["pose_basis"]):
        identity = torch.eye(3, dtype=pose.dtype, device=pose.device)
        features = (rotations[:, 1:] - identity).reshape(frames, -1)
        vertices = vertices + _blend(features, head["pose_basis"])
    turns, shifts = joint_motions(rotations, joints, head["joint_parents"])
    motions = torch.cat((turns.reshape(frames, joint_count, 9), shifts), -1)
    blended = head["skinning_weights"] @ motions  # [F,V,12]
    blended_turns = blended[..., :9].reshape(frames, -1, 3, 3)
    moved = (blended_turns @ vertices[..., None])[..., 0] + blended[..., 9:]
    return moved + translation[:, None]


def _blend(coefficients: torch.Tensor, basis: torch.Tensor) -> torch.Tensor:
    """[..., K] and [>=K,V,3] -> [...,V,3]."""
    used = basis[: coefficients.shape[-1]]
    flat = coefficients @ used.reshape(len(used), 3 * basis.shape[1])
    return flat.reshape(*coefficients.shape[:-1], *basis.shape[1:])


def joint_motions(
    rotations: torch.Tensor, joints: torch.Tensor, parents: list[int]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Rest-to-posed motions x -> turn x + shift: turns [F,J,3,3] and shifts [F,J,3]."""
    turns = [rotations[:, 0]]
    places = [joints[:, 0]]
    for joint, parent in enumerate(parents[1:], start=1):
        bone = (joints[:, joint] - joints[:, parent])[..., None]
        places.append(places[parent] + (turns[parent] @ bone)[..., 0])
        turns.append(turns[parent] @ rotations[:, joint])
    turn = torch.stack(turns, 1)
    shift = torch.stack(places, 1) - (turn @ joints[..., None])[..., 0]
    return turn, shift
