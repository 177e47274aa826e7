"""Rays of one posed mesh, and the samples along them as the field takes them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch

from ..deformation import Clearance
from ..deformation.rigid import Stance
from ..field.field import Samples
from ..kernels.structures import Picks, Wave
from .cameras import Camera

_BLOCK = 64  # pixels a side of the squares that a picture is taken in, one after the other
TILE = 4  # rays go together in squares of pixels: neighbours share triangles and cache lines


@dataclass(eq=False)
class RayBatch:
    """R rays: origins, directions [R, 3] (unit), cosine [R] (camera depth = t * cosine), end [R]:
    metres along each after which nothing is seen, None for no end; start: metres from the camera to
    the origins, that a depth begins with; begin [R]: metres along each before which nothing is, as
    far as known."""

    origins: torch.Tensor
    directions: torch.Tensor
    cosine: torch.Tensor
    end: torch.Tensor | None = None
    start: float = 0.0
    begin: torch.Tensor | None = None

    def __len__(self) -> int:
        return len(self.cosine)

    def to(self, device: torch.device) -> RayBatch:
        return self._each(lambda values: values.to(device))

    def pick(self, rows: torch.Tensor) -> RayBatch:
        return self._each(lambda values: values[rows])

    def _each(self, change: Callable[[torch.Tensor], torch.Tensor]) -> RayBatch:
        begin, end = (None if t is None else change(t) for t in (self.begin, self.end))
        changed = change(self.origins), change(self.directions), change(self.cosine)
        return RayBatch(*changed, end, self.start, begin)

    def within(self, begin: np.ndarray, end: np.ndarray) -> RayBatch:
        """The same rays where anything is only between these metres [R] along each."""
        last = torch.from_numpy(end)
        last = last if self.end is None else torch.minimum(self.end, last)
        return replace(self, begin=torch.from_numpy(begin), end=last)


def camera_rays(
    camera: Camera,
    columns: np.ndarray,
    rows: np.ndarray,
    limit: np.ndarray | None = None,
    start: float = 0.0,
) -> RayBatch:
    """Rays through the centres of pixels (columns [R], rows [R]); limit [R]: how far they see,
    metres along the camera's axis; start: metres before which there is nothing to see."""
    origins, directions, cosine = (torch.from_numpy(a) for a in camera.rays(columns, rows, start))
    end = None
    if limit is not None:
        end = torch.from_numpy(np.asarray(limit, np.float32)) / cosine - start
    return RayBatch(origins, directions, cosine, end, start)


def tiled(width: int, height: int) -> np.ndarray:
    """Pixels [width * height] (row * width + column), so that any run of neighbours in the order
    covers a square as far as it can: what lies together is searched and read together."""
    inner_row, inner_column = _curve(_BLOCK)
    rows = np.arange(-(-height // _BLOCK))[:, None, None] * _BLOCK + inner_row
    columns = np.arange(-(-width // _BLOCK))[None, :, None] * _BLOCK + inner_column
    inside = (rows < height) & (columns < width)
    return (rows * width + columns)[inside]


@lru_cache(maxsize=1)
def _curve(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of a square of pixels in the order of Morton's curve."""
    at = np.arange(side * side)
    row, column = np.zeros_like(at), np.zeros_like(at)
    for bit in range(side.bit_length() - 1):
        column |= (at >> 2 * bit & 1) << bit
        row |= (at >> 2 * bit + 1 & 1) << bit
    return row, column


@dataclass(eq=False)
class Packed:
    """The samples of a wave, flat: ray [N] int32 (sorted), t [N] metres, where each lies."""

    ray: torch.Tensor
    t: torch.Tensor
    triangle: torch.Tensor
    barycentric: torch.Tensor
    canonical: torch.Tensor
    distance: torch.Tensor

    def __len__(self) -> int:
        return len(self.ray)


def pack(wave: Wave | Picks, jitter: torch.Tensor, step: float) -> tuple[Packed, torch.Tensor]:
    """The used slots of a wave or of picks, and which they are (flat)."""
    width = wave.k.shape[1]
    used = torch.arange(width)[None, :] < wave.count[:, None]
    slots = used.reshape(-1).nonzero()[:, 0]
    ray = torch.div(slots, width, rounding_mode="floor")
    t = (wave.k.reshape(-1)[slots].float() + jitter[ray]) * step
    packed = Packed(
        ray.int(),
        t,
        wave.triangle.reshape(-1)[slots],
        wave.barycentric.reshape(-1, 3)[slots],
        wave.canonical.reshape(-1, 3)[slots],
        wave.distance.reshape(-1)[slots],
    )
    return packed, slots


def still_of(packed: Packed, clearance: Clearance, rays: RayBatch, stance: Stance) -> torch.Tensor:
    """Where samples [N, 3] lie in the unit box if the shoulders carry them."""
    ray = packed.ray.long()
    points = rays.origins[ray] + packed.t[:, None] * rays.directions[ray]
    return (stance.still(points) - clearance.box_min) * clearance.box_scale


def samples_of(
    packed: Packed,
    clearance: Clearance,
    appearance: int,
    condition: torch.Tensor,
    rays: RayBatch,
    stance: Stance,
) -> Samples:
    """What the field needs for samples of one frame; condition [E] as `field.condition` made it."""
    count = len(packed)
    turned = rays.directions @ torch.from_numpy(stance.rotation)
    return Samples(
        canonical=(packed.canonical - clearance.box_min) * clearance.box_scale,
        still=still_of(packed, clearance, rays, stance),
        triangle=packed.triangle,
        barycentric=packed.barycentric,
        distance=packed.distance,
        appearance=torch.full((count,), appearance, dtype=torch.int32),
        frame=torch.zeros(count, dtype=torch.int32),
        ray=packed.ray,
        condition=condition[None],
        direction=turned,
    )
