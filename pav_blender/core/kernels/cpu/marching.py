"""Sampling rays against a posed mesh sixteen at a time, leaping over what is empty.

Samples of ray r lie at `t_k = (k + jitter[r]) * step`, k an integer; directions are unit vectors.
Sixteen consecutive rays walk side by side, each at its own k, so rays should come in an order in
which neighbours are neighbours in the picture (tiles of 4x4 pixels).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit

from ..reference.marching import bounds, lattice
from ..structures import Clearance, PosedMesh, Wave
from .compositing import composite, weigh
from .lanes import (
    LANES,
    bits,
    fma,
    lane,
    load,
    lowest_bit,
    select,
    splat,
    splat_int,
    square_root,
    store,
    to_float,
)
from .nearest import settle
from .search import LEAN, OPTIONS, STACK, foot, search
from .threads import run_chunks

__all__ = ["bounds", "canonicalise", "composite", "lattice", "march", "weigh"]

_CHUNK = 256  # rays a thread takes at a time: a multiple of LANES
# Of a clear distance in canonical space, what a step in posed space may use: the maps stretch.
_TRUST = 0.7
_MAP = 12  # numbers of a map


@njit(**LEAN)
def _canonical(triangle_maps, vertex_maps, vertices, corners, triangle, wa, wb, wc, x, y, z, row):
    """Canonical place of a posed point; triangle must not be negative. `kernels/structures.py`.

    row [16] is scratch: a point's map is gathered as a whole, which is a third of the instructions
    of gathering its twelve numbers for sixteen points.
    """
    if len(vertex_maps) == 0:
        store(row, 0, load(triangle_maps, triangle * _MAP))
    else:
        a, b, c = corners[3 * triangle], corners[3 * triangle + 1], corners[3 * triangle + 2]
        blend = splat(wa) * load(vertex_maps, a * _MAP)
        blend = fma(splat(wb), load(vertex_maps, b * _MAP), blend)
        store(row, 0, fma(splat(wc), load(vertex_maps, c * _MAP), blend))
        x -= wa * vertices[3 * a] + wb * vertices[3 * b] + wc * vertices[3 * c]
        y -= wa * vertices[3 * a + 1] + wb * vertices[3 * b + 1] + wc * vertices[3 * c + 1]
        z -= wa * vertices[3 * a + 2] + wb * vertices[3 * b + 2] + wc * vertices[3 * c + 2]
    return (
        row[0] * x + row[1] * y + row[2] * z + row[3],
        row[4] * x + row[5] * y + row[6] * z + row[7],
        row[8] * x + row[9] * y + row[10] * z + row[11],
    )


@njit(**LEAN)
def _cell(size, corner, scale, x, y, z):
    """Flat index of the cell that canonical (x, y, z), a place inside the box, lies in."""
    fx, fy, fz = (x - corner[0]) * scale, (y - corner[1]) * scale, (z - corner[2]) * scale
    return (int(fx) * size + int(fy)) * size + int(fz)


@njit(**LEAN)
def clear_cells(grid, size, corner, scale, x, y, z):
    """Cells to the nearest occupied one from canonical (x, y, z): 0 inside an occupied cell."""
    fx, fy, fz = (x - corner[0]) * scale, (y - corner[1]) * scale, (z - corner[2]) * scale
    outside = max(max(-fx, -fy, -fz), max(fx, fy, fz) - np.float32(size))
    within = min(fx, fy, fz) >= 0 and max(fx, fy, fz) < size
    if within:
        return int(grid[_cell(size, corner, scale, x, y, z)])
    if outside > 0:
        return 1 + int(min(outside, np.float32(254.0)))
    return 1  # on the far face, or not a number


@njit(**LEAN)
def locate(arrays, triangle_maps, vertex_maps, vertices, corners, px, py, pz, going, band,
           stack, scratch, feet, triangle, barycentric, canonical, distances):  # fmt: skip
    """Where the points of a packet lie: triangle [16], barycentric and canonical [3 * 16],
    distances [16]; feet [3 * 16], the nearest points found before, bound the search and are set to
    those found now. Only lanes that are `going` (one at least) count, canonical places only within
    the band."""
    some = lowest_bit(bits(going))  # stands in for those that are not
    px = select(going, px, splat(lane(px, some)))
    py = select(going, py, splat(lane(py, some)))
    pz = select(going, pz, splat(lane(pz, some)))
    gx, gy, gz = px - load(feet, 0), py - load(feet, LANES), pz - load(feet, 2 * LANES)
    # The last nearest point is a bound, d; rounding must leave it above the answer. Both are off by
    # some roundings of the coordinates, e = 7e-7 |p| in all: (d + e)^2 <= 1.001 d^2 + 1001 e^2.
    best = fma(gx, gx, fma(gy, gy, gz * gz)) * splat(1.001)
    best = fma(fma(px, px, fma(py, py, pz * pz)), splat(5e-10), best)
    best = select(going, best, splat(-1.0))
    boxes, starts, records = arrays[0], arrays[1], arrays[2]
    best, found = search(boxes, starts, records, px, py, pz, best, splat_int(-1), stack, scratch)
    slots = select(found < splat_int(0), splat_int(0), found)
    wa, wb, wc, qx, qy, qz = foot(records, slots, px, py, pz)
    store(feet, 0, qx)
    store(feet, LANES, qy)
    store(feet, 2 * LANES, qz)
    distance = square_root(select(going, best, splat(0.0)))
    store(distances, 0, distance)
    settle(arrays, found, wa, wb, wc, triangle, barycentric)
    near = bits(going & (distance <= splat(band)))
    store(canonical, 0, px)
    store(canonical, LANES, py)
    store(canonical, 2 * LANES, pz)
    while near != 0:
        i = lowest_bit(near)
        near &= near - 1
        if triangle[i] < 0:
            continue
        x, y, z = _canonical(triangle_maps, vertex_maps, vertices, corners, triangle[i],
                             barycentric[i], barycentric[LANES + i], barycentric[2 * LANES + i],
                             canonical[i], canonical[LANES + i], canonical[2 * LANES + i],
                             scratch)  # fmt: skip
        canonical[i], canonical[LANES + i], canonical[2 * LANES + i] = x, y, z


@njit(**OPTIONS)
def _march(
    start,
    stop,
    arrays,
    triangle_maps,
    vertex_maps,
    vertices,
    flat_corners,
    origins,
    directions,
    first,
    last,
    jitter,
    step,
    grid,
    size,
    corner,
    scale,
    band,
    leap_limit,
    wave,
    out_count,
    out_next,
    out_k,
    out_triangle,
    out_barycentric,
    out_canonical,
    out_distance,
):
    """Samples of rays start to stop into the slots of a wave; `march` says which."""
    stack = np.empty(STACK, np.int32)
    scratch = np.empty(LANES, np.float32)
    rays = np.empty(7 * LANES, np.float32)  # origin, direction, jitter
    feet = np.empty(3 * LANES, np.float32)
    canonical = np.empty(3 * LANES, np.float32)
    distances = np.empty(LANES, np.float32)
    barycentric = np.empty(3 * LANES, np.float32)
    triangle = np.empty(LANES, np.int32)
    ks = np.empty(LANES, np.int32)
    active = np.empty(LANES, np.int32)
    steps = splat(step)
    cell = np.float32(1.0) / scale
    for base in range(start, stop, LANES):
        alive = 0
        for i in range(LANES):
            ray = min(base + i, stop - 1)
            for axis in range(3):
                rays[axis * LANES + i] = origins[ray, axis]
                rays[(axis + 3) * LANES + i] = directions[ray, axis]
                feet[axis * LANES + i] = np.inf
            rays[6 * LANES + i] = jitter[ray]
            ks[i] = first[ray]
            active[i] = 1 if base + i < stop and first[ray] <= last[ray] else 0
            alive += active[i]
            if base + i < stop:
                out_count[ray] = 0
                out_next[ray] = max(first[ray], last[ray] + 1)
        while alive > 0:
            going = splat_int(0) < load(active, 0)
            t = (to_float(load(ks, 0)) + load(rays, 6 * LANES)) * steps
            px = fma(t, load(rays, 3 * LANES), load(rays, 0))
            py = fma(t, load(rays, 4 * LANES), load(rays, LANES))
            pz = fma(t, load(rays, 5 * LANES), load(rays, 2 * LANES))
            locate(arrays, triangle_maps, vertex_maps, vertices, flat_corners, px, py, pz, going,
                   band, stack, scratch, feet, triangle, barycentric, canonical,
                   distances)  # fmt: skip
            for i in range(LANES):
                if active[i] == 0:
                    continue
                ray = base + i
                k = ks[i]
                distance = distances[i]
                clear = np.float32(0.0)
                if triangle[i] < 0:
                    clear = np.float32(np.inf)
                elif distance > band:
                    clear = (distance - band) * np.float32(0.99999)
                else:
                    cells = 0
                    u, v, w = canonical[i], canonical[LANES + i], canonical[2 * LANES + i]
                    if size > 0:
                        cells = clear_cells(grid, size, corner, scale, u, v, w)
                    if cells == 0:
                        slot = out_count[ray]
                        out_k[ray, slot] = k
                        out_triangle[ray, slot] = triangle[i]
                        out_distance[ray, slot] = distance
                        for axis in range(3):
                            out_barycentric[ray, slot, axis] = barycentric[axis * LANES + i]
                            out_canonical[ray, slot, axis] = canonical[axis * LANES + i]
                        out_count[ray] = slot + 1
                        if slot + 1 == wave:
                            out_next[ray] = k + 1
                            active[i] = 0
                            alive -= 1
                            continue
                    else:
                        clear = min(np.float32(cells - 1) * cell * np.float32(_TRUST), leap_limit)
                leap = np.int32(min(clear / step, np.float32(last[ray] - k))) + 1
                ks[i] = k + leap
                if k + leap > last[ray]:
                    active[i] = 0
                    alive -= 1
    for ray in range(start, stop):
        for slot in range(out_count[ray], wave):
            out_k[ray, slot] = -1
            out_triangle[ray, slot] = -1
            out_distance[ray, slot] = 0.0
            for axis in range(3):
                out_barycentric[ray, slot, axis] = 0.0
                out_canonical[ray, slot, axis] = 0.0


_NOTHING = np.empty(0, np.float32)


def flat(values: torch.Tensor | None) -> np.ndarray:
    if values is None:
        return _NOTHING
    return np.ascontiguousarray(values.detach().numpy(), np.float32).reshape(-1)


def _maps(maps: torch.Tensor | None) -> np.ndarray:
    """Maps [N,3,4] one after the other; the last is read as a whole vector, so there is room."""
    if maps is None:
        return _NOTHING
    room = np.empty(maps.numel() + LANES - _MAP, np.float32)
    room[: maps.numel()] = maps.detach().numpy().reshape(-1)
    return room


def rows_of(values: torch.Tensor, kind: type) -> np.ndarray:
    return np.ascontiguousarray(values.detach().numpy(), kind)


def grid_of(clearance: Clearance | None) -> tuple[np.ndarray, int, np.ndarray, np.float32]:
    """Flat cells, cells a side (0: no grid), lowest corner, cells a metre."""
    if clearance is None:
        return np.empty(0, np.uint8), 0, np.zeros(3, np.float32), np.float32(1)
    size = clearance.grid.shape[0]
    grid = np.ascontiguousarray(clearance.grid.numpy(), np.uint8).reshape(-1)
    return grid, size, flat(clearance.box_min), np.float32(clearance.box_scale * size)


def surface_of(mesh: PosedMesh) -> tuple[Any, ...]:
    """What compiled functions are told of a mesh: its search tree, maps, vertices, corners."""
    return (
        mesh.search.arrays,
        _maps(mesh.triangle_maps),
        _maps(mesh.vertex_maps),
        flat(mesh.vertices),
        mesh.search.topology.corners.reshape(-1),
    )


def walk(
    mesh: PosedMesh,
    origins: torch.Tensor,
    directions: torch.Tensor,
    first: torch.Tensor,
    last: torch.Tensor,
    jitter: torch.Tensor,
    step: float,
    clearance: Clearance | None,
    band: float,
) -> tuple[Any, ...]:
    """What compiled functions are told of a mesh, rays and the clearance; as `march`."""
    return (
        *surface_of(mesh),
        rows_of(origins, np.float32),
        rows_of(directions, np.float32),
        rows_of(first, np.int32),
        rows_of(last, np.int32),
        rows_of(jitter, np.float32),
        np.float32(step),
        *grid_of(clearance),
        np.float32(band),
    )


def march(
    mesh: PosedMesh,
    origins: torch.Tensor,
    directions: torch.Tensor,
    first: torch.Tensor,
    last: torch.Tensor,
    jitter: torch.Tensor,
    step: float,
    *,
    wave: int,
    clearance: Clearance | None = None,
    band: float = np.inf,
    leap_limit: float = 0.004,
) -> Wave:
    """Up to `wave` samples a ray among lattice indices first..last [R] int32, in order.

    A sample counts when it is within `band` metres of the posed mesh and, with a clearance, when
    its canonical cell is occupied. Outside the band a ray leaps by what certainly stays outside; in
    empty cells by 0.7 of the clear distance, at most `leap_limit` metres, which can pass over an
    occupied cell only where the map to canonical space stretches more or jumps (between lips).
    """
    count = len(origins)
    result = Wave(
        torch.empty(count, dtype=torch.int32),
        torch.empty(count, dtype=torch.int32),
        torch.empty((count, wave), dtype=torch.int32),
        torch.empty((count, wave), dtype=torch.int32),
        torch.empty((count, wave, 3)),
        torch.empty((count, wave, 3)),
        torch.empty((count, wave)),
    )
    run_chunks(
        _march,
        count,
        _CHUNK,
        *walk(mesh, origins, directions, first, last, jitter, step, clearance, band),
        np.float32(leap_limit),
        wave,
        *(values.numpy() for values in result),
    )
    return result


@njit(**OPTIONS)
def _canonicalise(
    start, stop, points, triangles, barycentric, triangle_maps, vertex_maps, vertices, corners, out
):
    row = np.empty(LANES, np.float32)
    for i in range(start, stop):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if triangles[i] >= 0:
            wa, wb, wc = barycentric[i, 0], barycentric[i, 1], barycentric[i, 2]
            x, y, z = _canonical(triangle_maps, vertex_maps, vertices, corners, triangles[i],
                                 wa, wb, wc, x, y, z, row)  # fmt: skip
        out[i, 0], out[i, 1], out[i, 2] = x, y, z


def canonicalise(
    points: torch.Tensor,
    triangle: torch.Tensor,
    barycentric: torch.Tensor,
    mesh: PosedMesh,
) -> torch.Tensor:
    """Posed points [N,3] with nearest triangle [N] and barycentrics [N,3] -> canonical [N,3].

    Points without a triangle (-1) keep their place. Not differentiable.
    """
    out = torch.empty((len(points), 3))
    run_chunks(
        _canonicalise,
        len(points),
        8192,
        rows_of(points, np.float32),
        rows_of(triangle, np.int32),
        rows_of(barycentric, np.float32),
        _maps(mesh.triangle_maps),
        _maps(mesh.vertex_maps),
        flat(mesh.vertices),
        mesh.search.topology.corners.reshape(-1),
        out.numpy(),
    )
    return out
