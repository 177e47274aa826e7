"""The other meshes of a scene as simply shaded solids, before and behind an avatar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .. import kernels
from ..kernels.soup import Lights, Soup
from .cameras import Camera
from .colour import linear_premultiplied

NEAR = 0.01  # metres; what is nearer to a camera is not seen
# x right, y down, z forward: a key light over the left shoulder, a weak one from the right
LIGHTS = Lights(np.array([[-0.32, -0.44, -0.5], [0.2, 0.02, -0.14]]), 0.12)


@dataclass(frozen=True, eq=False)
class Shape:
    """A mesh in its own space: vertices [V, 3] float32 metres, triangles [T, 3] int32, normals
    [N, 3] float32, normal_of [T, 3] int32 (each corner's), material [T] int32 (the slot)."""

    vertices: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray
    normal_of: np.ndarray
    material: np.ndarray


@dataclass(frozen=True, eq=False)
class Solid:
    """A shape in the world: place [4, 4] takes its own space there; colours [M, 3] float32,
    scene-linear, a row for each slot."""

    shape: Shape
    place: np.ndarray
    colours: np.ndarray

    def equals(self, other: Solid) -> bool:
        """Whether both would give the same picture."""
        return (
            self.shape is other.shape
            and np.array_equal(self.place, other.place)
            and np.array_equal(self.colours, other.colours)
        )


def gather(solids: Sequence[Solid]) -> Soup:
    """One soup of all shapes, which stays as it is where only places and colours change."""
    starts = np.cumsum([0, *(len(solid.shape.vertices) for solid in solids)])
    firsts = np.cumsum([0, *(len(solid.shape.normals) for solid in solids)])
    rows = np.cumsum([0, *(len(solid.colours) for solid in solids)])
    shapes = [solid.shape for solid in solids]

    def joined(parts: list[np.ndarray], width: tuple[int, ...], kind: type) -> np.ndarray:
        return np.concatenate([np.empty((0, *width), kind), *parts]).astype(kind, copy=False)

    return Soup(
        joined([shape.vertices for shape in shapes], (3,), np.float32),
        np.repeat(np.arange(len(solids), dtype=np.int32), np.diff(starts)),
        joined(
            [s.triangles + np.int32(n) for s, n in zip(shapes, starts, strict=False)],
            (3,),
            np.int32,
        ),
        joined([shape.normals for shape in shapes], (3,), np.float32),
        joined(
            [s.normal_of + np.int32(n) for s, n in zip(shapes, firsts, strict=False)],
            (3,),
            np.int32,
        ),
        joined(
            [
                np.clip(s.shape.material, 0, len(s.colours) - 1) + np.int32(n)
                for s, n in zip(solids, rows, strict=False)
            ],
            (),
            np.int32,
        ),
    )


class Gatherer:
    """Keeps the last soup: while things only move, nothing is copied."""

    def __init__(self) -> None:
        self._key: tuple[tuple[Shape, int], ...] = ()
        self._soup: Soup | None = None

    def __call__(self, solids: Sequence[Solid]) -> Soup:
        # Shape compares by identity: the key keeps the shapes alive, so none can take another's
        key = tuple((solid.shape, len(solid.colours)) for solid in solids)
        if self._soup is None or key != self._key:
            self._key, self._soup = key, gather(solids)
        return self._soup


def picture(
    solids: Sequence[Solid], camera: Camera, soup: Soup | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Colour [H, W, 3] float32, scene-linear, and depth [H, W] float32, metres along the camera's
    axis, inf where nothing is. soup: what `gather` made of the same shapes."""
    soup = soup or gather(solids)
    world_to_camera = np.linalg.inv(camera.camera_to_world)
    to_pixels = np.zeros((4, 4))
    to_pixels[:3, :3] = camera.intrinsics
    to_pixels[3, 2] = 1.0
    if camera.parallel:
        to_pixels[:3, 3], to_pixels[:3, 2] = to_pixels[:3, 2], 0.0
    places = np.array([solid.place for solid in solids], np.float64).reshape(-1, 4, 4)
    seen = world_to_camera @ places
    # the transposed inverse but for a positive factor, also of what is flat
    turns = np.stack(
        [np.cross(seen[:, (i + 1) % 3, :3], seen[:, (i + 2) % 3, :3]) for i in range(3)], 1
    )
    turns *= np.where(np.linalg.det(seen[:, :3, :3]) < 0, -1.0, 1.0)[:, None, None]
    palette = np.concatenate([np.empty((0, 3)), *(s.colours for s in solids)]).astype(np.float32)
    return kernels.select("cpu").solids.draw(
        soup, to_pixels @ seen, turns, palette, LIGHTS, (camera.width, camera.height), NEAR
    )


def farthest(depth: np.ndarray, samples: int) -> np.ndarray:
    """How far a ray is to look that stands for samples x samples pixels of a finer depth."""
    return np.max(_parts(depth, samples), axis=0)


def compose(
    rgba: np.ndarray,
    depth: np.ndarray,
    colour: np.ndarray,
    solid_depth: np.ndarray,
    background: Sequence[float] | None,
    *,
    enlarged: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """An avatar's picture among solids.

    rgba [H, W, 4] straight sRGB and depth [H, W] of an avatar that was rendered up to the
    `farthest` solid in each pixel; colour [nH, nW, 3] scene-linear and solid_depth [nH, nW]: n
    samples of the solids along either side of a pixel. Each sample goes before or behind the
    avatar by depth. background: scene-linear, None for a transparent one. Returns the whole [H, W,
    4], scene-linear and premultiplied, and its depth [H, W], inf where nothing is; `enlarged`:
    [nH, nW] of both, where samples are not averaged.
    """
    samples = len(colour) // len(rgba)
    over = linear_premultiplied(rgba)
    if enlarged:
        over, depth = (_repeated(values, samples) for values in (over, depth))
        samples = 1
    left = 1 - over[..., 3:]
    total = np.zeros_like(over)
    for shade, distance in zip(_parts(colour, samples), _parts(solid_depth, samples), strict=True):
        own = np.empty_like(over)
        own[..., :3], own[..., 3] = shade, 1.0
        own[~np.isfinite(distance)] = 0.0 if background is None else (*background, 1.0)
        shown = over + left * own
        total += np.where((distance < depth)[..., None], own, shown)
    nearest = np.min(_parts(solid_depth, samples), axis=0)
    return total / np.float32(samples**2), np.minimum(depth, nearest)


def _repeated(values: np.ndarray, times: int) -> np.ndarray:
    return np.repeat(np.repeat(values, times, 0), times, 1)


def _parts(values: np.ndarray, samples: int) -> list[np.ndarray]:
    """The samples of each pixel, as that many pictures."""
    return [values[y::samples, x::samples] for y in range(samples) for x in range(samples)]
