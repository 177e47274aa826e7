"""Multi-resolution hash encoding and latent reads for the CPU; see `reference/encoding.py`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ...cores import threads
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
from ..reference.optimiser import check_adam
from . import corners, rows
from .optimiser import adam_range, adam_settings
from .threads import run_chunks

__all__ = [
    "Layout",
    "encode",
    "encode_adam_step",
    "encode_adam_steps",
    "encode_all",
    "encode_backward_into",
    "read_texture",
    "read_texture_backward_into",
    "read_vertices",
    "read_vertices_backward_into",
    "resolutions",
    "table_sizes",
]

CHUNK = 4096  # samples of a latent read handed to a thread at a time
# Not "nnan" or "ninf": points may be anything.
FAST = {"contract", "reassoc", "nsz", "arcp"}


def encode(points: Tensor, tables: Tensor, layout: Layout) -> Tensor:
    """As the reference, in float32; the gradient goes to the tables only.

    The result [N, levels * 2] lies in memory feature by feature (its strides are 1 and N): levels
    are worked on one at a time, so that a level's table stays in the cache. `mlp` takes it so.
    """
    check_encode(points, tables, layout)
    _refuse_gradient("encode", "points", points)
    return _Encode.apply(points, tables, layout)


def encode_backward_into(
    points: Tensor, grad_out: Tensor, grad_tables: Tensor, layout: Layout
) -> None:
    """Add the gradient of `encode` with respect to the tables to grad_tables, in place."""
    check_encode(points, grad_tables, layout)
    arrays = _array(points), _array(grad_out.t()).reshape(-1), _flat_in_place(grad_tables)
    _run_levels(_backward_levels, len(points), layout, *arrays, level_array(layout))


def encode_all(grids: Sequence[tuple[Tensor, Tensor, Layout]]) -> Tensor:
    """As the reference; lies in memory as what `encode` returns."""
    for points, tables, layout in grids:
        check_encode(points, tables, layout)
        _refuse_gradient("encode_all", "points", points)
    if torch.is_grad_enabled() and any(tables.requires_grad for _, tables, _ in grids):
        return torch.cat([encode(*grid).t() for grid in grids]).t()
    out = torch.empty(sum(layout.width for _, _, layout in grids), len(grids[0][0]))
    pieces, at = [], 0
    for points, tables, layout in grids:
        part = out[at : at + layout.width]
        arrays = _array(points), _array(tables).reshape(-1), part.view(-1).numpy()
        pieces += [(*arrays, level) for level in level_array(layout)]
        at += layout.width
    run_chunks(_encode_pieces, len(pieces), 1, pieces)
    return out.t()


def _encode_pieces(first: int, end: int, pieces: list[tuple[Any, ...]]) -> None:
    encode_levels: Callable[..., Any] = _encode_levels
    for *arrays, level in pieces[first:end]:
        encode_levels(0, 1, *arrays, level[None])


def encode_adam_step(
    points: Tensor,
    grad_out: Tensor,
    tables: Tensor,
    m: Tensor,
    v: Tensor,
    layout: Layout,
    **settings: Any,
) -> None:
    """As the reference; a level's gradient is used while it lies in the cache, and forgotten."""
    encode_adam_steps([(points, grad_out, tables, m, v, layout)], **settings)


def encode_adam_steps(
    grids: Sequence[tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Layout]],
    *,
    step: int,
    lr: float,
    beta1: float = 0.9,
    beta2: float = 0.99,
    eps: float = 1e-15,
    weight_decay: float = 0.0,
) -> None:
    """As the reference; see `encode_adam_step`."""
    settings = adam_settings(step, lr, beta1, beta2, eps, weight_decay)
    pieces: list[tuple[Any, ...]] = []
    for points, grad_out, tables, m, v, layout in grids:
        check_encode(points, tables, layout)
        check_adam(tables, tables, m, v, step)
        state = [_flat_in_place(tensor) for tensor in (tables, m, v)]
        arrays = _array(points), _array(grad_out.t()).reshape(-1), *state, settings
        sizes = layout.sizes[::-1]
        pieces += [(*arrays, *own) for own in zip(sizes, level_array(layout), strict=True)]
    # the large ones first, so that short ones fill the gap at the end
    pieces.sort(key=lambda piece: -piece[-2])
    run_chunks(_adam_pieces, len(pieces), 1, pieces)


def _adam_pieces(first: int, end: int, pieces: list[tuple[Any, ...]]) -> None:
    adam_level: Callable[..., Any] = _adam_level
    for piece in pieces[first:end]:
        adam_level(*piece)


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, tables: Tensor, layout: Layout) -> Tensor:
        ctx.save_for_backward(points)
        ctx.layout = layout
        out = torch.empty(layout.width, len(points))
        arrays = _array(points), _array(tables).reshape(-1), out.view(-1).numpy()
        _run_levels(_encode_levels, len(points), layout, *arrays, level_array(layout))
        return out.t()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor, None]:
        (points,) = ctx.saved_tensors
        grad = torch.zeros(ctx.layout.entries, FEATURES)
        encode_backward_into(points, grads[0], grad, ctx.layout)
        return None, grad, None


def _run_levels(kernel: Callable[..., Any], count: int, layout: Layout, *arrays: Any) -> None:
    """A level belongs to one thread: no two add to one entry, and its sums have one order."""
    share = -(-layout.levels // (2 * threads()))
    # Few samples are not worth handing out a level at a time.
    run_chunks(kernel, layout.levels, max(1, min(share, 8192 // max(count, 1))), *arrays)


def level_array(layout: Layout) -> np.ndarray:
    """Resolution, first entry, hash mask (0 where dense) and number of every level.

    The finest come first: they take longest, and the short ones fill the gap at the end.
    """
    masks = [size - 1 if h else 0 for size, h in zip(layout.sizes, layout.hashed, strict=True)]
    found = [*zip(layout.resolutions, layout.offsets, masks, range(layout.levels), strict=True)]
    return np.array(found[::-1], np.int64)


@njit(cache=True, nogil=True, fastmath=FAST)
def _transpose_points(points, start, count, unit):
    """Points start to start + count as three rows of unit, clamped; not a number becomes 0."""
    for i in range(count):
        for axis in range(3):
            p = points[start + i, axis]
            p = p if p > 0 else np.float32(0)
            unit[axis * corners.BLOCK + i] = p if p < 1 else np.float32(1)


@njit(cache=True, nogil=True)
def _scratch():
    """Room for a block: points, entries, weights."""
    size = 8 * corners.STRIDE
    return (
        np.zeros(3 * corners.BLOCK, np.float32),
        np.zeros(size, np.int32),
        np.zeros(size, np.float32),
    )


@njit(cache=True, nogil=True)
def _encode_levels(first, end, points, table, out, levels):
    unit, index, weight = _scratch()
    total = len(points)
    for k in range(first, end):
        res, entry, mask, level = levels[k]
        for begin in range(0, total, corners.BLOCK):
            count = min(corners.BLOCK, total - begin)
            _transpose_points(points, begin, count, unit)
            corners.locate_block(unit, count, res, entry, mask, table, index, weight)
            at = 2 * level * total + begin
            for i in range(count):
                corners.read_corners(table, index, weight, i, out, at + i, at + total + i)


@njit(cache=True, nogil=True)
def _backward_level(points, grad_out, level, res, entry, mask, grad_table, scratch):
    """Add the gradient of one level, whose first entry is `entry`, to grad_table."""
    unit, index, weight = scratch
    total = len(points)
    for begin in range(0, total, corners.BLOCK):
        count = min(corners.BLOCK, total - begin)
        _transpose_points(points, begin, count, unit)
        corners.locate_block(unit, count, res, entry, mask, grad_table, index, weight)
        at = 2 * level * total + begin
        for i in range(count):
            corners.add_corners(grad_table, index, weight, i, grad_out, at + i, at + total + i)


@njit(cache=True, nogil=True)
def _backward_levels(first, end, points, grad_out, grad_table, levels):
    scratch = _scratch()
    for k in range(first, end):
        res, entry, mask, level = levels[k]
        _backward_level(points, grad_out, level, res, entry, mask, grad_table, scratch)


@njit(cache=True, nogil=True)
def _adam_level(points, grad_out, table, m, v, settings, size, row):
    res, entry, mask, level = row
    grad = np.zeros(2 * size, np.float32)
    _backward_level(points, grad_out, level, res, np.int64(0), mask, grad, _scratch())
    low, high = 2 * entry, 2 * (entry + size)
    adam_range(0, high - low, table[low:high], grad, m[low:high], v[low:high], settings, False)


def read_texture(latent: Tensor, appearance: Tensor, uv: Tensor) -> Tensor:
    """As the reference, in float32; the gradient goes to the textures only."""
    check_texture(latent, appearance, uv)
    _refuse_gradient("read_texture", "uv", uv)
    return _ReadTexture.apply(latent, appearance, uv)


def read_texture_backward_into(
    appearance: Tensor, uv: Tensor, grad_out: Tensor, grad_latent: Tensor
) -> None:
    """Add the gradient of `read_texture` with respect to the textures to grad_latent, in place."""
    check_texture(grad_latent, appearance, uv)
    places = _array(appearance, torch.int32), _array(uv)
    size, width = grad_latent.shape[2:]
    flat = _flat_in_place(grad_latent)
    _run_parts(_add_texels, size, width, *places, _array(grad_out).reshape(-1), flat)


class _ReadTexture(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, latent: Tensor, appearance: Tensor, uv: Tensor) -> Tensor:
        ctx.save_for_backward(appearance, uv)
        ctx.shape = latent.shape
        size, width = latent.shape[2:]
        out = torch.empty(len(uv), width)
        arrays = _array(latent).reshape(-1), _array(appearance, torch.int32), _array(uv)
        run_chunks(_read_texels, len(uv), CHUNK, size, width, *arrays, out.view(-1).numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        grad = torch.zeros(ctx.shape)
        appearance, uv = ctx.saved_tensors
        read_texture_backward_into(appearance, uv, grads[0], grad)
        return grad, None, None


@njit(cache=True, nogil=True)
def _read_texels(start, stop, size, width, latent, appearance, uv, out):
    index = np.zeros(4 * rows.STRIDE, np.int64)
    weight = np.zeros(4 * rows.STRIDE, np.float32)
    for begin in range(start, stop, rows.BLOCK):
        count = min(rows.BLOCK, stop - begin)
        rows.locate_texels(size, appearance, uv, begin, count, index, weight)
        rows.read_rows(latent, width, index, weight, np.int64(4), count, out, begin)


@njit(cache=True, nogil=True)
def _add_texels(first, end, parts, size, width, appearance, uv, grad_out, grad_latent):
    index = np.zeros(4 * rows.STRIDE, np.int64)
    weight = np.zeros(4 * rows.STRIDE, np.float32)
    for part in range(first, end):
        for begin in range(0, len(uv), rows.BLOCK):
            count = min(rows.BLOCK, len(uv) - begin)
            rows.locate_texels(size, appearance, uv, begin, count, index, weight)
            rows.add_rows(
                grad_latent, width, index, weight, np.int64(4), count, grad_out, begin, part, parts
            )


def read_vertices(
    latent: Tensor,
    appearance: Tensor,
    triangles: Tensor,
    triangle: Tensor,
    barycentric: Tensor,
) -> Tensor:
    """As the reference, in float32; the gradient goes to the features only."""
    check_vertices(latent, appearance, triangles, triangle, barycentric)
    _refuse_gradient("read_vertices", "barycentrics", barycentric)
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
    places = _mesh_arrays(appearance, triangles, triangle, barycentric)
    vertices, width = grad_latent.shape[1:]
    flat = _flat_in_place(grad_latent)
    _run_parts(_add_vertices, vertices, width, *places, _array(grad_out).reshape(-1), flat)


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
        ctx.save_for_backward(appearance, triangles, triangle, barycentric)
        ctx.shape = latent.shape
        vertices, width = latent.shape[1:]
        out = torch.empty(len(barycentric), width)
        arrays = (
            _array(latent).reshape(-1),
            *_mesh_arrays(appearance, triangles, triangle, barycentric),
            out.view(-1).numpy(),
        )
        run_chunks(_read_vertices, len(barycentric), CHUNK, vertices, width, *arrays)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None, None]:
        grad = torch.zeros(ctx.shape)
        appearance, triangles, triangle, barycentric = ctx.saved_tensors
        read_vertices_backward_into(appearance, triangles, triangle, barycentric, grads[0], grad)
        return grad, None, None, None, None


def _mesh_arrays(
    appearance: Tensor, triangles: Tensor, triangle: Tensor, barycentric: Tensor
) -> tuple[Any, ...]:
    integers = (_array(tensor, torch.int32) for tensor in (appearance, triangles, triangle))
    return (*integers, _array(barycentric))


@njit(cache=True, nogil=True)
def _read_vertices(
    start, stop, vertices, width, latent, appearance, triangles, triangle, barycentric, out
):
    index = np.zeros(3 * rows.STRIDE, np.int64)
    weight = np.zeros(3 * rows.STRIDE, np.float32)
    for begin in range(start, stop, rows.BLOCK):
        count = min(rows.BLOCK, stop - begin)
        rows.locate_vertices(
            vertices, appearance, triangles, triangle, barycentric, begin, count, index, weight
        )
        rows.read_rows(latent, width, index, weight, np.int64(3), count, out, begin)


@njit(cache=True, nogil=True)
def _add_vertices(first, end, parts, vertices, width, appearance, triangles, triangle, barycentric,
                  grad_out, grad_latent):  # fmt: skip
    index = np.zeros(3 * rows.STRIDE, np.int64)
    weight = np.zeros(3 * rows.STRIDE, np.float32)
    for part in range(first, end):
        for begin in range(0, len(triangle), rows.BLOCK):
            count = min(rows.BLOCK, len(triangle) - begin)
            rows.locate_vertices(
                vertices, appearance, triangles, triangle, barycentric, begin, count, index, weight
            )
            rows.add_rows(
                grad_latent, width, index, weight, np.int64(3), count, grad_out, begin, part, parts
            )


def _run_parts(kernel: Callable[..., Any], *arrays: Any) -> None:
    """Rows of a table are shared out between threads, in a power of two of parts."""
    parts = 1 << (threads().bit_length() - 1)
    run_chunks(kernel, parts, 1, parts, *arrays)


def _refuse_gradient(function: str, name: str, tensor: Tensor) -> None:
    if tensor.requires_grad and torch.is_grad_enabled():
        raise InputError(
            f"{function}: the CPU kernel has no gradient for {name}; use the reference"
        )


def _flat_in_place(tensor: Tensor) -> Any:
    if not tensor.is_contiguous():
        raise InputError("CPU kernels change contiguous tensors in place, and no others")
    return _array(tensor).reshape(-1)


def _array(tensor: Tensor, dtype: torch.dtype = torch.float32) -> Any:
    """The tensor's memory as an array; copied only where it is not contiguous or another type."""
    if tensor.device.type != "cpu" or (dtype == torch.float32 and tensor.dtype != dtype):
        raise InputError(
            f"CPU kernels work on float32 in main memory, not on {tensor.dtype} on {tensor.device}"
        )
    return tensor.detach().to(dtype).contiguous().numpy()
