"""What is known of heads before any picture is seen: the fit's weights and expectations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..head import HeadModel
from .landmark_model import (
    LEFT_IRIS,
    LEFT_LIDS,
    LEFT_OPENING,
    LIPS,
    OVAL,
    RIGHT_IRIS,
    RIGHT_LIDS,
    RIGHT_OPENING,
)
from .observe import LANDMARKS

# The detector's own scatter, of the face's size; neighbouring landmarks err together, so that 478
# of them tell about as much as this share of them would.
SCATTER = 0.006
INDEPENDENT = 0.2
SCORE_SPREAD = 0.3
# Landmarks hardly tell a near head under a wide lens from a far one under a long lens. Two guesses
# are weighed: a portrait's field of view (some 42 degrees, unless the video was cropped before)
# and the distance one is filmed from; spreads are of logarithms.
FOCAL_OF_SIDE, FOCAL_OF_SIDE_SPREAD = 1.3, 0.6
METRES_AWAY, METRES_AWAY_SPREAD = 1.2, 0.3
FOCAL_SPREAD = 0.1
ROOT_SPREAD, NECK_SPREAD = 0.12, 0.25
# A landmark's place on the head is itself uncertain, and no number of frames cures that: so many
# frames of a clip add up to one independent look at what stays the same (identity, lens).
FRAMES_A_LOOK = 12
# One camera cannot see how large a head is; left alone, heads shrink, for then the same components
# bend them more cheaply. Relative spread of a head's size about its model's.
SIZE_SPREAD = 0.02


def focal_guess(side: float, pixels_per_metre: float) -> float:
    """Focal length in pixels: of a picture's longer side, and of how large the head is in it."""
    views = np.log([FOCAL_OF_SIDE * side, METRES_AWAY * pixels_per_metre])
    weights = np.array([FOCAL_OF_SIDE_SPREAD, METRES_AWAY_SPREAD]) ** -2.0
    return float(np.exp(np.average(views, weights=weights)))


@dataclass(frozen=True, eq=False)
class FramePrior:
    """For the n unknowns of a frame (joints but the root, translation, expression).

    mean, weight [n] of quadratic terms; steady [n]: weight on second differences over time;
    low, high [n]: limits; pairs: (i, j, weight) terms that
    hold unknowns i and j equal.
    """

    mean: np.ndarray
    weight: np.ndarray
    steady: np.ndarray
    low: np.ndarray
    high: np.ndarray
    pairs: tuple[tuple[int, int, float], ...]


# joint -> (mean x, spreads x y z, jitter in radians a frame squared)
_JOINTS = {
    "neck": (0.0, (10.0, 10.0, 10.0), 0.006),
    "jaw": (0.04, (0.12, 0.02, 0.015), 0.04),
    "left_eye": (0.0, (0.25, 0.3, 0.005), 0.15),
    "right_eye": (0.0, (0.25, 0.3, 0.005), 0.15),
}
# what landmarks hardly show, and would be used to mend the identity
_UNSEEN = {"cheekPuff": 0.1, "tongueOut": 0.02, "jawForward": 0.1}
_OTHER_JOINT = (0.0, (0.05, 0.05, 0.05), 0.02)
_TRANSLATION_JITTER = (0.0006, 0.0006, 0.002)


def is_blend_shapes(head: HeadModel) -> bool:
    """Whether expressions are shapes worn between 0 and 1 rather than signed components."""
    return "mouthSmileLeft" in head.expression_names or "eyeBlinkLeft" in head.expression_names


def frame_prior(head: HeadModel) -> FramePrior:
    """The prior of one frame of `head` (see FramePrior for the order of unknowns)."""
    mean, spread, jitter = [], [], []
    low, high = [], []
    for name in head.joint_names[1:]:
        middle, spreads, shake = _JOINTS.get(name, _OTHER_JOINT)
        if name == "jaw" and "jawOpen" in head.expression_names:
            # the expression does it, for that is what an animator or a face capture will drive
            middle, spreads = 0.0, (0.01, 0.005, 0.005)
        mean += [middle, 0.0, 0.0]
        spread += list(spreads)
        jitter += [shake] * 3
        low += [0.0 if name == "jaw" else -np.inf, -np.inf, -np.inf]
        high += [np.inf] * 3
    mean += [0.0] * 3
    spread += [1e3] * 3
    jitter += list(_TRANSLATION_JITTER)
    low += [-np.inf] * 3
    high += [np.inf] * 3
    count = len(head.expression_basis)
    shapes = is_blend_shapes(head)
    mean += [0.0] * count
    spread += [_UNSEEN.get(name, 0.3 if shapes else 1.0) for name in head.expression_names]
    jitter += [0.3 if shapes else 1.0] * count
    low += [0.0 if shapes else -np.inf] * count
    high += [1.0 if shapes else np.inf] * count
    return FramePrior(
        np.array(mean),
        1 / np.array(spread) ** 2,
        1 / np.array(jitter) ** 2,
        np.array(low),
        np.array(high),
        _eye_pairs(head),
    )


def _eye_pairs(head: HeadModel) -> tuple[tuple[int, int, float], ...]:
    names = head.joint_names[1:]
    if "left_eye" not in names or "right_eye" not in names:
        return ()
    left, right = 3 * names.index("left_eye"), 3 * names.index("right_eye")
    return tuple((left + axis, right + axis, 1 / 0.03**2) for axis in (0, 1))


def expected_expression(
    head: HeadModel, scores: np.ndarray | None, score_names: tuple[str, ...], frames: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean [F,E] and weight [E] of the expression, from a detector's scores where it gave any."""
    prior = frame_prior(head)
    count = len(head.expression_basis)
    mean = np.zeros((frames, count))
    weight = prior.weight[len(prior.weight) - count :].copy()
    if scores is None or not is_blend_shapes(head):
        return mean, weight
    where = {name: column for column, name in enumerate(score_names)}
    for column, name in enumerate(head.expression_names):
        if name in where and name not in _UNSEEN:
            mean[:, column] = scores[:, where[name]]
            weight[column] = 1 / SCORE_SPREAD**2
    return mean, weight


def landmark_weights() -> np.ndarray:
    """How much each landmark says, [478]: lips and lids, whose mistakes are seen, most; the face's
    sliding outline least."""
    weights = np.full(LANDMARKS, 0.6)
    weights[list(LIPS)] = 8.0
    weights[[*LEFT_LIDS, *RIGHT_LIDS]] = 4.0
    weights[[*LEFT_IRIS, *RIGHT_IRIS]] = 4.0
    weights[list(OVAL)] = 0.25
    return weights


def iris_trust(landmarks: np.ndarray) -> np.ndarray:
    """[F,478]: 1, and toward 0 for the irises of closing eyes, which the detector makes up."""
    trust = np.ones(landmarks.shape[:2])
    for iris, opening in ((LEFT_IRIS, LEFT_OPENING), (RIGHT_IRIS, RIGHT_OPENING)):
        upper, lower, outer, inner = (landmarks[:, i, :2] for i in opening)
        gap = np.linalg.norm(upper - lower, axis=1)
        width = np.linalg.norm(outer - inner, axis=1).clip(1e-6)
        trust[:, list(iris)] = ((gap / width - 0.08) / 0.1).clip(0.01, 1)[:, None]
    return trust
