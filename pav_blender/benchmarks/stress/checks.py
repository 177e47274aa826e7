"""What every picture must be, however hostile the scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ...core.deformation import Deformer
from ...core.evaluation.metrics import over, psnr
from ...core.kernels.cpu.threads import torch_alone
from ...core.rendering.cameras import Camera
from ...core.rendering.render import Picture, RenderSettings, render
from ..plain import quadrature
from .scene import Found
from .subjects import Head

COARSE = 4e-3  # metres between places where the oracle looks as well
# every place looked at, nothing passed over, no ray ended
WHOLE = replace(RenderSettings.preset("reference"), step=COARSE)
EVERY = replace(WHOLE, skip=True, probe=1, longest=1, wave=RenderSettings().wave)
LEVELS = 255.0
_PIXELS = 6  # that the oracle looks at
_POINTS = 300


def shown(head: Head, settings: RenderSettings | None = None, camera: Camera | None = None,
          appearance: str | dict[str, float] | None = None) -> Picture:  # fmt: skip
    return render(
        head.avatar,
        head.vertices,
        camera or head.camera,
        appearance or head.avatar.appearances[0],
        settings,
        expression=head.expression,
    )


def wrong_values(picture: Picture, camera: Camera) -> int:
    """How many numbers of a picture are not what they may be: colours and alpha finite and in
    [0, 1], a depth above 0 where anything shows and infinite elsewhere, the size asked for."""
    size = camera.height, camera.width
    if picture.rgba.shape != (*size, 4) or picture.depth.shape != size:
        return camera.width * camera.height
    wrong = ~(picture.rgba >= 0) | ~(picture.rgba <= 1)
    seen = picture.rgba[..., 3] > 0
    depth = np.where(
        seen, np.isfinite(picture.depth) & (picture.depth > 0), np.isposinf(picture.depth)
    )
    return int(wrong.sum() + (~depth).sum())


def black(picture: Picture) -> np.ndarray:
    """Premultiplied colour and alpha [H, W, 4]."""
    return np.concatenate([picture.rgba[..., :3] * picture.rgba[..., 3:], picture.rgba[..., 3:]], 2)


def apart(a: Picture, b: Picture) -> float:
    """The greatest difference of two pictures before black, in 1/255."""
    return float(np.abs(black(a) - black(b)).max()) * LEVELS


def likeness(a: Picture, b: Picture) -> float:
    """PSNR before white, dB, at most 99."""
    return min(99.0, float(psnr(over(a.rgba, 1.0), over(b.rgba, 1.0))))


def sound(found: Found, picture: Picture, camera: Camera, of: str = "") -> None:
    """Claims that every number of a picture is what it may be."""
    found.at_most(f"wrong numbers{of}", wrong_values(picture, camera), 0)
    found.raw[f"covered{of}"] = round(float((picture.rgba[..., 3] > 0.5).mean()), 4)


def same_bits(found: Found, head: Head, first: Picture, settings: RenderSettings | None = None,
              camera: Camera | None = None, of: str = "") -> None:  # fmt: skip
    """Claims that the same input gives the same bits."""
    again = shown(head, settings, camera)
    differ = (first.rgba != again.rgba).sum() + (first.depth != again.depth).sum()
    found.at_most(f"numbers that differ when drawn again{of}", int(differ), 0)


def right_distances(found: Found, head: Head) -> None:
    """Claims that the distance to the mesh is that of trying every triangle in float64."""
    random = np.random.default_rng(0)
    low, high = head.vertices.min(0), head.vertices.max(0)
    points = torch.from_numpy(
        random.uniform(low - 0.02, high + 0.02, (_POINTS, 3)).astype(np.float32)
    )
    distances = []
    for reference in (False, True):
        avatar = head.avatar
        mode = avatar.config.frames
        deformer = Deformer(avatar.canonical_vertices, avatar.triangles, mode, reference=reference)
        with torch_alone():
            distances.append(deformer.nearest(deformer.pose(head.vertices), points)[2].double())
    gap = float((distances[0] - distances[1]).abs().max())
    found.at_most("distances from float64", gap * 1e6, 1.0, "um")


def agrees(found: Found, head: Head, *, levels: float = 2.0, skip_db: float = 35.0,
           near: tuple[int, int] | None = None, of: str = "") -> None:  # fmt: skip
    """Claims that the picture is the oracle's (plain torch, distances in float64, every sample
    against every triangle) where nothing is passed over, and hardly another where empty space is.

    near: a pixel (column, row) about which the oracle looks; else it looks where anything
    shows. of: what is said of which picture in the claims' names.
    """
    camera = head.camera
    whole, every = shown(head, WHOLE), shown(head, EVERY)
    sound(found, shown(head), camera, of)
    flat = black(whole).reshape(-1, 4)
    pixels = _chosen(flat[:, 3], camera, near)
    truth = quadrature(head.avatar, head.vertices, head.expression, 0, camera, pixels, COARSE)
    found.at_most(
        f"from plain torch, worst pixel{of}",
        np.abs(flat[pixels] - truth).max() * LEVELS,
        levels,
        "/255",
    )
    found.at_least(f"with empty space passed over{of}", likeness(every, whole), skip_db, "dB")
    same_bits(found, head, every, EVERY, of=of)


def _chosen(alpha: np.ndarray, camera: Camera, near: tuple[int, int] | None) -> np.ndarray:
    random = np.random.default_rng(0)
    if near is not None:
        column, row = np.clip(
            np.array(near) + random.integers(-1, 2, (3, 2)),
            0,
            (camera.width - 1, camera.height - 1),
        ).T
        return row * camera.width + column
    some = np.flatnonzero(alpha > 0.02)
    if len(some) == 0:
        some = np.arange(len(alpha))
    return random.choice(some, min(_PIXELS, len(some)), replace=False)


def with_vertices(head: Head, vertices: np.ndarray) -> Head:
    return replace(head, vertices=np.ascontiguousarray(vertices, np.float32))
