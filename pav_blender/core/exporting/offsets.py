"""Posed meshes as offsets of the head at rest: so FLAME's users carry what is beyond FLAME."""

from __future__ import annotations

import numpy as np
import torch

from ..head import HeadModel
from ..head.skinning import joint_motions, rotation_matrices

_ROUNDS = 20
_CLOSE = 1e-6  # metres


def offset_to(
    head: HeadModel,
    betas: np.ndarray,
    expression: np.ndarray,
    pose: np.ndarray,
    translation: np.ndarray,
    vertices: np.ndarray,
) -> np.ndarray:
    """The offset [V, 3] metres with which the head, posed so, has these vertices [V, 3].

    expression [E], pose [J, 3], translation [3]. The joints are read off the head with its offset,
    so that this is a fixed point: some rounds of turning what is left back to rest.
    """
    parents = head.joint_parents.tolist()
    turns = rotation_matrices(torch.tensor(pose, dtype=torch.float64)[None])
    motions, _ = joint_motions(turns, torch.zeros(1, len(pose), 3).double(), parents)
    weights = torch.tensor(head.skinning_weights, dtype=torch.float64)
    blended = torch.einsum("vj,jab->vab", weights, motions[0])
    back = torch.linalg.inv(blended).numpy()
    values = torch.tensor(expression, dtype=torch.float64)[None]
    turned = torch.tensor(pose, dtype=torch.float64)[None]
    offset = np.zeros(vertices.shape)
    for _ in range(_ROUNDS):
        posed = head.pose(betas, values, turned, translation[None], offset=offset)[0].numpy()
        left = vertices - posed
        if np.abs(left).max() < _CLOSE:
            break
        offset += np.einsum("vab,vb->va", back, left)
    return offset.astype(np.float32)
