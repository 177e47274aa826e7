"""The paper's losses (Optimization), colour and depth, and one against fog; means over rays."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from .. import kernels
from ..config import Config
from .batches import Pixels


@dataclass(frozen=True)
class Loss:
    """total is what is minimised; mse is the plain colour error, squared [R, 3] each ray's."""

    total: torch.Tensor
    mse: float
    depth: float
    squared: torch.Tensor


def losses(
    config: Config,
    pixels: Pixels,
    background: torch.Tensor,
    colour: torch.Tensor,
    opacity: torch.Tensor,
    depth: torch.Tensor,
    counted: torch.Tensor,
) -> Loss:
    """Predicted premultiplied colour [R, 3], opacity [R], ray termination [R] (sum of w t);
    counted [R] bool: the rays that take part.

    Prediction and target stand before the same random background [R, 3], so that the mattes
    teach where the avatar ends.
    """
    alpha = pixels.alpha[:, None]
    target = pixels.colour * alpha + background * (1 - alpha)
    shown = colour + background * (1 - opacity[:, None])
    squared = torch.where(counted[:, None], (shown - target).square(), 0.0)
    mse = squared.sum() / (3 * counted.sum().clamp(min=1))
    face = (pixels.depth > 0) & counted
    gap = torch.where(face, (depth * pixels.rays.cosine - pixels.depth).abs(), 0.0).mean()
    total = config.colour_weight * mse + config.depth_weight * gap
    return Loss(total, float(mse.detach()), float(gap.detach()), squared.detach())


def distortion(
    weights: torch.Tensor, t: torch.Tensor, ray: torch.Tensor, rays: int
) -> torch.Tensor:
    """How far apart along a ray its weights lie, metres: the mean over rays of the sum over pairs
    of w_i w_j |t_i - t_j| (Mip-NeRF 360, Eq. 15, without the term within a sample).

    weights, t, ray [N], sorted by ray and along it. Fog spreads a ray's weight: without fog fewer
    samples show the same.
    """
    compiled = getattr(kernels.select(weights.device), "compositing", None)
    if compiled is not None and weights.dtype == torch.float32 and not t.requires_grad:
        return compiled.distortion(weights, t, ray, rays)
    index = ray.long()
    counts = torch.bincount(index, minlength=rays)
    place = torch.arange(len(index), device=ray.device)
    place = place - (torch.cumsum(counts, 0) - counts)[index]
    shape = (rays, int(counts.max()) if len(index) else 0)
    w = weights.new_zeros(shape).index_put((index, place), weights)
    at = t.new_zeros(shape).index_put((index, place), t)
    before, moment = torch.cumsum(w, 1) - w, torch.cumsum(w * at, 1) - w * at
    return 2 * (w * (at * before - moment)).sum() / max(rays, 1)
