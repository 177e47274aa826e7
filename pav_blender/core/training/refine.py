"""The correction of one frame's track: Gauss-Newton on the difference of avatar and picture.

The head is never posed anew for a derivative. What a ray shows once the surface before it has
moved by a little is what the same ray, moved back by as much, shows now: two gradients a ray,
across its direction, and the chain rule give the derivative by every parameter that moves the mesh
(Lucas and Kanade 1981, "An iterative image registration technique"; Baker and Matthews 2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ..rendering.cameras import Camera
from ..rendering.rays import RayBatch, camera_rays, tiled
from ..rendering.render import RenderSettings, Scene, trace_rays
from ..rendering.wearing import deformer_of
from .corrections import RIGID, Space, motion, seen_from

_ITERATIONS = 3
_PIXELS = 0.5  # how far rays are moved for a gradient
_HUBER = 0.1  # colour beyond which a difference counts less: what no motion explains
_ALIKE = 24.0  # differences that tell the same: four channels of neighbouring pixels
_LEAST_NOISE = 0.01
_ALONG = 1 / 3  # the prior's deviation along the view, as a part of that across it
_DAMPING = 1e-3
_LEAP = 2.0  # prior's deviations that one step may go
_SETTINGS = RenderSettings.preset("preview")


@dataclass(frozen=True, eq=False)
class Sight:
    """Pixels of a frame: columns, rows [R], and colours [R, 4] in [0, 1], premultiplied."""

    camera: Camera
    columns: np.ndarray
    rows: np.ndarray
    colours: np.ndarray

    def part(self, chosen: np.ndarray) -> Sight:
        """Those chosen, by mask or index."""
        arrays = (values[chosen] for values in (self.columns, self.rows, self.colours))
        return Sight(self.camera, *arrays)


def choose_pixels(
    rgba: np.ndarray, camera: Camera, count: int, random: np.random.Generator
) -> Sight:
    """`count` pixels of a picture uint8 [H, W, 4], most of them where it changes much."""
    colour = rgba.astype(np.float64) / 255
    colour[..., :3] *= colour[..., 3:]
    across, down = np.gradient(colour, axis=1), np.gradient(colour, axis=0)
    steep = np.sqrt((across**2 + down**2).sum(2)).reshape(-1)
    near = (colour[..., 3] > 0).reshape(-1) | (steep > 0)
    if not near.any():
        near[:] = True
    weight = near * (steep + steep[near].mean() + 1e-6)
    count = min(count, int(near.sum()))
    height, width = rgba.shape[:2]
    drawn = np.zeros(len(weight), bool)
    drawn[random.choice(len(weight), count, replace=False, p=weight / weight.sum())] = True
    order = tiled(width, height)  # neighbours search alike
    at = order[drawn[order]]
    colours = colour.reshape(-1, 4)[at]
    return Sight(camera, at % width, at // width, colours)


def look(scene: Scene, sight: Sight, correction: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """What the avatar shows there, [R, 4] premultiplied, where the scene is posed with the
    correction's expressions already."""
    camera = seen_from(sight.camera, motion(correction, middle))
    return _trace(scene, camera_rays(camera, sight.columns, sight.rows))[0]


def correct(
    scene: Scene,
    sight: Sight,
    start: np.ndarray,
    middle: np.ndarray,
    space: Space,
    changes: np.ndarray | None,
    expression: np.ndarray,
    iterations: int = _ITERATIONS,
) -> np.ndarray:
    """The correction [6 + K] that brings avatar and pixels together, from `start` on.

    scene: posed with the expressions that `start` corrects, and no motion; middle [3]: of the
    tracked head; changes [K, V, 3]: see `mesh_changes`, None to leave the expressions alone;
    expression [E]: the track's.
    """
    free = len(space) if changes is not None and len(changes) else RIGID
    current = start.copy()
    if not len(sight.columns):
        return start
    precision = _precision(space, sight.camera)
    best, least = current, np.inf
    jacobian = hit = None
    for left in range(iterations, -1, -1):
        camera = seen_from(sight.camera, motion(current, middle))
        rays = camera_rays(camera, sight.columns, sight.rows)
        bent = current[RIGID:] - start[RIGID:]
        if hit is not None and bent.any():
            rays.origins = rays.origins - torch.from_numpy(hit.moved(changes, bent))
        shown, points = _trace(scene, rays)
        difference = shown - sight.colours
        cost = _cost(difference, current, precision)
        if cost < least:
            best, least = current, cost
        if left == 0:
            break
        if jacobian is None:  # motions are of a pixel or two: it stays what it is
            jacobian, hit = _jacobian(scene, camera, rays, points, middle, changes, free)
        current = _step(jacobian, difference, current, precision)
        current = space.bounded(current, expression)
    return best


@dataclass(frozen=True, eq=False)
class _Hit:
    """Where rays [R] met the head: vertices [R, 3] of the nearest triangles, and barycentrics."""

    corners: np.ndarray
    barycentric: np.ndarray

    def carry(self, change: np.ndarray) -> np.ndarray:
        """A change of the mesh [V, 3] where the rays met it, [R, 3]."""
        return (change[self.corners] * self.barycentric[..., None]).sum(1)

    def moved(self, changes: np.ndarray | None, by: np.ndarray) -> np.ndarray:
        assert changes is not None
        return self.carry(np.tensordot(by, changes, 1).astype(np.float32))


def _trace(scene: Scene, rays: RayBatch) -> tuple[np.ndarray, np.ndarray]:
    """Colours [R, 4] premultiplied, and where the rays end [R, 3] (nan: nowhere)."""
    rgba, depth = trace_rays(scene, rays, _SETTINGS)
    colours = rgba.astype(np.float64)
    colours[:, :3] *= colours[:, 3:]
    far = depth / rays.cosine.numpy()
    far[~np.isfinite(far)] = np.nan
    return colours, rays.origins.numpy() + far[:, None] * rays.directions.numpy()


def _jacobian(
    scene: Scene,
    camera: Camera,
    rays: RayBatch,
    points: np.ndarray,
    middle: np.ndarray,
    changes: np.ndarray | None,
    free: int,
) -> tuple[np.ndarray, _Hit]:
    """Derivatives [R, 4, free] of the colours, and where the rays meet the head."""
    directions = rays.directions.double().numpy()
    right = camera.camera_to_world[:3, 0]
    across = right - (directions @ right)[:, None] * directions
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = across, np.cross(directions, across)
    away = np.linalg.norm(middle - camera.origin)
    step = _PIXELS * away / camera.intrinsics[0, 0]
    gradients = []
    for axis in axes:
        ends = []
        for sign in (1, -1):
            shift = torch.from_numpy((sign * step * axis).astype(np.float32))
            moved = RayBatch(rays.origins + shift, rays.directions, rays.cosine)
            colours, reached = _trace(scene, moved)
            ends.append(colours)
            # rays past the outline have no point of their own: that of a ray beside them
            points = np.where(np.isnan(points), reached - sign * step * axis, points)
        gradients.append((ends[0] - ends[1]) / (2 * step))
    lost = np.isnan(points).any(1)
    points = np.where(lost[:, None], middle, points)
    triangle, barycentric, _ = deformer_of(scene.avatar).nearest(
        scene.mesh, torch.from_numpy(points.astype(np.float32))
    )
    hit = _Hit(scene.avatar.triangles[triangle.numpy()], barycentric.numpy())
    motions = np.zeros((len(points), 3, free))
    for axis in range(3):
        unit = np.eye(3)[axis]
        motions[:, :, axis] = np.cross(unit, points - middle)
        motions[:, axis, 3 + axis] = 1
    for index in range(free - RIGID):
        assert changes is not None
        motions[:, :, RIGID + index] = hit.carry(changes[index])
    jacobian = np.zeros((len(points), 4, free))
    for axis, gradient in zip(axes, gradients, strict=True):
        along = np.einsum("ri,rif->rf", axis, motions)
        jacobian -= gradient[:, :, None] * along[:, None, :]
    jacobian[lost] = 0
    return jacobian, hit


def _weights(difference: np.ndarray) -> np.ndarray:
    """Huber's weights [R] of differences [R, 4]."""
    size = np.sqrt((difference**2).mean(1))
    return _HUBER / np.maximum(size, _HUBER)


def _precision(space: Space, camera: Camera) -> np.ndarray:
    """The prior's inverse covariance [6 + K, 6 + K]. Along the view it is narrow: a head that is a
    millimetre farther away looks the same, and what moved it there would be noise."""
    precision = np.diag(space.sigma**-2)
    shift = slice(3, RIGID)
    axes = camera.camera_to_world[:3, :3]
    precision[shift, shift] = (
        axes @ (precision[shift, shift] @ np.diag([1, 1, _ALONG**-2])) @ axes.T
    )
    return precision


def _cost(difference: np.ndarray, correction: np.ndarray, precision: np.ndarray) -> float:
    """What is minimised, up to the noise: robust mean squares and the prior."""
    size = np.sqrt((difference**2).mean(1))
    robust = np.where(size < _HUBER, size**2, _HUBER * (2 * size - _HUBER))
    prior = float(correction @ precision @ correction) * _ALIKE / max(difference.size, 1)
    return float(robust.mean() + _LEAST_NOISE**2 * prior)


def _step(
    jacobian: np.ndarray, difference: np.ndarray, current: np.ndarray, precision: np.ndarray
) -> np.ndarray:
    """One damped step: the prior pulls to the track as far as the pixels leave it open."""
    free = jacobian.shape[2]
    weights = _weights(difference)
    telling = np.abs(jacobian).sum((1, 2)) > 0
    if telling.sum() < 2 * free:
        return current
    weights = weights[telling]
    rows, wrong = jacobian[telling], difference[telling]
    noise = max(float((weights[:, None] * wrong**2).mean()), _LEAST_NOISE**2) * _ALIKE
    weighted = rows * weights[:, None, None]
    prior = precision[:free, :free]
    normal = np.einsum("rcf,rcg->fg", weighted, rows) / noise + prior
    pull = np.einsum("rcf,rc->f", weighted, wrong) / noise + prior @ current[:free]
    # in units of the prior, so that the damping means the same for radians and metres
    unit = 1 / np.sqrt(np.diag(prior))
    scaled = normal * np.outer(unit, unit)
    scaled += _DAMPING * np.diag(np.diag(scaled))
    change = -np.linalg.solve(scaled, pull * unit) * unit
    out = current.copy()
    out[:free] += np.clip(change, -_LEAP * unit, _LEAP * unit)
    return out
