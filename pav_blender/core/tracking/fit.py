"""A head fitted to landmarks, then to pictures: one identity for all clips, everything else a
frame or a clip.

Gauss-Newton with Levenberg-Marquardt damping on all unknowns at once. The camera stands at the
origin and looks down -z while fitting; `world` then puts the head, not the camera, in the middle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..errors import Cancelled, PavError
from ..head import HeadModel
from ..kernels.cpu.threads import each
from . import priors
from .equations import Expected, Problem, cost, step, stepped
from .landmark_model import LandmarkModel, axis_angles, rotations
from .observe import Observations
from .photo import Pictures, common_look, face_points
from .terms import ClipFit, Landmarks, Photo, with_weight

# identity and lens are found on so many frames of each clip, then all frames follow
_COARSE_FRAMES, _COARSE_STEPS, _FINE_STEPS = 40, 10, 5
# blur of the pictures in pixels of a face's window, and at most so many steps with it
_PHOTO_LEVELS = ((3.0, 10), (0.0, 8))
# once pictures speak, landmarks only say where on the face the skin is
_LANDMARKS_LEFT = 0.07
# of the way from a clip's own look to what all clips show
_SHARED = 0.7
_FOREHEAD, _CHIN = 10, 152
_LEFT_PUPIL, _RIGHT_PUPIL = 473, 468
USUAL_RATE = 30.0
_DAMPING = 1e-3


@dataclass(eq=False)
class HeadFit:
    """betas [B]; clips in the order given; errors: [F] a clip, each frame's median distance of
    landmarks in source pixels; eye_distances: [C] pixels between the pupils (median)."""

    betas: np.ndarray
    clips: list[ClipFit]
    errors: list[np.ndarray]
    eye_distances: list[float]


Tell = Callable[[float], None]
ShouldStop = Callable[[], bool]


@dataclass(eq=False)
class _State:
    betas: np.ndarray
    clips: list[ClipFit]


def fit_head(
    head: HeadModel,
    seen: list[Observations],
    *,
    shapes: int = 64,
    rates: list[float] | None = None,
    progress: Tell | None = None,
    should_stop: ShouldStop | None = None,
) -> HeadFit:
    """Fits `head` to the landmarks of all clips.

    shapes: identity components used, at most; rates: frames a second of each clip's video, by
    which heads move between frames (default 30). Raises InputError for a head without landmarks,
    PavError where the fit does not come about, Cancelled.
    """
    model = LandmarkModel(head, shapes)
    prior = priors.frame_prior(head)
    rates = rates or [USUAL_RATE] * len(seen)
    state = _State(np.zeros(model.shapes), [])
    sparse = [np.arange(0, len(clip), -(-len(clip) // _COARSE_FRAMES)) for clip in seen]
    coarse = [clip.subset(rows) for clip, rows in zip(seen, sparse, strict=True)]
    problem = Problem(model, prior, [], [])
    for observed in coarse:
        expected, landmarks = _prepare(model, observed, prior, None)
        state.clips.append(_first_guess(model, expected, landmarks, observed))
        problem.expected.append(expected)
        problem.terms.append([landmarks])
    tell = progress or (lambda fraction: None)
    share = sum(map(len, sparse)) / (sum(map(len, sparse)) + sum(map(len, seen)))
    state = _descend(problem, state, _COARSE_STEPS, lambda done: tell(share * done), should_stop)
    whole = Problem(model, prior, [], [])
    firm = []
    for index, observed in enumerate(seen):
        expected, landmarks = _prepare(model, observed, prior, rates[index])
        expected.focal = problem.expected[index].focal
        whole.expected.append(expected)
        whole.terms.append([landmarks])
        firm.append(landmarks)
        state.clips[index] = _filled_in(state.clips[index], sparse[index], len(observed))
    state = _descend(
        whole, state, _FINE_STEPS, lambda done: tell(share + (1 - share) * done), should_stop
    )
    return _finished(state, firm, seen)


def refine_head(
    head: HeadModel,
    seen: list[Observations],
    fit: HeadFit,
    pictures: list[Pictures],
    *,
    rates: list[float] | None = None,
    progress: Tell | None = None,
    should_stop: ShouldStop | None = None,
) -> HeadFit:
    """Refines a fit by photo-consistency: a point of the face looks alike in all frames of a clip,
    and roughly alike in all clips. Arguments and errors as of `fit_head`."""
    model = LandmarkModel(head, len(fit.betas))
    points = face_points(head, len(fit.betas))
    prior = priors.frame_prior(head)
    rates = rates or [USUAL_RATE] * len(seen)
    problem = Problem(model, prior, [], [])
    photos: list[Photo] = []
    firm = []
    for index, observed in enumerate(seen):
        expected, landmarks = _prepare(model, observed, prior, rates[index])
        expected.focal = priors.focal_guess(
            max(observed.width, observed.height), _pixels_per_metre(model, fit, index)
        )
        photos.append(Photo(points, pictures[index]))
        firm.append(landmarks)
        problem.expected.append(expected)
        problem.terms.append([with_weight(landmarks, _LANDMARKS_LEFT), photos[-1]])
    state = _State(fit.betas, fit.clips)

    def look(state: _State) -> None:
        each(lambda index: photos[index].look(state.betas, state.clips[index]), len(photos))
        if len(photos) > 1:
            shared = common_look([(p.template, p.certainty) for p in photos])  # type: ignore[misc]
            for photo in photos:
                photo.lean(shared, _SHARED)

    tell = progress or (lambda fraction: None)
    for level, (sigma, steps) in enumerate(_PHOTO_LEVELS):
        for photo, whole in zip(photos, pictures, strict=True):
            photo.pictures = whole.blurred(sigma) if sigma else whole
            photo.front = None
        tell_level = _level(tell, level)
        state = _descend(problem, state, steps, tell_level, should_stop, look)
    return _finished(state, firm, seen)


def _level(tell: Tell, level: int) -> Tell:
    count = len(_PHOTO_LEVELS)
    return lambda done: tell((level + done) / count)


def _pixels_per_metre(model: LandmarkModel, fit: HeadFit, index: int) -> float:
    clip = fit.clips[index]
    posed = model.pose(fit.betas, clip.expression, clip.pose, clip.translation)
    return float(np.median(clip.focal / -posed.points[..., 2]))


def _finished(state: _State, landmarks: list[Landmarks], seen: list[Observations]) -> HeadFit:
    betas, clips = state.betas, state.clips
    if not np.isfinite(betas).all():
        raise PavError("the head fit diverged; leave out the clip that shows the face least")
    errors = [term.distances(betas, fit) for term, fit in zip(landmarks, clips, strict=True)]
    return HeadFit(betas, clips, errors, [_eye_distance(clip) for clip in seen])


def _descend(
    problem: Problem,
    state: _State,
    steps: int,
    tell: Tell,
    should_stop: ShouldStop | None,
    before_step: Callable[[_State], None] | None = None,
) -> _State:
    """Levenberg-Marquardt; the terms' weights are found anew for every step."""
    damping, previous = _DAMPING, np.inf
    for number in range(steps):
        if should_stop is not None and should_stop():
            raise Cancelled("tracking stopped; the same command goes on from here")
        if before_step is not None:
            before_step(state)
        _weigh(problem, state)
        before = cost(problem, state.betas, state.clips)
        normals = step(problem, state.betas, state.clips)
        for _ in range(8):
            candidate = stepped(problem, normals, damping, state.betas, state.clips)
            after = cost(problem, *candidate)
            if after < before:
                state = _State(*candidate)
                damping = max(damping * 0.3, 1e-7)
                break
            damping *= 6
        else:
            break
        tell((number + 1) / steps)
        if abs(before - after) < 1e-3 * before and abs(previous - before) < 5e-3 * before:
            break
        previous = before
    return state


def _weigh(problem: Problem, state: _State) -> None:
    def weigh(index: int) -> None:
        for term in problem.terms[index]:
            term.weigh(state.betas, state.clips[index])

    each(weigh, len(state.clips))


def _filled_in(fit: ClipFit, rows: np.ndarray, frames: int) -> ClipFit:
    """A fit of some rows carried on to all frames, linearly between."""

    def carried(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(rows), -1)
        every = np.arange(frames)
        columns = [np.interp(every, rows, column) for column in flat.T]
        return np.stack(columns, 1).reshape(frames, *values.shape[1:])

    return ClipFit(
        fit.focal, fit.root, carried(fit.pose), carried(fit.translation), carried(fit.expression)
    )


def _eye_distance(seen: Observations) -> float:
    apart = seen.landmarks[:, _LEFT_PUPIL, :2] - seen.landmarks[:, _RIGHT_PUPIL, :2]
    return float(np.median(np.linalg.norm(apart, axis=1)))


def _prepare(
    model: LandmarkModel, seen: Observations, prior: priors.FramePrior, rate: float | None
) -> tuple[Expected, Landmarks]:
    """rate: frames a second, None where frames are too far apart to hold each other steady."""
    head = model.head
    middle = np.array([seen.width / 2, seen.height / 2])
    target = seen.landmarks[..., :2].astype(np.float64) - middle
    face = float(np.median(np.linalg.norm(target[:, _CHIN] - target[:, _FOREHEAD], axis=1)))
    expected, weight = priors.expected_expression(head, seen.scores, seen.score_names, len(target))
    mean = np.tile(prior.mean, (len(target), 1))
    mean[:, mean.shape[1] - expected.shape[1] :] = expected
    whole = prior.weight.copy()
    whole[len(whole) - len(weight) :] = weight
    if "neck" in head.joint_names:
        # on the clip's mean rather than each frame: it only shares turns out to root and neck
        place = 3 * (head.joint_names.index("neck") - 1)
        whole[place : place + 3] = 1 / (priors.NECK_SPREAD**2 * len(target))
    trust = priors.iris_trust(seen.landmarks) * priors.landmark_weights() * priors.INDEPENDENT
    triples, steady = _steadiness(seen.frame_id, prior, rate)
    return (
        Expected(0.0, mean, whole, steady, triples),
        Landmarks(model, target, trust, priors.SCATTER * max(face, 1.0)),
    )


def _steadiness(
    frame_id: np.ndarray, prior: priors.FramePrior, rate: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Rows that stand evenly between their neighbours [T], and the weight on each one's
    accelerations [T,n]."""
    gaps = np.diff(frame_id.astype(np.int64))
    even = np.flatnonzero((gaps[:-1] == gaps[1:]) & (rate is not None))
    # what a head does between two frames grows with the square of the time between them
    longer = np.maximum(1.0, (gaps[even] * USUAL_RATE / (rate or USUAL_RATE)) ** 2)
    return even + 1, prior.steady / longer[:, None] ** 2


def _first_guess(
    model: LandmarkModel, expected: Expected, landmarks: Landmarks, seen: Observations
) -> ClipFit:
    """Each frame's turn and distance from the detector's own depth, by Procrustes' method."""
    rest = model.rest.sum(axis=0).T
    use = np.flatnonzero(priors.landmark_weights() >= 0.5)[:]
    source = rest[use] - rest[use].mean(axis=0)
    points = np.concatenate([landmarks.target, seen.landmarks[..., 2:].astype(np.float64)], axis=2)
    points = points[:, use] * np.array([1, -1, -1])
    points = points - points.mean(axis=1, keepdims=True)
    left, _, right = np.linalg.svd(np.einsum("fli,lj->fij", points, source))
    flip = np.ones((len(points), 3))
    flip[:, 2] = np.sign(np.linalg.det(left @ right))
    turn = (left * flip[:, None]) @ right
    scale = np.einsum("fli,fij,lj->f", points, turn, source) / (source**2).sum()
    left, _, right = np.linalg.svd(turn.mean(axis=0))
    root = axis_angles(left @ right) * 0.2
    frames = len(points)
    pose = np.zeros((frames, model.joints, 3))
    pose[:, 0] = root
    first = 1 if model.joints > 1 else 0
    if first:
        pose[:, first] = axis_angles(rotations(root).T @ turn)
    expression = expected.mean[:, expected.mean.shape[1] - model.expressions :].copy()
    posed = model.pose(np.zeros(model.shapes), expression, pose, np.zeros((frames, 3)))
    centre = posed.points[:, use].mean(axis=1)
    scale = scale.clip(1e-6)
    expected.focal = priors.focal_guess(max(seen.width, seen.height), float(np.median(scale)))
    depth = expected.focal / scale
    aim = landmarks.target[:, use].mean(axis=1) * (depth / expected.focal)[:, None]
    place = np.stack([aim[:, 0], -aim[:, 1], -depth], axis=1)
    return ClipFit(expected.focal, root, pose, place - centre, expression)


def world(head: HeadModel, betas: np.ndarray, fit: ClipFit) -> tuple[ClipFit, np.ndarray]:
    """The clip seen from a world that stands upright in the person's torso.

    The root's turn and the middle of the translations move into the camera. Returns the clip and
    camera_to_world [4,4] with OpenCV axes; every picture stays the same.
    """
    turn = rotations(fit.root)
    joint = head.joints(betas)[0].astype(np.float64)
    middle = np.median(fit.translation, axis=0)
    # x = turn (y - joint) + joint + translation; the new world's y carries the new translation
    translation = (fit.translation - middle) @ turn
    camera = np.eye(4)
    camera[:3, :3] = turn.T @ np.diag([1.0, -1.0, -1.0])
    camera[:3, 3] = joint - turn.T @ (joint + middle)
    pose = fit.pose.copy()
    pose[:, 0] = axis_angles(turn.T @ rotations(pose[:, 0]))
    return replace(fit, root=np.zeros(3), pose=pose, translation=translation), camera
