"""Where a clip was cut: the picture changes all at once, and not as it moves otherwise."""

from __future__ import annotations

import numpy as np

from .observe import Sightings

# a cut changes the thumbnail, and its colours wherever they are, by more than this (of 1), and by
# so many times what the frames about it change
_CHANGE, _COLOURS, _SUDDEN = 0.06, 0.12, 4.0
_ABOUT = 8
# of the face's size: how far it comes, or grows, from one frame to the next only by a cut
_LEAP, _GROWTH = 0.7, 1.5


def cut_into_shots(seen: Sightings) -> list[np.ndarray]:
    """The rows of `seen` in runs without a cut, in order."""
    change, colours = _changes(seen.thumbs)
    at = _sudden(change, _CHANGE) & (colours > _COLOURS)
    at |= _leaps(seen) & (change > _CHANGE / 2)
    return np.split(np.arange(len(seen.frame_id)), np.flatnonzero(at) + 1)


def _changes(thumbs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Between rows i and i + 1, [N - 1]: mean difference of the thumbnails, and half the mean
    difference of their colours' histograms."""
    flat = thumbs.astype(np.int16)
    change = np.abs(np.diff(flat, axis=0)).mean(axis=(1, 2, 3)) / 255
    # every value is shared out to its two nearest bins, so that a little light moves little
    place = thumbs.reshape(len(thumbs), -1, 3).astype(np.float32) / 255 * 7
    low = place.astype(int).clip(0, 6)
    part = place - low
    bins = np.arange(8)
    share = (low[..., None] == bins) * (1 - part)[..., None]
    share += (low[..., None] + 1 == bins) * part[..., None]
    histograms = share.mean(axis=1)  # [N, 3, 8]
    return change, np.abs(np.diff(histograms, axis=0)).sum(axis=2).mean(axis=1) / 2


def _sudden(change: np.ndarray, least: float) -> np.ndarray:
    """Where `change` is above `least`, and far above what it is about there."""
    about = np.array(
        [
            np.median(np.delete(change[max(0, i - _ABOUT) : i + _ABOUT + 1], min(i, _ABOUT)))
            if len(change) > 1
            else 0.0
            for i in range(len(change))
        ]
    )
    return (change > least) & (change > _SUDDEN * about)


def _leaps(seen: Sightings) -> np.ndarray:
    """[N - 1]: frames with one face each, which is somewhere else or of another size at once."""
    count = np.bincount(seen.row, minlength=len(seen.frame_id))
    alone = np.full(len(count), -1)
    alone[seen.row] = np.arange(len(seen.row))
    pairs = np.flatnonzero((count[:-1] == 1) & (count[1:] == 1))
    middles, sizes = places(seen.landmarks)
    before, after = alone[pairs], alone[pairs + 1]
    moved = np.linalg.norm(middles[after] - middles[before], axis=1)
    size = np.minimum(sizes[before], sizes[after])
    leaps = np.zeros(max(0, len(count) - 1), bool)
    leaps[pairs] = (moved > _LEAP * size) | (
        np.maximum(sizes[before], sizes[after]) > _GROWTH * size
    )
    return leaps


def places(landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of faces [K, 478, 3]: middles [K, 2] and sizes [K], pixels."""
    low, high = landmarks[..., :2].min(axis=1), landmarks[..., :2].max(axis=1)
    return (low + high) / 2, np.maximum((high - low).max(axis=1), 1.0)
