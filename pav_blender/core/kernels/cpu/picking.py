"""The samples that training takes, for the CPU; see `reference/picking.py`."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit

from ..reference.picking import FALL, LEAST, LONGEST, LOOKS, OPAQUE, RISE, SHARE, WIDTH
from ..structures import Clearance, Picks, PosedMesh
from .marching import flat, march_rays, rows_of, walk
from .search import OPTIONS
from .threads import run_chunks

_CHUNK = 128  # rays a thread takes at a time
_OPAQUE, _SHARE = np.float32(OPAQUE), np.float32(SHARE)
_GOLDEN = np.float32(0.6180339887)


def pick(
    mesh: PosedMesh,
    origins: torch.Tensor,
    directions: torch.Tensor,
    first: torch.Tensor,
    last: torch.Tensor,
    jitter: torch.Tensor,
    random: torch.Tensor,
    step: float,
    *,
    clearance: Clearance,
    guide: torch.Tensor,
    shell: Clearance | None = None,
    band: float = np.inf,
    leap_limit: float = 0.004,
) -> Picks:
    """As the reference; up to the rounding of the march."""
    count = len(origins)
    result = Picks(
        torch.zeros(count, dtype=torch.int32),
        torch.zeros(count, dtype=torch.int32),
        torch.zeros(count, dtype=torch.bool),
        torch.empty((count, WIDTH), dtype=torch.int32),
        torch.empty((count, WIDTH), dtype=torch.int32),
        torch.empty((count, WIDTH), dtype=torch.int32),
        torch.empty((count, WIDTH, 3)),
        torch.empty((count, WIDTH, 3)),
        torch.empty((count, WIDTH)),
    )
    run_chunks(
        _pick,
        count,
        _CHUNK,
        *walk(
            mesh, origins, directions, first, last, jitter, step, clearance, shell, band, leap_limit
        ),
        rows_of(random, np.float32),
        flat(guide),
        *(values.numpy() for values in result),
    )
    return result


@njit(**OPTIONS)
def _pick(start, stop, arrays, triangle_maps, vertex_maps, vertices, corners,
          origins, directions, first, last, jitter, step,
          grid, size, corner, scale, shell, shell_size, shell_corner, shell_scale,
          band, leap_limit, random, guide, out_count, out_looks, out_ended, out_k, out_steps,
          out_triangle, out_barycentric, out_canonical, out_distance):  # fmt: skip
    rays = stop - start
    density = np.empty((rays, LOOKS), np.float32)
    looks = np.zeros(rays, np.int32)
    following = np.zeros(rays, np.int32)
    k = np.empty((rays, LOOKS), np.int32)
    triangle = np.empty((rays, LOOKS), np.int32)
    barycentric = np.empty((rays, LOOKS, 3), np.float32)
    canonical = np.empty((rays, LOOKS, 3), np.float32)
    distance = np.empty((rays, LOOKS), np.float32)
    march_rays(0, rays, arrays, triangle_maps, vertex_maps, vertices, corners,
               origins[start:stop], directions[start:stop], first[start:stop], last[start:stop],
               jitter[start:stop], step, grid, size, corner, scale,
               shell, shell_size, shell_corner, shell_scale, band, leap_limit, guide, _OPAQUE,
               LOOKS, density, looks, following, k, triangle, barycentric, canonical,
               distance)  # fmt: skip
    for i in range(rays):
        ray = start + i
        out_looks[ray] = looks[i]
        slot, place = 0, 0
        left = np.float32(1.0)
        chance = random[ray]
        while place < looks[i] and slot < WIDTH:
            length, added = _together(place, looks[i], k[i], density[i], left, step)
            left -= added
            chosen = place + min(int(chance * length), length - 1)
            chance += _GOLDEN
            chance -= np.float32(1.0) if chance >= 1 else np.float32(0.0)
            out_k[ray, slot] = k[i, chosen]
            out_steps[ray, slot] = length
            out_triangle[ray, slot] = triangle[i, chosen]
            out_distance[ray, slot] = distance[i, chosen]
            for axis in range(3):
                out_barycentric[ray, slot, axis] = barycentric[i, chosen, axis]
                out_canonical[ray, slot, axis] = canonical[i, chosen, axis]
            slot += 1
            place += length
        out_count[ray] = slot
        out_ended[ray] = following[i] <= last[ray] or place < looks[i]


@njit(**OPTIONS)
def _together(place, looks, k, density, left, step):
    """How many places from `place` on go together, and what they add to the pixel."""
    added = left * (np.float32(1.0) - np.exp(-density[place] * step))
    length = 1
    while length < LONGEST and place + length < looks:
        if k[place + length] != k[place] + length:
            break  # a gap
        more = (left - added) * (np.float32(1.0) - np.exp(-density[place + length] * step))
        if added + more > _SHARE:
            break
        added += more
        length += 1
    return length, added


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
