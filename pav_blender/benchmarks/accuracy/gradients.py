"""Gradients of the whole chain, compiled in float32 against plain torch in float64.

The chain is the training's: encoding, embedding, networks, compositing, losses, on the samples that
a training would draw. Both see the same samples.

A gradient jumps where a unit's input passes 0, the log-density its limit, or a ray's depth what was
asked of it. A sample so near to such a place that rounding puts float32 on one side and float64 on
the other has two right answers, and one such sample can move a gradient by far more than rounding
does. Those few are counted (`decided`), must be as near as rounding goes, and are left out.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import nn

from ...core import kernels
from ...core.deformation import Deformer
from ...core.evaluation.report import Claim
from ...core.field.avatar import Avatar
from ...core.field.field import Field, Mlp
from ...core.field.identities import codes
from ...core.training.batches import Picked, Pixels, Poses, draw_pixels, pick_samples
from ...core.training.frames import Frame
from ...core.training.losses import distortion, losses
from ...core.training.occupancy import Visibility

_RAYS = 512
# A gradient is a sum over some thousand samples of products of rounded numbers, each off by a few
# times 6e-8.
BOUND = 1e-4
# What decides is a sum of 36 to 64 products, rounded once each at worst, all the same way
# (`rounding.networks`), in a chain of three networks of two layers: how far off, of the largest.
NEAR = 6 * 100 * 2**-24
# A batch has about a million units; their inputs are off by a few millionths of their spread. In a
# smaller one a few are.
SIDES, _FEW = 1e-5, 3
GROUPS = {
    "hash tables": "tables",
    "tables of the shoulders": "still_tables",
    "latent features": "latent",
    "codes": "code",
    "density network": "density.",
    "offset network": "offset.",
    "colour network": "colour.",
}


def measure(avatar: Avatar, frame: Frame, rays: int = _RAYS) -> tuple[Any, list[Claim]]:
    """ "gradients": a row a group of parameters, relative error of its gradient and each other's
    largest; "sides": a row a kind of decision, how many fall otherwise and how near."""
    pixels, picked = _batch(avatar, frame, rays)
    double = copy.deepcopy(avatar.field).double()

    def both(ask: Callable[..., Any], *rest: Any) -> tuple[Any, Any]:
        ours = ask(avatar, avatar.field, pixels, picked, torch.float32, *rest)
        with kernels.plain_torch():
            return ours, ask(avatar, double, pixels, picked, torch.float64, *rest)

    sides, kept = compared(*both(decided))
    picked = chosen(picked, kept)
    rays_sides, counted = compared(*both(gaps))
    ours, exact = both(gradients, counted)
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
    sides += rays_sides
    return {"gradients": rows, "sides": sides}, _claims(rows, sides)


def _claims(rows: list[dict[str, Any]], sides: list[dict[str, Any]]) -> list[Claim]:
    claims = [
        Claim.at_most(
            f"gradient of {r['gradient of']}: relative", r["relative error"] * 1e6, BOUND * 1e6,
            "1e-6"
        )
        for r in rows
    ]  # fmt: skip
    numbers = sum(r["numbers"] for r in sides)
    other, most = sum(r["on the other side"] for r in sides) / numbers, max(SIDES, _FEW / numbers)
    farthest = max(r["farthest, of the largest"] for r in sides)
    return [
        *claims,
        Claim.at_most("decisions that rounding turns", other * 1e6, most * 1e6, "1e-6"),
        Claim.at_most("how near those are", farthest * 1e6, NEAR * 1e6, "1e-6 of the largest"),
    ]


def _batch(avatar: Avatar, frame: Frame, rays: int) -> tuple[Pixels, Picked]:
    """Pixels of a frame and their samples; the avatar's occupancy stays as it is."""
    held = replace(avatar, occupied=avatar.occupied.copy())
    deformer = Deformer(avatar.canonical_vertices, avatar.triangles, avatar.config.frames)
    pixels = draw_pixels([frame], rays, np.random.default_rng(0))
    poses = Poses(deformer, avatar.canonical_vertices, avatar.rigid_weights)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        visibility = Visibility(held, deformer)
        rest = avatar.config, avatar.config.step, generator, codes(avatar)
        return pixels, pick_samples(poses, pixels, visibility, *rest)


def compared(
    ours: dict[str, torch.Tensor], exact: dict[str, torch.Tensor]
) -> tuple[list[dict[str, Any]], torch.Tensor]:
    """Numbers [N, units] of which the sign decides, by kind: a row a kind, and the N [N] of which
    all fall alike."""
    rows, alike = [], torch.ones(len(next(iter(exact.values()))), dtype=torch.bool)
    for kind, right in exact.items():
        other = (ours[kind] > 0) != (right > 0)
        alike &= ~other.any(1)
        farthest = right[other].abs().max() / right.abs().max() if bool(other.any()) else 0.0
        rows.append(
            {
                "decision": kind,
                "numbers": right.numel(),
                "on the other side": int(other.sum()),
                "farthest, of the largest": float(farthest),
            }
        )
    return rows, alike


def decided(
    avatar: Avatar, field: Field, pixels: Pixels, picked: Picked, kind: torch.dtype
) -> dict[str, torch.Tensor]:
    """What goes into each ReLU [N, units], and the log-density above its limit [N, 1]."""
    del avatar, pixels
    found: dict[str, torch.Tensor] = {}
    outputs: dict[str, torch.Tensor] = {}
    ops = kernels.select("cpu").mlp

    def watch(name: str, network: Mlp) -> Callable[..., None]:
        def hook(_module: nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor):
            x, constant, group = inputs
            weights, biases = list(network.weights), list(network.biases)
            bias = constant @ network.group_weight.T
            hidden = range(1, len(weights))
            cut = [ops.mlp(x, weights[:n], biases[:n], bias, group) for n in hidden]
            found[f"units of the {name} network"] = torch.cat(cut, 1)
            outputs[name] = output

        return hook

    networks = {"density": field.density, "offset": field.offset, "colour": field.colour}
    hooks = [n.register_forward_hook(watch(k, n)) for k, n in networks.items() if n is not None]
    samples = in_kind(picked.samples, kind)
    try:
        with torch.no_grad():  # one network after the other, as training's one pass has them
            _, inputs = field.geometry(samples)
            field.shade(inputs, samples.direction, samples.ray)
    finally:
        for hook in hooks:
            hook.remove()
    log_density = field.untrained(samples.distance) + sum(
        outputs[name][:, 0] for name in ("density", "offset") if name in outputs
    )
    found["limit of the density"] = (log_density - field.config.log_density_limit)[:, None]
    return found


def gaps(
    avatar: Avatar, field: Field, pixels: Pixels, picked: Picked, kind: torch.dtype
) -> dict[str, torch.Tensor]:
    """Depths of rays less what was asked of them [R, 1], of which the loss takes the absolute."""
    del avatar
    with torch.no_grad():
        _, _, depth, _ = _shown(field, in_kind(picked, kind), len(pixels.rays))
    pixels = in_kind(pixels, kind)
    gap = depth * pixels.rays.cosine - pixels.depth
    return {"depth of a ray": torch.where(pixels.depth > 0, gap, 0.0)[:, None]}


def chosen(picked: Picked, kept: torch.Tensor) -> Picked:
    """Those of the samples [N] that are `kept` [N]."""
    names = (
        "canonical", "still", "triangle", "barycentric", "distance", "appearance", "frame", "ray"
    )  # fmt: skip
    samples = replace(picked.samples, **{n: getattr(picked.samples, n)[kept] for n in names})
    own = {n: getattr(picked, n)[kept] for n in ("t", "width", "cells")}
    return replace(picked, samples=samples, **own)


def in_kind(values: Any, kind: torch.dtype) -> Any:
    """A dataclass with its floating-point tensors, and those of dataclasses in it, in `kind`."""
    found = {}
    for f in fields(values):
        value = getattr(values, f.name)
        if is_dataclass(value):
            found[f.name] = in_kind(value, kind)
        elif torch.is_tensor(value) and value.is_floating_point():
            found[f.name] = value.to(kind)
    return replace(values, **found)


def _shown(field: Field, picked: Picked, rays: int) -> tuple[torch.Tensor, ...]:
    """Premultiplied colours, opacities and depths of rays, and weights of samples."""
    sigma, rgb = field(picked.samples)
    composite = kernels.select("cpu").marching.composite
    return composite(sigma, rgb, picked.t, picked.width, picked.samples.ray, rays)


def gradients(
    avatar: Avatar,
    field: Field,
    pixels: Pixels,
    picked: Picked,
    kind: torch.dtype,
    counted: torch.Tensor,
) -> dict[str, torch.Tensor]:
    """By parameter, of the loss of a batch computed in `kind`; counted [R]: rays that count."""
    count = len(pixels.rays)
    picked, pixels = in_kind(picked, kind), in_kind(pixels, kind)
    background = torch.rand(count, 3, generator=torch.Generator().manual_seed(1)).to(kind)
    field.requires_grad_(True)
    field.zero_grad()
    colour, opacity, depth, weights = _shown(field, picked, count)
    loss = losses(avatar.config, pixels, background, colour, opacity, depth, counted).total
    spread = distortion(weights, picked.t, picked.samples.ray, count)
    (loss + avatar.config.distortion_weight * spread).backward()
    found = {n: p.grad.clone() for n, p in field.named_parameters() if p.grad is not None}
    field.zero_grad()
    return found
