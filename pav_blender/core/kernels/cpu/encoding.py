"""Multi-resolution hash encoding and latent reads for the CPU; see `reference/encoding.py`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ...errors import InputError
from .threads import run_chunks, threads
from ..reference.encoding import (
    FEATURES,
    Layout,
    check_encode,
    check_texture,
    check_vertices,
    resolutions,
    table_sizes,
)

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

BLOCK = 512  # samples whose corners and weights are worked out together: 32 KiB
PRIME_Y = np.uint32(2654435761)
PRIME_Z = np.uint32(805459861)
# Not "nnan" or "ninf": points may be anything.
FAST = {"contract", "reassoc", "nsz", "arcp"}


def encode(points: Tensor, tables: Tensor, layout: Layout) -> Tensor:
    """As the reference, in float32; the gradient goes to the tables only."""
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
        _encode_backward_levels,
        layout.levels,
        1,
        _array(points),
        _array(grad_out),
        _array(grad_tables, in_place=True),
        *_layout_arrays(layout),
    )


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, tables: Tensor, layout: Layout) -> Tensor:
        out = torch.empty(len(points), layout.width)
        run_chunks(
            _encode_samples,
            len(points),
            BLOCK * 8,
            _array(points),
            _array(tables),
            out.numpy(),
            *_layout_arrays(layout),
        )
        ctx.save_for_backward(points)
        ctx.layout = layout
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor, None]:
        (points,) = ctx.saved_tensors
        grad_tables = torch.zeros(ctx.layout.entries, FEATURES)
        encode_backward_into(points, grads[0], grad_tables, ctx.layout)
        return None, grad_tables, None


def _layout_arrays(layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Resolution, first entry, and hash mask of every level (0 where the level is dense)."""
    masks = [size - 1 if h else 0 for size, h in zip(layout.sizes, layout.hashed, strict=True)]
    return (
        np.array(layout.resolutions, np.int64),
        np.array(layout.offsets, np.int64),
        np.array(masks, np.int64),
    )


@njit(cache=True, nogil=True, fastmath=FAST)
def _transpose_points(points, start, count, unit):
    """Points start to start + count as rows of unit [3, BLOCK], clamped; not a number becomes 0."""
    for i in range(count):
        for axis in range(3):
            p = points[start + i, axis]
            p = p if p > 0 else np.float32(0)
            unit[axis, i] = p if p < 1 else np.float32(1)


@njit(cache=True, nogil=True, fastmath=FAST)
def _locate(unit, count, res, mask, index, weight):
    """Table entry (within the level) and weight of the 8 corners round every point."""
    scale = np.float32(res)
    last = np.int32(res - 1)
    row = np.int32(res + 1)
    for i in range(count):
        px = unit[0, i] * scale
        py = unit[1, i] * scale
        pz = unit[2, i] * scale
        x = min(np.int32(px), last)
        y = min(np.int32(py), last)
        z = min(np.int32(pz), last)
        fx = px - np.float32(x)
        fy = py - np.float32(y)
        fz = pz - np.float32(z)
        gx = np.float32(1) - fx
        gy = np.float32(1) - fy
        gz = np.float32(1) - fz
        weight[0, i] = gx * gy * gz
        weight[1, i] = fx * gy * gz
        weight[2, i] = gx * fy * gz
        weight[3, i] = fx * fy * gz
        weight[4, i] = gx * gy * fz
        weight[5, i] = fx * gy * fz
        weight[6, i] = gx * fy * fz
        weight[7, i] = fx * fy * fz
        if mask == 0:
            index[0, i] = np.int32(x + row * np.int32(y + row * z))
        else:
            # Remembered for the second loop, which turns them into the eight hashes.
            index[0, i] = x
            index[1, i] = y
            index[2, i] = z
    if mask == 0:
        for i in range(count):
            first = index[0, i]
            for corner in range(1, 8):
                step = (corner & 1) + row * ((corner >> 1 & 1) + row * (corner >> 2))
                index[corner, i] = np.int32(first + step)
    else:
        bits = np.uint32(mask)
        for i in range(count):
            x0 = np.uint32(index[0, i])
            y0 = np.uint32(np.uint32(index[1, i]) * PRIME_Y)
            z0 = np.uint32(np.uint32(index[2, i]) * PRIME_Z)
            x1 = np.uint32(x0 + np.uint32(1))
            y1 = np.uint32(y0 + PRIME_Y)
            z1 = np.uint32(z0 + PRIME_Z)
            index[0, i] = np.int32((x0 ^ y0 ^ z0) & bits)
            index[1, i] = np.int32((x1 ^ y0 ^ z0) & bits)
            index[2, i] = np.int32((x0 ^ y1 ^ z0) & bits)
            index[3, i] = np.int32((x1 ^ y1 ^ z0) & bits)
            index[4, i] = np.int32((x0 ^ y0 ^ z1) & bits)
            index[5, i] = np.int32((x1 ^ y0 ^ z1) & bits)
            index[6, i] = np.int32((x0 ^ y1 ^ z1) & bits)
            index[7, i] = np.int32((x1 ^ y1 ^ z1) & bits)


@njit(cache=True, nogil=True, fastmath=FAST)
def _encode_samples(start, stop, points, tables, out, grids, offsets, masks):
    unit = np.empty((3, BLOCK), np.float32)
    index = np.empty((8, BLOCK), np.int32)
    weight = np.empty((8, BLOCK), np.float32)
    for begin in range(start, stop, BLOCK):
        count = min(BLOCK, stop - begin)
        _transpose_points(points, begin, count, unit)
        for level in range(len(grids)):
            _locate(unit, count, grids[level], masks[level], index, weight)
            table = tables[offsets[level] :]
            for i in range(count):
                a = np.float32(0)
                b = np.float32(0)
                for corner in range(8):
                    w = weight[corner, i]
                    entry = index[corner, i]
                    a += w * table[entry, 0]
                    b += w * table[entry, 1]
                out[begin + i, 2 * level] = a
                out[begin + i, 2 * level + 1] = b


@njit(cache=True, nogil=True, fastmath=FAST)
def _encode_backward_levels(first, end, points, grad_out, grad_tables, grids, offsets, masks):
    unit = np.empty((3, BLOCK), np.float32)
    index = np.empty((8, BLOCK), np.int32)
    weight = np.empty((8, BLOCK), np.float32)
    for level in range(first, end):
        table = grad_tables[offsets[level] :]
        for begin in range(0, len(points), BLOCK):
            count = min(BLOCK, len(points) - begin)
            _transpose_points(points, begin, count, unit)
            _locate(unit, count, grids[level], masks[level], index, weight)
            for i in range(count):
                a = grad_out[begin + i, 2 * level]
                b = grad_out[begin + i, 2 * level + 1]
                for corner in range(8):
                    w = weight[corner, i]
                    entry = index[corner, i]
                    table[entry, 0] += w * a
                    table[entry, 1] += w * b


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
