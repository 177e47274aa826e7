"""The synthetic person's geometry: the head model refined for rendering, and its features."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..core.errors import PavError
from ..core.head import HeadModel
from .subdivision import quads_of, subdivision

LEVELS = 2


@dataclass(eq=False)
class Part:
    """A connected piece of the refined mesh: its rows there, and quads into those rows."""

    vertices: np.ndarray
    quads: np.ndarray


@dataclass(frozen=True)
class Landmarks:
    """Feature points in rest space (metres), measured on the identity's neutral mesh."""

    eye: np.ndarray  # the left eye's joint; the right one mirrors it
    nose: np.ndarray
    bridge: np.ndarray
    mouth: np.ndarray  # middle of the lip line
    mouth_half: float  # half the width of the mouth
    chin: np.ndarray
    ear: np.ndarray  # centre of the left ear
    ear_top: np.ndarray
    top: np.ndarray
    back: np.ndarray


@dataclass(eq=False)
class Person:
    head: HeadModel
    betas: np.ndarray
    rest: np.ndarray  # [V,3] the identity, neutral
    matrix: sparse.csr_matrix  # [V',V] posed -> refined
    fine: np.ndarray  # [V',3] refined rest vertices
    parts: dict[str, Part]
    joints: np.ndarray  # [J,3] rest joints
    landmarks: Landmarks
    normals: np.ndarray = field(repr=False)  # [V',3] rest normals
    masks: dict[str, np.ndarray] = field(repr=False)  # smooth region masks on the refined mesh

    def posed(self, expression, pose, translation) -> np.ndarray:
        """The head model's vertices [V,3] of these parameters."""
        posed = self.head.pose(self.betas, expression[None], pose[None], translation[None])
        return np.ascontiguousarray(posed[0].numpy(), np.float32)

    def refined(self, posed: np.ndarray) -> np.ndarray:
        return np.asarray(self.matrix @ posed, np.float32)


def build_person(head: HeadModel, betas: np.ndarray) -> Person:
    """Refine `head` with the identity `betas` and measure it."""
    rest = np.asarray(head.shaped(betas), np.float32)
    faces = quads_of(head.triangles)
    matrix, quads = subdivision(faces, len(rest), LEVELS)
    fine = np.asarray(matrix @ rest, np.float32)
    normals = vertex_normals(fine, quads)
    masks = {
        name: np.asarray(matrix @ mask.astype(np.float32)) for name, mask in head.regions.items()
    }
    parts = _split(head, matrix, quads, fine)
    joints = np.asarray(head.joints(betas), np.float32)
    skin = parts["skin"].vertices
    landmarks = _measure(fine[skin], {k: v[skin] for k, v in masks.items()}, joints, normals[skin])
    return Person(head, betas, rest, matrix, fine, parts, joints, landmarks, normals, masks)


def _split(head: HeadModel, matrix, quads: np.ndarray, fine: np.ndarray) -> dict[str, Part]:
    """Name the connected pieces by the model's regions, sides and skinning."""
    edges = np.concatenate([quads[:, [0, 1]], quads[:, [1, 2]], quads[:, [2, 3]]])
    graph = sparse.csr_matrix((np.ones(len(edges)), edges.T), shape=(len(fine),) * 2)
    count, label = connected_components(graph, directed=False)
    eyeball = np.asarray(matrix @ head.regions["eyeballs"].astype(np.float32))
    jaw = np.asarray(matrix @ head.skinning_weights[:, head.joint_names.index("jaw")])
    sizes = np.bincount(label, minlength=count)
    groups: dict[str, list[int]] = {}
    inner = []
    for piece in range(count):
        mine = label == piece
        if piece == sizes.argmax():
            name = "skin"
        elif eyeball[mine].mean() > 0.5:
            name = "left_eye" if fine[mine, 0].mean() > 0 else "right_eye"
        else:
            inner.append(piece)
            continue
        groups.setdefault(name, []).append(piece)
    # of what hangs in the mouth: the upper row keeps still, the tongue has the most vertices
    moving = [p for p in inner if jaw[label == p].mean() > 0.5]
    for piece in inner:
        if piece not in moving:
            name = "upper_teeth"
        else:
            name = "tongue" if sizes[piece] == max(sizes[p] for p in moving) else "lower_teeth"
        groups.setdefault(name, []).append(piece)
    missing = {"skin", "left_eye", "right_eye"} - set(groups)
    if missing:
        raise PavError(f"the head model has no {', '.join(sorted(missing))}: use the built-in head")
    parts = {}
    for name, pieces in groups.items():
        vertices = np.flatnonzero(np.isin(label, pieces))
        renumber = np.full(len(fine), -1)
        renumber[vertices] = np.arange(len(vertices))
        mine = renumber[quads]
        parts[name] = Part(vertices, mine[(mine >= 0).all(1)])
    return parts


def _measure(skin, masks, joints, normals) -> Landmarks:
    x, y, z = skin.T
    eye = joints[3]
    middle = np.abs(x) < 0.004
    front = middle & (normals[:, 2] > 0) & (z > eye[2])
    face = front & (y < eye[1] + 0.01) & (y > eye[1] - 0.09)
    nose = skin[face][z[face].argmax()]
    band = front & (y > nose[1] + 0.012) & (y < eye[1] + 0.012)
    bridge = skin[band][z[band].argmin()]
    lips = masks["lips"] > 0.5
    width = float(np.abs(x[lips]).max())
    mouth = np.array([0.0, np.median(y[lips & (np.abs(x) > 0.8 * width)]), z[lips].max()])
    below = front & (y < mouth[1] - 0.012) & (y > mouth[1] - 0.065)
    # the chin is where the profile turns under: the most forward-and-down point
    chin = skin[below][(z[below] - 0.6 * y[below]).argmax()]
    ear = skin[(masks["ears"] > 0.5) & (x > 0)]
    scalp = skin[y > eye[1]]
    head = scalp[np.abs(scalp[:, 0]) < 0.02]
    return Landmarks(
        eye=eye, nose=nose, bridge=bridge, mouth=mouth.astype(np.float32), mouth_half=width,
        chin=chin, ear=ear.mean(0), ear_top=ear[ear[:, 1].argmax()],
        top=scalp[scalp[:, 1].argmax()], back=head[head[:, 2].argmin()],
    )  # fmt: skip


def vertex_normals(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals [V,3] of a quad mesh."""
    a, b, c, d = (vertices[quads[:, k]] for k in range(4))
    face = np.cross(c - a, d - b)
    out = np.zeros_like(vertices)
    for k in range(4):
        for axis in range(3):
            out[:, axis] += np.bincount(quads[:, k], face[:, axis], len(vertices))
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)


def joint_transforms(pose: np.ndarray, joints: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """Matrices [J,4,4] that take rest points to posed ones, as `HeadModel.pose` skins them."""
    out = np.tile(np.eye(4), (len(pose), 1, 1))
    for j, vector in enumerate(np.asarray(pose, float)):
        turn = np.eye(4)
        turn[:3, :3] = rotation(vector)
        turn[:3, 3] = joints[j] - turn[:3, :3] @ joints[j]
        out[j] = turn if parents[j] < 0 else out[parents[j]] @ turn
    return out


def rotation(vector: np.ndarray) -> np.ndarray:
    """Rodrigues' rotation matrix of an axis-angle vector."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-9:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


class Surface:
    """Height over the rest mesh, near enough for combing hair: nearest vertex and its normal."""

    def __init__(self, vertices: np.ndarray, normals: np.ndarray):
        self.vertices, self.normals = vertices, normals
        self.tree = cKDTree(vertices)

    def push_out(self, points: np.ndarray, clearance) -> np.ndarray:
        """Points moved out along the surface normal until they keep `clearance` (metres)."""
        _, nearest = self.tree.query(points, workers=1)
        normal = self.normals[nearest]
        height = ((points - self.vertices[nearest]) * normal).sum(1)
        lift = np.maximum(clearance - height, 0.0)
        return points + lift[:, None] * normal
