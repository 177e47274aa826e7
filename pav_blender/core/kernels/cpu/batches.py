"""What training asks of all samples of a batch at once: where they lie, and what was seen there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numba import njit

from ...cores import threads
from ..structures import Clearance, Seen
from .search import OPTIONS
from .threads import run_chunks

_CHUNK = 256  # rays a thread takes at a time
_STRIPE = 6  # cells that follow one another go to one thread, 2^6 at a time


class Gathered(NamedTuple):
    """N samples sorted by ray: ray [N] int32; t and width [N], metres: where each is and how much
    of the ray it stands for; canonical and still [N, 3] in the unit box (`field.Samples`); cells
    [N] int64, flat indices into the occupancy [A, G, G, G]."""

    ray: torch.Tensor
    t: torch.Tensor
    width: torch.Tensor
    triangle: torch.Tensor
    barycentric: torch.Tensor
    canonical: torch.Tensor
    still: torch.Tensor
    distance: torch.Tensor
    frame: torch.Tensor
    appearance: torch.Tensor
    cells: torch.Tensor


def gather(frames: list[Seen], step: float, space: Clearance) -> Gathered:
    """The samples of all frames' rays, one frame after the other."""
    ends = np.cumsum(np.concatenate([seen.picks.count.numpy() for seen in frames]), dtype=np.int64)
    starts = np.concatenate([[0], ends])
    count, whole = int(starts[-1]), torch.int32
    out = Gathered(
        torch.empty(count, dtype=whole),
        torch.empty(count),
        torch.empty(count),
        torch.empty(count, dtype=whole),
        torch.empty(count, 3),
        torch.empty(count, 3),
        torch.empty(count, 3),
        torch.empty(count),
        torch.empty(count, dtype=whole),
        torch.empty(count, dtype=whole),
        torch.empty(count, dtype=torch.int64),
    )
    size, corner, scale = len(space.grid), space.box_min.numpy(), np.float32(space.box_scale)
    arrays = tuple(values.numpy() for values in out)
    first = 0
    for frame, seen in enumerate(frames):
        rays, picks = len(seen.jitter), seen.picks
        own = starts[first : first + rays]
        picked = picks.k, picks.steps, picks.triangle, picks.barycentric, picks.canonical
        lying = seen.jitter, seen.origins, seen.directions
        run_chunks(
            _gather,
            rays,
            _CHUNK,
            first,
            frame,
            seen.appearance,
            own,
            picks.count.numpy(),
            *(values.numpy() for values in (*picked, picks.distance, *lying)),
            np.ascontiguousarray(seen.shoulders, np.float32),
            np.ascontiguousarray(seen.offset, np.float32),
            np.float32(step),
            size,
            corner,
            scale,
            arrays,
        )
        first += rays
    return out


@njit(**OPTIONS)
def _gather(begin, stop, first, frame, appearance, starts, count, k, steps, triangle, barycentric,
            canonical, distance, jitter, origins, directions, shoulders, offset, step, size, corner,
            scale, out):  # fmt: skip
    (ray_out, t_out, width_out, triangle_out, barycentric_out, canonical_out, still_out,
     distance_out, frame_out, appearance_out, cells_out) = out  # fmt: skip
    cells = np.float32(size)
    for ray in range(begin, stop):
        for slot in range(count[ray]):
            to = starts[ray] + slot
            t = (np.float32(k[ray, slot]) + jitter[ray]) * step
            ray_out[to] = first + ray
            t_out[to] = t
            width_out[to] = np.float32(steps[ray, slot]) * step
            triangle_out[to] = triangle[ray, slot]
            distance_out[to] = distance[ray, slot]
            frame_out[to] = frame
            appearance_out[to] = appearance
            x = origins[ray, 0] + t * directions[ray, 0]
            y = origins[ray, 1] + t * directions[ray, 1]
            z = origins[ray, 2] + t * directions[ray, 2]
            cell = np.int64(appearance)
            for axis in range(3):
                barycentric_out[to, axis] = barycentric[ray, slot, axis]
                unit = (canonical[ray, slot, axis] - corner[axis]) * scale
                canonical_out[to, axis] = unit
                cell = cell * size + min(max(np.int64(unit * cells), 0), size - 1)
                carried = x * shoulders[0, axis] + y * shoulders[1, axis] + z * shoulders[2, axis]
                still_out[to, axis] = (carried + offset[axis] - corner[axis]) * scale
            cells_out[to] = cell


def watch(
    weight: torch.Tensor,
    looks: torch.Tensor,
    cells: torch.Tensor,
    density: torch.Tensor,
    weights: torch.Tensor,
    width: torch.Tensor,
    seen: float,
) -> None:
    """Raises `weight` of cells to the most that a sample adds to a millimetre of its ray, counts in
    `looks` the samples that something of the ray's light reaches (the part `seen`); both flat, in
    place. Samples [N]: cells int64, density (1/m), weight in the pixel, width (metres)."""
    parts = 1 << (threads().bit_length() - 1)
    arrays = [values.numpy() for values in (weight, looks, cells, density, weights, width)]
    run_chunks(_watch, parts, 1, parts, *arrays, np.float32(seen))


@njit(**OPTIONS)
def _watch(first, end, parts, weight, looks, cells, density, weights, width, least):
    for part in range(first, end):
        for i in range(len(cells)):
            cell = cells[i]
            if (cell >> _STRIPE) & (parts - 1) != part:
                continue
            # at the sample itself, from the weight: T = w / alpha
            # in double precision 1 - exp is as good as expm1, at half the price
            alpha = 1.0 - np.exp(-np.float64(density[i]) * width[i])
            if alpha <= 1e-6 or weights[i] > least * alpha:
                looks[cell] += np.float32(1)
            weight[cell] = max(weight[cell], weights[i] / (np.float32(1e3) * width[i]))
