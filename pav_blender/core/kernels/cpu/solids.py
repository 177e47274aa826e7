"""Meshes of a scene as shaded solids, a band of rows a thread; see `reference/solids.py`."""

from __future__ import annotations

import numpy as np
from numba import njit

from ..soup import Lights, Soup
from .threads import run_chunks

_BAND = 16  # rows
_CHUNK = 1 << 14  # vertices or triangles a thread takes at a time
_WIDE = 8  # pixels from which it pays to find where a row of a triangle begins and ends
_SLACK = 1e-4  # pixels


def draw(
    soup: Soup,
    matrices: np.ndarray,
    turns: np.ndarray,
    palette: np.ndarray,
    lights: Lights,
    size: tuple[int, int],
    near: float,
) -> tuple[np.ndarray, np.ndarray]:
    """As the reference."""
    width, height = size
    colour = np.zeros((height, width, 3), np.float32)
    depth = np.full((height, width), np.inf, np.float32)
    count = len(soup.triangles)
    if count == 0:
        return colour, depth
    points = np.empty((len(soup.vertices), 6))  # X, Y, W, depth; X / W, Y / W
    boxes = np.empty((count, 4), np.int32)
    index = np.full((height, width), -1, np.int32)
    run_chunks(_project, len(points), _CHUNK, soup.vertices, soup.owner, matrices, points)
    run_chunks(_bound, count, _CHUNK, points, soup.triangles, width, height, near, boxes)
    bands = -(-height // _BAND)
    begins, sorted_ = _sort(boxes, bands)
    work = begins, sorted_, boxes, points, soup.triangles, near, depth, index
    run_chunks(_fill, bands, 1, *work)
    surface = soup.normals, soup.normal_of, soup.owner, soup.material
    light = turns, palette, lights.directions, lights.ambient
    run_chunks(_shade, height, _BAND, points, soup.triangles, index, *surface, *light, colour)
    return colour, depth


@njit(cache=True, nogil=True)
def _project(start, stop, vertices, owner, matrices, points):  # type: ignore[no-untyped-def]
    for i in range(start, stop):
        m = matrices[owner[i]]
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for k in range(4):
            points[i, k] = m[k, 0] * x + m[k, 1] * y + m[k, 2] * z + m[k, 3]
        points[i, 4] = points[i, 0] / points[i, 2] if points[i, 2] != 0 else 0.0
        points[i, 5] = points[i, 1] / points[i, 2] if points[i, 2] != 0 else 0.0


@njit(cache=True, nogil=True)
def _clipped(points, corners, near):  # type: ignore[no-untyped-def]
    """Left, top, right and bottom of the part of a triangle that is farther than `near`."""
    left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
    for i in range(3):
        p, q = points[corners[i]], points[corners[(i + 1) % 3]]
        if p[3] > near:
            x, y = p[4], p[5]
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        if (p[3] > near) != (q[3] > near):  # where the side passes the nearest depth
            s = (near - p[3]) / (q[3] - p[3])
            w = p[2] + s * (q[2] - p[2])
            x, y = (p[0] + s * (q[0] - p[0])) / w, (p[1] + s * (q[1] - p[1])) / w
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
    return left, top, right, bottom


@njit(cache=True, nogil=True)
def _bound(start, stop, points, triangles, width, height, near, boxes):  # type: ignore[no-untyped-def]
    """Columns and rows (x0, y0, x1, y1, all within) that triangles may cover; x0 > x1 for none."""
    for t in range(start, stop):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if points[a, 3] > near and points[b, 3] > near and points[c, 3] > near:
            left = min(points[a, 4], points[b, 4], points[c, 4])
            right = max(points[a, 4], points[b, 4], points[c, 4])
            top = min(points[a, 5], points[b, 5], points[c, 5])
            bottom = max(points[a, 5], points[b, 5], points[c, 5])
        else:
            left, top, right, bottom = _clipped(points, triangles[t], near)
        boxes[t, 0], boxes[t, 2] = 1, 0
        if left < width and right > 0 and top < height and bottom > 0:
            boxes[t, 0] = int(np.ceil(max(left, 0.0) - 0.5 - _SLACK))
            boxes[t, 1] = int(np.ceil(max(top, 0.0) - 0.5 - _SLACK))
            boxes[t, 2] = int(np.floor(min(right, float(width)) - 0.5 + _SLACK))
            boxes[t, 3] = int(np.floor(min(bottom, float(height)) - 0.5 + _SLACK))
            if boxes[t, 1] > boxes[t, 3]:
                boxes[t, 0], boxes[t, 2] = 1, 0


@njit(cache=True, nogil=True)
def _sort(boxes, bands):  # type: ignore[no-untyped-def]
    """The triangles of each band of rows: those of band b are sorted_[begins[b]:begins[b + 1]],
    in their own order."""
    begins = np.zeros(bands + 1, np.int64)
    for t in range(len(boxes)):
        if boxes[t, 0] <= boxes[t, 2]:
            for b in range(boxes[t, 1] // _BAND, boxes[t, 3] // _BAND + 1):
                begins[b + 1] += 1
    for b in range(bands):
        begins[b + 1] += begins[b]
    sorted_, at = np.empty(begins[bands], np.int32), begins[:-1].copy()
    for t in range(len(boxes)):
        if boxes[t, 0] <= boxes[t, 2]:
            for b in range(boxes[t, 1] // _BAND, boxes[t, 3] // _BAND + 1):
                sorted_[at[b]] = t
                at[b] += 1
    return begins, sorted_


@njit(inline="always")
def _side(b, c, sign):  # type: ignore[no-untyped-def]
    """The weight of the corner that is neither b nor c, as numbers (A, B, C) of A x + B y + C.

    Exactly the opposite where b and c change places: neighbours leave no seam."""
    return (
        sign * (b[1] * c[2] - b[2] * c[1]),
        sign * (b[2] * c[0] - b[0] * c[2]),
        sign * (b[0] * c[1] - b[1] * c[0]),
    )


@njit(inline="always")
def _volume(a, b, c):  # type: ignore[no-untyped-def]
    u, v, w = _side(b, c, 1.0)
    return u * a[0] + v * a[1] + w * a[2]


@njit(cache=True, nogil=True)
def _fill(start, stop, begins, sorted_, boxes, points, triangles, near, depth, index):  # type: ignore[no-untyped-def]
    for place in range(begins[start], begins[stop]):
        t = sorted_[place]
        a, b, c = points[triangles[t, 0]], points[triangles[t, 1]], points[triangles[t, 2]]
        volume = _volume(a, b, c)
        if not abs(volume) > 0:
            continue
        sign = 1.0 if volume > 0 else -1.0
        ax, ay, aw = _side(b, c, sign)
        bx, by, bw = _side(c, a, sign)
        cx, cy, cw = _side(a, b, sign)
        x0, x1 = boxes[t, 0], boxes[t, 2]
        for y in range(max(boxes[t, 1], start * _BAND), min(boxes[t, 3] + 1, stop * _BAND)):
            py = y + 0.5
            ar, br, cr = ay * py + aw, by * py + bw, cy * py + cw
            first, last = x0, x1
            if x1 - x0 >= _WIDE:
                low, high = float(x0), float(x1)
                for slope, rest in ((ax, ar), (bx, br), (cx, cr)):
                    if slope > 0:
                        low = max(low, -rest / slope - 1.5)
                    elif slope < 0:
                        high = min(high, -rest / slope + 0.5)
                if not low <= high:
                    continue
                first, last = max(x0, int(low)), min(x1, int(high) + 1)
            for x in range(first, last + 1):
                px = x + 0.5
                u, v, w = ax * px + ar, bx * px + br, cx * px + cr
                total = u + v + w
                if u < 0 or v < 0 or w < 0 or not total > 0:
                    continue
                z = np.float32((u * a[3] + v * b[3] + w * c[3]) / total)
                if z < depth[y, x] and z > near:
                    depth[y, x] = z
                    index[y, x] = t


@njit(cache=True, nogil=True)
def _shade(start, stop, points, triangles, index, normals, normal_of, owner, material, turns,
           palette, directions, ambient, colour):  # type: ignore[no-untyped-def]  # fmt: skip
    normal = np.empty(3)
    for y in range(start, stop):
        last, facing = -1, 1.0
        ax, ay, aw = 0.0, 0.0, 0.0
        bx, by, bw = 0.0, 0.0, 0.0
        cx, cy, cw = 0.0, 0.0, 0.0
        for x in range(index.shape[1]):
            t = index[y, x]
            if t < 0:
                continue
            turn = turns[owner[triangles[t, 0]]]
            if t != last:
                last = t
                a, b, c = points[triangles[t, 0]], points[triangles[t, 1]], points[triangles[t, 2]]
                volume = _volume(a, b, c)
                sign = 1.0 if volume > 0 else -1.0
                ax, ay, aw = _side(b, c, sign)
                bx, by, bw = _side(c, a, sign)
                cx, cy, cw = _side(a, b, sign)
                facing = -sign if _volume(turn[0], turn[1], turn[2]) > 0 else sign
            px, py = x + 0.5, y + 0.5
            u, v, w = ax * px + (ay * py + aw), bx * px + (by * py + bw), cx * px + (cy * py + cw)
            n0, n1, n2 = (
                normals[normal_of[t, 0]],
                normals[normal_of[t, 1]],
                normals[normal_of[t, 2]],
            )
            lx = u * n0[0] + v * n1[0] + w * n2[0]
            ly = u * n0[1] + v * n1[1] + w * n2[1]
            lz = u * n0[2] + v * n1[2] + w * n2[2]
            length = 0.0
            for k in range(3):
                normal[k] = turn[k, 0] * lx + turn[k, 1] * ly + turn[k, 2] * lz
                length += normal[k] * normal[k]
            scale = facing / np.sqrt(length) if length > 0 else 0.0
            shade = ambient
            for i in range(directions.shape[0]):
                towards = 0.0
                for k in range(3):
                    towards += normal[k] * directions[i, k]
                shade += max(0.0, towards * scale)
            for k in range(3):
                colour[y, x, k] = palette[material[t], k] * shade
