"""A square window on the head: still where it can be, slowly following where it cannot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from ..errors import InputError

if TYPE_CHECKING:
    from .observe import Observations

# of the face's size (forehead to chin, or as wide where the head is turned): how far the window
# should reach above the forehead's landmarks, below the chin and to the sides; and what it must
_ABOVE, _BELOW, _BESIDE = 0.5, 0.7, 0.55
_ABOVE_LEAST, _BELOW_LEAST, _BESIDE_LEAST = 0.36, 0.1, 0.2
_FOREHEAD, _CHIN = 10, 152
# of the window a head needs: beyond it the picture follows the head instead of holding still
_STILL_LIMIT = 1.45
_SMALLEST = 48


@dataclass(frozen=True, eq=False)
class Crop:
    """side: pixels of the source frame; corners [F, 2] int: left and top, in the source frame."""

    side: int
    corners: np.ndarray

    @property
    def still(self) -> bool:
        return bool((self.corners == self.corners[0]).all())

    def intrinsics(self, focal: float, width: int, height: int, size: int) -> np.ndarray:
        """[F, 3, 3] of the cropped, resized pictures; the source's centre is its axis."""
        scale = size / self.side
        matrices = np.zeros((len(self.corners), 3, 3))
        matrices[:, 0, 0] = matrices[:, 1, 1] = focal * scale
        matrices[:, 0, 2] = (width / 2 - self.corners[:, 0]) * scale
        matrices[:, 1, 2] = (height / 2 - self.corners[:, 1]) * scale
        matrices[:, 2, 2] = 1
        return matrices


def cut(rgb: np.ndarray, corner: np.ndarray, side: int, size: int) -> np.ndarray:
    """The window of a frame [H, W, 3] uint8 as float32 [size, size, 3] in [0, 1]."""
    left, top = int(corner[0]), int(corner[1])
    window = np.ascontiguousarray(rgb[top : top + side, left : left + side])
    return resize(window.astype(np.float32) / 255, size).clip(0, 1)


def resize(picture: np.ndarray, size: int) -> np.ndarray:
    """float32 [S, S, C] -> [size, size, C]: area-true when smaller, bicubic when larger."""
    if picture.shape[0] == size:
        return picture
    stacked = torch.from_numpy(picture).permute(2, 0, 1)[None]
    resized = torch.nn.functional.interpolate(
        stacked, (size, size), mode="bicubic", antialias=True, align_corners=False
    )
    return resized[0].permute(1, 2, 0).contiguous().numpy()


_ACROSS = 64  # columns (rows) looked at for bars above and below (at the sides)


def edges(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What `content_box` needs of a frame [H, W, 3]: grey [H, 64] and, turned, [W, 64], uint8."""
    height, width = rgb.shape[:2]
    tall = rgb[:, np.linspace(0, width - 1, _ACROSS).astype(int)]
    wide = rgb[np.linspace(0, height - 1, _ACROSS).astype(int)].transpose(1, 0, 2)
    return tuple((strip.mean(axis=2) + 0.5).astype(np.uint8) for strip in (tall, wide))


def content_box(tall: np.ndarray, wide: np.ndarray) -> tuple[int, int, int, int]:
    """left, top, right, bottom of the picture inside its black bars.

    tall [N, H, 64], wide [N, W, 64]: of N frames, see `edges`. A bar is dark, the same all along
    and in every frame, and ends in a sharp line.
    """
    tall, wide = tall.astype(np.float32), wide.astype(np.float32)
    right = wide.shape[1] - _bar(wide[:, ::-1])
    bottom = tall.shape[1] - _bar(tall[:, ::-1])
    return _bar(wide), _bar(tall), right, bottom


def _bar(grey: np.ndarray) -> int:
    """Rows of a bar at the top of [N, H, 64]."""
    limit = grey.shape[1] // 3
    colour = float(np.median(grey[:, 0]))
    if colour > 48:
        return 0
    # an encoder rings near the line, so a share of the pixels may stray
    strays = (np.abs(grey[:, :limit] - colour) > 12).mean(axis=(0, 2))
    inside = strays < 0.02
    rows = limit if inside.all() else int(np.argmin(inside))
    if rows == 0 or rows == limit:
        return 0
    edge = grey[:, min(rows + 3, grey.shape[1] - 1)]
    sharp = (np.abs(edge - colour) > 12).mean() > 0.3
    # two rows more: the line itself is blended by the encoder
    return rows + 2 if sharp else 0


def plan_crop(seen: Observations, box: tuple[int, int, int, int], name: str) -> Crop:
    """Where to cut every frame: one place for the whole clip if the head stays within reach.

    Raises InputError where the face is too small to learn anything from.
    """
    points = seen.landmarks[..., :2].astype(np.float64)
    low, high = points.min(axis=1), points.max(axis=1)
    face = np.maximum(
        np.linalg.norm(points[:, _CHIN] - points[:, _FOREHEAD], axis=1), high[:, 0] - low[:, 0]
    )
    size = float(np.median(face))
    wide_low = low - size * np.array([_BESIDE, _ABOVE])
    wide_high = high + size * np.array([_BESIDE, _BELOW])
    left, top, right, bottom = box
    room = min(right - left, bottom - top)
    need = float(np.median((wide_high - wide_low).max(axis=1)))
    union_low, union_high = _range(wide_low, wide_high)
    union = float((union_high - union_low).max())
    least_low, least_high = _range(
        (low - size * np.array([_BESIDE_LEAST, _ABOVE_LEAST])).clip([left, top], None),
        (high + size * np.array([_BESIDE_LEAST, _BELOW_LEAST])).clip(None, [right, bottom]),
    )
    still_side = min(round(union), room)
    if union <= _STILL_LIMIT * need and (least_high - least_low).max() <= still_side:
        side = still_side
        centre = ((union_low + union_high) / 2).clip(least_high - side / 2, least_low + side / 2)
        centres = np.broadcast_to(centre, low.shape)
    else:
        side = min(round(need * 1.1), room)
        centres = _calm((wide_low + wide_high) / 2, seen.frame_id)
    if side < _SMALLEST:
        raise InputError(
            f"{name}: the head covers only {side} pixels; use a video that shows it larger"
        )
    corners = np.round(centres - side / 2).astype(int)
    limit = np.array([right - side, bottom - side])
    return Crop(side, np.clip(corners, [left, top], np.maximum(limit, [left, top])))


def _range(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the boxes [F,2] cover together, a stray frame left aside."""
    return np.percentile(low, 2, axis=0), np.percentile(high, 98, axis=0)


def _calm(path: np.ndarray, frame_id: np.ndarray) -> np.ndarray:
    """Low-passes [F, 2] over about a second (sigma of 12 frames)."""
    apart = (frame_id[:, None] - frame_id[None]).astype(np.float64)
    weights = np.exp(-0.5 * (apart / 12) ** 2)
    return (weights / weights.sum(axis=1, keepdims=True)) @ path
