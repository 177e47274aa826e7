"""Where MediaPipe's 478 landmarks lie on the head: detect on pictures of it, cast back, fuse.

Every detection votes for a place in the UV atlas, where the lips are apart even when the mouth is
shut. Votes come from several identities, expressions and sides, so that neither the detector's
prior nor one grazing view decides; left and right are averaged at the end.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from pav_blender.core.errors import PavError
from pav_blender.core.head.geometry import vertex_normals
from pav_blender.core.head.model import HeadModel
from tools.builtin_head.picture import View, draw

COUNT = 478
_SKIN = 468  # the rest are irises: centre, then four points round it; right eye first
_PEOPLE = 8
_VIEWS = tuple(
    View(640, turn, lift) for turn, lift in
    ((0, 0), (-18, 0), (18, 0), (-36, 0), (36, 0), (0, 14), (0, -14))
)  # fmt: skip
_OPEN = {"jawOpen": 0.35, "eyeWideLeft": 0.15, "eyeWideRight": 0.15}
_EXPRESSIONS: tuple[dict[str, float], ...] = (
    {"eyeWideLeft": 0.15, "eyeWideRight": 0.15},
    _OPEN,
    {"mouthSmileLeft": 0.4, "mouthSmileRight": 0.4, "jawOpen": 0.2},
)
_REACH = 10  # pixels from a detection to the skin it may be attached to
_FACING = 0.25  # least cosine between view and normal that counts as seen
_IRIS_ANGLE = 0.41  # radians: a 5.9 mm iris on the head's 14.9 mm eyeball


@dataclass(frozen=True)
class Embedding:
    triangles: np.ndarray  # [478] int32
    barycentrics: np.ndarray  # [478,3]


def embed_landmarks(head: HeadModel, mirror: np.ndarray, island: np.ndarray) -> Embedding:
    """Landmarks on the neutral topology.

    mirror: [V] mirror image of each vertex; island: bool [T], triangles of the UV island that
    carries the face. Raises :class:`PavError` where the detector sees too few of the pictures.
    """
    from mediapipe.python.solutions.face_mesh import FaceMesh  # heavy, only needed here

    skin = island & ~np.isin(head.triangles, np.flatnonzero(head.regions["ears"])).any(1)
    votes: list[list[tuple[float, ...]]] = [[] for _ in range(_SKIN)]
    frontal: list[np.ndarray] = []
    seen = 0
    with FaceMesh(static_image_mode=True, refine_landmarks=True) as detector:
        for vertices, view in _pictures(head):
            picture, index, weights = draw(head, vertices, view)
            found = detector.process(picture).multi_face_landmarks
            if found:
                seen += 1
                points = np.array([(p.x, p.y, p.z) for p in found[0].landmark]) * view.size
                _vote(head, vertices, view, index, weights, points[:, :2], skin, votes)
                if view == View(view.size, target=view.target):
                    frontal.append(points[:_SKIN])
    total = _PEOPLE * len(_EXPRESSIONS) * len(_VIEWS)
    print(f"landmarks: a face in {seen} of {total} pictures")
    if seen < 0.7 * total:
        raise PavError(f"a face was found in only {seen} of {total} pictures of the head")
    shape = np.mean(frontal, axis=0)
    partners = _partners(shape)
    side = shape[:, 0] - shape[partners, 0]
    fused = np.array(
        [
            _median(_from_own_side(np.array(v), s))
            for v, s in zip(votes, side / np.ptp(side) * 2, strict=True)
        ]
    )
    fused = _symmetrise(head, fused, mirror, partners, np.flatnonzero(skin))
    triangles, barycentrics = _locate(head, fused, np.flatnonzero(skin))
    iris = [_iris(head, side) for side in ("right_eye", "left_eye")]
    return Embedding(
        np.concatenate([triangles, *(part[0] for part in iris)]).astype(np.int32),
        np.concatenate([barycentrics, *(part[1] for part in iris)]).astype(np.float32),
    )


def _pictures(head: HeadModel):
    rng = np.random.default_rng(3)
    people = rng.normal(0, 0.6, (_PEOPLE, len(head.shape_basis)))
    people[0] = 0
    for betas, expression in product(people, _EXPRESSIONS):
        values = np.zeros((1, len(head.expression_names)))
        for name, value in expression.items():
            values[0, head.expression_names.index(name)] = value
        pose = np.zeros((1, len(head.joint_names), 3))
        vertices = head.pose(betas, values, pose, np.zeros((1, 3)))[0].numpy().astype(np.float64)
        middle = vertices[head.regions["face"]].mean(0)
        for view in _VIEWS:
            yield vertices, replace(view, target=(0.0, float(middle[1]), 0.0))


def _vote(head, vertices, view, index, weights, points, skin, votes) -> None:
    """Add each landmark's place in the atlas, with its weight, where the skin is seen there."""
    allowed = (index >= 0) & skin[index]
    rows, columns = np.nonzero(allowed)
    distance, nearest = cKDTree(np.stack([columns, rows], 1) + 0.5).query(points[:_SKIN])
    triangle = index[rows[nearest], columns[nearest]]
    blend = weights[rows[nearest], columns[nearest]]
    uv = (head.uvs[head.uv_triangles[triangle]] * blend[..., None]).sum(1)
    normals = vertex_normals(vertices, head.triangles)[head.triangles[triangle]]
    towards = np.array([np.sin(np.radians(view.turn)), 0.0, np.cos(np.radians(view.turn))])
    facing = (normals * blend[..., None]).sum(1) @ towards
    for landmark in np.flatnonzero((distance < _REACH) & (facing > 0)):
        weight = max(facing[landmark] - _FACING, 0.01) ** 2
        votes[landmark].append((*uv[landmark], weight, view.turn))


def _from_own_side(votes: np.ndarray, side: float) -> np.ndarray:
    """Votes [n,4] less those of cameras across the face, which see only its outline.

    side: -1 (the person's right) to 1.
    """
    return votes[(votes[:, 3] == 0) | (np.sign(votes[:, 3]) * side > -0.25)]


def _median(votes: np.ndarray) -> np.ndarray:
    """Weighted geometric median [2] of votes [n,4] (u, v, weight, _), by Weiszfeld's iteration."""
    points, weights = votes[:, :2], votes[:, 2]
    centre = np.average(points, axis=0, weights=weights)
    for _ in range(60):
        pull = weights / np.maximum(np.linalg.norm(points - centre, axis=1), 1e-5)
        centre = np.average(points, axis=0, weights=pull)
    return centre


def _partners(points: np.ndarray) -> np.ndarray:
    """Each landmark's counterpart across the face, from the detector's own frontal shape [n,3]."""
    middle = np.median(points[:, 0])
    image = points * (-1, 1, 1) + (2 * middle, 0, 0)
    partner = linear_sum_assignment(np.linalg.norm(points[:, None] - image[None], axis=-1))[1]
    broken = np.flatnonzero(partner[partner] != np.arange(len(points)))
    if len(broken):
        raise PavError(f"landmarks {broken.tolist()} have no partner across the face")
    return partner


def _symmetrise(head, uv, mirror, partners, candidates) -> np.ndarray:
    """Average each landmark's place [n,2] with the mirror image of its partner's."""
    triangles, blend = _locate(head, uv, candidates)
    atlas = np.zeros((len(head.template), 2))
    atlas[head.triangles[candidates]] = head.uvs[head.uv_triangles[candidates]]
    image = (atlas[mirror[head.triangles[triangles]]] * blend[..., None]).sum(1)
    differ = np.linalg.norm(uv - image[partners], axis=1).max()
    print(f"landmarks: the two sides differ by up to {differ:.4f} of the atlas")
    return 0.5 * (uv + image[partners])


def _locate(head, uv, candidates) -> tuple[np.ndarray, np.ndarray]:
    """Triangle [n] and barycentrics [n,3] nearest to places in the atlas [n,2]."""
    corners = head.uvs[head.uv_triangles[candidates]].astype(np.float64)  # [k,3,2]
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    triangles, blends = [], []
    for point in uv:
        offset = point - a
        v = (offset[:, 0] * ac[:, 1] - offset[:, 1] * ac[:, 0]) / area
        w = (ab[:, 0] * offset[:, 1] - ab[:, 1] * offset[:, 0]) / area
        blend = np.clip(np.stack([1 - v - w, v, w], 1), 0, None)
        blend /= blend.sum(1, keepdims=True)
        reached = (corners * blend[..., None]).sum(1)
        best = int(np.argmin(np.linalg.norm(reached - point, axis=1)))
        triangles.append(candidates[best])
        blends.append(blend[best])
    return np.array(triangles), np.array(blends)


def _iris(head: HeadModel, joint: str) -> tuple[np.ndarray, np.ndarray]:
    """Centre and rim of an iris: MediaPipe goes toward +x of the picture, up, -x, down."""
    centre = (head.joint_regressor @ head.template)[head.joint_names.index(joint)]
    sine, cosine = np.sin(_IRIS_ANGLE), np.cos(_IRIS_ANGLE)
    directions = np.array(
        [(0, 0, 1), (sine, 0, cosine), (0, sine, cosine), (-sine, 0, cosine), (0, -sine, cosine)]
    )
    eye = head.regions["eyeballs"][head.triangles].all(1)
    eye &= (head.template[head.triangles][..., 0].mean(1) > 0) == (centre[0] > 0)
    candidates = np.flatnonzero(eye)
    corners = (head.template[head.triangles[candidates]] - centre).astype(np.float64)
    triangles, blends = [], []
    for direction in directions:
        blend = np.linalg.solve(np.moveaxis(corners, 1, 2), np.tile(direction, (len(corners), 1)))
        best = int(np.argmax(blend.min(1)))
        triangles.append(candidates[best])
        blends.append(blend[best] / blend[best].sum())
    return np.array(triangles), np.array(blends)
