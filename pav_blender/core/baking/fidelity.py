"""How far a baked mesh's pictures are from the field's own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..evaluation.metrics import over, psnr
from ..progress import Report
from ..rendering.cameras import Camera
from ..rendering.rasterise import rasterise
from ..rendering.render import RenderSettings, Scene
from .bake import Baked
from .texture import sample
from .views import camera_at, field_picture

BACKGROUND = 1.0
# degrees: yaw, pitch; none of them is a view that the surface was made from
VIEWS = ((0, 0), (-20, 0), (20, 0), (-40, 0), (40, 0), (0, 15), (0, -15))
_FINER = 3  # samples a pixel each way


@dataclass(eq=False)
class Likeness:
    """One view, in dB: the head (where the field is half opaque, the outline with it), the part of
    it that both show, and the whole picture; field and mesh [H, W, 4] straight sRGB."""

    yaw: float
    pitch: float
    head_psnr: float
    inside_psnr: float
    psnr: float
    field: np.ndarray
    mesh: np.ndarray


def picture(baked: Baked, camera: Camera) -> np.ndarray:
    """The baked mesh as an engine shows it, unlit: straight sRGB with alpha [H, W, 4]."""
    fine = camera.resized(camera.width * _FINER, camera.height * _FINER)
    _, triangle, barycentric = rasterise(baked.vertices, baked.triangles, fine)
    seen = triangle >= 0
    corners = baked.uvs[baked.triangles[triangle[seen]]]
    colours = np.zeros((*triangle.shape, 4))
    colours[seen, :3] = sample(baked.texture, (corners * barycentric[seen][..., None]).sum(1))
    colours[seen, 3] = 1
    mean = colours.reshape(camera.height, _FINER, camera.width, _FINER, 4).mean((1, 3))
    mean[..., :3] /= np.maximum(mean[..., 3:], 1e-6)
    return mean.astype(np.float32)


def compare(
    scene: Scene, baked: Baked, size: int = 384, *, progress: Report | None = None
) -> list[Likeness]:
    """Pictures of both in views round the face, before white."""
    low, high = baked.vertices.min(0), baked.vertices.max(0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    found = []
    for done, (yaw, pitch) in enumerate(VIEWS):
        camera = camera_at(middle, np.radians(yaw), np.radians(pitch), radius, size)
        field, _ = field_picture(scene, camera, RenderSettings())
        mesh = picture(baked, camera)
        truth, ours = over(field, BACKGROUND), over(mesh, BACKGROUND)
        head = field[..., 3] > 0.5
        both = head & (mesh[..., 3] > 0.99)
        whole = psnr(ours, truth)
        head_psnr, inside_psnr = (psnr(ours, truth, mask) for mask in (head, both))
        found.append(Likeness(yaw, pitch, head_psnr, inside_psnr, whole, field, mesh))
        if progress:
            progress((done + 1) / len(VIEWS), step="compare")
    return found
