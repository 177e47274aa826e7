"""Which pixels of a picture are traced: one that lies between four that agree is their mean.

Every second pixel of every second row comes first, then those in the middle of four, then the rest,
so that each is held against its nearest neighbours on all sides. One in five of the second kind is
traced in any case, spread so that no row, column or diagonal goes without: where one of these is
not what its neighbours promise, all around it are traced, and lines finer than a pixel are not
lost between those that came first.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

_DIAGONAL = 0.6  # of what neighbours may differ by, for those that are further apart
_SURFACE = 0.01  # metres along the camera's axis that neighbours may differ by
_BEFORE = 0.05  # metres that must be free before the depth at which a pixel is cut off
_AROUND = 2  # pixels of the second kind that are traced on each side of a surprise
_CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))
_SIDES = ((-1, 0), (1, 0), (0, -1), (0, 1))


def passes(
    rgba: np.ndarray, depth: np.ndarray, limit: np.ndarray | None, agreement: float
) -> Iterator[np.ndarray]:
    """Masks [H, W] of what is to be traced next, into straight rgba [H, W, 4] and depth [H, W]
    (metres, infinite where there is nothing); what is in none of them is filled in here.

    limit [H, W]: how far each pixel sees. agreement: the most by which neighbours may differ, in
    any of the premultiplied colours and alpha from 0 to 1; at 0 every pixel is traced.
    """
    shape = depth.shape
    if agreement <= 0 or min(shape) < 3:
        yield np.ones(shape, bool)
        return
    first = np.zeros(shape, bool)
    first[::2, ::2] = True
    middles = first[1::2, 1::2]
    row, column = np.ogrid[: middles.shape[0], : middles.shape[1]]
    probes = (row + 2 * column) % 5 == 0
    middles |= probes
    yield first

    mean, agree = _between(rgba, depth, limit, 1, 1, _CORNERS, _DIAGONAL * agreement)
    height, width = agree.shape
    probes = probes[:height, :width]
    own = _premultiplied(rgba[1::2, 1::2][:height, :width])
    surprise = probes & ~(np.abs(own - mean[0]).max(-1) < _DIAGONAL * agreement)
    agree &= ~_grown(surprise) & ~probes
    _fill(rgba, depth, 1, 1, mean, agree)
    second = np.zeros(shape, bool)
    second[1::2, 1::2] = True
    second[1::2, 1::2][:height, :width] = ~agree
    yield second & ~first

    third = np.zeros(shape, bool)
    third[::2, 1::2] = third[1::2, ::2] = True
    for top, left in ((2, 1), (1, 2)):
        mean, agree = _between(rgba, depth, limit, top, left, _SIDES, agreement)
        _fill(rgba, depth, top, left, mean, agree)
        _lattice(third, top, left)[...] = ~agree
    yield third


def _lattice(values: np.ndarray, top: int, left: int, down: int = 0, right: int = 0) -> np.ndarray:
    """Every second pixel from (top, left) on, those on the picture's edge left out, or what lies
    beside each."""
    height, width = values.shape[:2]
    return values[top + down : height - 1 + down : 2, left + right : width - 1 + right : 2]


def _premultiplied(rgba: np.ndarray) -> np.ndarray:
    alpha = rgba[..., 3:]
    return np.concatenate([rgba[..., :3] * alpha, alpha], -1)


def _between(
    rgba: np.ndarray,
    depth: np.ndarray,
    limit: np.ndarray | None,
    top: int,
    left: int,
    around: tuple[tuple[int, int], ...],
    agreement: float,
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """The mean colour (premultiplied) and depth of each lattice pixel's neighbours, and where they
    agree: in both, and in that nothing stands before them."""
    colours = [_premultiplied(_lattice(rgba, top, left, *step)) for step in around]
    depths = [_lattice(depth, top, left, *step) for step in around]
    low, high = _extent(colours)
    agree = ((high - low) < agreement).all(-1)
    near, far = _extent(depths)
    with np.errstate(invalid="ignore"):  # both infinite: there is nothing
        agree &= (far - near < _SURFACE) | np.isinf(near)
    if limit is not None:
        sight = [_lattice(limit, top, left, *step) for step in around]
        own, least = _lattice(limit, top, left), _extent(sight)[0]
        free = np.minimum(own, least) > far + _BEFORE
        agree &= np.where(np.isinf(near), own <= least, free)
    colour = sum(colours[1:], colours[0]) / len(colours)
    return (colour, sum(depths[1:], depths[0]) / len(depths)), agree


def _extent(values: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    low = high = values[0]
    for value in values[1:]:
        low, high = np.minimum(low, value), np.maximum(high, value)
    return low, high


def _grown(mask: np.ndarray) -> np.ndarray:
    """What lies within `_AROUND` of a mask, in both directions."""
    for axis in (0, 1):
        wide = mask.copy()
        for step in range(1, _AROUND + 1):
            ahead, behind = [slice(None)] * 2, [slice(None)] * 2
            ahead[axis], behind[axis] = slice(step, None), slice(None, -step)
            wide[tuple(ahead)] |= mask[tuple(behind)]
            wide[tuple(behind)] |= mask[tuple(ahead)]
        mask = wide
    return mask


def _fill(
    rgba: np.ndarray,
    depth: np.ndarray,
    top: int,
    left: int,
    mean: tuple[np.ndarray, np.ndarray],
    where: np.ndarray,
) -> None:
    """Put means into the lattice's pixels."""
    colour, far = mean
    alpha = colour[..., 3:]
    straight = np.where(alpha > 0, colour[..., :3] / np.where(alpha > 0, alpha, 1), 0)
    np.copyto(_lattice(rgba, top, left)[..., :3], straight, where=where[..., None])
    np.copyto(_lattice(rgba, top, left)[..., 3:], alpha, where=where[..., None])
    np.copyto(_lattice(depth, top, left), far, where=where)
