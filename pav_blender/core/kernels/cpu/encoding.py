"""Multi-resolution hash encoding and latent reads for the CPU; see `reference/encoding.py`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ...errors import InputError
from ..reference.encoding import (
    FEATURES,
    Layout,
    check_encode,
    check_texture,
    check_vertices,
    resolutions,
    table_sizes,
)
from .corners import BLOCK, STRIDE, add_corners, locate_block, read_corners
from .threads import run_chunks, threads

__all__ = [
    "Layout",
    "encode",
    "encode_backward_into",
    "read_texture",
    "read_texture_backward_into",
    "read_vertices",
    "read_vertices_backward_into",
    "resolutions",
    "table_sizes",
]

# Not "nnan" or "ninf": points may be anything.
FAST = {"contract", "reassoc", "nsz", "arcp"}


def encode(points: Tensor, tables: Tensor, layout: Layout) -> Tensor:
    """As the reference, in float32; the gradient goes to the tables only.

    The result [N, levels * 2] lies in memory feature by feature (its strides are 1 and N): levels
    are worked on one at a time, so that a level's table stays in the cache. `mlp` takes it so.
    """
    check_encode(points, tables, layout)
    if points.requires_grad:
        raise InputError("encode: the CPU kernel has no gradient for points; use the reference")
    return _Encode.apply(points, tables, layout)


def encode_backward_into(
    points: Tensor, grad_out: Tensor, grad_tables: Tensor, layout: Layout
) -> None:
    """Add the gradient of `encode` with respect to the tables to grad_tables, in place."""
    check_encode(points, grad_tables, layout)
    # A level belongs to one thread, so that no two add to one entry and sums have one order.
    run_chunks(
        _backward_levels,
        layout.levels,
        _levels_at_once(len(points), layout),
        _array(points),
        _array(grad_out.t()).reshape(-1),
        _array(grad_tables, in_place=True).reshape(-1),
        _level_array(layout),
    )


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, tables: Tensor, layout: Layout) -> Tensor:
        out = torch.empty(layout.width, len(points))
        run_chunks(
            _encode_levels,
            layout.levels,
            _levels_at_once(len(points), layout),
            _array(points),
            _array(tables).reshape(-1),
            out.view(-1).numpy(),
            _level_array(layout),
        )
        ctx.save_for_backward(points)
        ctx.layout = layout
        return out.t()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor, None]:
        (points,) = ctx.saved_tensors
        grad_tables = torch.zeros(ctx.layout.entries, FEATURES)
        encode_backward_into(points, grads[0], grad_tables, ctx.layout)
        return None, grad_tables, None


def _level_array(layout: Layout) -> np.ndarray:
    """Resolution, first entry and hash mask (0 where dense) of every level, the finest first:

    the levels that take longest begin first, and the short ones fill the gap at the end.
    """
    masks = [size - 1 if h else 0 for size, h in zip(layout.sizes, layout.hashed, strict=True)]
    rows = [*zip(layout.resolutions, layout.offsets, masks, range(layout.levels), strict=True)]
    return np.array(rows[::-1], np.int64)


def _levels_at_once(count: int, layout: Layout) -> int:
    """Few samples are not worth handing out a level at a time."""
    share = -(-layout.levels // (2 * threads()))
    return max(1, min(share, 8192 // max(count, 1)))


@njit(cache=True, nogil=True, fastmath=FAST)
def _transpose_points(points, start, count, unit):
    """Points start to start + count as three rows of unit, clamped; not a number becomes 0."""
    for i in range(count):
        for axis in range(3):
            p = points[start + i, axis]
            p = p if p > 0 else np.float32(0)
            unit[axis * BLOCK + i] = p if p < 1 else np.float32(1)


@njit(cache=True, nogil=True)
def _encode_levels(first, end, points, table, out, levels):
    unit = np.zeros(3 * BLOCK, np.float32)
    index = np.zeros(8 * STRIDE, np.int32)
    weight = np.zeros(8 * STRIDE, np.float32)
    total = len(points)
    for k in range(first, end):
        res, entry, mask, level = levels[k]
        for begin in range(0, total, BLOCK):
            count = min(BLOCK, total - begin)
            _transpose_points(points, begin, count, unit)
            locate_block(unit, count, res, entry, mask, table, index, weight)
            at = 2 * level * total + begin
            for i in range(count):
                read_corners(table, index, weight, i, out, at + i, at + total + i)


@njit(cache=True, nogil=True)
def _backward_levels(first, end, points, grad_out, grad_table, levels):
    unit = np.zeros(3 * BLOCK, np.float32)
    index = np.zeros(8 * STRIDE, np.int32)
    weight = np.zeros(8 * STRIDE, np.float32)
    total = len(points)
    for k in range(first, end):
        res, entry, mask, level = levels[k]
        for begin in range(0, total, BLOCK):
            count = min(BLOCK, total - begin)
            _transpose_points(points, begin, count, unit)
            locate_block(unit, count, res, entry, mask, grad_table, index, weight)
            at = 2 * level * total + begin
            for i in range(count):
                add_corners(grad_table, index, weight, i, grad_out, at + i, at + total + i)


def read_texture(latent: Tensor, appearance: Tensor, uv: Tensor) -> Tensor:
    """As the reference, in float32; the gradient goes to the textures only."""
    check_texture(latent, appearance, uv)
    if uv.requires_grad:
        raise InputError("read_texture: the CPU kernel has no gradient for uv; use the reference")
    return _ReadTexture.apply(latent, appearance, uv)


def read_texture_backward_into(
    appearance: Tensor, uv: Tensor, grad_out: Tensor, grad_latent: Tensor
) -> None:
    """Add the gradient of `read_texture` with respect to the textures to grad_latent, in place."""
    check_texture(grad_latent, appearance, uv)
    # Channels are split, not samples: no two threads add to one number.
    channels = grad_latent.shape[3]
    run_chunks(
        _texture_backward,
        channels,
        max(1, -(-channels // threads())),
        _array(appearance, torch.int32),
        _array(uv),
        _array(grad_out),
        _array(grad_latent, in_place=True),
    )


class _ReadTexture(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, latent: Tensor, appearance: Tensor, uv: Tensor) -> Tensor:
        out = torch.empty(len(uv), latent.shape[3])
        arrays = (_array(latent), _array(appearance, torch.int32), _array(uv), out.numpy())
        run_chunks(_texture_samples, len(uv), BLOCK * 8, *arrays)
        ctx.save_for_backward(appearance, uv)
        ctx.shape = latent.shape
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        appearance, uv = ctx.saved_tensors
        grad_latent = torch.zeros(ctx.shape)
        read_texture_backward_into(appearance, uv, grads[0], grad_latent)
        return grad_latent, None, None


@njit(cache=True, nogil=True, fastmath=FAST)
def _texel(coordinate, size):
    """Texel below a coordinate in [0, 1] and how far the coordinate lies toward the next."""
    c = coordinate if coordinate > 0 else np.float32(0)
    c = c if c < 1 else np.float32(1)
    position = c * np.float32(size) - np.float32(0.5)
    position = min(max(position, np.float32(0)), np.float32(size - 1))
    low = min(np.int64(position), max(size - 2, 0))
    return low, position - np.float32(low)


@njit(cache=True, nogil=True, fastmath=FAST)
def _texture_samples(start, stop, latent, appearance, uv, out):
    size = latent.shape[1]
    for i in range(start, stop):
        u, fu = _texel(uv[i, 0], size)
        v, fv = _texel(uv[i, 1], size)
        u1 = min(u + 1, size - 1)
        v1 = min(v + 1, size - 1)
        gu = np.float32(1) - fu
        gv = np.float32(1) - fv
        texture = latent[appearance[i]]
        for c in range(latent.shape[3]):
            first = gu * texture[v, u, c] + fu * texture[v, u1, c]
            second = gu * texture[v1, u, c] + fu * texture[v1, u1, c]
            out[i, c] = gv * first + fv * second


@njit(cache=True, nogil=True, fastmath=FAST)
def _texture_backward(first, end, appearance, uv, grad_out, grad_latent):
    size = grad_latent.shape[1]
    for i in range(len(uv)):
        u, fu = _texel(uv[i, 0], size)
        v, fv = _texel(uv[i, 1], size)
        u1 = min(u + 1, size - 1)
        v1 = min(v + 1, size - 1)
        gu = np.float32(1) - fu
        gv = np.float32(1) - fv
        texture = grad_latent[appearance[i]]
        for c in range(first, end):
            g = grad_out[i, c]
            texture[v, u, c] += g * gu * gv
            texture[v, u1, c] += g * fu * gv
            texture[v1, u, c] += g * gu * fv
            texture[v1, u1, c] += g * fu * fv


def read_vertices(
    latent: Tensor, appearance: Tensor, triangles: Tensor, triangle: Tensor, barycentric: Tensor
) -> Tensor:
    """As the reference, in float32; the gradient goes to the features only."""
    check_vertices(latent, appearance, triangles, triangle, barycentric)
    if barycentric.requires_grad:
        raise InputError(
            "read_vertices: the CPU kernel has no gradient for barycentrics; use the reference"
        )
    return _ReadVertices.apply(latent, appearance, triangles, triangle, barycentric)


def read_vertices_backward_into(
    appearance: Tensor,
    triangles: Tensor,
    triangle: Tensor,
    barycentric: Tensor,
    grad_out: Tensor,
    grad_latent: Tensor,
) -> None:
    """Add the gradient of `read_vertices` with respect to the features to grad_latent, in place."""
    check_vertices(grad_latent, appearance, triangles, triangle, barycentric)
    channels = grad_latent.shape[2]
    run_chunks(
        _vertices_backward,
        channels,
        max(1, -(-channels // threads())),
        _array(appearance, torch.int32),
        _array(triangles, torch.int32),
        _array(triangle, torch.int32),
        _array(barycentric),
        _array(grad_out),
        _array(grad_latent, in_place=True),
    )


class _ReadVertices(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        latent: Tensor,
        appearance: Tensor,
        triangles: Tensor,
        triangle: Tensor,
        barycentric: Tensor,
    ) -> Tensor:
        out = torch.empty(len(barycentric), latent.shape[2])
        run_chunks(
            _vertices_samples,
            len(barycentric),
            BLOCK * 8,
            _array(latent),
            _array(appearance, torch.int32),
            _array(triangles, torch.int32),
            _array(triangle, torch.int32),
            _array(barycentric),
            out.numpy(),
        )
        ctx.save_for_backward(appearance, triangles, triangle, barycentric)
        ctx.shape = latent.shape
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None, None]:
        grad_latent = torch.zeros(ctx.shape)
        appearance, triangles, triangle, barycentric = ctx.saved_tensors
        read_vertices_backward_into(
            appearance, triangles, triangle, barycentric, grads[0], grad_latent
        )
        return grad_latent, None, None, None, None


@njit(cache=True, nogil=True, fastmath=FAST)
def _vertices_samples(start, stop, latent, appearance, triangles, triangle, barycentric, out):
    for i in range(start, stop):
        features = latent[appearance[i]]
        a, b, c = triangles[triangle[i]]
        wa, wb, wc = barycentric[i]
        for channel in range(latent.shape[2]):
            out[i, channel] = (
                wa * features[a, channel] + wb * features[b, channel] + wc * features[c, channel]
            )


@njit(cache=True, nogil=True, fastmath=FAST)
def _vertices_backward(
    first, end, appearance, triangles, triangle, barycentric, grad_out, grad_latent
):
    for i in range(len(triangle)):
        features = grad_latent[appearance[i]]
        a, b, c = triangles[triangle[i]]
        wa, wb, wc = barycentric[i]
        for channel in range(first, end):
            g = grad_out[i, channel]
            features[a, channel] += wa * g
            features[b, channel] += wb * g
            features[c, channel] += wc * g


def _array(tensor: Tensor, dtype: torch.dtype = torch.float32, in_place: bool = False) -> Any:
    """The tensor's memory as an array; copied only where it is not contiguous or another type."""
    if tensor.device.type != "cpu" or (dtype == torch.float32 and tensor.dtype != dtype):
        raise InputError(
            f"CPU kernels work on float32 in main memory, not on {tensor.dtype} on {tensor.device}"
        )
    if in_place and not tensor.is_contiguous():
        raise InputError("CPU kernels add gradients in place to contiguous tensors only")
    return tensor.detach().to(dtype).contiguous().numpy()
