"""Swept and lofted meshes, and rings measured round the body."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d


def sweep(path: np.ndarray, radius, sides: int = 10, closed: bool = False, flatten: float = 1.0):
    """A tube along `path` [N,3]: vertices and quads; `radius` one or [N]."""
    count = len(path)
    ahead = np.roll(path, -1, 0) if closed else np.concatenate([path[1:], path[-1:]])
    behind = np.roll(path, 1, 0) if closed else np.concatenate([path[:1], path[:-1]])
    along = ahead - behind
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.empty_like(path)
    seed = np.array([0.0, 1.0, 0.0]) if abs(along[0, 1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    for k in range(count):
        seed = seed - (seed @ along[k]) * along[k]
        seed = seed / np.linalg.norm(seed)
        side[k] = seed
    other = np.cross(along, side)
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    radius = np.broadcast_to(radius, count)[:, None, None]
    ring = np.cos(turn)[None, :, None] * side[:, None] * flatten
    ring = ring + np.sin(turn)[None, :, None] * other[:, None]
    return grid(path[:, None] + radius * ring, closed_rows=closed, closed_columns=True)


def grid(points: np.ndarray, closed_rows: bool = False, closed_columns: bool = False):
    """Vertices and quads of a lattice [N,M,3]."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    if closed_rows:
        index = np.concatenate([index, index[:1]])
    if closed_columns:
        index = np.concatenate([index, index[:, :1]], axis=1)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)
    return points.reshape(-1, 3), quads.reshape(-1, 4)


def join(*meshes):
    """One mesh of several (vertices, quads)."""
    vertices, quads, base = [], [], 0
    for points, faces in meshes:
        vertices.append(points)
        quads.append(faces + base)
        base += len(points)
    return np.concatenate(vertices), np.concatenate(quads)


def ring(
    points: np.ndarray, centre: np.ndarray, height, count: int = 96, band: float = 0.006,
    smooth: float = 2.0,
) -> np.ndarray:  # fmt: skip
    """A closed curve [count,3] round `points` where y = height(z), starting in front (+z).

    The radius about the axis through `centre` is the surface's outermost within the band.
    """
    y = height(points[:, 2])
    near = points[np.abs(points[:, 1] - y) < band]
    x, z = near[:, 0] - centre[0], near[:, 2] - centre[2]
    azimuth, reach = np.arctan2(x, z), np.hypot(x, z)
    grid_angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    gap = np.abs((azimuth[None] - grid_angle[:, None] + np.pi) % (2 * np.pi) - np.pi)
    inside = gap < 1.5 * np.pi / count * 2
    radius = np.where(inside, reach[None], 0).max(1)
    known = radius > 0
    radius = np.interp(grid_angle, grid_angle[known], radius[known], period=2 * np.pi)
    radius = gaussian_filter1d(radius, smooth, mode="wrap")
    x = centre[0] + radius * np.sin(grid_angle)
    z = centre[2] + radius * np.cos(grid_angle)
    return np.stack([x, height(z), z], axis=1)
