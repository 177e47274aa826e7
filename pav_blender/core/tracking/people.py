"""Which of the faces is the person: the one that comes back in the most clips.

No network for recognising people is used. A face is followed through a shot by its place; two
tracks are the same person where the shape of their skulls, as the landmarks have it, agrees. That
tells faces of different build apart, not siblings, and not an unlucky pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .landmark_model import RIGID
from .observe import Sightings
from .shots import places

# of the face's size: how far a face may move, and by which factor it may grow, from a frame to the
# next; how many frames it may be gone
_STEP, _GROWTH, _GONE = 0.5, 1.35, 8
# shape distance up to which two tracks count as one person, see `apart`
ALIKE = 0.05
_SHAPE = tuple(sorted({*RIGID, 1, 2, 4, 5, 98, 327, 129, 358, 205, 425, 117, 346, 50, 280}))
_LEFT, _RIGHT, _FOREHEAD, _CHIN = 234, 454, 10, 152
_FRONTAL = 16  # so many frames of a track, the most frontal ones, give its shape


@dataclass(eq=False)
class Face:
    """One face through a shot. source, shot: their numbers; faces [n]: numbers of the source's
    `Sightings` faces, rows [n] their frames; shape [S, 3]: see `shape_of`; weight: frames times
    the face's size."""

    source: int
    shot: int
    faces: np.ndarray
    rows: np.ndarray
    shape: np.ndarray
    weight: float


def follow(seen: Sightings, source: int, shot: int, rows: np.ndarray) -> list[Face]:
    """The faces of a shot (its `rows` are consecutive), each followed by its place."""
    middles, sizes = places(seen.landmarks)
    inside = np.flatnonzero((seen.row >= rows[0]) & (seen.row <= rows[-1]))
    tracks: list[list[int]] = []
    for row in np.unique(seen.row[inside]):
        here = [int(k) for k in inside[seen.row[inside] == row]]
        pairs = sorted(
            (_distance(middles, sizes, track[-1], k), index, k)
            for index, track in enumerate(tracks)
            if row > seen.row[track[-1]]
            for k in here
        )
        taken: set[int] = set()
        free = set(here)
        for distance, index, k in pairs:
            if distance < 1 and index not in taken and k in free:
                tracks[index].append(k)
                taken.add(index)
                free.discard(k)
        tracks += [[k] for k in sorted(free)]
    found = []
    for track in tracks:
        faces = np.array(track)
        hands = np.isfinite(seen.hands[seen.row[faces]]).any(axis=(1, 2, 3))
        shape = shape_of(seen.landmarks[faces], hands)
        weight = float(sizes[faces].sum())
        found.append(Face(source, shot, faces, seen.row[faces], shape, weight))
    return found


def _distance(middles: np.ndarray, sizes: np.ndarray, before: int, after: int) -> float:
    """Below 1 where the two may be one face."""
    size = min(sizes[before], sizes[after])
    growth = np.log(max(sizes[before], sizes[after]) / size) / np.log(_GROWTH)
    return float(max(np.linalg.norm(middles[after] - middles[before]) / (_STEP * size), growth))


def shape_of(landmarks: np.ndarray, doubtful: np.ndarray | None = None) -> np.ndarray:
    """Where a track's steady landmarks [n, 478, 3] lie in the head's own frame, [S, 3], in units of
    their spread; the median over the most frontal frames, `doubtful` ones [n] last."""
    points = landmarks.astype(np.float64)
    across = points[:, _RIGHT] - points[:, _LEFT]
    turned = np.abs(across[:, 2]) / np.maximum(np.linalg.norm(across, axis=1), 1e-9)
    order = turned if doubtful is None else turned + doubtful
    frontal = np.argsort(order, kind="stable")[:_FRONTAL]
    return np.median(upright(points[frontal]), axis=0)


def upright(landmarks: np.ndarray) -> np.ndarray:
    """Steady landmarks of faces [n, 478, 3] in a frame that turns with the head, [n, S, 3]: about
    their middle, in units of their spread."""
    points = landmarks.astype(np.float64)
    axes, _ = turns(points)
    local = np.einsum("nij,nkj->nki", axes, points[:, _SHAPE])
    local -= local.mean(axis=1, keepdims=True)
    spread = np.sqrt((local**2).sum(axis=2).mean(axis=1))
    return local / np.maximum(spread, 1e-9)[:, None, None]


def turns(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of faces [n, 478, 3]: the head's axes as rows [n, 3, 3], and its height [n] in pixels."""
    x = _unit(points[:, _RIGHT] - points[:, _LEFT])
    up = points[:, _FOREHEAD] - points[:, _CHIN]
    y = _unit(up - (up * x).sum(axis=1, keepdims=True) * x)
    height = np.maximum(np.linalg.norm(up, axis=1), 1.0)
    return np.stack([x, y, np.cross(x, y)], axis=1), height


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Root mean square distance of two shapes, of their spread."""
    return float(np.sqrt(((one - other) ** 2).sum(axis=1).mean()))


def choose(faces: list[Face]) -> tuple[list[Face], list[int]]:
    """The faces that are the person, and the sources in which only another face was found.

    The person is the face that has its like in the most sources, then for the longest and largest.
    """
    sources = sorted({face.source for face in faces})
    # short tracks have uncertain shapes: they may follow, not lead
    leaders = sorted(faces, key=lambda face: -face.weight)[:64]
    best: tuple[tuple[int, float], list[Face]] | None = None
    for leader in leaders:
        alike = [face for face in faces if apart(face.shape, leader.shape) <= ALIKE]
        score = (len({face.source for face in alike}), sum(face.weight for face in alike))
        if best is None or score > best[0]:
            best = (score, alike)
    chosen = best[1] if best else []
    # one face a frame: the larger of two that are alike
    kept: list[Face] = []
    for face in sorted(chosen, key=lambda face: -face.weight):
        if not any(_meet(face, other) for other in kept):
            kept.append(face)
    absent = [source for source in sources if source not in {face.source for face in kept}]
    return sorted(kept, key=lambda face: (face.source, int(face.faces[0]))), absent


def _meet(one: Face, other: Face) -> bool:
    same = one.source == other.source and one.shot == other.shot
    return same and len(np.intersect1d(one.rows, other.rows)) > 0
