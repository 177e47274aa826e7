"""Few samples along a ray, and each where it tells something; no network runs to find them.

A guide, the density of every canonical cell as it was of late, tells what each place along a ray
would add to its pixel, and `Voxels` which cell a place is in. Places that follow one another are
taken together until they add enough, and one of them stands for all: thin fog is stepped through
coarsely, a surface finely. Only samples search for their nearest triangle.
"""

from __future__ import annotations

import math

import torch

from ..structures import Clearance, Picks, PosedMesh, Thrift, Voxels
from .bricks import BRICK
from .marching import canonicalise, occupied
from .nearest import nearest

LEAST = 1e-4  # density (1/m) that the guide calls empty
RISE, FALL = 0.15, 0.5  # parts of the way that one sample moves the guide
GOLDEN = 0.6180339887


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
    """Samples among lattice indices first..last [R] int32 that lie in voxels with a cell.

    guide [G, G, G] float32 (1/m); chance [R] in [0, 1) decides which place of those taken together
    is the sample; left [R] is the transmittance that rays start with. Samples whose canonical point
    is in no occupied cell, or farther than `band` metres from the mesh, are dropped.
    """
    rays, device = len(origins), origins.device
    density_of = torch.cat([guide.reshape(-1), guide.new_full((1,), -1.0)])  # -1: no cell
    count, looks = (torch.zeros(rays, dtype=torch.int64, device=device) for _ in range(2))
    begin, length, following = torch.zeros_like(count), torch.zeros_like(count), first.long()
    added, passed = torch.zeros_like(left), torch.zeros_like(left)
    left, chance = left.clone(), chance.clone()
    k_out = torch.full((rays, thrift.width), -1, dtype=torch.int64, device=device)
    steps = torch.zeros_like(k_out)
    going = last >= first

    def close(which: torch.Tensor) -> None:
        row = which.nonzero()[:, 0]
        place = (chance[row] * length[row]).long().clamp(max=length[row] - 1)
        k_out[row, count[row]] = begin[row] + place
        steps[row, count[row]] = length[row]
        count[row] += 1
        chance[row] = (chance[row] + GOLDEN) % 1.0
        length[row] = 0

    ks = range(int(first.min()), int(last.max()) + 1) if rays else ()
    for k in ks:
        here = going & (first <= k) & (k <= last)
        t = (k + jitter) * step
        density = density_of[_cells(voxels, origins + t[:, None] * directions)]
        seen = here & (density >= 0)
        alpha = -torch.expm1(-density * step)
        more = left * alpha
        together = seen & (length > 0) & (begin + length == k) & (length < thrift.longest)
        together &= added + more <= thrift.share
        opens = seen & ~together
        close(opens & (length > 0))
        full = opens & (count == thrift.width)
        going &= ~full
        opens &= ~full
        seen &= ~full
        begin = torch.where(opens, k, begin)
        length = torch.where(opens, 1, length + together)
        added = torch.where(opens, more, added + torch.where(together, more, 0.0))
        if math.isfinite(thrift.opaque):
            left = torch.where(seen, left - more, left)
        passed = passed + torch.where(seen, density * step, 0.0)
        looks += seen
        following = torch.where(here & ~full, k + 1, following)
        going &= passed <= thrift.opaque
    close(length > 0)
    finished = following > last
    following = torch.where(finished, torch.maximum(last + 1, first), following)
    rays_of = origins, directions, jitter, step
    return _located(mesh, *rays_of, clearance, band, count, looks, following, k_out, steps)


def _cells(voxels: Voxels, points: torch.Tensor) -> torch.Tensor:
    """Canonical cell of each posed point [N, 3], or -1."""
    size = len(voxels.bricks)
    place = (points - voxels.box_min) * voxels.scale
    inside = ((place >= 0) & (place < size)).all(1)
    brick = torch.where(inside[:, None], place.floor(), 0.0)
    within = ((torch.where(inside[:, None], place, 0.0) - brick) * BRICK).long()
    row = voxels.bricks[brick.long().unbind(1)].long()
    if len(voxels.cells) == 0:
        return torch.full_like(row, -1)
    cell = voxels.cells[row.clamp(min=0), within[:, 0], within[:, 1], within[:, 2]].long()
    return torch.where(inside & (row >= 0), cell, -1)


def _located(
    mesh: PosedMesh,
    origins: torch.Tensor,
    directions: torch.Tensor,
    jitter: torch.Tensor,
    step: float,
    clearance: Clearance,
    band: float,
    count: torch.Tensor,
    looks: torch.Tensor,
    following: torch.Tensor,
    k: torch.Tensor,
    steps: torch.Tensor,
) -> Picks:
    """Where the chosen places lie; those that lie nowhere are taken out."""
    used = torch.arange(k.shape[1], device=k.device) < count[:, None]
    ray, slot = used.nonzero().unbind(1)
    t = (k[ray, slot].to(origins.dtype) + jitter[ray]) * step
    points = origins[ray] + t[:, None] * directions[ray]
    triangle, barycentric, distance = nearest(mesh.search, points)
    canonical = canonicalise(points, triangle, barycentric, mesh)
    keep = (triangle >= 0) & (distance <= band) & occupied(canonical, clearance)
    ray, slot = ray[keep], slot[keep]
    kept = torch.bincount(ray, minlength=len(k))
    place = torch.arange(len(ray), device=k.device) - (torch.cumsum(kept, 0) - kept)[ray]

    def spread(values: torch.Tensor, kind: torch.dtype) -> torch.Tensor:
        out = torch.zeros((*k.shape, *values.shape[1:]), dtype=kind, device=k.device)
        out[ray, place] = values.to(kind)
        return out

    whole, real = torch.int32, origins.dtype
    return Picks(
        kept.to(whole),
        looks.to(whole),
        following.to(whole),
        spread(k[ray, slot], whole),
        spread(steps[ray, slot], whole),
        spread(triangle[keep], whole),
        spread(barycentric[keep], real),
        spread(canonical[keep], real),
        spread(distance[keep], real),
    )


def follow(guide: torch.Tensor, cells: torch.Tensor, density: torch.Tensor) -> None:
    """Moves the guide at flat cells [N] toward the densities [N] (1/m) that were found there, one
    sample after the other and by a part of their ratio's logarithm; in place.

    Down faster than up: a ray that passes the empty side of a cell must not end there.
    """
    flat = guide.view(-1)
    for cell, found in zip(cells.tolist(), density.tolist(), strict=True):
        known = float(flat[cell])
        rate = RISE if found > known else FALL
        flat[cell] = known * (max(found, LEAST) / known) ** rate
