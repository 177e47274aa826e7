"""The cost of a fit, and the normal equations of one Gauss-Newton step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..kernels.cpu.threads import each
from . import bordered, priors
from .landmark_model import PointModel
from .terms import ClipFit, Term

_CHUNK = 16  # frames
_HELD = 1e9  # stiffness of what may not move


@dataclass(eq=False)
class Expected:
    """What is expected of a clip beforehand: the focal length in pixels; mean [F,n] and weight [n]
    of a frame's unknowns; steady [T,n], the weight on second differences over time at `triples`
    [T], rows i with i-1, i, i+1 evenly spaced."""

    focal: float
    mean: np.ndarray
    weight: np.ndarray
    steady: np.ndarray
    triples: np.ndarray


@dataclass(eq=False)
class Problem:
    """Everything that is minimised; expected and terms: a clip each, in the clips' order."""

    model: PointModel
    prior: priors.FramePrior
    expected: list[Expected]
    terms: list[Sequence[Term]]


def unknowns(fit: ClipFit) -> np.ndarray:
    """A frame's own: joints but the root, translation, expression, [F,n]."""
    frames = len(fit.pose)
    return np.concatenate(
        [fit.pose[:, 1:].reshape(frames, -1), fit.translation, fit.expression], axis=1
    )


def with_unknowns(fit: ClipFit, values: np.ndarray, root: np.ndarray, focal: float) -> ClipFit:
    frames, joints = fit.pose.shape[:2]
    turns = 3 * (joints - 1)
    pose = np.empty_like(fit.pose)
    pose[:, 0] = root
    pose[:, 1:] = values[:, :turns].reshape(frames, joints - 1, 3)
    return ClipFit(focal, root, pose, values[:, turns : turns + 3], values[:, turns + 3 :])


def cost(problem: Problem, betas: np.ndarray, clips: list[ClipFit]) -> float:
    prior = problem.prior
    grown = float(problem.model.growth @ betas) / priors.SIZE_SPREAD
    total = _looks(clips) * (float((betas**2).sum()) + grown**2)
    missed = each(
        lambda index: sum(term.cost(betas, clips[index]) for term in problem.terms[index]),
        len(clips),
    )
    for expected, misses, fit in zip(problem.expected, missed, clips, strict=True):
        total += misses
        values = unknowns(fit)
        total += float((expected.weight * (values - expected.mean) ** 2).sum())
        for i, j, stiff in prior.pairs:
            total += stiff * float(((values[:, i] - values[:, j]) ** 2).sum())
        total += float((expected.steady * _bends(values, expected.triples) ** 2).sum())
        total += float((fit.root**2).sum()) / priors.ROOT_SPREAD**2
        looks = _looks([fit])
        total += looks * np.log(fit.focal / expected.focal) ** 2 / priors.FOCAL_SPREAD**2
    return total


def _looks(clips: list[ClipFit]) -> float:
    """Weight of the priors on what all frames share, see priors.FRAMES_A_LOOK."""
    return max(1.0, sum(len(fit.pose) for fit in clips) / priors.FRAMES_A_LOOK)


def _bends(values: np.ndarray, triples: np.ndarray) -> np.ndarray:
    return values[triples - 1] - 2 * values[triples] + values[triples + 1]


def step(problem: Problem, betas: np.ndarray, clips: list[ClipFit]) -> list[bordered.Normal]:
    """The normal equations, a clip each; the first carries the shared unknowns' priors. Shared
    unknowns: betas, then log focal and root a clip."""
    normals = [_zeros(problem.model.shapes, fit, len(clips)) for fit in clips]
    pieces = [
        (index, slice(start, start + _CHUNK))
        for index, fit in enumerate(clips)
        for start in range(0, len(fit.pose), _CHUNK)
    ]
    sums = each(lambda at: _add_terms(problem, normals, *pieces[at], betas, clips), len(pieces))
    for (index, _), (common, pull) in zip(pieces, sums, strict=True):
        mine = _columns(problem.model, index)
        normals[index].shared[np.ix_(mine, mine)] += common
        normals[index].shared_gradient[mine] += pull
    each(lambda index: _add_expected(problem, index, normals[index], clips[index]), len(clips))
    _add_shared_priors(problem, normals[0], betas, clips)
    return normals


def _zeros(shapes: int, fit: ClipFit, clips: int) -> bordered.Normal:
    frames, size = unknowns(fit).shape
    shared = shapes + 4 * clips
    return bordered.Normal(
        np.zeros((frames, size, size)),
        np.zeros((frames, size, shared)),
        np.zeros((shared, shared)),
        np.zeros((frames, size)),
        np.zeros(shared),
        (np.zeros((frames, size)), np.zeros((frames, size))),
    )


def _columns(model: PointModel, index: int) -> np.ndarray:
    """Of the shared unknowns, those of clip `index`."""
    mine = model.shapes + 4 * index
    return np.r_[0 : model.shapes, mine : mine + 4]


def _add_terms(
    problem: Problem,
    normals: list[bordered.Normal],
    index: int,
    rows: slice,
    betas: np.ndarray,
    clips: list[ClipFit],
) -> tuple[np.ndarray, np.ndarray]:
    """What pictures and landmarks say of some frames of clip `index`, added to their own equations;
    given back: what they say of the shared unknowns in `_columns`, matrix and gradient."""
    normal, columns = normals[index], _columns(problem.model, index)
    size = normal.gradient.shape[1]
    common = np.zeros((len(columns), len(columns)))
    common_pull = np.zeros(len(columns))
    for term in problem.terms[index]:
        residual, slopes = term.linearised(betas, clips[index], rows)
        across = slopes.transpose(0, 2, 1)
        product = (across @ slopes).astype(np.float64)
        pull = (across @ residual[..., None])[..., 0].astype(np.float64)
        normal.own[rows] += product[:, :size, :size]
        normal.border[rows, :, columns] += product[:, :size, size:]
        normal.gradient[rows] += pull[:, :size]
        common += product[:, size:, size:].sum(axis=0)
        common_pull += pull[:, size:].sum(axis=0)
    return common, common_pull


def _add_expected(problem: Problem, index: int, normal: bordered.Normal, fit: ClipFit) -> None:
    """Adds what is expected of a clip's frames beforehand, and holds what stands at a limit."""
    prior, expected = problem.prior, problem.expected[index]
    own, gradient, values = normal.own, normal.gradient, unknowns(fit)
    diagonal = np.arange(values.shape[1])
    own[:, diagonal, diagonal] += expected.weight
    gradient += expected.weight * (values - expected.mean)
    for i, j, stiff in prior.pairs:
        own[:, i, i] += stiff
        own[:, j, j] += stiff
        own[:, i, j] -= stiff
        own[:, j, i] -= stiff
        gradient[:, i] += stiff * (values[:, i] - values[:, j])
        gradient[:, j] -= stiff * (values[:, i] - values[:, j])
    _add_steadiness(expected, values, normal)
    # what stands at a limit and would go past it stays where it is
    held = ((values <= prior.low) & (gradient > 0)) | ((values >= prior.high) & (gradient < 0))
    own[:, diagonal, diagonal] += np.where(held, _HELD, 0.0)


def _add_steadiness(expected: Expected, values: np.ndarray, normal: bordered.Normal) -> None:
    """Adds the weight on second differences, which join frames to the next two."""
    steady, triples = expected.steady, expected.triples
    diagonal = np.arange(values.shape[1])
    next_one, next_two = normal.couplings
    bends = steady * _bends(values, triples)
    for offset, factor in ((-1, 1.0), (0, -2.0), (1, 1.0)):
        at = triples + offset
        normal.own[at[:, None], diagonal, diagonal] += factor**2 * steady
        normal.gradient[at] += factor * bends
    next_one[triples - 1] -= 2 * steady
    next_one[triples] -= 2 * steady
    next_two[triples - 1] += steady


def _add_shared_priors(
    problem: Problem, normal: bordered.Normal, betas: np.ndarray, clips: list[ClipFit]
) -> None:
    diagonal = np.einsum("ii->i", normal.shared)
    count = len(betas)
    stiff = _looks(clips)
    diagonal[:count] += stiff
    normal.shared_gradient[:count] += stiff * betas
    growth = problem.model.growth / priors.SIZE_SPREAD
    normal.shared[:count, :count] += stiff * np.outer(growth, growth)
    normal.shared_gradient[:count] += stiff * growth * float(growth @ betas)
    for index, (expected, fit) in enumerate(zip(problem.expected, clips, strict=True)):
        at = count + 4 * index
        stiff = _looks([fit]) / priors.FOCAL_SPREAD**2
        diagonal[at] += stiff
        normal.shared_gradient[at] += stiff * np.log(fit.focal / expected.focal)
        diagonal[at + 1 : at + 4] += 1 / priors.ROOT_SPREAD**2
        normal.shared_gradient[at + 1 : at + 4] += fit.root / priors.ROOT_SPREAD**2


def stepped(
    problem: Problem,
    normals: list[bordered.Normal],
    damping: float,
    betas: np.ndarray,
    clips: list[ClipFit],
) -> tuple[np.ndarray, list[ClipFit]]:
    """Betas and clips after the step that the normal equations ask for, as far as the unknowns'
    limits let it go."""
    steps, shared = bordered.solve(normals, damping)
    moved = []
    for index, (fit, change) in enumerate(zip(clips, steps, strict=True)):
        focal, *root = shared[len(betas) + 4 * index : len(betas) + 4 * index + 4]
        values = (unknowns(fit) + change).clip(problem.prior.low, problem.prior.high)
        moved.append(with_unknowns(fit, values, fit.root + root, fit.focal * float(np.exp(focal))))
    return betas + shared[: len(betas)], moved
