"""Maps from a posed mesh to its canonical one, compiled; see `reference/frames.py`."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit

from ..reference.frames import FLATNESS, triangle_maps
from .search import LEAN, OPTIONS
from .threads import run_chunks

__all__ = ["triangle_maps", "vertex_maps"]

_ROW = 10  # numbers of a triangle: the linear part times its weight, the weight


def vertex_maps(
    canonical_vertices: torch.Tensor, vertices: torch.Tensor, triangles: torch.Tensor
) -> torch.Tensor:
    """As the reference, for one mesh [V,3] in float32."""
    corners = np.ascontiguousarray(triangles.numpy(), np.int32)
    canonical = np.ascontiguousarray(canonical_vertices.numpy(), np.float32)
    posed = np.ascontiguousarray(vertices.numpy(), np.float32)
    linear = np.empty((len(corners), _ROW))
    run_chunks(_linear_parts, len(corners), 2048, canonical, posed, corners, linear)
    sums = np.zeros((len(posed), _ROW))
    _add_up(corners, linear, sums)
    maps = torch.empty(len(posed), 3, 4)
    run_chunks(_means, len(posed), 4096, sums, canonical, maps.numpy())
    return maps


@njit(**LEAN)
def _frame(vertices, a, b, c):
    """Edges ab and ac, the cross product, and its length, 0 where the triangle is degenerate."""
    ax, ay, az = np.float64(vertices[a, 0]), np.float64(vertices[a, 1]), np.float64(vertices[a, 2])
    ux, uy, uz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
    vx, vy, vz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    area = np.sqrt(nx * nx + ny * ny + nz * nz)
    third = (ux - vx) ** 2 + (uy - vy) ** 2 + (uz - vz) ** 2
    longest = max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, third)
    usable = area > FLATNESS * longest and area < np.inf
    return ux, uy, uz, vx, vy, vz, nx, ny, nz, area if usable else 0.0


@njit(**OPTIONS)
def _linear_parts(start, stop, canonical, posed, corners, out):
    """Of each triangle what takes posed edges and normal to canonical ones, times the posed
    area."""
    for triangle in range(start, stop):
        a, b, c = corners[triangle, 0], corners[triangle, 1], corners[triangle, 2]
        ux, uy, uz, vx, vy, vz, nx, ny, nz, area = _frame(posed, a, b, c)
        kx, ky, kz, lx, ly, lz, mx, my, mz, there = _frame(canonical, a, b, c)
        if not (area > 0 and there > 0):
            out[triangle] = 0.0
            continue
        out[triangle, 9] = area
        # of [u v n] with n of unit length the inverse's rows are v x n, n x u, both over |u x v|, n
        nx, ny, nz = nx / area, ny / area, nz / area
        mx, my, mz = mx / there, my / there, mz / there
        px, py, pz = vy * nz - vz * ny, vz * nx - vx * nz, vx * ny - vy * nx
        qx, qy, qz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
        for i in range(3):
            k, l_, m = (kx, ky, kz)[i], (lx, ly, lz)[i], (mx, my, mz)[i] * area
            out[triangle, 3 * i] = k * px + l_ * qx + m * nx
            out[triangle, 3 * i + 1] = k * py + l_ * qy + m * ny
            out[triangle, 3 * i + 2] = k * pz + l_ * qz + m * nz


@njit(**OPTIONS)
def _add_up(corners, linear, sums):
    for triangle in range(len(corners)):
        for j in range(3):
            vertex = corners[triangle, j]
            for i in range(_ROW):
                sums[vertex, i] += linear[triangle, i]


@njit(**OPTIONS)
def _means(start, stop, sums, canonical, out):
    for vertex in range(start, stop):
        total = sums[vertex, 9]
        for i in range(3):
            for j in range(3):
                known = sums[vertex, 3 * i + j] / total if total > 0 else np.float64(i == j)
                out[vertex, i, j] = known
            out[vertex, i, 3] = canonical[vertex, i]
