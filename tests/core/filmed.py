"""Videos of the synthetic person, made as a camera would have: over a background, encoded."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import av
import numpy as np

from pav_blender.core.collection import read_collection
from pav_blender.core.images import read_rgba
from pav_blender.core.tracking.crop import resize

STUDIO = Path(__file__).resolve().parents[2] / "data" / "studio3"


@cache
def room(height: int, width: int, seed: int = 0) -> np.ndarray:
    """A blurred background, float32 [H, W, 3] in [0, 1]."""
    coarse = np.random.default_rng(seed).uniform(0.15, 0.85, (1, 3, 7, 7)).astype(np.float32)
    rows, columns = np.linspace(0, 5.99, height), np.linspace(0, 5.99, width)
    top, left = rows.astype(int), columns.astype(int)
    down, along = (rows - top)[:, None], (columns - left)[None]
    grid = coarse[0]
    upper = grid[:, top][:, :, left] * (1 - along) + grid[:, top][:, :, left + 1] * along
    lower = grid[:, top + 1][:, :, left] * (1 - along) + grid[:, top + 1][:, :, left + 1] * along
    return np.ascontiguousarray((upper * (1 - down) + lower * down).transpose(1, 2, 0), np.float32)


@cache
def person(look: str, row: int, side: int) -> np.ndarray:
    """A picture of the studio's person, float32 [side, side, 4], colours premultiplied."""
    collection = read_collection(STUDIO)
    clip = collection.clip(look)
    rgba = read_rgba(collection.image_path(clip, row)).astype(np.float32) / 255
    rgba[..., :3] *= rgba[..., 3:]
    return resize(rgba, side).clip(0, 1)


def frame(
    look: str, row: int, *, height: int = 240, width: int = 320, scale: float = 0.95, seed: int = 0
) -> np.ndarray:
    """uint8 [H, W, 3]: the person stands in the middle at the bottom of a room."""
    picture = room(height, width, seed).copy()
    side = int(min(height, width) * scale)
    rgba = person(look, row, side)
    left = (width - side) // 2
    part = picture[height - side :, left : left + side]
    part[:] = rgba[..., :3] + part * (1 - rgba[..., 3:])
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def film(path: Path, pictures: list[np.ndarray], rate: int = 25, codec: str = "mpeg4") -> Path:
    """Encodes pictures [H, W, 3] uint8."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = 40 * stream.height * stream.width
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path
