"""Head parameters of meshes whose tool wrote the mesh alone: every vertex corresponds."""

from __future__ import annotations

import numpy as np
import torch

from ...head import HeadModel
from ...head.flame import EYELIDS
from ...head.skinning import joint_motions, pose_vertices, rotation_matrices

_TURNING = ("jaw", "left_eye", "right_eye")  # the joints that are looked for
_STEPS = 10
_FRESH_STEPS = 2  # of these with derivatives of their own; the later ones move little
_STILL = 1e-7
_DIFFERENCE = 1e-5
_CHUNK = 256
_SAMPLES = 100  # vertices a part


def _turning(head: HeadModel) -> list[int]:
    return [head.joint_names.index(name) for name in _TURNING if name in head.joint_names]


def fit_shape(
    head: HeadModel, vertices: np.ndarray, expression: np.ndarray, pose: np.ndarray
) -> np.ndarray:
    """Betas [B] that best explain posed meshes [K, V, 3], given the rest.

    A posed mesh is affine in the betas, so that this is one linear least-squares problem; every
    fourth vertex is enough for it.
    """
    whole = head.tensors(torch.device("cpu"), torch.float64)
    chosen = torch.arange(0, head.vertex_count, 4)
    basis, weights = whole["shape_basis"][:, chosen], whole["skinning_weights"][chosen]
    rest_joints = whole["joint_regressor"] @ whole["template"]
    joint_basis = whole["joint_regressor"] @ whole["shape_basis"]  # [B,J,3]
    count = len(basis)
    normal = torch.zeros(count, count, dtype=torch.float64)
    right = torch.zeros(count, dtype=torch.float64)
    none, pose = np.zeros(count), np.asarray(pose, np.float64)
    for mesh, values, turns in zip(vertices, expression, pose, strict=True):
        moved = torch.tensor(values)[None], torch.tensor(turns)[None], np.zeros((1, 3))
        posed = head.pose(none, *moved)[0][chosen]
        rotations = rotation_matrices(torch.tensor(turns))
        joints = torch.cat([rest_joints[None], rest_joints + joint_basis])
        every = rotations.expand(count + 1, *rotations.shape)
        turn, shift = joint_motions(every, joints, head.joint_parents.tolist())
        blended = torch.einsum("vj,jab->vab", weights, turn[0])
        columns = torch.einsum("vab,nvb->nva", blended, basis)
        columns += torch.einsum("vj,nja->nva", weights, shift[1:] - shift[0])
        columns = columns.reshape(count, -1)
        normal += columns @ columns.T
        right += columns @ (torch.tensor(mesh, dtype=torch.float64)[chosen] - posed).reshape(-1)
    normal += 1e-9 * max(float(normal.trace()) / count, 1e-12) * torch.eye(count).double()
    return torch.linalg.solve(normal, right).numpy()


def fit_pose(
    head: HeadModel, betas: np.ndarray, expression: np.ndarray, vertices: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Jaw and eyes (and eyelids, where the head has them) of meshes [F, V, 3] of a still head.

    expression [F, E]. Returns pose [F, J, 3] and expression [F, E] with the eyelids filled in.
    By Gauss-Newton on some hundreds of vertices.
    """
    lids = [head.expression_names.index(n) for n in EYELIDS if n in head.expression_names]
    turning = _turning(head)
    chosen = _chosen(head, lids)
    pose = np.zeros((len(vertices), len(head.joint_names), 3))
    filled = np.array(expression, np.float64)
    if not (turning or lids):
        return pose, filled
    small = _reduced(head, betas, chosen)
    for start in range(0, len(vertices), _CHUNK):
        part = slice(start, start + _CHUNK)
        pose[part], filled[part] = _fit_chunk(
            small, filled[part], vertices[part][:, chosen].astype(np.float64), lids, turning
        )
    return pose, filled


def _chosen(head: HeadModel, lids: list[int]) -> np.ndarray:
    weights = head.skinning_weights
    parts = [np.flatnonzero(weights[:, joint] > 0.3) for joint in _turning(head)]
    parts += [np.flatnonzero(np.abs(head.expression_basis[lid]).max(1) > 1e-3) for lid in lids]
    spread = [part[:: max(1, -(-len(part) // _SAMPLES))] for part in parts]
    return np.unique(np.concatenate(spread)) if any(len(p) for p in parts) else np.arange(50)


def _reduced(head: HeadModel, betas: np.ndarray, chosen: np.ndarray) -> dict:
    """The head of an identity, for `pose_vertices`, with few vertices; the joints follow them as
    vertices of their own, from which they are read."""
    whole = head.tensors(torch.device("cpu"), torch.float64)
    shaped = torch.tensor(head.shaped(betas), dtype=torch.float64)
    joints = whole["joint_regressor"] @ shaped
    count = len(joints)
    index = torch.from_numpy(chosen)
    moves = whole["joint_expression"]
    if not len(moves):
        moves = torch.zeros(len(head.expression_names), count, 3, dtype=torch.float64)
    basis = torch.cat([whole["expression_basis"][:, index], moves], 1)
    correctives = whole["pose_basis"][:, index]
    correctives = torch.cat([correctives, correctives.new_zeros(len(correctives), count, 3)], 1)
    weights = whole["skinning_weights"][index]
    anchors = torch.eye(1, count, dtype=torch.float64).repeat(count, 1)
    regressor = torch.cat(
        [torch.zeros(count, len(chosen), dtype=torch.float64), torch.eye(count).double()], 1
    )
    return {
        "template": torch.cat([shaped[index], joints]),
        "shape_basis": torch.zeros(0, len(chosen) + count, 3, dtype=torch.float64),
        "expression_basis": basis,
        "pose_basis": correctives,
        "skinning_weights": torch.cat([weights, anchors]),
        "joint_regressor": regressor,
        "joint_expression": basis[:0, :count],  # the joints' own vertices move already
        "joint_parents": whole["joint_parents"],
        "count": len(chosen),
    }


def _fit_chunk(
    small: dict, expression: np.ndarray, goals: np.ndarray, lids: list[int], turning: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    frames, joints = len(goals), len(small["joint_parents"])
    turns = 3 * len(turning)
    unknowns = turns + len(lids)
    values = np.zeros((frames, unknowns))
    basis = small["expression_basis"]
    base = torch.tensor(expression)
    base[:, lids] = 0
    shaped = small["template"] + torch.einsum("fe,evc->fvc", base, basis)
    # the joints are read off vertices that hold all of the expression but the eyelids
    lid_basis = basis[lids]
    lid_joints = lid_basis[:, small["count"] :]
    rest = {**small, "expression_basis": lid_basis, "joint_expression": lid_joints}
    target = torch.tensor(goals)

    def posed(at: np.ndarray) -> torch.Tensor:
        pose = torch.zeros(frames, joints, 3, dtype=torch.float64)
        pose[:, turning] = torch.tensor(at[:, :turns].reshape(frames, -1, 3))
        lid = torch.tensor(at[:, turns:])
        still = torch.zeros(frames, 3, dtype=torch.float64)
        empty = torch.zeros(0, dtype=torch.float64)
        made = pose_vertices({**rest, "template": shaped}, empty, lid, pose, still)
        return made[:, : small["count"]]

    for round_ in range(_STEPS):
        now = posed(values)
        left = (target - now).reshape(frames, -1)
        if round_ < _FRESH_STEPS:
            columns = []
            for unknown in range(unknowns):
                moved = values.copy()
                moved[:, unknown] += _DIFFERENCE
                columns.append((posed(moved) - now).reshape(frames, -1) / _DIFFERENCE)
            jacobian = torch.stack(columns, 1)  # [F, unknowns, 3 K]
            normal = jacobian @ jacobian.transpose(1, 2)
            normal += 1e-9 * torch.eye(unknowns, dtype=torch.float64)
        step = torch.linalg.solve(normal, (jacobian @ left[..., None])[..., 0]).numpy()
        values += step
        if np.abs(step).max() < _STILL:
            break
    pose = np.zeros((frames, joints, 3))
    pose[:, turning] = values[:, :turns].reshape(frames, -1, 3)
    filled = expression.copy()
    filled[:, lids] = values[:, turns:]
    return pose, filled
