"""The head's landmarks as a small model of their own: positions and exact derivatives.

Posing 478 points instead of some ten thousand vertices is what makes a Gauss-Newton fit of whole
clips take seconds. A landmark is a fixed mix of three vertices and skinning is linear in vertex
positions, so mixing commutes with it and the points are those of `HeadModel.pose`, not nearly so.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..head import HeadModel, builtin_head
from ..head.geometry import vertex_normals

# where the detector sees the built-in head's landmarks: [3,478,3] metres from their places on the
# surface, in the head's frame, seen from the front, and what comes to it with each unit of
# `LandmarkModel.sides`; see tools/measure_detector.py
OFFSETS_PATH = Path(__file__).parent / "data" / "mediapipe_offsets.npy"

# MediaPipe's face mesh, by the numbers its documentation gives
LIPS = (
    61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 185, 40, 39, 37, 0, 267, 269, 270, 409,
    78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 191, 80, 81, 82, 13, 312, 311, 310, 415,
)  # fmt: skip
RIGHT_LIDS = (33, 7, 163, 144, 145, 153, 154, 155, 133, 173, 157, 158, 159, 160, 161, 246)
LEFT_LIDS = (263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466)
OVAL = (
    10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377,
    152, 148, 176, 149, 150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109,
)  # fmt: skip
RIGHT_IRIS = (468, 469, 470, 471, 472)
LEFT_IRIS = (473, 474, 475, 476, 477)
# forehead, temples, eye corners, bridge of the nose: they move with the skull
RIGID = (10, 338, 297, 332, 284, 251, 109, 67, 103, 54, 21, 33, 133, 362, 263, 6, 168, 197)
# their own surface turns inward
_INWARD = (*LIPS, *RIGHT_LIDS, *LEFT_LIDS, *RIGHT_IRIS, *LEFT_IRIS)
# upper lid, lower lid, outer corner, inner corner
RIGHT_OPENING, LEFT_OPENING = (159, 145, 33, 133), (386, 374, 263, 362)


@dataclass(eq=False)
class Posed:
    """points [F,L,3] metres; and what `LandmarkModel.jacobian` needs to go on."""

    points: np.ndarray
    parts: np.ndarray  # [F,U,3,L]: each used joint's share of a point, translation left out
    turns: np.ndarray  # [F,J,3,3] joints' rotations in the world
    places: np.ndarray  # [F,J,3] joints' positions, translation left out
    local: np.ndarray  # [F,J,3,3] joints' own rotations


class PointModel:
    """L points on `head`, with the first `shapes` identity components.

    triangles [L], barycentrics [L,3]: where they are; offsets [L,3]: metres that they stand off
    the neutral surface; forward: those that count as facing forward whatever their surface does.
    """

    def __init__(
        self,
        head: HeadModel,
        shapes: int,
        triangles: np.ndarray,
        barycentrics: np.ndarray,
        offsets: np.ndarray | None = None,
        forward: tuple[int, ...] = (),
    ) -> None:
        self.head = head
        self.forward = list(forward)
        self.barycentrics = barycentrics.astype(np.float64)
        self.corners = corners = head.triangles[triangles]  # [L,3]
        mix = self.barycentrics
        skin = mix[..., None] * head.skinning_weights[corners]  # [L,3,J]
        # the joints that move any of the points at all: on skin, no eyes
        self.used = np.flatnonzero(skin.any(axis=(0, 1)))
        skin = skin[..., self.used]  # [L,3,U]
        self.shapes = min(shapes, len(head.shape_basis))
        self.expressions = len(head.expression_basis)
        self.correctives = len(head.pose_basis)
        bases = np.concatenate(
            [
                head.shape_basis[: self.shapes, corners],
                head.expression_basis[:, corners],
                head.pose_basis[:, corners],
            ]
        ).astype(np.float64)  # [K,L,3,3]
        self.share = np.ascontiguousarray(skin.sum(axis=1).T)  # [U,L]
        rest = head.template[corners].astype(np.float64)
        self.rest = np.einsum("lvj,lvx->jxl", skin, rest)
        if offsets is not None:
            self.rest += self.share[:, None] * offsets.astype(np.float64).T
        self.basis = np.einsum("lvj,klvx->kjxl", skin, bases, optimize=True)  # [K,U,3,L]
        regressor = head.joint_regressor.astype(np.float64)
        self.joint_rest = regressor @ head.template
        self.joint_basis = np.einsum(
            "jv,bvx->jxb", regressor, head.shape_basis[: self.shapes], optimize=True
        )
        self.parents = head.joint_parents.tolist()
        self.joints = len(self.parents)
        # of the used ones, those that turn with each joint
        self.below = [np.flatnonzero(np.isin(self.used, tree)) for tree in _subtrees(self.parents)]

    @cached_property
    def normals(self) -> np.ndarray:
        """Outward directions [L,3] of the neutral head at the points."""
        corners = vertex_normals(self.head.template, self.head.triangles)[self.corners]
        normals = (corners * self.barycentrics[..., None]).sum(axis=1)
        normals[self.forward] = (0, 0, 1)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)

    def facing(self, posed: Posed) -> np.ndarray:
        """Cosines [F,L] between the points' directions and the way to the camera at the origin."""
        turn = posed.turns[:, 1 if self.joints > 1 else 0]
        normals = np.einsum("fxy,ly->flx", turn, self.normals)
        view = -posed.points / np.linalg.norm(posed.points, axis=2, keepdims=True)
        return (normals * view).sum(axis=2)

    @cached_property
    def growth(self) -> np.ndarray:
        """Relative growth of the face by one unit of each identity component, [shapes]."""
        rest = self.rest.sum(axis=0)
        rest = rest - rest.mean(axis=1, keepdims=True)
        basis = self.basis[: self.shapes].sum(axis=1)
        return np.einsum("xl,bxl->b", rest, basis) / (rest**2).sum()

    @cached_property
    def _by_landmark(self) -> np.ndarray:
        """The bases as [L, U*3, K] float32: derivatives do not need more."""
        count = self.basis.shape[-1]
        by_landmark = self.basis.transpose(3, 1, 2, 0).reshape(count, 3 * len(self.used), -1)
        return np.ascontiguousarray(by_landmark, np.float32)

    def pose(
        self,
        betas: np.ndarray,
        expression: np.ndarray,
        pose: np.ndarray,
        translation: np.ndarray,
    ) -> Posed:
        """betas [shapes], expression [F,E], pose [F,J,3] axis-angle, translation [F,3]."""
        frames = len(pose)
        local = rotations(pose)
        joints = self.joint_rest + self.joint_basis @ betas
        turns, places = [local[:, 0]], [np.broadcast_to(joints[0], (frames, 3))]
        for joint in range(1, self.joints):
            parent = self.parents[joint]
            places.append(places[parent] + turns[parent] @ (joints[joint] - joints[parent]))
            turns.append(turns[parent] @ local[:, joint])
        turn, place = np.stack(turns, 1), np.stack(places, 1)
        coefficients = [np.broadcast_to(betas, (frames, self.shapes)), expression]
        if self.correctives:
            coefficients.append((local[:, 1:] - np.eye(3)).reshape(frames, -1))
        known = np.concatenate(coefficients, 1)
        own = known @ self.basis.reshape(len(self.basis), -1)
        own = own.reshape(frames, *self.rest.shape) + self.rest
        shift = place - (turn @ joints[..., None])[..., 0]
        used = self.used
        parts = turn[:, used] @ own + shift[:, used, :, None] * self.share[:, None]
        points = parts.sum(axis=1).transpose(0, 2, 1) + translation[:, None]
        return Posed(points, parts, turn, place, local)

    def jacobian(self, posed: Posed, pose: np.ndarray, outer: np.ndarray) -> Jacobian:
        """Derivatives of `outer @ point`, outer [F,L,D,3] (a projection's own derivative)."""
        outer = outer.astype(np.float32)
        frames, count, rows = outer.shape[:3]
        turns = posed.turns[:, self.used].astype(np.float32)
        turned = outer.reshape(frames, count * rows, 3) @ turns.transpose(0, 2, 1, 3).reshape(
            frames, 3, -1
        )
        turned = turned.reshape(frames, count, rows, -1).transpose(1, 0, 2, 3)
        linear = turned.reshape(count, frames * rows, -1) @ self._by_landmark
        linear = linear.reshape(count, frames, rows, -1).transpose(1, 0, 2, 3)
        shape = linear[..., : self.shapes] + self._joint_effect(posed, outer)
        expression = linear[..., self.shapes : self.shapes + self.expressions]
        swings = rotation_derivatives(pose, posed.local)  # [F,J,3(k),3,3]
        across = np.ascontiguousarray(outer.transpose(0, 2, 3, 1))  # [F,D,3,L]
        columns = np.empty((frames, self.joints, 3, rows, count), np.float32)
        for joint in range(self.joints):
            parent = self.parents[joint]
            before = (
                posed.turns[:, parent] if parent >= 0 else np.broadcast_to(np.eye(3), (1, 3, 3))
            )
            back = posed.turns[:, joint].transpose(0, 2, 1)
            spin = before[:, None] @ swings[:, joint] @ back[:, None]  # [F,3(k),3,3]
            below = self.below[joint]
            lever = posed.parts[:, below].sum(axis=1)
            lever -= self.share[below].sum(axis=0) * posed.places[:, joint, :, None]
            swept = (spin @ lever[:, None]).astype(np.float32)  # [F,3(k),3,L]
            columns[:, joint] = (across[:, None] * swept[:, :, None]).sum(axis=3)
            if self.correctives and joint > 0:
                first = self.shapes + self.expressions + 9 * (joint - 1)
                bent = linear[..., first : first + 9].reshape(frames, count * rows, 9)
                swung = swings[:, joint].reshape(frames, 3, 9).astype(np.float32)
                bent = (bent @ swung.transpose(0, 2, 1)).reshape(frames, count, rows, 3)
                columns[:, joint] += bent.transpose(0, 3, 2, 1)
        columns = columns.reshape(frames, 3 * self.joints, rows, count).transpose(0, 3, 2, 1)
        return Jacobian(shape, expression, columns, outer)

    def _joint_effect(self, posed: Posed, outer: np.ndarray) -> np.ndarray:
        """How identity moves landmarks by moving the joints they turn about, [F,L,D,B]."""
        moved = [np.broadcast_to(self.joint_basis[0], (len(outer), *self.joint_basis[0].shape))]
        for joint in range(1, self.joints):
            parent = self.parents[joint]
            bone = self.joint_basis[joint] - self.joint_basis[parent]
            moved.append(moved[parent] + posed.turns[:, parent] @ bone)
        shift = (np.stack(moved, 1) - posed.turns @ self.joint_basis)[:, self.used]  # [F,U,3,B]
        frames, count, rows, _ = outer.shape
        pulled = outer[:, :, :, None] * self.share.T[:, None, :, None].astype(np.float32)
        drift = pulled.reshape(frames, count * rows, -1) @ shift.astype(np.float32).reshape(
            frames, -1, self.shapes
        )
        return drift.reshape(frames, count, rows, self.shapes)


class LandmarkModel(PointModel):
    """A head's landmarks, where the detector would see them.

    Raises InputError where the head has no landmarks.
    """

    def __init__(self, head: HeadModel, shapes: int) -> None:
        if len(head.landmark_triangles) == 0:
            raise InputError(
                f"head {head.name!r} has no landmark embedding, which tracking needs; add one "
                "(docs: head files) or track with the built-in head"
            )
        offsets = np.zeros((3, len(head.landmark_triangles), 3), np.float32)
        if _is_builtin(head):
            offsets = np.load(OFFSETS_PATH, allow_pickle=False)
        super().__init__(
            head,
            shapes,
            head.landmark_triangles,
            head.landmark_barycentrics,
            offsets[0],
            _INWARD,
        )
        self.by_side = offsets[1:].astype(np.float64)

    def strayed(self, posed: Posed) -> np.ndarray:
        """How much farther than from the front the detector's points stray from where the surface
        has them, [F,L,3] metres in the camera's frame."""
        turn = posed.turns[:, 1 if self.joints > 1 else 0]
        own = np.tensordot(sides(turn, posed.points), self.by_side, 1)
        return own @ turn.transpose(0, 2, 1)


def sides(turn: np.ndarray, points: np.ndarray) -> np.ndarray:
    """From where a head is looked at, [F,2]: how far from its left and from above, as sines.

    turn [F,3,3] of the head, points [F,L,3] of its face; the camera stands at the origin.
    """
    away = -points.mean(axis=1)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return np.einsum("fji,fj->fi", turn, away)[:, :2]


def _is_builtin(head: HeadModel) -> bool:
    """The same surface with the same landmarks, whatever the file is called."""
    builtin = builtin_head()
    return head.fingerprint == builtin.fingerprint and np.array_equal(
        head.landmark_triangles, builtin.landmark_triangles
    )


@dataclass(eq=False)
class Jacobian:
    """shape [F,L,D,shapes], expression [F,L,D,E], pose [F,L,D,J 3] by axis-angle components,
    translation [F,L,D,3]; float32."""

    shape: np.ndarray
    expression: np.ndarray
    pose: np.ndarray
    translation: np.ndarray


def _subtrees(parents: list[int]) -> list[list[int]]:
    below: list[list[int]] = [[joint] for joint in range(len(parents))]
    for joint in range(len(parents) - 1, 0, -1):
        below[parents[joint]] += below[joint]
    return below


def cross_matrices(vectors: np.ndarray) -> np.ndarray:
    """[...,3] -> [...,3,3] with `m @ x = cross(vector, x)`."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    return rows.reshape(*vectors.shape[:-1], 3, 3)


def rotations(vectors: np.ndarray) -> np.ndarray:
    """Axis-angle [...,3] radians -> matrices [...,3,3]."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = cross_matrices(vectors)
    sine = np.sinc(angle / np.pi)
    cosine = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + sine * cross + cosine * (cross @ cross)


def axis_angles(matrices: np.ndarray) -> np.ndarray:
    """Rotation matrices [...,3,3] -> axis-angle [...,3]; turns of less than half a circle."""
    skew = np.stack(
        [
            matrices[..., 2, 1] - matrices[..., 1, 2],
            matrices[..., 0, 2] - matrices[..., 2, 0],
            matrices[..., 1, 0] - matrices[..., 0, 1],
        ],
        -1,
    )
    cosine = ((np.trace(matrices, axis1=-2, axis2=-1) - 1) / 2).clip(-1, 1)
    angle = np.arccos(cosine)
    return skew / (2 * np.sinc(angle / np.pi))[..., None].clip(1e-9)


def rotation_derivatives(vectors: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """d matrix / d vector_k, [...,3(k),3,3] (Gallego and Yezzi 2015, with the limit at zero)."""
    squared = (vectors * vectors).sum(-1)[..., None]
    small = squared < 1e-10
    left = np.eye(3) - matrices
    spun = np.cross(vectors[..., None, :], np.moveaxis(left, -1, -2))  # row k: v x (I - R) e_k
    axis = (vectors[..., None] * vectors[..., None, :] + spun) / np.where(small, 1, squared)[
        ..., None
    ]
    axis = np.where(
        small[..., None], np.eye(3) + 0.5 * cross_matrices(vectors).swapaxes(-1, -2), axis
    )
    return cross_matrices(axis) @ matrices[..., None, :, :]
