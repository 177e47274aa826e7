"""Few samples along a ray, for the CPU; see `reference/picking.py`.

First every ray by itself runs over the voxels, then sixteen neighbouring rays at a time look for
the nearest triangles of what they chose.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit

from ..reference.bricks import BRICK
from ..reference.picking import FALL, GOLDEN, LEAST, RISE
from ..structures import Clearance, Picks, PosedMesh, Thrift, Voxels
from .lanes import LANES, load, splat_int
from .marching import clear_cells, flat, locate, rows_of, walk
from .search import LEAN, OPTIONS, STACK
from .threads import run_chunks

_CHUNK = 128  # rays a thread takes at a time: a multiple of LANES
_GOLDEN = np.float32(GOLDEN)


def pick(
    mesh: PosedMesh,
    voxels: Voxels,
    guide: torch.Tensor,
    origins: torch.Tensor,
    directions: torch.Tensor,
    first: torch.Tensor,
    last: torch.Tensor,
    jitter: torch.Tensor,
    chance: torch.Tensor,
    left: torch.Tensor,
    step: float,
    *,
    clearance: Clearance,
    band: float,
    thrift: Thrift,
) -> Picks:
    """As the reference; up to the rounding of the places."""
    count, width = len(origins), thrift.width
    whole = torch.int32
    result = Picks(
        torch.zeros(count, dtype=whole),
        torch.zeros(count, dtype=whole),
        torch.zeros(count, dtype=whole),
        torch.zeros((count, width), dtype=whole),
        torch.zeros((count, width), dtype=whole),
        torch.zeros((count, width), dtype=whole),
        torch.zeros((count, width, 3)),
        torch.zeros((count, width, 3)),
        torch.zeros((count, width)),
    )
    run_chunks(
        _pick,
        count,
        _CHUNK,
        *walk(mesh, origins, directions, first, last, jitter, step, clearance, band),
        rows_of(voxels.bricks.view(-1), np.int32),
        len(voxels.bricks),
        rows_of(voxels.cells.view(-1), np.int32),
        flat(voxels.box_min),
        np.float32(voxels.scale),
        flat(guide),
        rows_of(chance, np.float32),
        rows_of(left, np.float32),
        np.float32(thrift.share),
        thrift.longest,
        np.float32(thrift.opaque),
        *(values.numpy() for values in result),
    )
    return result


@njit(**LEAN)
def _until(x, inverse, cell, clear):
    """How far along the ray, one over its direction being `inverse`, x leaves the cells that are
    nearer than `clear` to this one."""
    if inverse > 0:
        return (np.float32(cell + clear) - x) * inverse
    return (np.float32(cell + 1 - clear) - x) * inverse


@njit(**LEAN)
def leave(x, y, z, u, v, w, over, clear):
    """How far along a ray, one over its direction being `over`, a place leaves the cells that are
    nearer than `clear` to its own, (u, v, w)."""
    near = min(_until(x, over[0], u, clear), _until(y, over[1], v, clear))
    return min(near, _until(z, over[2], w, clear))


@njit(**LEAN)
def _inverse(d):
    """One over a direction; infinite, and above zero, where it does not move."""
    return np.float32(1) / d if d != 0 else np.float32(np.inf)


@njit(**LEAN)
def in_bricks(ray, origins, directions, corner, scale):
    """A ray in bricks: where it begins, its direction, and one over that."""
    dx, dy, dz = directions[ray, 0] * scale, directions[ray, 1] * scale, directions[ray, 2] * scale
    begin = (
        (origins[ray, 0] - corner[0]) * scale,
        (origins[ray, 1] - corner[1]) * scale,
        (origins[ray, 2] - corner[2]) * scale,
    )
    return begin, (dx, dy, dz), (_inverse(dx), _inverse(dy), _inverse(dz))


@njit(**LEAN)
def _visit(x, y, z, over, bricks, brick_count):
    """The flat voxel of a place (x, y, z), in bricks, or -1 where there is none; and how far along
    a direction, one over which is `over`, there will be none either."""
    nothing = np.float32(0)
    if not (min(x, y, z) >= 0 and max(x, y, z) < np.float32(brick_count)):
        return np.int64(-1), nothing
    u, v, w = int(x), int(y), int(z)
    row = bricks[(u * brick_count + v) * brick_count + w]
    if row < 0:  # up to where the ray leaves the bricks that are clear as well
        return np.int64(-1), leave(x, y, z, u, v, w, over, -row)
    u = int((x - np.float32(u)) * BRICK)
    v = int((y - np.float32(v)) * BRICK)
    w = int((z - np.float32(w)) * BRICK)
    return np.int64(((row * BRICK + u) * BRICK + v) * BRICK + w), nothing


@njit(**LEAN)
def _choose(ray, first, last, origins, directions, jitter, step, bricks, brick_count, cells, corner,
            scale, guide, chance, left, share, longest, opaque, width, k_out,
            steps_out):  # fmt: skip
    """The places of one ray that are samples: how many, how many looks, where to go on."""
    (ox, oy, oz), (dx, dy, dz), over = in_bricks(ray, origins, directions, corner, scale)
    count, looks, length, begin = 0, 0, 0, 0
    added, passed = np.float32(0.0), np.float32(0.0)
    k = first
    while k <= last:
        t = (np.float32(k) + jitter) * step
        k += 1
        voxel, clear = _visit(ox + t * dx, oy + t * dy, oz + t * dz, over, bricks, brick_count)
        cell = cells[voxel] if voxel >= 0 else -1
        if cell < 0:
            k += max(np.int64(min(clear / step, np.float32(last - k))), 0)
            continue
        optical = guide[cell] * step
        more = left * (np.float32(1.0) - np.exp(-optical))
        if length > 0 and length < longest and begin + length == k - 1 and added + more <= share:
            length += 1
            added += more
        else:
            if length > 0:
                count, chance = _close(k_out, steps_out, count, begin, length, chance)
                length = 0
            if count == width:
                return count, looks, k - 1
            begin, length, added = k - 1, 1, more
        looks += 1
        if opaque < np.inf:
            left -= more
            passed += optical
            if passed > opaque:
                break
    if length > 0:
        count, chance = _close(k_out, steps_out, count, begin, length, chance)
    return count, looks, k


@njit(**LEAN)
def _close(k_out, steps_out, count, begin, length, chance):
    """One of the places taken together becomes a sample."""
    k_out[count] = begin + min(int(chance * np.float32(length)), length - 1)
    steps_out[count] = length
    chance += _GOLDEN
    if chance >= 1:
        chance -= np.float32(1.0)
    return count + 1, chance


@njit(**OPTIONS)
def _pick(start, stop, arrays, triangle_maps, vertex_maps, vertices, corners,
          origins, directions, first, last, jitter, step, grid, size, corner, scale, band,
          bricks, brick_count, cells, brick_corner, brick_scale, guide, chance, left,
          share, longest, opaque, out_count, out_looks, out_next, out_k, out_steps,
          out_triangle, out_barycentric, out_canonical, out_distance):  # fmt: skip
    width = out_k.shape[1]
    for ray in range(start, stop):
        count, looks, following = _choose(
            ray, first[ray], last[ray], origins, directions, jitter[ray], step, bricks,
            brick_count, cells, brick_corner, brick_scale, guide, chance[ray], left[ray], share,
            longest, opaque, width, out_k[ray], out_steps[ray])  # fmt: skip
        out_count[ray] = count
        out_looks[ray] = looks
        out_next[ray] = following
        if following > last[ray]:
            out_next[ray] = max(first[ray], last[ray] + 1)
    stack = np.empty(STACK, np.int32)
    scratch = np.empty(LANES, np.float32)
    points = np.empty(3 * LANES, np.float32)
    feet = np.empty(3 * LANES, np.float32)
    canonical = np.empty(3 * LANES, np.float32)
    distances = np.empty(LANES, np.float32)
    barycentric = np.empty(3 * LANES, np.float32)
    triangle = np.empty(LANES, np.int32)
    active = np.zeros(LANES, np.int32)
    kept = np.zeros(LANES, np.int32)
    for base in range(start, stop, LANES):
        rays = min(LANES, stop - base)
        most = 0
        for i in range(LANES):
            kept[i] = 0
            for axis in range(3):
                feet[axis * LANES + i] = np.inf
            if i < rays:
                most = max(most, out_count[base + i])
        for slot in range(most):
            for i in range(LANES):
                active[i] = 1 if i < rays and slot < out_count[base + i] else 0
                if active[i] == 0:
                    continue
                t = (np.float32(out_k[base + i, slot]) + jitter[base + i]) * step
                for axis in range(3):
                    along = t * directions[base + i, axis]
                    points[axis * LANES + i] = origins[base + i, axis] + along
            going = splat_int(0) < load(active, 0)
            px, py, pz = load(points, 0), load(points, LANES), load(points, 2 * LANES)
            locate(arrays, triangle_maps, vertex_maps, vertices, corners, px, py, pz, going, band,
                   stack, scratch, feet, triangle, barycentric, canonical,
                   distances)  # fmt: skip
            for i in range(LANES):
                if active[i] == 0 or triangle[i] < 0 or not distances[i] <= band:
                    continue
                u, v, w = canonical[i], canonical[LANES + i], canonical[2 * LANES + i]
                if clear_cells(grid, size, corner, scale, u, v, w) > 0:
                    continue
                ray, to = base + i, kept[i]
                out_k[ray, to] = out_k[ray, slot]
                out_steps[ray, to] = out_steps[ray, slot]
                out_triangle[ray, to] = triangle[i]
                out_distance[ray, to] = distances[i]
                for axis in range(3):
                    out_barycentric[ray, to, axis] = barycentric[axis * LANES + i]
                    out_canonical[ray, to, axis] = canonical[axis * LANES + i]
                kept[i] = to + 1
        for i in range(rays):
            out_count[base + i] = kept[i]


def follow(guide: torch.Tensor, cells: torch.Tensor, density: torch.Tensor) -> None:
    """As the reference."""
    _follow(guide.view(-1).numpy(), rows_of(cells, np.int64), rows_of(density, np.float32))


@njit(**OPTIONS)
def _follow(guide, cells, density):
    for i in range(len(cells)):
        known = guide[cells[i]]
        found = max(density[i], np.float32(LEAST))
        rate = np.float32(RISE if found > known else FALL)
        guide[cells[i]] = known * (found / known) ** rate
