"""Cubes of posed space, taken to canonical space by their middles: which may hold anything, and
the cells that a brick's voxels lie in. See `deformation/voxels.py`.

A brick's map is a row of sixteen: an affine map [3, 4] from posed to canonical space, then how far
it may be off and the nearest point of the mesh (`Voxels`).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch

from ..structures import Clearance, PosedMesh
from .marching import canonicalise
from .nearest import nearest

BRICK = 4  # voxels a side
MAP = 16  # numbers of a brick's map
SLACK = 12  # its column that says how far the map may be off
FOOT = 13  # and from where on the nearest point of the mesh to the brick's middle is written
TORN = 0.004  # metres between where two bricks' maps take a place, from which they are torn
FAR = 0.012  # metres of a leap from which the map of a larger cube tells nothing of its parts


class Found(NamedTuple):
    """Where posed points lie: kept [N] bool, whether they are to be looked at more closely; nearest
    triangle [N] int32, barycentrics [N, 3], the nearest point itself, foot [N, 3]; canonical place
    [N, 3]; clear [N]: how many cells off the nearest occupied one is. What is not kept may hold
    anything."""

    kept: torch.Tensor
    triangle: torch.Tensor
    barycentric: torch.Tensor
    foot: torch.Tensor
    canonical: torch.Tensor
    clear: torch.Tensor

    def pick(self, rows: torch.Tensor) -> Found:
        return Found(*(values[rows] for values in self))


def look(
    mesh: PosedMesh,
    space: Clearance,
    middles: torch.Tensor,
    near: float,
    margin: int,
    feet: torch.Tensor,
) -> Found:
    """Keeps those of posed points [N, 3] that are at most `near` metres from the mesh and `margin`
    cells from an occupied one.

    feet [N, 3]: some point of the mesh for each that is not far, from which the search begins, or
    infinite. Fastest when neighbours are neighbours in space.
    """
    triangle, barycentric, distance = nearest(mesh.search, middles)
    canonical = canonicalise(middles, triangle, barycentric, mesh)
    clear = cells_from_occupied(canonical, space)
    kept = (distance <= near) & (clear <= margin)
    corners = mesh.vertices[mesh.triangles.long()[triangle.long().clamp(min=0)]]
    foot = (corners * barycentric[..., None]).sum(1)
    return Found(kept, triangle, barycentric, foot, canonical, clear)


def brick_maps(mesh: PosedMesh, found: Found, middles: torch.Tensor) -> torch.Tensor:
    """The maps [N, 16] of bricks by what was found of their middles [N, 3]; none is off."""
    index = found.triangle.long().clamp(min=0)
    if mesh.triangle_maps is not None:
        linear = mesh.triangle_maps[index, :, :3]
    else:
        assert mesh.vertex_maps is not None
        corners = mesh.triangles.long()[index]
        weights = found.barycentric[..., None, None]
        linear = (mesh.vertex_maps[corners, :, :3] * weights).sum(1)
    moved = found.canonical[..., None] - linear @ middles[..., None]
    rows = torch.cat([linear, moved], 2).view(-1, SLACK)
    return torch.cat([rows, torch.zeros_like(rows[:, :1]), found.foot], 1)


def _linear(maps: torch.Tensor) -> torch.Tensor:
    """The linear parts [N, 3, 3] of maps [N, 16]."""
    return maps[:, :SLACK].view(-1, 3, 4)[:, :, :3]


def cells_from_occupied(canonical: torch.Tensor, space: Clearance) -> torch.Tensor:
    """How many cells canonical points [N, 3] are from an occupied one, chessboard distance [N]."""
    return _in_grid(canonical, space)[1]


def _in_grid(canonical: torch.Tensor, space: Clearance) -> tuple[torch.Tensor, torch.Tensor]:
    """Flat cell of canonical points [N, 3], and how many cells the nearest occupied one is off."""
    size = space.grid.shape[0]
    place = ((canonical - space.box_min) * (space.box_scale * size)).floor()
    cell = place.clamp(0, size - 1)
    outside = (cell - place).abs().amax(1)
    x, y, z = cell.long().unbind(1)
    flat = (x * size + y) * size + z
    return flat, space.grid.view(-1)[flat].float().maximum(outside)


def brick_cells(
    rows: torch.Tensor,
    found: Found,
    maps: torch.Tensor,
    space: Clearance,
    voxel: float,
    margin: int,
) -> torch.Tensor:
    """Canonical cells [M, 64] int32 of the voxels of some bricks, -1 where no occupied cell is
    beside.

    rows [M]: which bricks; found: of all their middles; maps [N, 16], taken to hold over the brick;
    voxel: side in metres; margin: cells from an occupied one beyond which nothing in a brick can
    be.
    """
    cells = _cells_about(found.canonical[rows], _linear(maps)[rows], space, voxel)
    return torch.where((found.clear[rows] <= margin)[:, None], cells, -1)


def _cells_about(
    canonical: torch.Tensor, linear: torch.Tensor, space: Clearance, voxel: float
) -> torch.Tensor:
    within = torch.cartesian_prod(*[torch.arange(BRICK, device=canonical.device)] * 3)
    offsets = (within + 0.5 - BRICK / 2) * voxel
    around = canonical[:, None] + offsets @ linear.mT
    cells, clear = _in_grid(around.view(-1, 3), space)
    return torch.where(clear <= 1, cells, -1).int().view(-1, BRICK**3)


def leaps(
    at: torch.Tensor, places: torch.Tensor, canonical: torch.Tensor, maps: torch.Tensor, side: float
) -> torch.Tensor:
    """How far [N], in metres, the middle of a cube is at most from where the maps of those beside
    it take it: far where the nearest point leaps from one part of a mesh to another.

    at: rows of cubes in a grid with a free border, -1 where there is none; places [N, 3]: where
    each is in it; canonical [N, 3]: where their middles lie; maps [N, 16]; side: in metres.
    """
    found = canonical.new_zeros(len(canonical))
    for cubes, _, there in _about(at, places, canonical, maps, side):
        found[cubes] = torch.maximum(found[cubes], (there - canonical[cubes]).abs().amax(1))
    return found


def likely(
    canonical: torch.Tensor,
    maps: torch.Tensor,
    leaps: torch.Tensor,
    space: Clearance,
    side: float,
    margin: int,
) -> torch.Tensor:
    """Which of the eight smaller cubes [N, 8] that each one of this side (metres) is made of has
    its middle within `margin` cells of an occupied one by its map, which is trusted to its leap
    [N]: all eight where that is beyond `FAR`."""
    within = torch.cartesian_prod(*[torch.arange(2, device=canonical.device)] * 3)
    offsets = (within - 0.5) * (side / 2)
    places = canonical[:, None] + offsets @ _linear(maps).mT
    clear = cells_from_occupied(places.view(-1, 3), space).view(-1, 8)
    return (clear <= margin + (leaps / space.cell).ceil()[:, None]) | (leaps > FAR)[:, None]


def add_torn(
    cells: torch.Tensor,
    rows: torch.Tensor,
    at: torch.Tensor,
    places: torch.Tensor,
    canonical: torch.Tensor,
    maps: torch.Tensor,
    space: Clearance,
    voxel: float,
    margin: int,
) -> None:
    """Where the nearest point leaps from one part of a mesh to another between two bricks, the
    map of each may hold in part of the other: cells [M, 64] of bricks rows [M] are set, in place,
    where they have none, to what the maps of torn neighbours say. The rest as in `leaps` and
    `brick_cells`."""
    linear = _linear(maps)
    place = torch.full((len(maps),), -1, device=rows.device)
    place[rows] = torch.arange(len(rows), device=rows.device)
    for bricks, beside, there in _about(at, places, canonical, maps, BRICK * voxel):
        torn = (there - canonical[bricks]).abs().amax(1) > TORN
        torn &= (cells_from_occupied(there, space) <= margin) & (place[bricks] >= 0)
        own, beside, there = place[bricks[torn]], beside[torn], there[torn]
        found = _cells_about(there, linear[beside], space, voxel)
        cells[own] = torch.where(cells[own] < 0, found, cells[own])


def _about(
    at: torch.Tensor, places: torch.Tensor, canonical: torch.Tensor, maps: torch.Tensor, side: float
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """In each of six directions the cubes that have one beside them, that one, and where its map
    takes the middle of the first."""
    for axis in range(3):
        for sign in (1, -1):
            step = torch.zeros(3, dtype=places.dtype, device=places.device)
            step[axis] = sign
            beside = at[(places + step).long().unbind(1)].long()
            cubes = (beside >= 0).nonzero()[:, 0]
            beside = beside[cubes]
            yield cubes, beside, canonical[beside] - sign * side * _linear(maps)[beside, :, axis]
