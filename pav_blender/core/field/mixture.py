"""Several appearances worn at once, each by a share that may differ from place to place.

The shares mix log-densities, so that what one appearance lacks fades evenly. Below EMPTY there is
nothing to see and above SOLID nothing to see through, so only what lies between is mixed at first,
else hair would stay opaque until its share is next to none; what is beyond SOLID counts where all
that is worn is as good as solid. Colours mix by shares and by how opaque a
millimetre or two of each appearance is there. To mix latent features instead shows colours that
nothing was trained on wherever appearances differ in shape.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from .field import Field, Samples, Worn

EMPTY, SOLID = 3e-3, 0.1  # a millimetre
FIRMNESS = 8  # the power of how solid a place is by which densities beyond SOLID count there
THICK = 2.0  # millimetres whose opacity says how much of the colour is an appearance's


@dataclass(frozen=True, eq=False)
class Mixture:
    """shares [K, S, S, S], none negative, sum 1: values in the middles of the cells of the unit
    box (S may be 1: the same everywhere); filled [K, G, G, G] bool, where each appearance is."""

    shares: torch.Tensor
    filled: torch.Tensor


def at_samples(mixture: Mixture, canonical: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Shares [N, K] at places [N, 3] of the unit box, and which appearances are there, bool."""
    size = mixture.filled.shape[-1]
    x, y, z = (canonical * size).long().clamp(0, size - 1).unbind(1)
    # grid_sample counts axes backwards, and the unit box from -1 to 1
    places = (2 * canonical - 1).flip(1)[None, :, None, None]
    shares = torch.nn.functional.grid_sample(
        mixture.shares[None], places.to(mixture.shares), padding_mode="border", align_corners=False
    )
    return shares[0, :, :, 0, 0].T, mixture.filled[:, x, y, z].T


def mix(shares: torch.Tensor, densities: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Shares and densities a millimetre [N, K] -> density [N], and each appearance's part [N, K]
    in the colour."""
    above = (densities / EMPTY).clamp(min=1).log()
    range_ = math.log(SOLID / EMPTY)
    fading = (shares * above.clamp(max=range_)).sum(1)
    beyond = (shares * (above - range_).clamp(min=0)).sum(1)
    mixed = EMPTY * torch.expm1(fading + (fading / range_) ** FIRMNESS * beyond)
    parts = shares * -torch.expm1(-densities * THICK)
    parts = parts / parts.sum(1, keepdim=True).clamp(min=1e-12)
    return mixed, parts


def geometry(
    field: Field, mixture: Mixture, worn: Worn, samples: Samples
) -> tuple[torch.Tensor, torch.Tensor, list[torch.Tensor]]:
    """Density [N] per metre; each appearance's part in the colour [N, K], and what its colour
    depends on besides the view, K times [N, C]; `worn` holds the K appearances."""
    encoded = field.encode(samples)
    shares, filled = at_samples(mixture, samples.canonical)
    densities, inputs = [], []
    for row in range(len(mixture.filled)):
        one = replace(samples, appearance=torch.full_like(samples.appearance, row))
        density, seen = field.geometry(one, worn, encoded)
        densities.append(density * 1e-3)
        inputs.append(seen)
    density, parts = mix(shares, torch.where(filled, torch.stack(densities, 1), 0))
    return density * 1e3, parts, inputs
