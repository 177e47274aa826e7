"""Few frames out of many: as different as can be in turn and expression, not in time alone."""

from __future__ import annotations

import numpy as np

from .landmark_model import LEFT_OPENING, LIPS, RIGHT_OPENING
from .observe import Observations
from .people import turns

TEST_SHARE = 0.1
# what counts as one unit of difference: radians of the head; of the face's size, its place; and of
# its size, lips and lids; a score; and the part of the clip that passes meanwhile, so that where
# nothing moves frames are spread over time
_TURN, _PLACE, _SHAPE, _SCORE, _TIME = 0.15, 0.5, 0.05, 0.4, 0.5
_BROWS = (55, 285, 105, 334)


def splits(count: int) -> np.ndarray:
    """The last tenth (one frame at least, of two or more) is held out, [count] '<U8'."""
    split = np.full(count, "train", "<U8")
    held = max(1, round(count * TEST_SHARE)) if count > 1 else 0
    split[count - held :] = "test"
    return split


def spread(seen: Observations, most: int | None) -> np.ndarray:
    """Rows of `seen`, `most` of them, in order.

    The last tenth of the clip keeps its share: it is held out later, and a mixture of both would
    be held out of nothing.
    """
    if most is None or len(seen) <= most:
        return np.arange(len(seen))
    features = look(seen)
    held = int((splits(len(seen)) == "test").sum())
    wanted = int((splits(most) == "test").sum())
    first = len(seen) - held
    train = farthest(features[:first], most - wanted)
    test = farthest(features[first:], wanted)
    return np.concatenate([train, first + test])


def look(seen: Observations) -> np.ndarray:
    """What tells frames apart, [F, D], a unit of each being one step of difference."""
    points = seen.landmarks.astype(np.float64)
    axes, size = turns(points)
    middle = points[..., :2].mean(axis=1)
    moving = np.einsum("fij,fkj->fki", axes, points - points.mean(axis=1, keepdims=True))
    shape = moving[:, [*LIPS, *LEFT_OPENING, *RIGHT_OPENING, *_BROWS]] / size[:, None, None]
    shape = shape.reshape(len(points), -1)
    parts = [
        axes.reshape(len(points), -1) / (_TURN * np.sqrt(2)),
        (middle - middle.mean(axis=0)) / (_PLACE * size.mean()),
        np.log(size / size.mean())[:, None] / _PLACE,
        shape / (_SHAPE * np.sqrt(shape.shape[1])),
        (np.arange(len(points)) / len(points) / _TIME)[:, None],
    ]
    if seen.scores is not None:
        parts.append(seen.scores / _SCORE)
    return np.concatenate(parts, axis=1)


def farthest(features: np.ndarray, count: int) -> np.ndarray:
    """Rows of `features` [F, D], `count` of them, ascending: the middle one, then always the one
    farthest from all chosen (Gonzalez 1985)."""
    if count >= len(features):
        return np.arange(len(features))
    if count < 1:
        return np.zeros(0, int)
    chosen = [int(np.argmin(((features - np.median(features, axis=0)) ** 2).sum(axis=1)))]
    away = np.full(len(features), np.inf)
    while len(chosen) < count:
        away = np.minimum(away, ((features - features[chosen[-1]]) ** 2).sum(axis=1))
        away[chosen] = -1.0
        chosen.append(int(np.argmax(away)))
    return np.sort(np.array(chosen))
