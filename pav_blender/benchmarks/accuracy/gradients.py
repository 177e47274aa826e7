"""Gradients of the whole chain, compiled in float32 against plain torch in float64.

The chain is the training's: encoding, embedding, networks, compositing, losses, on the samples that
a training would draw. Both see the same samples.
"""

from __future__ import annotations

import copy
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch

from ...core import kernels
from ...core.deformation import Deformer
from ...core.evaluation.report import Claim
from ...core.field.avatar import Avatar
from ...core.field.field import Field
from ...core.training.batches import Picked, Pixels, Poses, draw_pixels, pick_samples
from ...core.training.frames import Frame
from ...core.training.losses import distortion, losses
from ...core.training.occupancy import Visibility

_RAYS = 512
# A gradient is a sum over some thousand samples of products of rounded numbers, each off by a few
# times 6e-8, and a sample whose ReLU input is within rounding of 0 may fall on its other side.
BOUND = 1e-4
GROUPS = {
    "hash tables": "tables",
    "tables of the shoulders": "still_tables",
    "latent features": "latent",
    "codes": "code",
    "density network": "density.",
    "offset network": "offset.",
    "colour network": "colour.",
}


def measure(avatar: Avatar, frame: Frame, rays: int = _RAYS) -> tuple[list[dict], list[Claim]]:
    """A row a group of parameters: relative error of its gradient, and each other's largest."""
    pixels, picked = _batch(avatar, frame, rays)
    ours = gradients(avatar, avatar.field, pixels, picked, torch.float32)
    with kernels.plain_torch():
        double = copy.deepcopy(avatar.field).double()
        exact = gradients(avatar, double, pixels, picked, torch.float64)
    rows: list[dict[str, Any]] = []
    for group, prefix in GROUPS.items():
        names = [n for n in exact if n == prefix or (prefix[-1] == "." and n.startswith(prefix))]
        if not names:
            continue
        a, b = (torch.cat([g[n].double().reshape(-1) for n in names]) for g in (ours, exact))
        largest = float(b.abs().max())
        rows.append(
            {
                "gradient of": group,
                "numbers": len(b),
                "not 0": int((b != 0).sum()),
                "relative error": float((a - b).norm() / b.norm()),
                "largest, of the largest": float((a - b).abs().max()) / largest,
            }
        )
    return rows, [
        Claim.at_most(
            f"gradient of {r['gradient of']}: relative", r["relative error"] * 1e6, BOUND * 1e6,
            "1e-6"
        )
        for r in rows
    ]  # fmt: skip


def _batch(avatar: Avatar, frame: Frame, rays: int) -> tuple[Pixels, Picked]:
    """Pixels of a frame and their samples; the avatar's occupancy stays as it is."""
    held = replace(avatar, occupied=avatar.occupied.copy())
    deformer = Deformer(avatar.canonical_vertices, avatar.triangles, avatar.config.frames)
    pixels = draw_pixels([frame], rays, np.random.default_rng(0))
    poses = Poses(deformer, avatar.canonical_vertices, avatar.rigid_weights)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        visibility = Visibility(held, deformer)
        step = avatar.config.step
        return pixels, pick_samples(poses, pixels, visibility, avatar.config, step, generator)


def gradients(
    avatar: Avatar, field: Field, pixels: Pixels, picked: Picked, kind: torch.dtype
) -> dict[str, torch.Tensor]:
    """By parameter, of the loss of a batch computed in `kind`."""

    def wide(value: Any) -> Any:
        return value.to(kind) if torch.is_tensor(value) and value.is_floating_point() else value

    samples = picked.samples
    samples = replace(samples, **{f.name: wide(getattr(samples, f.name)) for f in fields(samples)})
    pixels = replace(
        pixels,
        rays=pixels.rays._each(wide),
        **{name: wide(getattr(pixels, name)) for name in ("colour", "alpha", "depth")},
    )
    count = len(pixels.rays)
    background = torch.rand(count, 3, generator=torch.Generator().manual_seed(1)).to(kind)
    field.requires_grad_(True)
    field.zero_grad()
    sigma, rgb = field(samples)
    t = wide(picked.t)
    colour, opacity, depth, weights = kernels.select("cpu").marching.composite(
        sigma, rgb, t, wide(picked.width), samples.ray, count
    )
    counted = torch.ones(count, dtype=torch.bool)
    loss = losses(avatar.config, pixels, background, colour, opacity, depth, counted).total
    spread = distortion(weights, t, samples.ray, count)
    (loss + avatar.config.distortion_weight * spread).backward()
    found = {n: p.grad.clone() for n, p in field.named_parameters() if p.grad is not None}
    field.zero_grad()
    return found
