"""What the fit wants small: landmarks that miss, and skin whose look changes as the head moves.

A term belongs to one clip. It knows its weights, its residuals, and their derivatives by a frame's
unknowns and the shared ones, in the order that `equations` uses.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from .landmark_model import LandmarkModel, PointModel, Posed
from .photo import Pictures, sample, templates, visible

# a photo residual is this likely to be new information beside its neighbours'
_PHOTO_INDEPENDENT = 0.05
_FLOOR = 0.05  # of a feature's units: pictures are never alike to less than that
# pixels of a face's window that skin may be off without counting as something else before it: where
# a feature is steep it differs much for little, and says most
_ASTRAY = 1.0


@dataclass(eq=False)
class ClipFit:
    """One clip: focal length in source pixels; root [3], how the shoulders mostly turn; pose
    [F,J,3], with the root in it; translation [F,3]; expression [F,E]."""

    focal: float
    root: np.ndarray
    pose: np.ndarray
    translation: np.ndarray
    expression: np.ndarray


class Term(Protocol):
    """weigh: finds the weights anew; cost: their weighted squares; linearised: residuals [f, L D]
    and slopes [f, L D, n + B + 4] of some rows, both times the square root of the weights."""

    def weigh(self, betas: np.ndarray, fit: ClipFit) -> None: ...

    def cost(self, betas: np.ndarray, fit: ClipFit) -> float: ...

    def linearised(
        self, betas: np.ndarray, fit: ClipFit, rows: slice
    ) -> tuple[np.ndarray, np.ndarray]: ...


def project(points: np.ndarray, focal: float) -> np.ndarray:
    """[F,L,3], camera at the origin looking down -z -> pixels [F,L,2], y down."""
    depth = -points[..., 2:].clip(None, -1e-3)
    return points[..., :2] * np.array([focal, -focal]) / depth


def project_slopes(points: np.ndarray, focal: float) -> np.ndarray:
    """d pixels / d point, [F,L,2,3]."""
    x, y, z = np.moveaxis(points, -1, 0)
    z = z.clip(None, -1e-3)
    outer = np.zeros((*points.shape[:2], 2, 3))
    outer[..., 0, 0] = -focal / z
    outer[..., 0, 2] = focal * x / z**2
    outer[..., 1, 1] = focal / z
    outer[..., 1, 2] = -focal * y / z**2
    return outer


def _posed(model: PointModel, betas: np.ndarray, fit: ClipFit, rows: slice = slice(None)) -> Posed:
    return model.pose(betas, fit.expression[rows], fit.pose[rows], fit.translation[rows])


class _Poser:
    """A clip's points where a fit has them. The last are kept, less what derivatives need: a step
    asks for them when it accepts a fit, and again when it weighs and looks."""

    def __init__(self) -> None:
        self._last: tuple[np.ndarray, ClipFit, Posed] | None = None

    def __call__(self, model: PointModel, betas: np.ndarray, fit: ClipFit) -> Posed:
        if self._last is None or self._last[0] is not betas or self._last[1] is not fit:
            posed = replace(_posed(model, betas, fit), parts=_NOTHING)
            self._last = betas, fit, posed
        return self._last[2]


_NOTHING = np.zeros(0)


def _slopes(
    model: PointModel, posed: Posed, pose: np.ndarray, outer: np.ndarray, by_focal: np.ndarray
) -> np.ndarray:
    """[f, L D, n + B + 4]: joints but the root, translation, expression; identity, log focal,
    root. outer [f,L,D,3]; by_focal [f,L,D]."""
    slopes = model.jacobian(posed, pose, outer)
    focal = by_focal[..., None].astype(np.float32)
    own = (slopes.pose[..., 3:], slopes.translation, slopes.expression)
    together = np.concatenate([*own, slopes.shape, focal, slopes.pose[..., :3]], axis=3)
    return together.reshape(len(together), -1, together.shape[3])


@dataclass(eq=False)
class Landmarks:
    """target [F,L,2] pixels about the picture's middle, y down; trust [F,L]; scatter in pixels.

    `aim` [F,L,2] is the target without what the detector strays in such a turn of the head.
    """

    model: LandmarkModel
    target: np.ndarray
    trust: np.ndarray
    scatter: float
    weights: np.ndarray | None = None
    aim: np.ndarray | None = None
    posed: _Poser = field(default_factory=_Poser, init=False)

    def weigh(self, betas: np.ndarray, fit: ClipFit) -> None:
        """Trust, less for what turns away from the camera and for what fits badly."""
        posed = self.posed(self.model, betas, fit)
        facing = ((self.model.facing(posed) - 0.05) / 0.4).clip(0.03, 1)
        pixels = project(posed.points, fit.focal)
        strayed = project(posed.points + self.model.strayed(posed), fit.focal)
        self.aim = self.target - (strayed - pixels)
        distance = np.linalg.norm(pixels - self.aim, axis=2)
        # while everything is still far off, nothing is an outlier yet
        usual = max(self.scatter, float(np.median(distance)))
        robust = 1 / (1 + (distance / (4 * usual)) ** 2)
        self.weights = self.trust * facing * robust / self.scatter**2

    def cost(self, betas: np.ndarray, fit: ClipFit) -> float:
        assert self.weights is not None
        assert self.aim is not None
        missed = project(self.posed(self.model, betas, fit).points, fit.focal) - self.aim
        return float((self.weights[..., None] * missed**2).sum())

    def linearised(
        self, betas: np.ndarray, fit: ClipFit, rows: slice
    ) -> tuple[np.ndarray, np.ndarray]:
        assert self.weights is not None
        assert self.aim is not None
        posed = _posed(self.model, betas, fit, rows)
        pixels = project(posed.points, fit.focal)
        root = np.sqrt(self.weights[rows])[..., None]
        outer = project_slopes(posed.points, fit.focal) * root[..., None]
        slopes = _slopes(self.model, posed, fit.pose[rows], outer, pixels * root)
        residual = (pixels - self.aim[rows]) * root
        return residual.reshape(len(slopes), -1).astype(np.float32), slopes

    def distances(self, betas: np.ndarray, fit: ClipFit) -> np.ndarray:
        """Median distance of a frame's landmarks, in pixels, [F]."""
        posed = self.posed(self.model, betas, fit)
        missed = project(posed.points + self.model.strayed(posed), fit.focal) - self.target
        return np.median(np.linalg.norm(missed, axis=2), axis=1)


@dataclass(eq=False)
class Photo:
    """A clip's pictures at points of the face, against what the clip shows there on the whole.

    `template` [L] is that, and `certainty` [L] the weight behind it; `look` finds them, and what is
    `seen` of the points, [F,L]. It must precede the first use.
    """

    model: PointModel
    pictures: Pictures
    weight: float = 1.0
    template: np.ndarray | None = None
    certainty: np.ndarray | None = None
    weights: np.ndarray | None = None
    seen: np.ndarray | None = None
    # [F,L] nothing of the head hides it; kept, for it hardly changes
    front: np.ndarray | None = None
    posed: _Poser = field(default_factory=_Poser, init=False)

    def look(self, betas: np.ndarray, fit: ClipFit) -> None:
        """Finds what is visible, and each point's usual look over the frames."""
        posed = self.posed(self.model, betas, fit)
        facing = ((self.model.facing(posed) - 0.2) / 0.5).clip(0, 1)
        if self.front is None:
            self.front = visible(self.model, betas, fit, posed.points, self.pictures)
        self.seen = facing * self.front
        values, _, inside = sample(self.pictures, project(posed.points, fit.focal))
        self.template, self.certainty = templates(values, self.seen * inside)

    def lean(self, shared: np.ndarray, share: float) -> None:
        """Moves the template by `share` toward `shared` [L], less where it differs much."""
        assert self.template is not None
        apart = shared - self.template
        self.template = self.template + share * apart / (1 + (apart / 0.5) ** 2)

    def weigh(self, betas: np.ndarray, fit: ClipFit) -> None:
        residual, inside, gradient = self._compared(betas, fit)
        assert self.seen is not None
        base = self.seen * inside
        usual = 1.48 * float(np.median(np.abs(residual[base > 0.5]))) if (base > 0.5).any() else 1.0
        usual = max(usual, _FLOOR)
        steep = (gradient**2).sum(axis=2) / self.pictures.scale[:, None] ** 2
        likely = usual**2 + _ASTRAY**2 * steep
        robust = 1 / (1 + residual**2 / (4 * likely)) ** 2
        self.weights = self.weight * _PHOTO_INDEPENDENT * base * robust / usual**2

    def cost(self, betas: np.ndarray, fit: ClipFit) -> float:
        residual, _ = self.residual(betas, fit)
        assert self.weights is not None
        # a point that leaves the window keeps what its edge shows: a jump would stop all others
        return float((self.weights * residual**2).sum())

    def linearised(
        self, betas: np.ndarray, fit: ClipFit, rows: slice
    ) -> tuple[np.ndarray, np.ndarray]:
        assert self.weights is not None
        assert self.template is not None
        posed = _posed(self.model, betas, fit, rows)
        pixels = project(posed.points, fit.focal)
        values, gradient, _ = sample(self.pictures, pixels, rows)
        root = np.sqrt(self.weights[rows])
        gradient = gradient * root[..., None]
        outer = gradient[..., None, :] @ project_slopes(posed.points, fit.focal)
        by_focal = (gradient * pixels).sum(axis=2, keepdims=True)
        slopes = _slopes(self.model, posed, fit.pose[rows], outer, by_focal)
        return ((values - self.template) * root).astype(np.float32), slopes

    def residual(self, betas: np.ndarray, fit: ClipFit) -> tuple[np.ndarray, np.ndarray]:
        """What the points show more than the template [F,L], and which are in the picture."""
        return self._compared(betas, fit)[:2]

    def _compared(
        self, betas: np.ndarray, fit: ClipFit
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `residual`, and the pictures' gradients [F,L,2] a source pixel."""
        assert self.template is not None
        posed = self.posed(self.model, betas, fit)
        values, gradient, inside = sample(self.pictures, project(posed.points, fit.focal))
        return values - self.template, inside, gradient


def with_weight(term: Landmarks, factor: float) -> Landmarks:
    """The same landmarks, trusted `factor` times as much."""
    return replace(term, trust=term.trust * factor, weights=None)
