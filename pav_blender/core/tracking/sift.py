"""Frames that would teach an avatar something false, and why they are left out."""

from __future__ import annotations

import numpy as np

from .landmark_model import OVAL
from .observe import Sightings
from .people import upright

# the reasons, as they are written and shown
NO_FACE = "no face"
OTHER_FACE = "another face"
COVERED = "hand over the face"
BLURRED = "blurred"
JUMPING = "landmarks jump"
NO_FIT = "head does not fit"
SHORT_SHOT = "shot too short"

# points of a hand (of 21) inside the face's outline, which is widened by so much, for a hand at the
# chin spoils the picture too; frames between two covered ones; and so many that a hand is about to
# reach, or has just left
_POINTS, _WIDER, _BETWEEN, _BESIDE = 2, 1.2, 6, 2
# of what is usual in the clip
_DULL = 0.25
_ABOUT, _STRAY, _STRAY_LEAST = 4, 5.0, 0.05


def sift(
    seen: Sightings, rows: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, dict[str, list[int]]]:
    """Of a shot's `rows` the faces worth using, and the numbers of the other frames by reason.

    faces: numbers of the person's faces in the shot, one a frame at most.
    """
    have = np.isin(rows, seen.row[faces])
    anyone = np.isin(rows, seen.row)
    left_out: dict[str, list[int]] = {}
    _add(left_out, NO_FACE, seen.frame_id[rows[~anyone]])
    _add(left_out, OTHER_FACE, seen.frame_id[rows[anyone & ~have]])
    for reason, fault in ((COVERED, covered), (BLURRED, blurred), (JUMPING, jumping)):
        bad = fault(seen, faces)
        _add(left_out, reason, seen.frame_id[seen.row[faces[bad]]])
        faces = faces[~bad]
    return faces, left_out


def _add(left_out: dict[str, list[int]], reason: str, numbers: np.ndarray) -> None:
    if len(numbers):
        left_out[reason] = [int(number) for number in numbers]


def covered(seen: Sightings, faces: np.ndarray) -> np.ndarray:
    """bool [n]: a hand is in front of the face."""
    row = seen.row[faces]
    outlines = seen.landmarks[faces][:, OVAL, :2]
    middles = outlines.mean(axis=1, keepdims=True)
    outlines = middles + _WIDER * (outlines - middles)
    inside = [
        np.count_nonzero(_within(seen.hands[r].reshape(-1, 2), outline))
        for r, outline in zip(row, outlines, strict=True)
    ]
    hit = row[np.array(inside, int) >= _POINTS]
    reach = np.zeros(len(seen.frame_id) + 2 * _BESIDE, bool)
    for before, after in zip(hit, [*hit, 10**9][1:], strict=True):
        end = after if after - before <= _BETWEEN else before
        reach[before : end + 2 * _BESIDE + 1] = True
    return reach[row + _BESIDE]


def _within(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """bool [n]: points [n, 2] inside a closed outline [m, 2]; NaN is outside."""
    x, y = points[:, :1], points[:, 1:]
    x0, y0 = outline.T
    x1, y1 = np.roll(outline, -1, axis=0).T
    with np.errstate(divide="ignore", invalid="ignore"):
        crosses = ((y0 > y) != (y1 > y)) & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return crosses.sum(axis=1) % 2 == 1


def blurred(seen: Sightings, faces: np.ndarray) -> np.ndarray:
    """bool [n]: far less fine detail than the shot's faces usually have."""
    if len(faces) == 0:
        return np.zeros(0, bool)
    sharp = seen.sharpness[faces]
    return sharp < _DULL * float(np.median(sharp))


def jumping(seen: Sightings, faces: np.ndarray) -> np.ndarray:
    """bool [n]: the face's steady parts lie otherwise than in the frames about it, for no skull
    changes its shape."""
    if len(faces) < 3:
        return np.zeros(len(faces), bool)
    shapes = upright(seen.landmarks[faces])
    away = np.empty(len(faces))
    for i in range(len(faces)):
        about = np.r_[max(0, i - _ABOUT) : i, i + 1 : min(len(faces), i + _ABOUT + 1)]
        usual = np.median(shapes[about], axis=0)
        away[i] = np.sqrt(((shapes[i] - usual) ** 2).sum(axis=1).mean())
    return away > max(_STRAY_LEAST, _STRAY * float(np.median(away)))


def ranges(numbers: list[int], step: int = 1) -> str:
    """[1, 2, 3, 7] -> '1-3, 7'; step: between frames that were looked at."""
    parts: list[list[int]] = []
    for number in sorted(numbers):
        if parts and number == parts[-1][1] + step:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)
