"""Along rays through the voxels of a pose: where something may begin, and runs of places."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit

from ..reference.bricks import BRICK
from ..structures import Known, Voxels
from .marching import flat, rows_of
from .picking import in_bricks, leave
from .search import LEAN, OPTIONS
from .threads import run_chunks

_VOXELS = BRICK**3
_OCTANT = 0x330033  # the bits of a brick's first eight voxels, 2 x 2 x 2


def known_density(voxels: Voxels, guide: torch.Tensor) -> Known:
    """What a guide [G, G, G] knows of the density in each voxel."""
    count = len(voxels.cells)
    known = Known(torch.empty(voxels.cells.shape), torch.empty(count, dtype=torch.int64))
    run_chunks(
        _look_up,
        count,
        1 << 10,
        rows_of(voxels.cells.view(count, _VOXELS), np.int32),
        flat(guide),
        known.density.view(count, _VOXELS).numpy(),
        known.held.numpy(),
    )
    return known


@njit(**OPTIONS)
def _look_up(start, stop, cells, guide, density, held):
    for brick in range(start, stop):
        bits = np.int64(0)
        for i in range(_VOXELS):
            cell = cells[brick, i]
            density[brick, i] = guide[cell] if cell >= 0 else np.float32(-1)
            bits |= np.int64(cell >= 0) << i
        held[brick] = bits


@njit(**LEAN)
def _held_at(x, y, z, over, bricks, brick_count, held):
    """The flat voxel of a place (x, y, z), in bricks, that holds something, or -1 and how far along
    a direction, one over which is `over`, there will be nothing."""
    nothing, one = np.float32(0), np.int64(1)
    if not (min(x, y, z) >= 0 and max(x, y, z) < np.float32(brick_count)):
        return np.int64(-1), nothing
    u, v, w = np.int64(x), np.int64(y), np.int64(z)
    row = np.int64(bricks[(u * brick_count + v) * brick_count + w])
    if row < 0:  # up to where the ray leaves the bricks that are clear as well
        return np.int64(-1), leave(x, y, z, u, v, w, over, -row)
    i = np.int64((x - np.float32(u)) * BRICK)
    j = np.int64((y - np.float32(v)) * BRICK)
    k = np.int64((z - np.float32(w)) * BRICK)
    bit = (i * BRICK + j) * BRICK + k
    bits = held[row]
    if (bits >> bit) & 1:
        return row * _VOXELS + bit, nothing
    side = np.float32(BRICK)
    octant = ((i >> 1) * BRICK + (j >> 1)) * 2 * BRICK + (k >> 1) * 2
    if bits & (np.int64(_OCTANT) << octant) == 0:
        side = np.float32(BRICK // 2)
    x, y, z = x * side, y * side, z * side
    beyond = leave(x, y, z, np.int64(x), np.int64(y), np.int64(z), over, one)
    return np.int64(-1), beyond / side


def enter(
    voxels: Voxels,
    known: Known,
    origins: torch.Tensor,
    directions: torch.Tensor,
    near: torch.Tensor,
    far: torch.Tensor,
    step: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The lattice indices [R] int32 between which rays may meet anything, as `trace` takes them:
    the first is a place in a voxel that holds something, or past the last. near, far [R]: metres
    along each ray beyond which nothing counts."""
    first, last = (torch.empty(len(origins), dtype=torch.int32) for _ in range(2))
    run_chunks(
        _enter,
        len(origins),
        1 << 14,
        (rows_of(origins, np.float32), rows_of(directions, np.float32), np.float32(step)),
        rows_of(near, np.float32),
        rows_of(far, np.float32),
        space_of(voxels, known),
        first.numpy(),
        last.numpy(),
    )
    return first, last


@njit(**OPTIONS)
def _enter(start, stop, rays, nears, fars, space, out_first, out_last):
    origins, directions, step = rays
    bricks, brick_count, _, held, corner, scale, _ = space
    side = np.float32(brick_count) / scale
    half, nothing = np.float32(0.5), np.float32(0)
    for ray in range(start, stop):
        near, far = max(nears[ray], nothing), fars[ray]
        for axis in range(3):
            o, d = origins[ray, axis] - corner[axis], directions[ray, axis]
            if d == 0:
                far = far if 0 <= o <= side else np.float32(-1)
                continue
            a, b = -o / d, (side - o) / d
            near, far = max(near, min(a, b)), min(far, max(a, b))
        first, last = 0, -1
        if near <= far < np.inf:
            first = np.int64(np.ceil(max(near / step - half, nothing)))
            last = np.int64(np.floor(far / step - half))
        (ox, oy, oz), (dx, dy, dz), over = in_bricks(ray, origins, directions, corner, scale)
        while first <= last:
            t = (np.float32(first) + half) * step
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            voxel, clear = _held_at(x, y, z, over, bricks, brick_count, held)
            if voxel >= 0:
                break
            first += 1 + max(np.int64(min(clear / step, np.float32(last - first))), 0)
        out_first[ray], out_last[ray] = first, last


def space_of(voxels: Voxels, known: Known) -> tuple[Any, ...]:
    """What compiled functions are told of voxels: bricks, how many a side, densities, bits, lowest
    corner, bricks a metre, maps."""
    return (
        rows_of(voxels.bricks.view(-1), np.int32),
        len(voxels.bricks),
        flat(known.density),
        known.held.numpy(),
        flat(voxels.box_min),
        np.float32(voxels.scale),
        flat(voxels.maps),
    )


@njit(**LEAN)
def runs_of(ray, first, last, rays, space, left, lengths_of, begins,
            lengths):  # fmt: skip
    """Places of one ray in runs, each looked at in its middle: how many runs, where to go on.

    A run is up to `probe` places that are in some cell, or up to `longest` that add no more than
    `share` to the pixel by the guide.
    """
    origins, directions, step = rays
    bricks, brick_count, density, held, corner, scale, _ = space
    width, share, longest, probe = lengths_of
    (ox, oy, oz), (dx, dy, dz), over = in_bricks(ray, origins, directions, corner, scale)
    count, length, added = -1, 0, np.float32(0.0)
    k = first
    while k <= last:
        t = (np.float32(k) + np.float32(0.5)) * step
        k += 1
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        voxel, clear = _held_at(x, y, z, over, bricks, brick_count, held)
        if voxel < 0:
            k += max(np.int64(min(clear / step, np.float32(last - k))), 0)
            continue
        more = left * min(density[voxel] * step, np.float32(1))
        together = (
            length > 0
            and begins[count] + length == k - 1
            and (length < probe or (length < longest and added + more <= share))
        )
        if together:
            length += 1
            added += more
            lengths[count] = length
            continue
        if count + 1 == width:
            return width, k - 1
        count += 1
        begins[count], lengths[count] = k - 1, 1
        length, added = 1, more
    return count + 1, k
