"""Which canonical cells an appearance fills, learned from what training rays saw there.

The interior of a head never thins out by itself, since nothing behind an opaque surface has a
gradient: so cells are emptied by what they add to pictures, not by their density. A cell that no
ray could see keeps what it has.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

from ..deformation import Clearance
from ..rendering.render import clearance_of

_SEEN = 0.1  # transmittance from which a look at a cell counts
_LOOKS = 12.0  # looks a cell needs before it may be emptied
_LEAST_WEIGHT = 4e-3
_FORGET = 0.6


class Visibility:
    """Running largest weight and number of looks a cell, over all appearances."""

    def __init__(self, occupied: np.ndarray, box_min: np.ndarray, box_size: float) -> None:
        self.occupied = occupied
        self._box = box_min, box_size
        self.weight = torch.zeros(occupied.size)
        self.looks = torch.zeros(occupied.size)
        self.spaces: list[Clearance] = []
        self._refresh()

    def _refresh(self) -> None:
        self.spaces = [clearance_of(cells, *self._box) for cells in self.occupied]

    def restore(self, occupied: np.ndarray, weight: torch.Tensor, looks: torch.Tensor) -> None:
        """Takes up the state of an interrupted training, in place."""
        self.occupied[:] = occupied
        self.weight.copy_(weight)
        self.looks.copy_(looks)
        self._refresh()

    def watch(self, cells: torch.Tensor, seen: torch.Tensor, weights: torch.Tensor) -> None:
        """Takes in the samples of a batch: cell [M], transmittance [M], weight [M]."""
        self.weight.scatter_reduce_(0, cells, weights, "amax")
        looked = cells[seen > _SEEN]
        self.looks.index_add_(0, looked, torch.ones(len(looked)))

    def prune(self) -> float:
        """Empties what was looked at and added nothing; returns the part of the cells left."""
        shape = self.occupied.shape
        weight = self.weight.numpy().reshape(shape)
        looks = self.looks.numpy().reshape(shape)
        filled = weight >= _LEAST_WEIGHT
        for cells in filled:  # a neighbour may be what a surface moves into
            ndimage.binary_dilation(cells, output=cells)
        self.occupied &= filled | (looks < _LOOKS)
        self.weight *= _FORGET
        self.looks *= _FORGET
        self._refresh()
        return float(self.occupied.mean())
