"""Where posed space may hold anything of an avatar, and which canonical cell lies there.

What a place on a ray costs is the search for its nearest triangle. A pose is looked over once
instead: from blocks to bricks to voxels, the middle of each is taken to canonical space, and those
whose middle is too far from any occupied cell are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from .. import kernels
from ..kernels.reference.bricks import BRICK, SLACK, TORN, Found
from ..kernels.structures import Clearance, PosedMesh, Voxels
from .occupancy import clearance

_VOXEL = 0.003  # metres
_STRETCH = 1.4  # of the map from posed to canonical space that is allowed for
_CORNER = 0.87  # of a side, from the middle of a cube to its corners
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
    far = torch.full((len(places), 3), torch.inf)
    near = _near(mesh, space, reach, low, places, far, _SIDES[0])
    for size in _SIDES[1:]:
        near = _near(mesh, space, reach, low, *_parts(mesh, space, near, size), size)
    rows, cells, maps = _brick_cells(mesh, space, near)
    held = (cells.amax(1) >= 0).nonzero()[:, 0]  # few are not: they stay, and nothing leads there
    places = near.places[rows[held]]
    corner = places.amin(0) if len(places) else torch.zeros(3, dtype=torch.int32)
    count = int((places - corner).max()) + 1 if len(places) else 1
    filled = torch.zeros((count,) * 3, dtype=torch.bool)
    at = (places - corner).long().unbind(1)
    filled[at] = True
    bricks = -torch.from_numpy(clearance(filled.numpy())).int()
    bricks[at] = held.int()
    shape = (-1, BRICK, BRICK, BRICK)
    side = BRICK * _VOXEL
    return Voxels(bricks, cells.view(shape), low + corner * side, 1 / side, maps)


def _cells(margin: float, space: Clearance) -> int:
    """How many cells from an occupied one something may lie that is `margin` metres off in posed
    space."""
    return int(np.ceil(margin * _STRETCH / space.cell))


@dataclass(frozen=True, eq=False)
class _Cubes:
    """Cubes at places [N, 3], counted in their own side, with their middles [N, 3] in metres and
    what was found of these."""

    places: torch.Tensor
    middles: torch.Tensor
    found: Found


def _near(
    mesh: PosedMesh,
    space: Clearance,
    reach: float,
    low: torch.Tensor,
    places: torch.Tensor,
    feet: torch.Tensor,
    size: int,
) -> _Cubes:
    """Those of the cubes at places [N, 3], of `size` voxels, that may hold something or are beside
    such; feet [N, 3]: a point of the mesh near each, or infinite."""
    middles = low + (places + 0.5) * (size * _VOXEL)
    half = _CORNER * size * _VOXEL
    ops = kernels.select("cpu").bricks
    found = ops.look(mesh, space, middles, reach + half, _cells(_BESIDE * half, space), feet)
    kept = found.kept.nonzero()[:, 0]
    return _Cubes(places[kept], middles[kept], found.pick(kept))


def _parts(
    mesh: PosedMesh, space: Clearance, cubes: _Cubes, size: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Places [M, 3] of the parts, of `size` voxels, half the cubes' own, that may hold something,
    block by block, and each one's point on the mesh. Most are told by the cube's map, without a
    search."""
    ops, places = kernels.select("cpu").bricks, cubes.places
    side = 2 * size * _VOXEL
    maps = ops.brick_maps(mesh, cubes.found, cubes.middles)
    leaps = torch.zeros(len(maps))
    if len(places):
        leaps = ops.leaps(*_grid_of(places), cubes.found.canonical, maps, side)
    margin = _cells(_CORNER * size * _VOXEL, space)
    likely = ops.likely(cubes.found.canonical, maps, leaps, space, side, margin)
    whole, part = likely.nonzero().unbind(1)
    within = torch.cartesian_prod(*[torch.arange(2, dtype=torch.int32)] * 3)
    return 2 * places[whole] + within[part], cubes.found.foot[whole]


def _brick_cells(
    mesh: PosedMesh, space: Clearance, bricks: _Cubes
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rows [M] of bricks that may hold something, their canonical cells [M, 64] and their maps
    [M, 16] (`Voxels`). Within a brick the map is as good as affine, but for bricks in which the
    nearest point leaps from one part of the mesh to another: their voxels may lie where a
    neighbour's map takes them as well."""
    ops, found = kernels.select("cpu").bricks, bricks.found
    margin = _cells(_CORNER * BRICK * _VOXEL, space)
    maps = ops.brick_maps(mesh, found, bricks.middles)
    if not len(maps):
        return torch.zeros(0, dtype=torch.int64), torch.zeros(0, BRICK**3, dtype=torch.int32), maps
    cubes = *_grid_of(bricks.places), found.canonical, maps
    leaps = ops.leaps(*cubes, BRICK * _VOXEL)
    rows = ((found.clear <= margin) | (leaps > TORN)).nonzero()[:, 0]
    cells = ops.brick_cells(rows, found, maps, space, _VOXEL, margin)
    ops.add_torn(cells, rows, *cubes, space, _VOXEL, margin)
    maps, leaps = maps[rows], leaps[rows]
    maps[:, SLACK] = torch.where(leaps > TORN, torch.inf, leaps + _SLACK)
    return rows, cells, maps


def _grid_of(places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows of cubes in a grid with a free border, -1 where there is none, and places [N, 3] in
    it."""
    corner = places.amin(0) - 1
    at = torch.full(tuple((places.amax(0) - corner + 2).tolist()), -1, dtype=torch.int32)
    where = places - corner
    at[where.long().unbind(1)] = torch.arange(len(places), dtype=torch.int32)
    return at, where
