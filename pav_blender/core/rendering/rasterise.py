"""A z-buffer for triangle meshes: depth, triangle and barycentrics a pixel."""

from __future__ import annotations

import numpy as np

from ..kernels import cpu as _cpu  # first: it says where numba keeps compiled code
from .cameras import Camera

from numba import njit  # isort: skip


def rasterise(
    vertices: np.ndarray, triangles: np.ndarray, camera: Camera, *, near: float = 1e-3
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest triangle a pixel centre, of vertices [V, 3] and triangles [T, 3].

    Returns depth [H, W] float32 along the camera's z (inf where empty), triangle [H, W] int32
    (-1 where empty), perspective-correct barycentrics [H, W, 3] float32. Triangles with a corner
    nearer than `near` metres are left out; both sides are seen.
    """
    pixels, depth = camera.project(vertices)
    return _fill(
        np.ascontiguousarray(pixels),
        np.ascontiguousarray(depth),
        np.ascontiguousarray(triangles, np.int32),
        camera.width,
        camera.height,
        near,
    )


def cover(points: np.ndarray, triangles: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a flat mesh, points [U, 2] in pixels, on a square picture.

    Returns triangle [size, size] int32 (-1 where none covers a pixel's centre; the first where
    several do) and barycentrics [size, size, 3] float32.
    """
    _, index, barycentric = _fill(
        np.ascontiguousarray(points, np.float64),
        np.ones(len(points)),
        np.ascontiguousarray(triangles, np.int32),
        size,
        size,
        0.0,
    )
    return index, barycentric


assert _cpu


@njit(cache=True, nogil=True)
def _fill(pixels, depths, triangles, width, height, near):  # type: ignore[no-untyped-def]
    depth = np.full((height, width), np.inf, np.float32)
    index = np.full((height, width), -1, np.int32)
    barycentric = np.zeros((height, width, 3), np.float32)
    for t in range(triangles.shape[0]):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        za, zb, zc = depths[a], depths[b], depths[c]
        if not (za > near and zb > near and zc > near):
            continue
        ax, ay = pixels[a, 0], pixels[a, 1]
        bx, by = pixels[b, 0], pixels[b, 1]
        cx, cy = pixels[c, 0], pixels[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > 1e-12:
            continue
        x0 = max(int(np.floor(min(ax, bx, cx) - 0.5)), 0)
        x1 = min(int(np.ceil(max(ax, bx, cx) - 0.5)), width - 1)
        y0 = max(int(np.floor(min(ay, by, cy) - 0.5)), 0)
        y1 = min(int(np.ceil(max(ay, by, cy) - 0.5)), height - 1)
        for y in range(y0, y1 + 1):
            py = y + 0.5
            for x in range(x0, x1 + 1):
                px = x + 0.5
                u = ((bx - px) * (cy - py) - (by - py) * (cx - px)) / area
                v = ((cx - px) * (ay - py) - (cy - py) * (ax - px)) / area
                w = 1.0 - u - v
                if u < 0 or v < 0 or w < 0:
                    continue
                inverse = u / za + v / zb + w / zc
                z = 1.0 / inverse
                if z < depth[y, x]:
                    depth[y, x] = z
                    index[y, x] = t
                    barycentric[y, x, 0] = u / za * z
                    barycentric[y, x, 1] = v / zb * z
                    barycentric[y, x, 2] = w / zc * z
    return depth, index, barycentric
