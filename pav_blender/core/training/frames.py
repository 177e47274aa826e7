"""The frames of a collection as training wants them: packed pictures, posed meshes, targets."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from ..collection import Clip, Collection
from ..errors import InputError
from ..images import read_rgba
from ..progress import Report
from ..rendering.cameras import Camera
from ..rendering.rasterise import rasterise
from ..rendering.rays import TILE


@dataclass(eq=False)
class Frame:
    """One frame: rgba uint8 [H, W, 4]; depth [H, W] float16 metres along z of the tracked mesh in
    the face region, 0 elsewhere; tiles [K, 2] int16: rows and columns of tiles near the matte."""

    rgba: np.ndarray
    depth: np.ndarray
    tiles: np.ndarray
    camera: Camera
    vertices: np.ndarray
    expression: np.ndarray
    appearance: int
    name: str


def halved(frame: Frame) -> Frame:
    """The frame at half its size, every pixel the mean of four; an odd last row or column goes."""
    height, width = (size // 2 for size in frame.rgba.shape[:2])
    if min(height, width) < 1:
        return frame
    shape = (height, 2, width, 2, -1)
    rgba = frame.rgba[: 2 * height, : 2 * width].astype(np.float32).reshape(shape)
    alpha = rgba[..., 3:].sum((1, 3))
    colour = (rgba[..., :3] * rgba[..., 3:]).sum((1, 3)) / np.maximum(alpha, 1e-6)
    mean = np.concatenate([colour, alpha / 4], -1)
    depth = frame.depth[: 2 * height, : 2 * width].astype(np.float32).reshape(shape)
    known = (depth > 0).all((1, 3))
    small = np.where(known, depth.mean((1, 3)), 0)[..., 0].astype(np.float16)
    rgba8 = (mean + 0.5).astype(np.uint8)
    return dataclasses.replace(
        frame,
        rgba=rgba8,
        depth=small,
        tiles=_tiles(rgba8[..., 3]),
        camera=frame.camera.window(0, 0, 2 * width, 2 * height).resized(width, height),
    )


def camera_of(clip: Clip, row: int) -> Camera:
    return Camera(clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row])


def load_picture(collection: Collection, clip: Clip, row: int) -> np.ndarray:
    """The picture of a frame, uint8 [H, W, 4]; InputError where it has another size."""
    path = collection.image_path(clip, row)
    rgba = read_rgba(path)
    if rgba.shape[:2] != (clip.height, clip.width):
        raise InputError(
            f"{path}: {rgba.shape[1]}x{rgba.shape[0]} pixels; the clip says "
            f"{clip.width}x{clip.height}"
        )
    return rgba


def load_frames(
    collection: Collection,
    clip: Clip,
    rows: np.ndarray,
    *,
    targets: bool = True,
    progress: Report | None = None,
) -> list[Frame]:
    """Reads `rows` of a clip. `targets=False` leaves out the depth (zeros) and is faster."""
    if len(rows) == 0:
        return []
    appearance = collection.appearances.index(clip.appearance)
    posed = collection.posed(clip, rows)
    frames = []
    for done, row in enumerate(rows):
        rgba = load_picture(collection, clip, row)
        camera = camera_of(clip, row)
        depth = np.zeros(rgba.shape[:2], np.float16)
        if targets:
            depth = face_depth(collection, rgba, posed[done], camera)
        frames.append(
            Frame(
                rgba,
                depth,
                _tiles(rgba[..., 3]),
                camera,
                posed[done],
                clip.expression[row],
                appearance,
                f"{clip.name}/{clip.frame_id[row]:06d}",
            )
        )
        if progress:
            progress((done + 1) / len(rows), frame=frames[-1].name)
    return frames


def face_depth(
    collection: Collection, rgba: np.ndarray, vertices: np.ndarray, camera: Camera
) -> np.ndarray:
    """Metres [H, W] float16 along z of a posed mesh [V, 3] where the face shows; 0 elsewhere."""
    surface, triangle, _ = rasterise(vertices, collection.head.triangles, camera)
    seen = (triangle >= 0) & _face_triangles(collection)[triangle] & (rgba[..., 3] > 200)
    return np.where(seen, surface, 0).astype(np.float16)


def _face_triangles(collection: Collection) -> np.ndarray:
    """Triangles [T] whose depth is trusted: the face's skin, not eyes, lips or mouth; none of a
    head that does not say where its face is."""
    regions = collection.head.regions
    if "face" not in regions:
        return np.zeros(len(collection.head.triangles), bool)
    trusted = regions["face"].copy()
    for name in ("lips", "mouth_interior", "eyeballs", "teeth"):
        if name in regions:
            trusted &= ~regions[name]
    return trusted[collection.head.triangles].all(1)


def _tiles(alpha: np.ndarray) -> np.ndarray:
    """Tiles within two tiles of any opaque pixel."""
    height, width = alpha.shape
    rows, columns = -(-height // TILE), -(-width // TILE)
    padded = np.zeros((rows * TILE, columns * TILE), bool)
    padded[:height, :width] = alpha > 0
    used = padded.reshape(rows, TILE, columns, TILE).any((1, 3))
    grown = used.copy()
    for axis in (0, 1):
        for shift in (1, 2):
            front, back = [slice(None)] * 2, [slice(None)] * 2
            front[axis], back[axis] = slice(shift, None), slice(None, -shift)
            source = grown.copy() if axis else used
            grown[tuple(front)] |= source[tuple(back)]
            grown[tuple(back)] |= source[tuple(front)]
    found = np.argwhere(grown)
    if len(found) == 0:
        found = np.argwhere(np.ones((rows, columns), bool))
    return found.astype(np.int16)
