"""A head fitted to landmarks: one identity for all clips, everything else a frame or a clip.

Gauss-Newton with Levenberg-Marquardt damping on all unknowns at once. The camera stands at the
origin and looks down -z while fitting; `world` then puts the head, not the camera, in the middle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..errors import Cancelled, PavError
from ..head import HeadModel
from . import bordered, priors
from .landmark_model import LandmarkModel, axis_angles, rotations
from .observe import Observations

_CHUNK = 32
# identity and lens are found on so many frames of each clip, then all frames follow
_COARSE_FRAMES, _COARSE_STEPS, _FINE_STEPS = 40, 10, 5
_FOREHEAD, _CHIN = 10, 152
_LEFT_PUPIL, _RIGHT_PUPIL = 473, 468


@dataclass(eq=False)
class ClipFit:
    """One clip: focal length in source pixels; root [3] constant; pose [F,J,3] with the root in
    it; translation [F,3]; expression [F,E]."""

    focal: float
    root: np.ndarray
    pose: np.ndarray
    translation: np.ndarray
    expression: np.ndarray


@dataclass(eq=False)
class HeadFit:
    """betas [B]; clips in the order given; errors: [F] a clip, each frame's median distance of
    landmarks in source pixels; eye_distances: [C] pixels between the pupils (median)."""

    betas: np.ndarray
    clips: list[ClipFit]
    errors: list[np.ndarray]
    eye_distances: list[float]


@dataclass(eq=False)
class _Clip:
    """A clip's data, ready for residuals: pixels about the picture's middle, y down."""

    target: np.ndarray  # [F,L,2]
    trust: np.ndarray  # [F,L]
    scatter: float  # pixels
    focal: float  # the prior's mean; found with the first guess
    mean: np.ndarray  # [F,n]
    weight: np.ndarray  # [n]
    triples: np.ndarray  # rows i with i-1, i, i+1 evenly spaced in time


def fit_head(
    head: HeadModel,
    seen: list[Observations],
    *,
    shapes: int = 60,
    progress: Callable[[float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> HeadFit:
    """Fits `head` to the landmarks of all clips.

    shapes: identity components used, at most. Raises InputError for a head without landmarks,
    PavError where the fit does not come about, Cancelled.
    """
    model = LandmarkModel(head, shapes)
    prior = priors.frame_prior(head)
    state = _State(np.zeros(model.shapes), [])
    sparse = [np.arange(0, len(clip), -(-len(clip) // _COARSE_FRAMES)) for clip in seen]
    coarse = [clip.subset(rows) for clip, rows in zip(seen, sparse, strict=True)]
    data = [_prepare(head, clip, prior, steady=False) for clip in coarse]
    for clip, observed in zip(data, coarse, strict=True):
        state.clips.append(_first_guess(model, clip, observed))
    tell = progress or (lambda fraction: None)
    share = sum(map(len, sparse)) / (sum(map(len, sparse)) + sum(map(len, seen)))
    state = _descend(
        model, prior, data, state, _COARSE_STEPS, lambda done: tell(share * done), should_stop
    )
    guesses = [clip.focal for clip in data]
    data = [_prepare(head, clip, prior, steady=True) for clip in seen]
    for index, clip in enumerate(data):
        clip.focal = guesses[index]
        state.clips[index] = _filled_in(state.clips[index], sparse[index], len(clip.target))
    state = _descend(
        model, prior, data, state, _FINE_STEPS,
        lambda done: tell(share + (1 - share) * done), should_stop,
    )  # fmt: skip
    betas, clips = state.betas, state.clips
    if not np.isfinite(betas).all():
        raise PavError("the head fit diverged; leave out the clip that shows the face least")
    return HeadFit(
        betas,
        clips,
        [errors(model, betas, fit, clip.target) for clip, fit in zip(data, clips, strict=True)],
        [_eye_distance(clip) for clip in seen],
    )


@dataclass(eq=False)
class _State:
    betas: np.ndarray
    clips: list[ClipFit]


def _descend(
    model: LandmarkModel,
    prior: priors.FramePrior,
    data: list[_Clip],
    state: _State,
    steps: int,
    tell: Callable[[float], None],
    should_stop: Callable[[], bool] | None,
) -> _State:
    """Levenberg-Marquardt; the landmarks' weights are found anew for every step."""
    damping, previous = 1e-3, np.inf
    for step in range(steps):
        if should_stop is not None and should_stop():
            raise Cancelled("tracking stopped; nothing was written")
        betas, clips = state.betas, state.clips
        weights = [_weights(model, betas, clip, fit) for clip, fit in zip(data, clips, strict=True)]
        before = _cost(model, prior, data, weights, betas, clips)
        normals = [
            _normal(model, prior, data, index, weights[index], betas, clips)
            for index in range(len(data))
        ]
        _add_shared_priors(model, normals[0], data, betas, clips)
        for _ in range(8):
            candidate = _stepped(normals, damping, betas, clips)
            after = _cost(model, prior, data, weights, *candidate)
            if after < before:
                state = _State(*candidate)
                damping = max(damping * 0.3, 1e-7)
                break
            damping *= 6
        else:
            break
        tell((step + 1) / steps)
        if abs(before - after) < 1e-3 * before and abs(previous - before) < 5e-3 * before:
            break
        previous = before
    return state


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
    head: HeadModel, seen: Observations, prior: priors.FramePrior, *, steady: bool
) -> _Clip:
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
    ids = seen.frame_id.astype(np.int64)
    gaps = np.diff(ids)
    usual = int(np.median(gaps)) if len(gaps) else 1
    even = (gaps[:-1] == usual) & (gaps[1:] == usual) & steady
    return _Clip(
        target,
        priors.iris_trust(seen.landmarks) * priors.landmark_weights() * priors.INDEPENDENT,
        priors.SCATTER * max(face, 1.0),
        0.0,
        mean,
        whole,
        np.flatnonzero(even) + 1,
    )


def _first_guess(model: LandmarkModel, clip: _Clip, seen: Observations) -> ClipFit:
    """Each frame's turn and distance from the detector's own depth, by Procrustes' method."""
    rest = model.rest.sum(axis=0).T
    use = np.flatnonzero(priors.landmark_weights() >= 0.5)[:]
    source = rest[use] - rest[use].mean(axis=0)
    points = np.concatenate([clip.target, seen.landmarks[..., 2:].astype(np.float64)], axis=2)
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
    expression = clip.mean[:, clip.mean.shape[1] - model.expressions :].copy()
    posed = model.pose(np.zeros(model.shapes), expression, pose, np.zeros((frames, 3)))
    centre = posed.points[:, use].mean(axis=1)
    scale = scale.clip(1e-6)
    clip.focal = priors.focal_guess(max(seen.width, seen.height), float(np.median(scale)))
    depth = clip.focal / scale
    aim = clip.target[:, use].mean(axis=1) * (depth / clip.focal)[:, None]
    place = np.stack([aim[:, 0], -aim[:, 1], -depth], axis=1)
    return ClipFit(clip.focal, root, pose, place - centre, expression)


def _project(points: np.ndarray, focal: float) -> np.ndarray:
    """[F,L,3], camera at the origin looking down -z -> pixels [F,L,2], y down."""
    depth = -points[..., 2:].clip(None, -1e-3)
    return points[..., :2] * np.array([focal, -focal]) / depth


def _outer(points: np.ndarray, focal: float) -> np.ndarray:
    """d pixels / d point, [F,L,2,3]."""
    x, y, z = np.moveaxis(points, -1, 0)
    z = z.clip(None, -1e-3)
    outer = np.zeros((*points.shape[:2], 2, 3))
    outer[..., 0, 0] = -focal / z
    outer[..., 0, 2] = focal * x / z**2
    outer[..., 1, 1] = focal / z
    outer[..., 1, 2] = -focal * y / z**2
    return outer


def errors(model: LandmarkModel, betas: np.ndarray, fit: ClipFit, target: np.ndarray) -> np.ndarray:
    """Median distance of a frame's landmarks from target [F,L,2], in pixels, [F]."""
    posed = model.pose(betas, fit.expression, fit.pose, fit.translation)
    distance = np.linalg.norm(_project(posed.points, fit.focal) - target, axis=2)
    return np.median(distance, axis=1)


def _weights(model: LandmarkModel, betas: np.ndarray, clip: _Clip, fit: ClipFit) -> np.ndarray:
    """[F,L]: trust, less for what turns away from the camera and for what fits badly."""
    posed = model.pose(betas, fit.expression, fit.pose, fit.translation)
    head = posed.turns[:, 1 if model.joints > 1 else 0]
    normals = np.einsum("fxy,ly->flx", head, model.normals)
    view = -posed.points / np.linalg.norm(posed.points, axis=2, keepdims=True)
    facing = (((normals * view).sum(axis=2) - 0.05) / 0.4).clip(0.03, 1)
    distance = np.linalg.norm(_project(posed.points, fit.focal) - clip.target, axis=2)
    # while everything is still far off, nothing is an outlier yet
    usual = max(clip.scatter, float(np.median(distance)))
    robust = 1 / (1 + (distance / (4 * usual)) ** 2)
    return clip.trust * facing * robust / clip.scatter**2


def _unknowns(fit: ClipFit) -> np.ndarray:
    frames = len(fit.pose)
    return np.concatenate(
        [fit.pose[:, 1:].reshape(frames, -1), fit.translation, fit.expression], axis=1
    )


def _with_unknowns(fit: ClipFit, values: np.ndarray, root: np.ndarray, focal: float) -> ClipFit:
    frames, joints = fit.pose.shape[:2]
    turns = 3 * (joints - 1)
    pose = np.empty_like(fit.pose)
    pose[:, 0] = root
    pose[:, 1:] = values[:, :turns].reshape(frames, joints - 1, 3)
    return ClipFit(focal, root, pose, values[:, turns : turns + 3], values[:, turns + 3 :])


def _cost(
    model: LandmarkModel,
    prior: priors.FramePrior,
    data: list[_Clip],
    weights: list[np.ndarray],
    betas: np.ndarray,
    clips: list[ClipFit],
) -> float:
    grown = float(model.growth @ betas) / priors.SIZE_SPREAD
    total = _looks(clips) * (float((betas**2).sum()) + grown**2)
    for clip, weight, fit in zip(data, weights, clips, strict=True):
        posed = model.pose(betas, fit.expression, fit.pose, fit.translation)
        missed = _project(posed.points, fit.focal) - clip.target
        total += float((weight[..., None] * missed**2).sum())
        values = _unknowns(fit)
        total += float((clip.weight * (values - clip.mean) ** 2).sum())
        over = values - values.clip(prior.low, prior.high)
        total += float((prior.wall * over**2).sum())
        for i, j, stiff in prior.pairs:
            total += stiff * float(((values[:, i] - values[:, j]) ** 2).sum())
        total += float((prior.steady * _bends(values, clip.triples) ** 2).sum())
        total += float((fit.root**2).sum()) / priors.ROOT_SPREAD**2
        looks = _looks([fit])
        total += looks * np.log(fit.focal / clip.focal) ** 2 / priors.FOCAL_SPREAD**2
    return total


def _looks(clips: list[ClipFit]) -> float:
    """Weight of the priors on what all frames share, see priors.FRAMES_A_LOOK."""
    return max(1.0, sum(len(fit.pose) for fit in clips) / priors.FRAMES_A_LOOK)


def _bends(values: np.ndarray, triples: np.ndarray) -> np.ndarray:
    return values[triples - 1] - 2 * values[triples] + values[triples + 1]


def _normal(
    model: LandmarkModel,
    prior: priors.FramePrior,
    data: list[_Clip],
    index: int,
    weight: np.ndarray,
    betas: np.ndarray,
    clips: list[ClipFit],
) -> bordered.Normal:
    """Normal equations of clip `index`; shared unknowns: betas, then log focal and root a clip."""
    clip, fit = data[index], clips[index]
    values = _unknowns(fit)
    frames, size = values.shape
    shared = model.shapes + 4 * len(clips)
    mine = model.shapes + 4 * index
    columns = np.r_[0 : model.shapes, mine : mine + 4]
    own = np.empty((frames, size, size))
    border = np.zeros((frames, size, shared))
    common = np.zeros((shared, shared))
    gradient = np.empty((frames, size))
    common_gradient = np.zeros(shared)
    for start in range(0, frames, _CHUNK):
        rows = slice(start, start + _CHUNK)
        residual, slopes = _linearised(model, clip, fit, rows, betas)
        root = np.sqrt(weight[rows])[:, None, None].astype(np.float32)
        slopes *= root
        slopes = slopes.reshape(*slopes.shape[:2], -1)
        residual = (residual * root[:, 0]).reshape(len(slopes), -1, 1)
        product = (slopes @ slopes.transpose(0, 2, 1)).astype(np.float64)
        pull = (slopes @ residual)[..., 0].astype(np.float64)
        own[rows] = product[:, :size, :size]
        border[rows, :, columns] = product[:, :size, size:]
        gradient[rows] = pull[:, :size]
        common[np.ix_(columns, columns)] += product[:, size:, size:].sum(axis=0)
        common_gradient[columns] += pull[:, size:].sum(axis=0)
    over = values - values.clip(prior.low, prior.high)
    diagonal = np.arange(size)
    own[:, diagonal, diagonal] += clip.weight + prior.wall * (over != 0)
    gradient += clip.weight * (values - clip.mean) + prior.wall * over
    for i, j, stiff in prior.pairs:
        own[:, i, i] += stiff
        own[:, j, j] += stiff
        own[:, i, j] -= stiff
        own[:, j, i] -= stiff
        gradient[:, i] += stiff * (values[:, i] - values[:, j])
        gradient[:, j] -= stiff * (values[:, i] - values[:, j])
    next_one, next_two = np.zeros((frames, size)), np.zeros((frames, size))
    bends = prior.steady * _bends(values, clip.triples)
    for offset, factor in ((-1, 1.0), (0, -2.0), (1, 1.0)):
        at = clip.triples + offset
        own[at[:, None], diagonal, diagonal] += factor**2 * prior.steady
        gradient[at] += factor * bends
    next_one[clip.triples - 1] -= 2 * prior.steady
    next_one[clip.triples] -= 2 * prior.steady
    next_two[clip.triples - 1] += prior.steady
    return bordered.Normal(own, border, common, gradient, common_gradient, (next_one, next_two))


def _linearised(
    model: LandmarkModel, clip: _Clip, fit: ClipFit, rows: slice, betas: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals [f,2,L] in pixels and their derivatives [f, n + B + 4, 2, L] by a frame's unknowns
    and the shared ones (identity, log focal, root), float32."""
    pose = fit.pose[rows]
    posed = model.pose(betas, fit.expression[rows], pose, fit.translation[rows])
    pixels = _project(posed.points, fit.focal)
    slopes = model.jacobian(posed, pose, _outer(posed.points, fit.focal))
    frames, count = posed.points.shape[:2]
    turns = slopes.pose.reshape(frames, -1, 2, count)
    by_focal = pixels.transpose(0, 2, 1)[:, None].astype(np.float32)
    parts = (turns[:, 3:], slopes.translation, slopes.expression, slopes.shape, by_focal)
    residual = (pixels - clip.target[rows]).transpose(0, 2, 1).astype(np.float32)
    return residual, np.concatenate([*parts, turns[:, :3]], axis=1)


def _add_shared_priors(
    model: LandmarkModel,
    normal: bordered.Normal,
    data: list[_Clip],
    betas: np.ndarray,
    clips: list[ClipFit],
) -> None:
    diagonal = np.einsum("ii->i", normal.shared)
    count = len(betas)
    stiff = _looks(clips)
    diagonal[:count] += stiff
    normal.shared_gradient[:count] += stiff * betas
    growth = model.growth / priors.SIZE_SPREAD
    normal.shared[:count, :count] += stiff * np.outer(growth, growth)
    normal.shared_gradient[:count] += stiff * growth * float(growth @ betas)
    for index, (clip, fit) in enumerate(zip(data, clips, strict=True)):
        at = count + 4 * index
        stiff = _looks([fit]) / priors.FOCAL_SPREAD**2
        diagonal[at] += stiff
        normal.shared_gradient[at] += stiff * np.log(fit.focal / clip.focal)
        diagonal[at + 1 : at + 4] += 1 / priors.ROOT_SPREAD**2
        normal.shared_gradient[at + 1 : at + 4] += fit.root / priors.ROOT_SPREAD**2


def _stepped(
    normals: list[bordered.Normal], damping: float, betas: np.ndarray, clips: list[ClipFit]
) -> tuple[np.ndarray, list[ClipFit]]:
    steps, shared = bordered.solve(normals, damping)
    moved = []
    for index, (fit, step) in enumerate(zip(clips, steps, strict=True)):
        focal, *root = shared[len(betas) + 4 * index : len(betas) + 4 * index + 4]
        moved.append(
            _with_unknowns(
                fit, _unknowns(fit) + step, fit.root + root, fit.focal * float(np.exp(focal))
            )
        )
    return betas + shared[: len(betas)], moved


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
    pose[:, 0] = 0
    return replace(fit, root=np.zeros(3), pose=pose, translation=translation), camera
