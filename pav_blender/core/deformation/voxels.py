"""Where posed space may hold anything of an avatar, and which canonical cell lies there.

What a place on a ray costs is the search for its nearest triangle. A pose is looked over once
instead: from blocks to bricks to voxels, the middle of each is taken to canonical space, and those
whose middle is too far from any occupied cell are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from .. import kernels
from ..kernels.reference.picking import BRICK, TORN, cells_from_occupied
from ..kernels.structures import Clearance, PosedMesh, Voxels
from .occupancy import clearance

_VOXEL = 0.003  # metres
_STRETCH = 1.4  # of the map from posed to canonical space that is allowed for
_BESIDE = 2.0  # times the margin of a cube: what is beside it may be torn from it
_SLACK = 3e-4  # metres that a brick's map is trusted to, beside what its neighbours' differ by
_SIDES = (16, 8, 4)  # in voxels, of the cubes that are looked at one after the other


def voxels(mesh: PosedMesh, space: Clearance, reach: float) -> Voxels:
    """The voxels of a pose where `space` has an occupied cell, within `reach` metres of the mesh.

    Outside their box there is nothing: rays are followed from where they enter it.
    """
    low = mesh.vertices.amin(0) - reach
    extent = float((mesh.vertices.amax(0) + reach - low).max())
    count = -(-int(np.ceil(extent / _VOXEL)) // _SIDES[0])
    places = torch.cartesian_prod(*[torch.arange(count, dtype=torch.int32)] * 3)
    children = torch.cartesian_prod(*[torch.arange(2, dtype=torch.int32)] * 3)
    for size in _SIDES:  # block by block: neighbours share a search
        if size < _SIDES[0]:
            places = (2 * places[:, None] + children).view(-1, 3)
        middles = low + (places + 0.5) * (size * _VOXEL)
        kept, found = _near_filled(mesh, space, reach, middles, size * _VOXEL)
        places = places[kept]
    cells, maps = _brick_cells(mesh, space, places, found, middles[kept])
    held = (cells >= 0).any(1)
    places, cells, maps = places[held], cells[held], maps[held]
    corner = places.amin(0) if len(places) else torch.zeros(3, dtype=torch.int32)
    count = int((places - corner).max()) + 1 if len(places) else 1
    filled = torch.zeros((count,) * 3, dtype=torch.bool)
    at = (places - corner).long().unbind(1)
    filled[at] = True
    bricks = -torch.from_numpy(clearance(filled.numpy())).int()
    bricks[at] = torch.arange(len(places), dtype=torch.int32)
    shape = (-1, BRICK, BRICK, BRICK)
    side = BRICK * _VOXEL
    return Voxels(bricks, cells.view(shape), low + corner * side, 1 / side, maps)


class _Found(NamedTuple):
    """Where posed points lie on the mesh and in canonical space, and how many cells off the nearest
    occupied one is."""

    triangle: torch.Tensor
    barycentric: torch.Tensor
    canonical: torch.Tensor
    clear: torch.Tensor


def _near_filled(
    mesh: PosedMesh, space: Clearance, reach: float, middles: torch.Tensor, side: float
) -> tuple[torch.Tensor, _Found]:
    """Which cubes [N], by their middles [N, 3] and side, may hold something or are beside such, and
    where the middles of those lie."""
    ops = kernels.select("cpu")
    triangle, barycentric, distance = ops.nearest.nearest(mesh.search, middles)
    canonical = ops.marching.canonicalise(middles, triangle, barycentric, mesh)
    half = 0.87 * side
    clear = cells_from_occupied(canonical, space)
    kept = (distance <= reach + half) & (clear <= np.ceil(_BESIDE * half * _STRETCH / space.cell))
    return kept, _Found(triangle[kept], barycentric[kept], canonical[kept], clear[kept])


def _brick_cells(
    mesh: PosedMesh,
    space: Clearance,
    places: torch.Tensor,
    found: _Found,
    middles: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Canonical cells [N, 64] of bricks at places [N, 3], and their maps [N, 16] (`Voxels`). Within
    a brick the map is as good as affine, but for bricks in which the nearest point leaps from one
    part of the mesh to another: their voxels may lie where a neighbour's map takes them as well."""
    ops = kernels.select("cpu").picking
    maps = _linear(mesh, found.triangle, found.barycentric)
    margin = int(np.ceil(0.87 * BRICK * _VOXEL * _STRETCH / space.cell))
    cells = torch.full((len(places), BRICK**3), -1, dtype=torch.int32)
    own = (found.clear <= margin).nonzero()[:, 0]
    cells[own] = ops.brick_cells(found.canonical[own], maps[own], space, _VOXEL)
    leaps = torch.zeros(len(cells))
    if len(places):
        corner = places.amin(0) - 1
        at = torch.full(tuple((places.amax(0) - corner + 2).tolist()), -1, dtype=torch.int32)
        where = places - corner
        at[where.long().unbind(1)] = torch.arange(len(places), dtype=torch.int32)
        leaps = ops.add_torn(cells, at, where, found.canonical, maps, space, _VOXEL, margin)
    moved = found.canonical[..., None] - maps @ middles[..., None]
    slack = torch.where(leaps > TORN, torch.inf, leaps + _SLACK)
    unused = torch.zeros(len(cells), 3)
    rows = torch.cat([torch.cat([maps, moved], 2).view(-1, 12), slack[:, None], unused], 1)
    return cells, rows


def _linear(mesh: PosedMesh, triangle: torch.Tensor, barycentric: torch.Tensor) -> torch.Tensor:
    """The linear part [N, 3, 3] of the maps to canonical space at points of the mesh."""
    index = triangle.long().clamp(min=0)
    if mesh.triangle_maps is not None:
        return mesh.triangle_maps[index, :, :3]
    assert mesh.vertex_maps is not None
    corners = mesh.triangles.long()[index]
    return (mesh.vertex_maps[corners, :, :3] * barycentric[..., None, None]).sum(1)
