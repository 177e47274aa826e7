"""Whole rays of a picture in one compiled pass, for a field that is held still.

A few hundred neighbouring rays advance together, a wave at a time. Each chooses runs of places that
may hold something, by the voxels of the pose, and looks at the middle of each; where that shows,
the places beside it are looked at too, so that what is empty is passed coarsely and a surface is
met finely. `rendering.render` does the same step by step, without runs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit

from ..reference.bricks import FOOT, MAP, SLACK
from ..structures import Clearance, Known, PosedMesh, Probing, Traced, Voxels
from .fields import (
    arrays_of,
    densities,
    features_for,
    inputs_for,
    shade,
    shading_room,
    short_tables,
)
from .following import enter, known_density, runs_of, space_of
from .frozen import DISTANCE, PLACES, RESTING, ROOM, WEIGHTS
from .lanes import LANES, fma, load, maximum, minimum, splat, splat_int, store
from .marching import clear_cells, flat, locate, rows_of, walk
from .search import LEAN, OPTIONS, STACK
from .views import views_of

__all__ = ["arrays_of", "enter", "known_density", "short_tables", "trace"]

GROUP = 256  # rays that advance together
_NONE, _WANTED = -1, -2


def trace(
    mesh: PosedMesh,
    voxels: Voxels,
    known: Known,
    field: tuple[Any, ...],
    origins: torch.Tensor,
    directions: torch.Tensor,
    first: torch.Tensor,
    last: torch.Tensor,
    step: float,
    *,
    clearance: Clearance,
    band: float,
    still: torch.Tensor,
    rotation: torch.Tensor,
    view: torch.Tensor,
    probing: Probing,
) -> Traced:
    """Rays [R] to their ends, on this thread alone.

    known: what a guide knows of the voxels; field: what `arrays_of` makes of a `Frozen`; first,
    last [R] int32: the lattice indices to look at, places lying half a step further; band: metres
    from the mesh beyond which nothing is; still [3, 4]: posed points to where the shoulders do not
    move; rotation [3, 3], view [16, hidden]: the head's, and what harmonics of a direction in its
    axes add to the first layer of the colour.
    """
    count = len(origins)
    traced = Traced(torch.zeros(count, 4), torch.zeros(count), torch.ones(count), 0)
    half = torch.full((count,), 0.5)
    walked = walk(mesh, origins, directions, first, last, half, step, clearance, band)
    space = space_of(voxels, known)
    unit = flat(clearance.box_min), np.float32(clearance.box_scale)
    evaluations = _trace(
        count,
        walked,
        space,
        (*unit, rows_of(still, np.float32)),
        views_of(directions, rotation, view),
        field,
        (
            probing.width,
            np.float32(probing.share),
            max(probing.longest, probing.probe),
            probing.probe,
        ),
        tuple(
            np.float32(x) for x in (probing.tolerance, probing.transmittance, probing.negligible)
        ),
        tuple(values.numpy() for values in traced[:3]),
    )
    return traced._replace(evaluations=evaluations)


@njit(**LEAN)
def _brick_at(x, y, z, voxels):
    """The row of the brick that a posed place is in, below 0 where there is none."""
    bricks, brick_count, _, corner, scale = voxels
    far = brick_count - 1  # by rounding, a place on the last brick's face may lie beyond it
    u = min(np.int64((x - corner[0]) * scale), far)
    v = min(np.int64((y - corner[1]) * scale), far)
    w = min(np.int64((z - corner[2]) * scale), far)
    return bricks[(u * brick_count + v) * brick_count + w]


@njit(**LEAN)
def _filled_near(x, y, z, row, maps, grid):
    """Whether there may be anything at a posed place, by the map of the brick that it is in: a look
    at a table, which spares most of the searches that would find nothing."""
    cells, size, grid_corner, grid_scale = grid
    if row < 0:
        return True
    at = row * MAP
    slack = maps[at + SLACK] * grid_scale  # in cells
    if not slack < 1:
        return True
    cx = maps[at] * x + maps[at + 1] * y + maps[at + 2] * z + maps[at + 3]
    cy = maps[at + 4] * x + maps[at + 5] * y + maps[at + 6] * z + maps[at + 7]
    cz = maps[at + 8] * x + maps[at + 9] * y + maps[at + 10] * z + maps[at + 11]
    cx = (cx - grid_corner[0]) * grid_scale
    cy = (cy - grid_corner[1]) * grid_scale
    cz = (cz - grid_corner[2]) * grid_scale
    last = np.float32(size) - np.float32(0.5)
    if not (min(cx, cy, cz) > -1 and max(cx, cy, cz) < size + 1):
        return False
    nothing = np.float32(0)
    i = np.int64(min(max(cx, nothing), last))
    j = np.int64(min(max(cy, nothing), last))
    k = np.int64(min(max(cz, nothing), last))
    clear = cells[(i * size + j) * size + k]
    if clear != 1:
        return clear == 0
    i0, i1 = np.int64(max(cx - slack, nothing)), np.int64(min(cx + slack, last))
    j0, j1 = np.int64(max(cy - slack, nothing)), np.int64(min(cy + slack, last))
    k0, k1 = np.int64(max(cz - slack, nothing)), np.int64(min(cz + slack, last))
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                if cells[(i * size + j) * size + k] == 0:
                    return True
    return False


@njit(**LEAN)
def _point_at(start, stop, base, asked, rays, voxels, grid, feet, points, wanted):
    """Places [6, N] of those of requests start..stop where there may be anything, with a point of
    the mesh near each, and which requests these are; returns how many. feet [G, 3]: each ray's last
    nearest point."""
    maps = voxels[2]
    origins, directions, step = rays
    want_row, want_k, sample_of = asked[0], asked[1], asked[2]
    count = 0
    for request in range(start, stop):
        sample_of[request] = -1
        ray = base + want_row[request]
        t = (np.float32(want_k[request]) + np.float32(0.5)) * step
        x = origins[ray, 0] + t * directions[ray, 0]
        y = origins[ray, 1] + t * directions[ray, 1]
        z = origins[ray, 2] + t * directions[ray, 2]
        brick = _brick_at(x, y, z, voxels)
        if not _filled_near(x, y, z, brick, maps, grid):
            continue
        points[0, count], points[1, count], points[2, count] = x, y, z
        row = want_row[request]
        u, v, w = feet[row, 0], feet[row, 1], feet[row, 2]
        if brick >= 0:
            at = brick * MAP + FOOT
            a, b, c = maps[at], maps[at + 1], maps[at + 2]
            there = (a - x) ** 2 + (b - y) ** 2 + (c - z) ** 2
            if not (u - x) ** 2 + (v - y) ** 2 + (w - z) ** 2 < there:
                u, v, w = a, b, c
        points[3, count], points[4, count], points[5, count] = u, v, w
        wanted[count] = request
        count += 1
    for i in range(count, -(-count // LANES) * LANES):  # a whole packet
        for axis in range(6):
            points[axis, i] = points[axis, count - 1]
    return count


@njit(**LEAN)
def _find(requests, wanted, points, asked, count, surface, grid, frames, feet, samples, room):
    """Where the points of `requests` requests lie: each gets a sample, from `count` on, or none
    where nothing can be; returns how many samples there are then."""
    arrays, triangle_maps, vertex_maps, vertices, mesh_corners, band = surface
    cells, size, grid_corner, grid_scale = grid
    unit_corner, unit_scale, still = frames
    want_row, sample_of = asked[0], asked[2]
    stack, scratch, near, weights, canonical, rest, distances, found = room
    triangle, places = samples
    zero, one = splat(0.0), splat(1.0)
    for begin in range(0, requests, LANES):
        lanes = min(LANES, requests - begin)
        for axis in range(3):
            store(near, axis * LANES, load(points[3 + axis], begin))
        px, py, pz = load(points[0], begin), load(points[1], begin), load(points[2], begin)
        locate(arrays, triangle_maps, vertex_maps, vertices, mesh_corners, px, py, pz,
               splat_int(0) < splat_int(1), band, stack, scratch, near, found, weights, canonical,
               distances)  # fmt: skip
        for axis in range(3):
            place = (load(canonical, axis * LANES) - splat(unit_corner[axis])) * splat(unit_scale)
            store(rest, axis * LANES, minimum(maximum(place, zero), one))
            place = fma(px, splat(still[axis, 0]), splat(still[axis, 3]))
            place = fma(pz, splat(still[axis, 2]), fma(py, splat(still[axis, 1]), place))
            place = (place - splat(unit_corner[axis])) * splat(unit_scale)
            store(rest, (3 + axis) * LANES, minimum(maximum(place, zero), one))
        for i in range(lanes):
            row = want_row[wanted[begin + i]]
            for axis in range(3):
                feet[row, axis] = near[axis * LANES + i]
            if found[i] < 0 or not distances[i] <= band:
                continue
            x, y, z = canonical[i], canonical[LANES + i], canonical[2 * LANES + i]
            if clear_cells(cells, size, grid_corner, grid_scale, x, y, z) > 0:
                continue
            sample_of[wanted[begin + i]] = count
            triangle[count] = found[i]
            places[DISTANCE, count] = distances[i]
            for axis in range(3):
                places[axis, count] = rest[axis * LANES + i]
                places[RESTING + axis, count] = rest[(3 + axis) * LANES + i]
                places[WEIGHTS + axis, count] = weights[axis * LANES + i]
            count += 1
    return count


@njit(**LEAN)
def _ask_middles(living, alive, chosen, runs, asked):
    """The middles of all runs, sixteen rays side by side; returns how many."""
    begins, lengths, middle, before, after = runs[0], runs[1], runs[2], runs[3], runs[4]
    want_row, want_k = asked[0], asked[1]
    count = 0
    for begin in range(0, living, LANES):
        for slot in range(begins.shape[1]):
            for a in range(begin, min(begin + LANES, living)):
                if slot < chosen[a]:
                    want_row[count] = alive[a]
                    want_k[count] = begins[a, slot] + lengths[a, slot] // 2
                    middle[a, slot] = count
                    before[a, slot] = after[a, slot] = _NONE
                    count += 1
    return count


@njit(**LEAN)
def _mark(
    living, alive, base, chosen, runs, sample_of, sigma, step, lefts, tolerance, transmittance
):
    """Which runs to take apart: before its middle, where a run shows, and after it what lies behind
    the middle of the run that comes before; after its own where light still passes."""
    begins, lengths, middle, before, after = runs[0], runs[1], runs[2], runs[3], runs[4]
    for a in range(living):
        left = lefts[base + alive[a]]
        for slot in range(chosen[a]):
            s = sample_of[middle[a, slot]]
            if s < 0:
                continue
            optical = sigma[s] * step
            passes = np.exp(-optical * np.float32(lengths[a, slot]))
            if left * (np.float32(1) - passes) > tolerance:
                before[a, slot] = _WANTED
                if slot > 0 and begins[a, slot - 1] + lengths[a, slot - 1] == begins[a, slot]:
                    after[a, slot - 1] = _WANTED
                if left * np.exp(-optical) > tolerance:
                    after[a, slot] = _WANTED
            left *= passes
            if left < transmittance:
                break


@njit(**LEAN)
def _ask_rest(living, alive, chosen, runs, asked, count):
    """The places beside the middles of marked runs; returns how many requests there are then."""
    begins, lengths, before, after = runs[0], runs[1], runs[3], runs[4]
    want_row, want_k = asked[0], asked[1]
    for begin in range(0, living, LANES):
        for slot in range(begins.shape[1]):
            for side in range(2):
                for a in range(begin, min(begin + LANES, living)):
                    part = before if side == 0 else after
                    if slot >= chosen[a] or part[a, slot] != _WANTED:
                        continue
                    part[a, slot] = count
                    half = lengths[a, slot] // 2
                    low = 0 if side == 0 else half + 1
                    high = half if side == 0 else lengths[a, slot]
                    for place in range(low, high):
                        want_row[count] = alive[a]
                        want_k[count] = begins[a, slot] + place
                        count += 1
    return count


@njit(**LEAN)
def _add_up(a, ray, chosen, runs, asked, sigma, parts, appearances, step, left, depth, negligible,
            row, showing, shown, shown_row, shown_weight):  # fmt: skip
    """One ray through its samples: what is left of it, its depth, and how many samples show, each
    once an appearance."""
    lengths, middle, before, after = runs[1], runs[2], runs[3], runs[4]
    want_k, sample_of = asked[1], asked[2]
    for slot in range(chosen[a]):
        half = lengths[a, slot] // 2
        lower, upper = before[a, slot], after[a, slot]
        for place in range(lengths[a, slot]):
            wide = 1
            if place < half:
                if lower < 0:
                    continue
                request = lower + place
            elif place > half:
                if upper < 0:
                    continue
                request = upper + place - half - 1
            else:  # the middle stands for what was not looked at
                request = middle[a, slot]
                wide += half if lower < 0 else 0
                wide += lengths[a, slot] - half - 1 if upper < 0 else 0
            s = sample_of[request]
            if s < 0:
                continue
            length = step * np.float32(wide)
            seen = left * (np.float32(1) - np.exp(-sigma[s] * length))
            depth += seen * (np.float32(want_k[request]) + np.float32(0.5)) * step
            left -= seen
            if seen > negligible * length:
                for k in range(appearances):
                    place_of = k * len(sigma) + s
                    part = parts[place_of] if appearances > 1 else np.float32(1)
                    if part > 0:
                        shown[showing], shown_row[showing] = place_of, row
                        shown_weight[showing] = seen * part
                        showing += 1
    return left, depth, showing


@njit(**OPTIONS)
def _trace(total, walked, space, frames, views, field, lengths_of, limits, outputs):
    (arrays, triangle_maps, vertex_maps, vertices, mesh_corners, origins, directions, first, last,
     _, step, cells, size, grid_corner, grid_scale, band) = walked  # fmt: skip
    surface = arrays, triangle_maps, vertex_maps, vertices, mesh_corners, band
    rays = origins, directions, step
    grid = cells, size, grid_corner, grid_scale
    voxels = space[0], space[1], space[6], space[4], space[5]
    width, longest = lengths_of[0], lengths_of[2]
    tolerance, transmittance, negligible = limits
    out_colour, out_depth, out_left = outputs
    most = GROUP * width * longest  # requests of a wave, every run taken apart
    room = most + ROOM
    alive = np.empty(GROUP, np.int32)
    feet = np.empty((GROUP, 3), np.float32)
    following = np.zeros(GROUP, np.int32)
    chosen = np.zeros(GROUP, np.int32)  # how many runs a ray has
    # of each: the lattice index it begins at, its length, the request of its middle, the first
    # request of what lies before that, or _NONE, and after
    runs = np.zeros((5, GROUP, width), np.int32)
    # requests: ray, lattice index, sample or -1
    asked = np.zeros((3, most), np.int32)
    # triangles; canonical places in the unit box, those that rest with the shoulders, barycentrics,
    # distances (`frozen`)
    samples = np.zeros(room, np.int32), np.zeros((PLACES, room), np.float32)
    points, wanted = np.zeros((6, most + LANES), np.float32), np.zeros(most, np.int32)
    packet = (
        np.empty(STACK, np.int32),
        np.empty(LANES, np.float32),
        np.full(3 * LANES, np.inf, np.float32),
        np.empty(3 * LANES, np.float32),
        np.empty(3 * LANES, np.float32),
        np.empty(6 * LANES, np.float32),
        np.empty(LANES, np.float32),
        np.empty(LANES, np.int32),
    )
    features = features_for(field, most)
    appearances = field[5][0]
    inputs = inputs_for(field, appearances * room)
    sigma, parts = np.zeros(room, np.float32), np.zeros(appearances * room, np.float32)
    shown = np.zeros(appearances * room, np.int32)
    shown_row = np.zeros(appearances * room, np.int32)
    shown_weight = np.zeros(appearances * room, np.float32)
    shading = shading_room(field)
    evaluations = 0
    for base in range(0, total, GROUP):
        living = 0
        for i in range(min(GROUP, total - base)):
            feet[i] = np.inf
            if first[base + i] <= last[base + i]:
                alive[living] = i
                living += 1
        while living > 0:
            for a in range(living):
                ray = base + alive[a]
                chosen[a], following[a] = runs_of(
                    ray, first[ray], last[ray], rays, space, out_left[ray], lengths_of, runs[0, a],
                    runs[1, a])  # fmt: skip
            count, known, requests = 0, 0, 0
            for part in range(2):  # the middles of runs, then what lies beside them
                if part == 0:
                    requests = _ask_middles(living, alive, chosen, runs, asked)
                elif tolerance < 1:
                    _mark(living, alive, base, chosen, runs, asked[2], sigma, step, out_left,
                          tolerance, transmittance)  # fmt: skip
                    known = requests
                    requests = _ask_rest(living, alive, chosen, runs, asked, known)
                else:
                    break
                begin = count
                found = _point_at(known, requests, base, asked, rays, voxels, grid, feet, points,
                                  wanted)  # fmt: skip
                count = _find(found, wanted, points, asked, begin, surface, grid, frames, feet,
                              samples, packet)  # fmt: skip
                densities(begin, count, field, mesh_corners, samples, features, inputs, sigma,
                          parts)  # fmt: skip
            evaluations += count
            showing, going_on = 0, 0
            for a in range(living):
                row = alive[a]
                ray = base + row
                out_left[ray], out_depth[ray], showing = _add_up(
                    a, ray, chosen, runs, asked, sigma, parts, appearances, step, out_left[ray],
                    out_depth[ray], negligible, row, showing, shown, shown_row,
                    shown_weight)  # fmt: skip
                first[ray] = following[a]
                if following[a] <= last[ray] and out_left[ray] > transmittance:
                    alive[going_on] = row
                    going_on += 1
            living = going_on
            shade(showing, base, views, field, inputs, shown, shown_row, shown_weight,
                  shading, out_colour)  # fmt: skip
    return evaluations
