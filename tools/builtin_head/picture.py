"""A small z-buffer and shader: pictures of the head for landmark detection and for looking at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from pav_blender.core.head.geometry import vertex_normals
from pav_blender.core.head.model import HeadModel

_SKIN = np.array([0.78, 0.58, 0.48])
_LIPS = np.array([0.66, 0.36, 0.34])
_BROW = np.array([0.22, 0.15, 0.11])
_HAIR = np.array([0.20, 0.15, 0.12])
_MOUTH = np.array([0.35, 0.12, 0.12])
_TEETH = np.array([0.88, 0.86, 0.80])
_BACKGROUND = np.array([0.55, 0.6, 0.65])
_PUPIL, _IRIS = 0.18, 0.46  # radians from the eye's axis


@dataclass(frozen=True)
class View:
    """A picture [S,S]; turn: degrees to the person's left; lift: degrees from above."""

    size: int = 640
    turn: float = 0.0
    lift: float = 0.0
    distance: float = 0.75
    span: float = 0.30  # metres across the picture at the target
    target: tuple[float, float, float] = (0.0, -0.03, 0.0)

    def project(self, points: np.ndarray) -> np.ndarray:
        """[N,3] -> pixel x, pixel y, depth [N,3]."""
        turn, lift = math.radians(self.turn), math.radians(self.lift)
        back = np.array(
            [math.sin(turn) * math.cos(lift), math.sin(lift), math.cos(turn) * math.cos(lift)]
        )
        right = np.array([math.cos(turn), 0.0, -math.sin(turn)])
        up = np.cross(back, right)
        relative = points - (np.array(self.target) + self.distance * back)
        depth = -relative @ back
        scale = self.size / self.span * self.distance / depth
        x = self.size / 2 + relative @ right * scale
        y = self.size / 2 - relative @ up * scale
        return np.stack([x, y, depth], 1)


@numba.njit(cache=True)
def rasterise(points, triangles, size):  # pragma: no cover - compiled
    """Depth [S,S], triangle [S,S] (-1 outside) and screen barycentrics [S,S,3]."""
    depth = np.full((size, size), np.inf)
    index = np.full((size, size), -1, np.int64)
    weights = np.zeros((size, size, 3))
    for t in range(len(triangles)):
        a, b, c = points[triangles[t, 0]], points[triangles[t, 1]], points[triangles[t, 2]]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(area) < 1e-12:
            continue
        x0 = max(math.floor(min(a[0], b[0], c[0]) - 0.5), 0)
        x1 = min(math.ceil(max(a[0], b[0], c[0]) + 0.5), size)
        y0 = max(math.floor(min(a[1], b[1], c[1]) - 0.5), 0)
        y1 = min(math.ceil(max(a[1], b[1], c[1]) + 0.5), size)
        for y in range(y0, y1):
            for x in range(x0, x1):
                px, py = x + 0.5, y + 0.5
                u = ((b[0] - px) * (c[1] - py) - (b[1] - py) * (c[0] - px)) / area
                v = ((c[0] - px) * (a[1] - py) - (c[1] - py) * (a[0] - px)) / area
                w = 1.0 - u - v
                if u < 0 or v < 0 or w < 0:
                    continue
                z = u * a[2] + v * b[2] + w * c[2]
                if z < depth[y, x]:
                    depth[y, x] = z
                    index[y, x] = t
                    weights[y, x, 0] = u
                    weights[y, x, 1] = v
                    weights[y, x, 2] = w
    return depth, index, weights


def draw(
    head: HeadModel, vertices: np.ndarray, view: View, *, plain: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Picture uint8 [S,S,3], triangle [S,S] and barycentrics [S,S,3] of a posed head.

    plain: one colour for all skin, so that shape alone shows.
    """
    vertices = np.asarray(vertices, np.float64)
    points = view.project(vertices)
    _, index, weights = rasterise(points, head.triangles, view.size)
    hit = index >= 0
    corners = head.triangles[index[hit]]
    blend = weights[hit][..., None]
    normals = (vertex_normals(vertices, head.triangles)[corners] * blend).sum(1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rest = (head.template[corners] * blend).sum(1)
    colour = _colours(head, corners, blend, rest, index[hit], plain)
    turn = math.radians(view.turn + 25)
    lamp = np.array([math.sin(turn), 0.7, math.cos(turn)])
    lamp /= np.linalg.norm(lamp)
    eye = head.regions["eyeballs"][corners].all(1) & (not plain)
    shade = 0.35 + 0.45 * np.clip(normals @ lamp, 0, 1) + 0.2 * (0.5 + 0.5 * normals[:, 1])
    shade = np.where(eye, 0.55 + 0.45 * shade, shade)
    picture = np.empty((view.size, view.size, 3))
    picture[:] = _BACKGROUND
    picture[hit] = colour * shade[:, None]
    return (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8), index, weights


def _colours(head, corners, blend, rest, triangle, plain) -> np.ndarray:
    def paint(base, region, colour):
        amount = (head.regions[region][corners] * blend[..., 0]).sum(1)[:, None]
        return base * (1 - amount) + colour * amount

    colour = np.tile(_SKIN, (len(corners), 1))
    if not plain:
        colour = paint(colour, "lips", _LIPS)
        colour = paint(colour, "scalp", _HAIR)
        brow = _brow_amount(rest)[:, None]
        colour = colour * (1 - 0.85 * brow) + _BROW * 0.85 * brow
    colour = paint(colour, "mouth_interior", _MOUTH)
    colour = paint(colour, "eye_sockets", _MOUTH)
    colour = paint(colour, "teeth", _TEETH)
    eyes = head.regions["eyeballs"][corners].all(1)
    colour[eyes] = _eye_colours(head, rest[eyes])
    return colour


def _brow_amount(rest: np.ndarray) -> np.ndarray:
    """Where a brow would be: an arc 2 cm above each eye (rest positions, metres)."""
    x = np.abs(rest[:, 0])
    middle = 0.0185 + 0.004 * np.clip((x - 0.012) / 0.024, 0, 1) - 0.12 * np.clip(x - 0.036, 0, 1)
    inside = np.clip((x - 0.010) / 0.004, 0, 1) * np.clip((0.054 - x) / 0.008, 0, 1)
    across = np.exp(-(((rest[:, 1] - middle) / 0.0038) ** 4))
    return across * inside * (rest[:, 2] > 0)


def _eye_colours(head: HeadModel, rest: np.ndarray) -> np.ndarray:
    joints = head.joint_regressor @ head.template
    names = [head.joint_names.index(name) for name in ("left_eye", "right_eye")]
    centre = joints[np.where(rest[:, 0] > 0, names[0], names[1])]
    direction = rest - centre
    angle = np.arccos(np.clip(direction[:, 2] / np.linalg.norm(direction, axis=1), -1, 1))
    result = np.tile(np.array([0.93, 0.91, 0.9]), (len(rest), 1))
    result[angle < _IRIS] = (0.36, 0.24, 0.14)
    result[np.abs(angle - _IRIS) < 0.04] = (0.16, 0.10, 0.07)
    result[angle < _PUPIL] = (0.03, 0.03, 0.03)
    return result
