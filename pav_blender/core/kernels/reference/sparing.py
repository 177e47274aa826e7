"""Pixels that lie between four others and are their mean where those agree."""

from __future__ import annotations

import numpy as np

SURFACE = 0.01  # metres along the camera's axis that neighbours may differ by
BEFORE = 0.05  # metres that must be free before the depth at which a pixel is cut off
Steps = tuple[tuple[int, int], ...]


def lattice(values: np.ndarray, top: int, left: int, down: int = 0, right: int = 0) -> np.ndarray:
    """Every second pixel from (top, left) on, those on the picture's edge left out, or what lies
    beside each."""
    height, width = values.shape[:2]
    return values[top + down : height - 1 + down : 2, left + right : width - 1 + right : 2]


def fill(
    rgba: np.ndarray,
    depth: np.ndarray,
    limit: np.ndarray | None,
    corner: tuple[int, int],
    around: Steps,
    agreement: float,
    free: np.ndarray,
) -> np.ndarray:
    """Where a lattice's pixels became the mean of those `around` [4] each, in place.

    rgba [H, W, 4] straight, depth [H, W] and limit [H, W], how far a pixel sees, in metres; corner:
    the lattice's first pixel (`lattice`); agreement: the most by which neighbours may differ in a
    premultiplied colour or alpha; free: the lattice's pixels that may be filled. Their depths must
    agree as well, and nothing may stand before what they show.
    """
    colours = [_premultiplied(lattice(rgba, *corner, *step)) for step in around]
    depths = [lattice(depth, *corner, *step) for step in around]
    low, high = _extent(colours)
    agree = ((high - low) < agreement).all(-1) & free
    near, far = _extent(depths)
    with np.errstate(invalid="ignore"):  # both infinite: there is nothing
        agree &= (far - near < SURFACE) | np.isinf(near)
    if limit is not None:
        own = lattice(limit, *corner)
        least = _extent([lattice(limit, *corner, *step) for step in around])[0]
        seen = np.minimum(own, least) > far + BEFORE
        agree &= np.where(np.isinf(near), own <= least, seen)
    mean = sum(colours[1:], colours[0]) / np.float32(len(colours))
    alpha = mean[..., 3:]
    mean[..., :3] = np.where(alpha > 0, mean[..., :3] / np.where(alpha > 0, alpha, 1), 0)
    np.copyto(lattice(rgba, *corner), mean, where=agree[..., None])
    along = sum(depths[1:], depths[0]) / np.float32(len(depths))
    np.copyto(lattice(depth, *corner), along, where=agree)
    return agree


def _premultiplied(rgba: np.ndarray) -> np.ndarray:
    alpha = rgba[..., 3:]
    return np.concatenate([rgba[..., :3] * alpha, alpha], -1)


def _extent(values: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    low = high = values[0]
    for value in values[1:]:
        low, high = np.minimum(low, value), np.maximum(high, value)
    return low, high


def cover(
    corners: np.ndarray, near: np.ndarray, far: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """The least of near [N] and the greatest of far [N] of the rectangles that cover each place of
    a grid of this shape; infinite, and below that, where none does. corners [N, 4]: first column
    and row, and those beyond the last."""
    least, most = np.full(shape, np.inf, np.float32), np.full(shape, -np.inf, np.float32)
    for (left, top, right, bottom), low, high in zip(corners, near, far, strict=True):
        np.minimum(part := least[top:bottom, left:right], low, out=part)
        np.maximum(part := most[top:bottom, left:right], high, out=part)
    return least, most
