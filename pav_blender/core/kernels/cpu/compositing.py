"""Compositing along rays, one pass forwards and one backwards (used through `marching.py`)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit

from .search import OPTIONS
from .threads import run_chunks

_CHUNK = 1024  # rays a thread takes at a time


@njit(**OPTIONS)
def _offsets(ray_index, rays):
    """Where each ray's samples begin, [R + 1]; -1 first when the index is unsorted or outside."""
    offsets = np.zeros(rays + 1, np.int64)
    previous = 0
    for i in range(len(ray_index)):
        ray = ray_index[i]
        if ray < previous or ray >= rays:
            offsets[0] = -1
            return offsets
        previous = ray
        offsets[ray + 1] += 1
    for ray in range(rays):
        offsets[ray + 1] += offsets[ray]
    return offsets


@njit(**OPTIONS)
def _weigh(start, stop, offsets, sigma, delta, transmittance, weights):
    """Writes the weights of the rays' samples and lowers what the rays have left."""
    one_delta = len(delta) == 1
    for ray in range(start, stop):
        left = np.float64(transmittance[ray])
        for i in range(offsets[ray], offsets[ray + 1]):
            # in double precision 1 - exp is as good as expm1, at half the price
            passes = np.exp(-np.float64(sigma[i]) * delta[0 if one_delta else i])
            weights[i] = left * (1.0 - passes)
            left *= passes
        transmittance[ray] = left


@njit(**OPTIONS)
def _forward(start, stop, offsets, sigma, rgb, t, delta, left, colour, opacity, depth, weights):
    _weigh(start, stop, offsets, sigma, delta, left, weights)
    for ray in range(start, stop):
        red = green = blue = alpha = far = 0.0
        for i in range(offsets[ray], offsets[ray + 1]):
            weight = np.float64(weights[i])
            red += weight * rgb[i, 0]
            green += weight * rgb[i, 1]
            blue += weight * rgb[i, 2]
            alpha += weight
            far += weight * t[i]
        colour[ray, 0], colour[ray, 1], colour[ray, 2] = red, green, blue
        opacity[ray] = alpha
        depth[ray] = far


@njit(**OPTIONS)
def _backward(
    start,
    stop,
    offsets,
    sigma,
    rgb,
    t,
    delta,
    weights,
    grad_colour,
    grad_opacity,
    grad_depth,
    grad_weights,
    grad_sigma,
    grad_rgb,
    grad_t,
):
    """With q_i the gradient of w_i: d/d(optical_i) = T_{i+1} q_i - sum_{j>i} w_j q_j.

    No division: exact where a sample is opaque or a ray has nothing left.
    """
    one_delta = len(delta) == 1
    for ray in range(start, stop):
        first, last = offsets[ray], offsets[ray + 1]
        if first == last:
            continue
        r, g, b = grad_colour[ray, 0], grad_colour[ray, 1], grad_colour[ray, 2]
        total = 0.0
        for i in range(first, last):
            q = r * rgb[i, 0] + g * rgb[i, 1] + b * rgb[i, 2] + grad_opacity[ray]
            q += grad_depth[ray] * t[i] + grad_weights[i]
            total += np.float64(weights[i]) * q
        left = 1.0
        for i in range(first, last):
            width = delta[0 if one_delta else i]
            q = r * rgb[i, 0] + g * rgb[i, 1] + b * rgb[i, 2] + grad_opacity[ray]
            q += grad_depth[ray] * t[i] + grad_weights[i]
            weight = np.float64(weights[i])
            left *= np.exp(-np.float64(sigma[i]) * width)
            total -= weight * q
            grad_sigma[i] = width * (left * q - total)
            grad_rgb[i, 0], grad_rgb[i, 1], grad_rgb[i, 2] = weight * r, weight * g, weight * b
            grad_t[i] = weight * grad_depth[ray]


def _array(values: torch.Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.detach().numpy(), np.float32)


def _widths(delta: float | torch.Tensor, count: int) -> np.ndarray:
    if isinstance(delta, torch.Tensor) and delta.ndim:
        # A lone sample's width is also "one for all": the same number either way.
        return _array(delta)
    return np.full(1, float(delta), np.float32)


def _starts(ray_index: torch.Tensor, rays: int) -> np.ndarray:
    offsets = _offsets(np.ascontiguousarray(ray_index.numpy()), rays)
    if offsets[0] < 0:
        raise ValueError(f"ray_index must be sorted and within 0..{rays - 1}")
    return offsets


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        sigma: torch.Tensor,
        rgb: torch.Tensor,
        t: torch.Tensor,
        delta: float | torch.Tensor,
        ray_index: torch.Tensor,
        rays: int,
    ) -> tuple[torch.Tensor, ...]:
        offsets, widths = _starts(ray_index, rays), _widths(delta, len(sigma))
        colour, opacity, depth = torch.zeros(rays, 3), torch.zeros(rays), torch.zeros(rays)
        weights = torch.empty(len(sigma))
        run_chunks(
            _forward,
            rays,
            _CHUNK,
            offsets,
            _array(sigma),
            _array(rgb),
            _array(t),
            widths,
            np.ones(rays, np.float32),
            colour.numpy(),
            opacity.numpy(),
            depth.numpy(),
            weights.numpy(),
        )
        ctx.save_for_backward(sigma, rgb, t, weights)
        ctx.offsets, ctx.widths = offsets, widths
        return colour, opacity, depth, weights

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        sigma, rgb, t, weights = ctx.saved_tensors
        grad_sigma, grad_rgb, grad_t = (
            torch.zeros(x.shape, dtype=torch.float32) for x in (sigma, rgb, t)
        )
        run_chunks(
            _backward,
            len(ctx.offsets) - 1,
            _CHUNK,
            ctx.offsets,
            _array(sigma),
            _array(rgb),
            _array(t),
            ctx.widths,
            _array(weights),
            *(_array(gradient) for gradient in gradients),
            grad_sigma.numpy(),
            grad_rgb.numpy(),
            grad_t.numpy(),
        )
        return grad_sigma, grad_rgb, grad_t, None, None, None


def composite(
    sigma: torch.Tensor,
    rgb: torch.Tensor,
    t: torch.Tensor,
    delta: float | torch.Tensor,
    ray_index: torch.Tensor,
    rays: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Quadrature of the volume rendering integral with `alpha_i = 1 - exp(-sigma_i delta_i)`.

    sigma [N] (1/m), rgb [N,3], t [N] (m), delta (m, one number or [N]), ray_index [N] sorted ->
    premultiplied colour [R,3], opacity [R], depth [R] (the sum of w t), weights [N].
    Differentiable in sigma, rgb and t.
    """
    return _Composite.apply(sigma, rgb, t, delta, ray_index, rays)


def weigh(
    sigma: torch.Tensor,
    delta: float | torch.Tensor,
    ray_index: torch.Tensor,
    transmittance: torch.Tensor,
) -> torch.Tensor:
    """The weights [N] that `composite` gives one wave of samples.

    `transmittance` [R] is what the rays have left and is lowered in place; it must be contiguous
    float32. Not differentiable.
    """
    if not transmittance.is_contiguous() or transmittance.dtype != torch.float32:
        raise ValueError("weigh changes transmittance in place: contiguous float32")
    weights = torch.empty(len(sigma))
    rays = len(transmittance)
    run_chunks(
        _weigh,
        rays,
        _CHUNK,
        _starts(ray_index, rays),
        _array(sigma),
        _widths(delta, len(sigma)),
        transmittance.numpy(),
        weights.numpy(),
    )
    return weights
