"""Nearest point on a mesh, sixteen queries at a time (the search itself is in `search.py`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numba import njit

from .lanes import LANES, lane, load, select, splat, splat_int, square_root, store
from .search import (
    LEAN,
    OPTIONS,
    STACK,
    build_order,
    fit_levels,
    fit_triangles,
    foot,
    level_starts,
    measure,
    search,
)
from .threads import run_chunks

_CHUNK = 2048  # queries a thread takes at a time: a multiple of LANES


class Topology:
    """What all poses of a mesh share: triangles [T,3] int32 and the order of the search tree.

    `rest_vertices` [V,3] decide the order: any pose that looks like the others will do. A triangle
    with the vertices of an earlier one is left out, since it could never be chosen.
    """

    def __init__(self, triangles: torch.Tensor, rest_vertices: torch.Tensor) -> None:
        self.triangles = triangles
        self.vertex_count = len(rest_vertices)
        self.corners = np.ascontiguousarray(triangles.numpy(), np.int32).reshape(-1, 3)
        rest = np.nan_to_num(rest_vertices.numpy().astype(np.float64))
        _, first = np.unique(np.sort(self.corners, axis=1), axis=0, return_index=True)
        kept = np.sort(first)
        order = kept[build_order(rest[self.corners[kept]].mean(axis=1))] if len(kept) else kept
        self.starts = level_starts(len(order))
        slots = -(-max(len(order), 1) // LANES) * LANES
        self.order = np.full(slots, -1, np.int32)
        self.order[: len(order)] = order
        pairs = np.sort(self.corners[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
        _, edges = np.unique(pairs, axis=0, return_inverse=True)
        self.edges = np.ascontiguousarray(edges.reshape(-1, 3), np.int32)  # opposite each corner
        self.edge_count = int(edges.max()) + 1 if len(edges) else 0


@dataclass(frozen=True, eq=False)
class Posed:
    """The search structure of one pose. `arrays` is what the compiled functions take."""

    topology: Topology
    vertices: torch.Tensor  # [V,3] float32
    usable: torch.Tensor  # [T] bool: not degenerate in this pose
    arrays: tuple[np.ndarray, ...]


@njit(**OPTIONS)
def _own(corners, edges, usable, edge_owner, vertex_owner):
    """The lowest usable triangle at every edge and vertex."""
    edge_owner[:] = -1
    vertex_owner[:] = -1
    for triangle in range(len(corners) - 1, -1, -1):
        if usable[triangle]:
            for i in range(3):
                edge_owner[edges[triangle, i]] = triangle
                vertex_owner[corners[triangle, i]] = triangle


def refit(topology: Topology, vertices: torch.Tensor) -> Posed:
    """The search structure with the vertices [V,3] float32 at these places; nothing is shared."""
    places = np.ascontiguousarray(vertices.numpy(), np.float32)
    slots = len(topology.order)
    records = np.empty(slots * 20, np.float32)
    boxes = np.empty(topology.starts[-1], np.float32)
    usable = np.zeros(len(topology.corners), np.bool_)
    run_chunks(
        fit_triangles,
        slots,
        -(-slots // 64) * LANES,
        places,
        topology.corners,
        topology.order,
        records,
        boxes,
        usable,
    )
    fit_levels(boxes, topology.starts)
    edge_owner = np.empty(topology.edge_count, np.int32)
    vertex_owner = np.empty(topology.vertex_count, np.int32)
    _own(topology.corners, topology.edges, usable, edge_owner, vertex_owner)
    arrays = (
        boxes,
        topology.starts,
        records,
        topology.order,
        topology.corners,
        topology.edges,
        edge_owner,
        vertex_owner,
    )
    return Posed(topology, vertices, torch.from_numpy(usable), arrays)


@njit(**LEAN)
def settle(arrays, found, wa, wb, wc, triangle, barycentric):
    """Triangle [16] and barycentrics [3 * 16] of slots; ties on an edge or vertex settled.

    Where the nearest point lies on an edge or a vertex, rounding alone would choose among the
    triangles that meet there: the lowest index gets it.
    """
    _, _, _, order, corners, edges, edge_owner, vertex_owner = arrays
    store(triangle, 0, found)
    store(barycentric, 0, wa)
    store(barycentric, LANES, wb)
    store(barycentric, 2 * LANES, wc)
    for i in range(LANES):
        if triangle[i] < 0:
            for j in range(3):
                barycentric[j * LANES + i] = 0.0
            continue
        here = order[triangle[i]]
        owner = here
        zeros = 0
        for j in range(3):
            if barycentric[j * LANES + i] == 0.0:
                zeros += 1
                owner = edge_owner[edges[here, j]]
        if zeros == 2:
            for j in range(3):
                if barycentric[j * LANES + i] != 0.0:
                    owner = vertex_owner[corners[here, j]]
        triangle[i] = owner
        if owner != here:
            a, b, c = barycentric[i], barycentric[LANES + i], barycentric[2 * LANES + i]
            for j in range(3):
                vertex = corners[owner, j]
                weight = np.float32(0.0)
                if vertex == corners[here, 0]:
                    weight = a
                elif vertex == corners[here, 1]:
                    weight = b
                elif vertex == corners[here, 2]:
                    weight = c
                barycentric[j * LANES + i] = weight


@njit(**OPTIONS)
def _nearest(start, stop, points, arrays, out_triangle, out_barycentric, out_distance):
    boxes, starts, records = arrays[0], arrays[1], arrays[2]
    stack = np.empty(STACK, np.int32)
    scratch = np.empty(LANES, np.float32)
    place = np.empty(3 * LANES, np.float32)
    triangle = np.empty(LANES, np.int32)
    barycentric = np.empty(3 * LANES, np.float32)
    finite = np.empty(LANES, np.bool_)
    seed = -1
    for first in range(start, stop, LANES):
        count = min(LANES, stop - first)
        good = -1
        for i in range(count):
            x, y, z = points[first + i, 0], points[first + i, 1], points[first + i, 2]
            finite[i] = np.isfinite(x) and np.isfinite(y) and np.isfinite(z)
            if finite[i]:
                good = i
                place[i], place[LANES + i], place[2 * LANES + i] = x, y, z
        if good >= 0:
            for i in range(LANES):  # lanes without a point repeat one
                if i >= count or not finite[i]:
                    for axis in range(3):
                        place[axis * LANES + i] = place[axis * LANES + good]
            px, py, pz = load(place, 0), load(place, LANES), load(place, 2 * LANES)
            best, found = splat(np.inf), splat_int(-1)
            if seed >= 0:
                best, found = measure(records, seed, px, py, pz), splat_int(seed)
            best, found = search(boxes, starts, records, px, py, pz, best, found, stack, scratch)
            seed = lane(found, LANES - 1)
            slots = select(found < splat_int(0), splat_int(0), found)
            wa, wb, wc, _, _, _ = foot(records, slots, px, py, pz)
            settle(arrays, found, wa, wb, wc, triangle, barycentric)
            store(scratch, 0, square_root(best))
        for i in range(count):
            lost = not finite[i] or triangle[i] < 0
            out_triangle[first + i] = -1 if lost else triangle[i]
            out_distance[first + i] = np.inf if lost else scratch[i]
            for j in range(3):
                out_barycentric[first + i, j] = 0.0 if lost else barycentric[j * LANES + i]


def nearest(posed: Posed, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Triangle [N] int32, barycentrics [N,3] and distance [N] (metres) of the closest point.

    Fastest when neighbours in `points` are neighbours in space, exact anyway. Degenerate triangles
    are never chosen; where the closest point lies on an edge or a vertex, the lowest index of the
    triangles that share it is. The answer does not depend on the other points asked about.
    A point that is not finite, or a mesh of degenerate triangles only, gives -1, zeros, infinity.
    """
    places = np.ascontiguousarray(points.detach().numpy(), np.float32)
    count = len(places)
    triangle = torch.empty(count, dtype=torch.int32)
    barycentric = torch.empty((count, 3))
    distance = torch.empty(count)
    run_chunks(
        _nearest,
        count,
        _CHUNK,
        places,
        posed.arrays,
        triangle.numpy(),
        barycentric.numpy(),
        distance.numpy(),
    )
    return triangle, barycentric, distance
