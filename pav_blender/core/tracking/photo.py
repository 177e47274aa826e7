"""Pictures of a face made comparable between frames, and read at points of the fitted head.

A picture's own brightness changes with the light, the exposure and the turn of the head. What is
compared is the luminance less its local mean, over its local deviation: pores, brows, nostrils and
lips keep that through all of it, so that no model of light is needed to follow the skin.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, uniform_filter

from ..head import HeadModel
from ..kernels import cpu as _cpu  # first: it says where numba keeps compiled code
from ..kernels.cpu.threads import run_chunks
from ..rendering.cameras import Camera
from ..rendering.rasterise import rasterise
from .crop import resize
from .landmark_model import PointModel

from numba import njit  # isort: skip

assert _cpu
SIDE = 224  # of a window, pixels
_ROOM = 0.18  # of the face's extent, round it
_LOCAL = 7  # pixels of the window that "local" means
_QUIET = 0.03  # luminance's deviation below which skin counts as plain
_STEP = 1 / 32  # of a stored feature
_POINTS = 1600
_BEHIND = 0.004  # metres behind the mesh's front that still count as on it


@dataclass(eq=False)
class Pictures:
    """features int8 [F,S,S]; corners [F,2] source pixels about the picture's middle; scale [F]
    window pixels a source pixel."""

    features: np.ndarray
    corners: np.ndarray
    scale: np.ndarray

    def blurred(self, sigma: float) -> Pictures:
        """The same pictures, softer by `sigma` window pixels: what is far off is still drawn in."""
        soft = np.empty_like(self.features)
        for row, feature in enumerate(self.features):
            soft[row] = np.round(gaussian_filter(feature.astype(np.float32), sigma))
        return Pictures(soft, self.corners, self.scale)


def windows(
    frames: Iterable[np.ndarray], landmarks: np.ndarray, width: int, height: int
) -> Pictures:
    """The faces cut out of frames uint8 [H,W,3], found by their landmarks [F,478,2]."""
    count = len(landmarks)
    features = np.zeros((count, SIDE, SIDE), np.int8)
    low, high = landmarks[..., :2].min(axis=1), landmarks[..., :2].max(axis=1)
    # one size for a clip: the features' scale must not breathe with the mouth
    side = max(8.0, float(np.median((high - low).max(axis=1))) * (1 + 2 * _ROOM))
    corners = np.round((low + high) / 2 - side / 2)
    whole = round(side)
    for row, rgb in enumerate(frames):
        features[row] = feature(luminance(rgb, corners[row].astype(int), whole))
    middle = np.array([width / 2, height / 2])
    return Pictures(features, corners - middle, np.full(count, SIDE / whole))


def luminance(rgb: np.ndarray, corner: np.ndarray, side: int) -> np.ndarray:
    """Of a square window of a frame uint8 [H,W,3], which may reach beyond it: float32 [SIDE,SIDE]
    in [0, 1], and a little beyond where edges are sharp. corner [2] int: left and top."""
    height, width = rgb.shape[:2]
    rows = np.arange(corner[1], corner[1] + side).clip(0, height - 1)
    columns = np.arange(corner[0], corner[0] + side).clip(0, width - 1)
    # one axis after the other: five times as fast as both at once
    window = rgb.take(rows, axis=0).take(columns, axis=1).astype(np.float32)
    grey = window @ (np.array([0.299, 0.587, 0.114], np.float32) / 255)
    return resize(grey[..., None], SIDE)[..., 0]


def feature(grey: np.ndarray, local: int = _LOCAL) -> np.ndarray:
    """What is compared, int8 [H, W], of luminance float32 [H, W] in [0, 1]; local: pixels."""
    smooth = gaussian_filter(grey, 1.0)
    mean = uniform_filter(uniform_filter(smooth, local), local)
    off = smooth - mean
    squares = uniform_filter(uniform_filter(off * off, local), local)
    deviation = np.sqrt(squares.clip(0))  # running sums may fall below 0
    return np.round(off / (deviation + _QUIET) / _STEP).clip(-127, 127).astype(np.int8)


def face_points(head: HeadModel, shapes: int) -> PointModel:
    """Points spread over the face's skin by area, always the same ones."""
    vertices = head.template.astype(np.float64)
    a, b, c = (vertices[head.triangles[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    region = head.regions.get("face", np.ones(head.vertex_count, bool))
    region = region & ~_any(head, ("eyeballs", "eye_sockets", "mouth_interior", "tongue", "teeth"))
    skin = region[head.triangles].all(axis=1)
    share = np.where(skin & (normal[:, 2] > -0.2 * area), area, 0.0)
    return PointModel(head, shapes, *scattered(share, _POINTS))


def scattered(share: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles [count], drawn by their share, and random barycentrics in them [count, 3]; the
    same ones every time."""
    rng = np.random.default_rng(0)
    triangles = rng.choice(len(share), count, p=share / share.sum())
    u = np.sqrt(rng.random(count))
    v = rng.random(count)
    return triangles, np.stack([1 - u, u * (1 - v), u * v], axis=1)


def _any(head: HeadModel, names: tuple[str, ...]) -> np.ndarray:
    mask = np.zeros(head.vertex_count, bool)
    for name in names:
        if name in head.regions:
            mask |= head.regions[name]
    return mask


def sample(
    pictures: Pictures, pixels: np.ndarray, rows: slice = slice(None)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features at pixels [f,L,2]: values [f,L], gradient a source pixel [f,L,2], inside [f,L].
    Outside the window values are those of its nearest place, and the gradient is 0."""
    scale = pictures.scale[rows]
    at = (pixels - pictures.corners[rows][:, None]) * scale[:, None, None] - 0.5
    features, at = pictures.features[rows], np.ascontiguousarray(at)
    values, inside = np.zeros(at.shape[:2], np.float32), np.zeros(at.shape[:2], np.bool_)
    gradient = np.zeros(at.shape, np.float32)
    run_chunks(lambda i, j: _sample(features, at, values, gradient, inside, i, j), len(at), 4)
    return values * _STEP, gradient * (_STEP * scale[:, None, None]), inside


@njit(cache=True, nogil=True)
def _sample(features, at, values, gradient, inside, start, stop):  # type: ignore[no-untyped-def]
    side = features.shape[1]
    for f in range(start, stop):
        for k in range(at.shape[1]):
            x, y = at[f, k, 0], at[f, k, 1]
            within = 1 <= x < side - 2 and 1 <= y < side - 2
            if not within:
                # the nearest place within; NaN becomes the first
                x = min(x, side - 2.5) if x > 1.0 else 1.0
                y = min(y, side - 2.5) if y > 1.0 else 1.0
            i, j = int(y), int(x)
            v, u = np.float32(y - i), np.float32(x - j)
            a, b = np.float32(features[f, i, j]), np.float32(features[f, i, j + 1])
            c, d = np.float32(features[f, i + 1, j]), np.float32(features[f, i + 1, j + 1])
            values[f, k] = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
            if within:
                gradient[f, k, 0] = (1 - v) * (b - a) + v * (d - c)
                gradient[f, k, 1] = (1 - u) * (c - a) + u * (d - b)
            inside[f, k] = within


def templates(values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What points show on the whole, [L], a few frames' occlusions left aside, and the summed
    weights behind it, [L]; values and weights [F,L]."""
    mean = (values * weights).sum(axis=0) / weights.sum(axis=0).clip(1e-6)
    for _ in range(3):
        robust = weights / (1 + ((values - mean) / 0.5) ** 2) ** 2
        mean = (values * robust).sum(axis=0) / robust.sum(axis=0).clip(1e-6)
    return mean, robust.sum(axis=0)


def common_look(looks: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Of all clips' templates and their weights: the shared look of each point, [L]."""
    total = sum(np.minimum(weight, 20.0) for _, weight in looks)
    return sum(look * np.minimum(weight, 20.0) for look, weight in looks) / np.clip(
        total, 1e-6, None
    )


def visible(
    model: PointModel, betas: np.ndarray, fit, points: np.ndarray, pictures: Pictures
) -> np.ndarray:
    """Which points [F,L,3] nothing of the head hides, bool [F,L], by a depth buffer a frame."""
    head, side = model.head, SIDE // 2
    whole = np.zeros(len(head.shape_basis), np.float32)
    whole[: len(betas)] = betas
    out = np.empty(points.shape[:2], bool)
    upright = np.diag([1.0, -1.0, -1.0, 1.0])
    for start in range(0, len(points), 32):
        rows = slice(start, start + 32)
        posed = head.pose(
            whole,
            *(x[rows].astype(np.float32) for x in (fit.expression, fit.pose, fit.translation)),
        ).numpy()
        for row in range(start, start + len(posed)):
            half = pictures.scale[row] / 2
            matrix = np.eye(3)
            matrix[0, 0] = matrix[1, 1] = fit.focal * half
            matrix[:2, 2] = -pictures.corners[row] * half
            camera = Camera(side, side, matrix, upright)
            depth, _, _ = rasterise(posed[row - start], head.triangles, camera)
            pixels, own = camera.project(points[row])
            at = np.floor(pixels).astype(int).clip(0, side - 1)
            out[row] = own <= depth[at[:, 1], at[:, 0]] + _BEHIND
    return out
