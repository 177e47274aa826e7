"""The samples that training takes: few along a ray, and each where it teaches something.

A guide, the density that the field had of late in every canonical cell, tells what each place
along a ray would add to its pixel. Places that follow one another are taken together until they
add enough, and one of them, drawn at random, stands for all: thin fog is stepped through
coarsely, a surface finely, and no network runs to find that out.
"""

from __future__ import annotations

import math

import torch

from ..structures import Clearance, Picks, PosedMesh
from .marching import march

LOOKS = 96  # places that are looked at on a ray, at most
WIDTH = 48  # samples a ray, at most
SHARE = 0.05  # of a pixel that places taken together may add
LONGEST = 3  # places taken together, at most
OPAQUE = 8.0  # optical depth at which a ray ends
LEAST = 1e-4  # density (1/m) that the guide calls empty
RISE, FALL = 0.15, 0.5  # parts of the way that one sample moves the guide
_GOLDEN = 0.6180339887


def pick(
    mesh: PosedMesh,
    origins: torch.Tensor,
    directions: torch.Tensor,
    first: torch.Tensor,
    last: torch.Tensor,
    jitter: torch.Tensor,
    random: torch.Tensor,
    step: float,
    *,
    clearance: Clearance,
    guide: torch.Tensor,
    shell: Clearance | None = None,
    band: float = math.inf,
    leap_limit: float = 0.004,
) -> Picks:
    """Samples among the places that `march` finds, by the guide [G, G, G] float32 (1/m).

    random [R] in [0, 1) decides which place of those taken together is the sample. Together the
    samples stand for every place up to where the guide is opaque.
    """
    wave = march(
        mesh, origins, directions, first, last, jitter, step,
        wave=LOOKS, clearance=clearance, shell=shell, band=band, leap_limit=leap_limit,
    )  # fmt: skip
    size = clearance.grid.shape[0]
    cell = torch.floor((wave.canonical - clearance.box_min) * (clearance.box_scale * size))
    x, y, z = cell.long().clamp(0, size - 1).unbind(-1)
    optical = guide.to(wave.canonical)[x, y, z] * step
    rays = len(origins)
    slots = torch.zeros((rays, WIDTH), dtype=torch.int64)
    steps = torch.zeros((rays, WIDTH), dtype=torch.int32)
    count, looks = (torch.zeros(rays, dtype=torch.int32) for _ in range(2))
    ended = torch.zeros(rays, dtype=torch.bool)
    for ray in range(rays):
        k = wave.k[ray, : wave.count[ray]].tolist()
        taken = _groups(k, optical[ray].tolist(), float(random[ray]))
        looks[ray], groups = taken
        count[ray] = len(groups)
        more = int(wave.next[ray]) <= int(last[ray]) or looks[ray] < wave.count[ray]
        ended[ray] = more or sum(length for _, length in groups) < looks[ray]
        for slot, (place, length) in enumerate(groups):
            slots[ray, slot], steps[ray, slot] = place, length
    slots = slots.to(wave.k.device)
    row = torch.arange(rays, device=slots.device)[:, None]
    kept = (wave.k, wave.triangle, wave.barycentric, wave.canonical, wave.distance)
    k_out, *others = (values[row, slots] for values in kept)
    return Picks(count, looks, ended, k_out, steps, *others)


def _groups(k: list[int], optical: list[float], chance: float) -> tuple[int, list[tuple[int, int]]]:
    """Places looked at on one ray, and its samples: (place, how many it stands for)."""
    passed, looks = 0.0, 0
    while looks < len(k) and passed <= OPAQUE:
        passed += optical[looks]
        looks += 1
    found: list[tuple[int, int]] = []
    place, left = 0, 1.0
    while place < looks and len(found) < WIDTH:
        added = left * -math.expm1(-optical[place])
        length = 1
        while length < LONGEST and place + length < looks:
            if k[place + length] != k[place] + length:
                break  # a gap
            more = (left - added) * -math.expm1(-optical[place + length])
            if added + more > SHARE:
                break
            added, length = added + more, length + 1
        left -= added
        found.append((place + min(int(chance * length), length - 1), length))
        chance = (chance + _GOLDEN) % 1.0
        place += length
    return looks, found


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
