"""Where posed space may hold anything of an avatar: a coarse grid a pose, for leaping to it.

What a sample costs is the search for its nearest triangle, and most of a ray through the mesh's
box passes nothing. The middle of every voxel is taken to canonical space once a pose; where the
occupied cells are farther from it than the voxel reaches, rays need not look.
"""

from __future__ import annotations

import numpy as np
import torch

from .. import kernels
from ..kernels.structures import Clearance, PosedMesh
from .occupancy import clearance

_VOXEL = 0.012  # metres
_STRETCH = 1.4  # of the map from posed to canonical space that is allowed for
_BLOCK = 4  # voxels a side of the blocks that are looked at first


def shell(mesh: PosedMesh, space: Clearance, reach: float) -> Clearance:
    """The clearance of posed space from what `space` occupies, within `reach` metres of the mesh.

    Nothing lies outside its box: rays are followed from where they enter it (`box`).
    """
    low = mesh.vertices.amin(0) - reach
    side = float((mesh.vertices.amax(0) + reach - low).max())
    blocks = -(-int(np.ceil(side / _VOXEL)) // _BLOCK)
    outer = torch.cartesian_prod(*[torch.arange(blocks)] * 3)
    inner = torch.cartesian_prod(*[torch.arange(_BLOCK)] * 3)
    middles = low + (outer + 0.5) * (_BLOCK * _VOXEL)
    chosen = _filled(mesh, space, reach, middles, _BLOCK * _VOXEL).nonzero()[:, 0]
    # block by block: neighbours share a search
    voxels = (outer[chosen, None] * _BLOCK + inner).view(-1, 3)
    voxels = voxels[_filled(mesh, space, reach, low + (voxels + 0.5) * _VOXEL, _VOXEL)]
    corner = voxels.amin(0) if len(voxels) else torch.zeros(3, dtype=torch.int64)
    size = int((voxels - corner).max()) + 1 if len(voxels) else 1
    cells = np.zeros((size, size, size), bool)
    cells[tuple((voxels - corner).T.numpy())] = True
    return Clearance(torch.from_numpy(clearance(cells)), low + corner * _VOXEL, 1 / (size * _VOXEL))


def box(shell: Clearance) -> torch.Tensor:
    """The two opposite corners [2, 3] of a shell, for `bounds`."""
    return torch.stack([shell.box_min, shell.box_min + 1 / shell.box_scale])


def _filled(
    mesh: PosedMesh, space: Clearance, reach: float, middles: torch.Tensor, side: float
) -> torch.Tensor:
    """Which voxels [N], by their middles [N, 3] and side, may hold a posed occupied place."""
    ops = kernels.select("cpu")
    triangle, barycentric, distance = ops.nearest.nearest(mesh.search, middles)
    canonical = ops.marching.canonicalise(middles, triangle, barycentric, mesh)
    half = 0.87 * side
    return (distance <= reach + half) & _within(canonical, space, half * _STRETCH)


def _within(canonical: torch.Tensor, space: Clearance, distance: float) -> torch.Tensor:
    """Which points [N, 3] are within `distance` metres of an occupied cell, or a little more."""
    size = space.grid.shape[0]
    place = (canonical - space.box_min) * (space.box_scale * size)
    cell = place.floor().clamp(0, size - 1)
    outside = (cell - place.floor()).abs().amax(1)
    x, y, z = cell.long().unbind(1)
    clear = space.grid[x, y, z].float().maximum(outside)
    return clear <= np.ceil(distance / space.cell)
