"""What density a trained avatar has in every canonical cell: how rays know where to look."""

from __future__ import annotations

import numpy as np
import torch

from ..deformation import Deformer
from ..field.avatar import Avatar
from ..field.field import Samples, Worn, condition

# one place in a cell each, and how the head is turned (axis times sine)
_TURNS = ((0.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, -0.5, 0.0), (0.3, 0.0, 0.0))


def guide(
    avatar: Avatar, deformer: Deformer, worn: Worn, person: torch.Tensor, occupied: np.ndarray
) -> torch.Tensor:
    """The greatest density (1/m) found in each cell [G, G, G] or one beside it, for the only
    appearance in `worn`, on the head of `person` (`identities.code`); 0 where nothing is
    `occupied`. Neighbours count since a voxel lies in several cells: without them surfaces were
    stepped over."""
    count = occupied.shape[0]
    cells = torch.from_numpy(np.argwhere(occupied).astype(np.float32))
    mesh = deformer.pose(avatar.canonical_vertices)
    generator = torch.Generator().manual_seed(0)
    found = torch.zeros(len(cells))
    for turn in _TURNS:
        unit = (cells + torch.rand(cells.shape, generator=generator)) / count
        points = unit * avatar.box_size + torch.from_numpy(avatar.box_min)
        triangle, barycentric, distance = deformer.nearest(mesh, points)
        still = np.zeros(len(avatar.expression_names), np.float32)
        zeros = torch.zeros(len(cells), dtype=torch.int32)
        seen = condition(avatar.config, still, np.array(turn, np.float32), person)
        samples = Samples(
            unit, unit, triangle, barycentric, distance, zeros, zeros, zeros,
            seen[None], torch.zeros(1, 3),
        )  # fmt: skip
        density = avatar.field.geometry(samples.to(avatar.field.device), worn)[0]
        found = torch.maximum(found, density.cpu())
    grid = torch.zeros(1, count, count, count)
    grid[0][torch.from_numpy(occupied)] = found
    return neighbourhood(grid)[0]


def neighbourhood(grids: torch.Tensor) -> torch.Tensor:
    """The greatest value in each cell or one beside it, of grids [K, G, G, G]."""
    grids = grids.detach()
    for axis in (1, 2, 3):
        count = grids.shape[axis] - 1
        wide = grids.clone()
        for there, here in ((1, 0), (0, 1)):
            part = wide.narrow(axis, here, count)
            part.copy_(torch.maximum(part, grids.narrow(axis, there, count)))
        grids = wide
    return grids
