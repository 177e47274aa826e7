"""What may be corrected of a frame's track: how the whole head lies, and a few expressions."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ..collection import Clip, Collection
from ..head import HeadModel
from ..rendering.cameras import Camera

RIGID = 6  # three of rotation (axis times radians), three of translation (metres)
_EXPRESSIONS = 8  # those that move the head most in this collection
_TURN = np.radians(0.5)  # standard deviations of a track's errors, for the prior: radians,
_SHIFT = 1.5e-3  # metres,
_SKIN = 1.5e-3  # and metres that one expression is off where it moves the skin


@dataclass(frozen=True, eq=False)
class Space:
    """The corrections [6 + K] of a collection's frames: a motion of the whole head about its
    middle, in world axes, then changes of the expressions in `rows` [K].

    sigma [6 + K]: the prior's standard deviations; low, high [K]: the range of those expressions
    in what is learned from, beyond which none is taken.
    """

    rows: np.ndarray
    sigma: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def __len__(self) -> int:
        return RIGID + len(self.rows)

    def bounded(self, correction: np.ndarray, expression: np.ndarray) -> np.ndarray:
        """The correction with the expression [E] of the track it is for kept in range."""
        own = expression[self.rows].astype(np.float64)
        out = correction.copy()
        low, high = np.minimum(self.low, own), np.maximum(self.high, own)
        out[RIGID:] = np.clip(own + correction[RIGID:], low, high) - own
        return out


def space_of(collection: Collection) -> Space:
    """Chooses the expressions that move the mesh most in this collection's training frames."""
    head = collection.head
    seen = np.concatenate([clip.expression[clip.indices("train")] for clip in collection.clips])
    moved = np.linalg.norm(head.expression_basis, axis=2)  # [E, V] metres a unit
    # where it moves the skin, not the mean over a head that mostly rests
    reach = np.sqrt((moved**2).sum(1) / np.maximum((moved > 0.1 * moved.max(1)[:, None]).sum(1), 1))
    weight = seen.std(0) * np.sqrt((moved**2).sum(1))
    rows = np.flatnonzero((weight > 0) & (reach > 0))
    rows = np.sort(rows[np.argsort(-weight[rows], kind="stable")[:_EXPRESSIONS]])
    sigma = np.concatenate([[_TURN] * 3, [_SHIFT] * 3, _SKIN / reach[rows]])
    return Space(rows, sigma, seen[:, rows].min(0), seen[:, rows].max(0))


def motion(correction: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """The rigid motion [4, 4] of a correction about the middle [3] of the tracked head."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(correction[:3]).as_matrix()
    out[:3, 3] = middle - out[:3, :3] @ middle + correction[3:RIGID]
    return out


def seen_from(camera: Camera, motion: np.ndarray) -> Camera:
    """The camera that sees the unmoved head as `camera` sees it after the motion [4, 4]."""
    moved = np.linalg.inv(motion) @ camera.camera_to_world
    return dataclasses.replace(camera, camera_to_world=moved)


def middle_of(vertices: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The middle [3] of the skull: vertices [V, 3], weights [V] of those that move with it."""
    return (weights[:, None] * vertices.astype(np.float64)).sum(0) / max(float(weights.sum()), 1e-9)


def mesh_changes(collection: Collection, clip: Clip, row: int, space: Space) -> np.ndarray:
    """Metres [K, V, 3] that the mesh of a frame moves a unit of each expression in `space`."""
    count = len(space.rows)
    expression = np.repeat(clip.expression[row][None], count + 1, 0)
    expression[np.arange(count), space.rows] += 1
    posed = _pose(collection, clip, row, expression)
    return posed[:count] - posed[count]


def corrected_mesh(
    collection: Collection, clip: Clip, row: int, space: Space, correction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and expression [E] of a frame with its expressions corrected, unmoved."""
    expression = clip.expression[row].copy()
    expression[space.rows] += correction[RIGID:].astype(np.float32)
    return _pose(collection, clip, row, expression[None])[0], expression


def _pose(collection: Collection, clip: Clip, row: int, expression: np.ndarray) -> np.ndarray:
    rows = np.full(len(expression), row)
    posed = collection.head.pose(
        collection.betas, expression, clip.pose[rows], clip.translation[rows]
    )
    return np.ascontiguousarray(posed.detach().numpy(), np.float32)


def corrected_clip(
    collection: Collection,
    clip: Clip,
    space: Space,
    corrections: dict[int, np.ndarray],
    weights: np.ndarray,
) -> Clip:
    """The clip with corrections {row: [6 + K]} in its expression, pose and translation (and in
    its vertices, where it has such); cameras stay."""
    out = dataclasses.replace(
        clip,
        expression=clip.expression.copy(),
        pose=clip.pose.copy(),
        translation=clip.translation.copy(),
        vertices=None if clip.vertices is None else clip.vertices.copy(),
    )
    for row, correction in sorted(corrections.items()):
        tracked = collection.posed(clip, np.array([row]))[0]
        moving = motion(correction, middle_of(tracked, weights))
        if out.vertices is not None:
            out.vertices[row] = tracked @ moving[:3, :3].T + moving[:3, 3]
        else:
            out.expression[row, space.rows] += correction[RIGID:].astype(np.float32)
        _move(collection.head, collection.betas, out, row, moving)
    return out


def _move(head: HeadModel, betas: np.ndarray, clip: Clip, row: int, motion: np.ndarray) -> None:
    """Moves a frame's posed head rigidly by way of its root and translation, in place."""

    def posed() -> np.ndarray:
        with torch.no_grad():
            arguments = clip.expression[[row]], clip.pose[[row]], clip.translation[[row]]
            return head.pose(betas, *arguments)[0].double().numpy()

    wanted = posed() @ motion[:3, :3].T + motion[:3, 3]
    turned = Rotation.from_matrix(motion[:3, :3]) * Rotation.from_rotvec(clip.pose[row, 0])
    clip.pose[row, 0] = turned.as_rotvec()
    clip.translation[row] += (wanted - posed()).mean(0)
