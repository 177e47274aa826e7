"""Compositing along rays, one pass forwards and one backwards (used through `marching.py`), and how
far apart weights lie along a ray.

What each sample lets through is worked out for a register of samples at a time, rays then go one
after the other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit

from .exponential import parts
from .lanes import LANES, fma, load, splat, store
from .search import OPTIONS
from .threads import run_chunks

_CHUNK = 1024  # rays a thread takes at a time


@njit(**OPTIONS)
def _offsets(ray_index, rays):
    """Where each ray's samples begin, [R + 1]; -1 first when the index is unsorted or outside."""
    offsets = np.empty(rays + 1, np.int64)
    current = np.int64(-1)
    for i in range(len(ray_index)):
        ray = np.int64(ray_index[i])
        if ray == current:
            continue
        if ray < current or ray >= rays:
            offsets[0] = -1
            return offsets
        offsets[current + 1 : ray + 1] = i
        current = ray
    offsets[current + 1 :] = len(ray_index)
    return offsets


@njit(inline="always")
def _let_through(sigma, delta):
    """Of a register of samples: what each takes of its light, and what it lets through."""
    s, p = parts(splat(np.float32(0)) - sigma * delta)
    taken = fma(splat(np.float32(0)) - s, p, splat(np.float32(1)) - s)
    return taken, fma(s, p, s)


@njit(inline="always")
def _passes(taken, through):
    return np.float64(through) if taken > np.float32(0.5) else 1.0 - np.float64(taken)


@njit(**OPTIONS)
def _opacities(first, last, sigma, delta, taken, passed):
    """1 - exp(-sigma delta) of samples first to last, and in passed, float64 and from 0 on, what it
    leaves: of thin samples 1 less what they take, since hundreds of them are multiplied, and each
    rounded to float32 next to 1 is off the same way."""
    one, through = splat(delta[0]), np.empty(LANES, np.float32)
    whole = first + (last - first) // LANES * LANES
    for i in range(first, whole, LANES):
        width = one if len(delta) == 1 else load(delta, i)
        alpha, beyond = _let_through(load(sigma, i), width)
        store(taken, i, alpha)
        store(through, 0, beyond)
        for k in range(LANES):
            passed[i - first + k] = _passes(taken[i + k], through[k])
    rest = np.zeros(3 * LANES, np.float32)
    for i in range(whole, last):
        rest[i - whole] = sigma[i]
        rest[LANES + i - whole] = delta[0 if len(delta) == 1 else i]
    alpha, beyond = _let_through(load(rest, 0), load(rest, LANES))
    store(rest, 2 * LANES, alpha)
    store(rest, LANES, beyond)
    for i in range(whole, last):
        taken[i] = rest[2 * LANES + i - whole]
        passed[i - first] = _passes(taken[i], rest[LANES + i - whole])


@njit(**OPTIONS)
def _weigh(start, stop, offsets, sigma, delta, transmittance, weights):
    """Writes the weights of the rays' samples and lowers what the rays have left."""
    begin, end = offsets[start], offsets[stop]
    passed = np.empty(end - begin, np.float64)
    _opacities(begin, end, sigma, delta, weights, passed)
    for ray in range(start, stop):
        left = np.float64(transmittance[ray])
        for i in range(offsets[ray], offsets[ray + 1]):
            weights[i] = left * weights[i]
            left *= passed[i - begin]
        transmittance[ray] = left


@njit(**OPTIONS)
def _forward(start, stop, offsets, sigma, rgb, t, delta, colour, opacity, depth, weights):
    begin, end = offsets[start], offsets[stop]
    passed = np.empty(end - begin, np.float64)
    _opacities(begin, end, sigma, delta, weights, passed)
    for ray in range(start, stop):
        left = 1.0
        red = green = blue = alpha = far = 0.0
        for i in range(offsets[ray], offsets[ray + 1]):
            weight = left * weights[i]
            left *= passed[i - begin]
            weights[i] = weight
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

    No division: exact where a sample is opaque or a ray has nothing left. grad_t is left out where
    it is empty.
    """
    begin, end = offsets[start], offsets[stop]
    passed = np.empty(end - begin, np.float64)
    _opacities(begin, end, sigma, delta, grad_sigma, passed)
    one_delta = len(delta) == 1
    for ray in range(start, stop):
        first, last = offsets[ray], offsets[ray + 1]
        r, g, b = grad_colour[ray, 0], grad_colour[ray, 1], grad_colour[ray, 2]
        total = 0.0
        for i in range(first, last):
            q = r * rgb[i, 0] + g * rgb[i, 1] + b * rgb[i, 2] + grad_opacity[ray]
            q += grad_depth[ray] * t[i] + grad_weights[i]
            grad_sigma[i] = q
            total += np.float64(weights[i]) * q
        left = 1.0
        for i in range(first, last):
            q, weight = np.float64(grad_sigma[i]), weights[i]
            left *= passed[i - begin]
            total -= weight * q
            grad_sigma[i] = delta[0 if one_delta else i] * (left * q - total)
            grad_rgb[i, 0], grad_rgb[i, 1], grad_rgb[i, 2] = weight * r, weight * g, weight * b
        if len(grad_t) > 0:
            for i in range(first, last):
                grad_t[i] = weights[i] * grad_depth[ray]


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
        colour, opacity, depth = torch.empty(rays, 3), torch.empty(rays), torch.empty(rays)
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
        needs_t = ctx.needs_input_grad[2]
        grad_sigma, grad_rgb = torch.empty(len(sigma)), torch.empty(len(sigma), 3)
        grad_t = torch.empty(len(sigma) if needs_t else 0)
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
        return grad_sigma, grad_rgb, grad_t if needs_t else None, None, None, None


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


@njit(**OPTIONS)
def _distances(start, stop, offsets, weights, t, sums):
    for ray in range(start, stop):
        before = moment = total = 0.0
        for i in range(offsets[ray], offsets[ray + 1]):
            weight = np.float64(weights[i])
            total += weight * (t[i] * before - moment)
            before += weight
            moment += weight * t[i]
        sums[ray] = total


@njit(**OPTIONS)
def _distances_back(start, stop, offsets, weights, t, scale, grad_weights):
    """d/dw_k: the sum over the others on the ray of w_i |t_k - t_i|."""
    for ray in range(start, stop):
        first, last = offsets[ray], offsets[ray + 1]
        after = moment = 0.0
        for i in range(first, last):
            after += weights[i]
            moment += np.float64(weights[i]) * t[i]
        before = passed = 0.0
        for i in range(first, last):
            weight = np.float64(weights[i])
            after -= weight
            moment -= weight * t[i]
            grad_weights[i] = scale * (t[i] * (before - after) - passed + moment)
            before += weight
            passed += weight * t[i]


class _Distortion(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, weights: torch.Tensor, t: torch.Tensor, ray_index: torch.Tensor, rays: int
    ) -> torch.Tensor:
        ctx.arrays = _starts(ray_index, rays), _array(weights), _array(t)
        sums = np.empty(rays)
        run_chunks(_distances, rays, _CHUNK, *ctx.arrays, sums)
        return torch.tensor(2 * sums.sum() / max(rays, 1), dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        offsets, weights, t = ctx.arrays
        rays = len(offsets) - 1
        grad_weights = torch.empty(len(weights))
        scale = 2 * float(gradients[0]) / max(rays, 1)
        arrays = offsets, weights, t, scale, grad_weights.numpy()
        run_chunks(_distances_back, rays, _CHUNK, *arrays)
        return grad_weights, None, None, None


def distortion(
    weights: torch.Tensor, t: torch.Tensor, ray_index: torch.Tensor, rays: int
) -> torch.Tensor:
    """As `training.losses.distortion`; the gradient goes to the weights only."""
    return _Distortion.apply(weights, t, ray_index, rays)
