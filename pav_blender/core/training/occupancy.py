"""Which canonical cells an appearance fills, learned from what training rays saw there.

The interior of a head never thins out by itself, since nothing behind an opaque surface has a
gradient: so cells are emptied by what they add to pictures, not by their density. A cell that no
ray could see stays where it is near the mesh (the back of a head), and goes where it is not (fog).
"""

from __future__ import annotations

import numpy as np
import torch

from .. import kernels
from ..deformation import Clearance, Deformer
from ..field.avatar import Avatar
from ..kernels.reference.picking import LEAST
from ..rendering.wearing import clearance_of
from .carving import UNSEEN_REACH

_MUCH = 0.5  # part of the space that is left when voxels are worth finding anew
_SEEN = 0.1  # transmittance from which a look at a cell counts
_LOOKS = 8.0  # looks after which a cell is judged
_BLOCK_LOOKS = 16.0  # the same for eight cells together
_LEAST_WEIGHT = 2e-3  # a millimetre; untrained fog has about twice that
_HIDDEN = 12  # rounds without a look after which a cell counts as hidden


def mesh_distance(avatar: Avatar, deformer: Deformer) -> torch.Tensor:
    """Metres [G, G, G] from the middle of each cell to the canonical mesh."""
    size = avatar.occupied.shape[1]
    side = avatar.box_size / size
    centres = torch.cartesian_prod(*[(torch.arange(size) + 0.5) * side] * 3)
    centres += torch.from_numpy(np.asarray(avatar.box_min, np.float32))
    distance = deformer.nearest(deformer.pose(avatar.canonical_vertices), centres)[2]
    return distance.view(size, size, size)


class Visibility:
    """What was seen of each cell since it was last judged, over all appearances.

    The avatar's `occupied` [A, G, G, G] is changed in place. guide [A, G, G, G] float32: the
    density (1/m) that the field had of late in each cell. version counts how often much was
    emptied.
    """

    def __init__(self, avatar: Avatar, deformer: Deformer) -> None:
        occupied = avatar.occupied
        self.occupied = occupied
        self._box = avatar.box_min, avatar.box_size
        self._one_geometry = avatar.config.one_geometry
        distance = mesh_distance(avatar, deformer)
        self._near = (distance <= UNSEEN_REACH).numpy()
        density = torch.exp(avatar.field.untrained(distance)) * 1e3
        self.guide = density.repeat(len(occupied), 1, 1, 1)
        self.weight = torch.zeros(occupied.size)
        self.looks = torch.zeros(occupied.size)
        self.filled = torch.ones(occupied.size, dtype=torch.bool)
        self.unseen = torch.zeros(occupied.size, dtype=torch.uint8)
        self.spaces: list[Clearance] = []
        self.version = 0
        self._marked = 1.0
        self._refresh()
        self._forget_emptied()

    def _refresh(self) -> None:
        filled = float(self.occupied.mean())
        if self.spaces and filled >= _MUCH * self._marked:
            # distances that were measured before the last cells were emptied are still safe
            for space, cells in zip(self.spaces, self.occupied, strict=True):
                space.grid.clamp_(min=torch.from_numpy(~cells).to(torch.uint8))
            return
        self._marked = filled
        self.version += 1
        self.spaces = [clearance_of(cells, *self._box) for cells in self.occupied]

    def _forget_emptied(self) -> None:
        """No ray may end in a voxel that is beside an occupied cell for what was there once."""
        self.guide[torch.from_numpy(~self.occupied)] = LEAST

    def state(self) -> dict[str, torch.Tensor]:
        """What an interrupted training must keep."""
        return {
            "occupied": torch.from_numpy(self.occupied),
            "weight": self.weight,
            "looks": self.looks,
            "filled": self.filled,
            "unseen": self.unseen,
            "guide": self.guide,
        }

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Takes up the state of an interrupted training, in place."""
        for name, tensor in self.state().items():
            if tensor.shape != state[name].shape:
                raise ValueError(f"{name} of {tuple(state[name].shape)}")
            tensor.copy_(state[name])
        self._refresh()

    def watch(
        self, cells: torch.Tensor, density: torch.Tensor, weights: torch.Tensor, width: torch.Tensor
    ) -> None:
        """Takes in the samples of a batch: cell [N], density [N] (1/m), weight [N] in the pixel,
        and how far along the ray each reaches [N], metres."""
        ops = kernels.select("cpu")
        ops.picking.follow(self.guide, cells, density)
        ops.batches.watch(self.weight, self.looks, cells, density, weights, width, _SEEN)

    def _judge_blocks(self) -> None:
        """Empties blocks of 2 x 2 x 2 cells that had looks enough together: there are too many
        cells for the rays of a few batches. What was judged is forgotten, so that old fog does not
        speak for a cell for ever."""
        size = self.occupied.shape[1]
        if size % 2:
            return
        shape = (-1, size // 2, 2, size // 2, 2, size // 2, 2)
        blocks = (len(self.occupied), *(size // 2, 1) * 3)
        looks, weight = (x.view(self.occupied.shape) for x in (self.looks, self.weight))
        judged = (torch.nn.functional.avg_pool3d(looks, 2) * 8 >= _BLOCK_LOOKS).view(blocks)
        filled = (torch.nn.functional.max_pool3d(weight, 2) >= _LEAST_WEIGHT).view(blocks)
        self.filled.view(shape).logical_and_(filled | ~judged)
        for values in (looks, weight):
            values.view(shape).mul_(~judged)

    def prune(self) -> float:
        """Empties cells that were looked at and added nothing; returns the part that is left."""
        self.unseen += (self.unseen < 255) & (self.looks == 0)
        self.unseen[self.looks > 0] = 0
        judged = self.looks >= _LOOKS
        self.filled = torch.where(judged, self.weight >= _LEAST_WEIGHT, self.filled)
        self._judge_blocks()
        shape = self.occupied.shape
        hidden = (self.unseen >= _HIDDEN).numpy().reshape(shape) & ~self._near
        filled = self.filled.numpy().reshape(shape) & ~hidden
        self.occupied &= _grown(filled)  # a surface may move into a neighbour
        if self._one_geometry:  # what one appearance shows, the others cannot lack
            self.occupied[:] = self.occupied.any(axis=0)
        self.weight.mul_(~judged)
        self.looks.mul_(~judged)
        self._refresh()
        self._forget_emptied()
        return float(self.occupied.mean())


def _grown(cells: np.ndarray) -> np.ndarray:
    """Cells [A, G, G, G] and those that share a face with one."""
    grown = cells.copy()
    for axis in (1, 2, 3):
        ahead, behind = [slice(None)] * 4, [slice(None)] * 4
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        grown[tuple(ahead)] |= cells[tuple(behind)]
        grown[tuple(behind)] |= cells[tuple(ahead)]
    return grown
