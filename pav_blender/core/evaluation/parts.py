"""Where the error is: what each part of a person has of their pixels, and of what they miss."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..collection import LABELS
from .metrics import decibels

# worn by the shoulders, or hidden by what they wear
NOT_HEAD = ("background", "neck", "cloth")
HEAD = "head: all but neck and cloth"


@dataclass(frozen=True)
class Part:
    """area: share of the person's pixels; error: share of their squared error, both in [0, 1];
    psnr: of its own pixels, all frames at once, dB."""

    name: str
    area: float
    error: float
    psnr: float


def measured(
    ours: np.ndarray, truth: np.ndarray, person: np.ndarray, labels: np.ndarray
) -> dict[str, list[float]]:
    """Pixels and summed squared error (mean of the channels) of each label in the person's pixels;
    ours and truth [H, W, 3], person bool [H, W], labels [H, W]."""
    squared = ((np.asarray(ours, np.float64) - truth) ** 2).mean(axis=2)[person]
    shown = labels[person]
    pixels = np.bincount(shown, minlength=len(LABELS))
    errors = np.bincount(shown, squared, minlength=len(LABELS))
    return {
        name: [int(pixels[number]), float(errors[number])]
        for number, name in enumerate(LABELS)
        if pixels[number]
    }


def shares(rows: Sequence[Mapping[str, Any]]) -> list[Part]:
    """Of frames' rows that have `parts` (see `measured`): each label that is seen, then the head
    without what shoulders wear. Empty where no row has them."""
    found = [row["parts"] for row in rows if "parts" in row]
    seen = [name for name in LABELS if any(name in frame for frame in found)]
    if not seen:
        return []
    total = _summed(found, seen)
    lines = [_part(name, _summed(found, [name]), total) for name in seen]
    head = [name for name in seen if name not in NOT_HEAD]
    return [*lines, _part(HEAD, _summed(found, head), total)] if head else lines


def _summed(
    found: Iterable[Mapping[str, Sequence[float]]], names: Iterable[str]
) -> tuple[float, float]:
    names = set(names)
    pairs = [frame[name] for frame in found for name in frame if name in names]
    return sum(pair[0] for pair in pairs), sum(pair[1] for pair in pairs)


def _part(name: str, own: tuple[float, float], total: tuple[float, float]) -> Part:
    pixels, error = own
    share = error / total[1] if total[1] else 0.0
    return Part(name, pixels / total[0], share, decibels(error / pixels))
