"""The paper's quadrature in plain torch: no skips, no compiled kernel; the oracle of pictures."""

from __future__ import annotations

import numpy as np
import torch

from ..core import kernels
from ..core.deformation import Deformer
from ..core.deformation.rigid import stance
from ..core.field.avatar import Avatar
from ..core.field.field import condition
from ..core.field.identities import code
from ..core.kernels.cpu.threads import torch_alone
from ..core.rendering.cameras import Camera
from ..core.rendering.rays import camera_rays, pack, samples_of
from ..core.rendering.wearing import space_of
from ..core.training.frames import Frame

_RAYS = 2  # at once: every sample is held against every triangle


def dense(avatar: Avatar, frame: Frame, pixels: np.ndarray, samples: int = 1024) -> np.ndarray:
    """Colours before white [N, 3] of a frame's pixels (row * width + column) [N], in its own
    appearance: `samples` places along the 0.4 metres of ray around the head, each evaluated."""
    pose = frame.vertices, frame.expression, frame.appearance
    rgba = quadrature(avatar, *pose, frame.camera, pixels, 0.4 / samples)
    return rgba[:, :3] + 1 - rgba[:, 3:]


def quadrature(
    avatar: Avatar,
    vertices: np.ndarray,
    expression: np.ndarray,
    appearance: int,
    camera: Camera,
    pixels: np.ndarray,
    step: float,
) -> np.ndarray:
    """Premultiplied colour and opacity [N, 4] of pixels (row * width + column) [N], with a place
    every `step` metres."""
    with torch.inference_mode(), kernels.plain_torch(), torch_alone():
        deformer = Deformer(
            avatar.canonical_vertices, avatar.triangles, avatar.config.frames, reference=True
        )
        mesh, space = deformer.pose(vertices), space_of(avatar, appearance)
        stands = stance(avatar.canonical_vertices, vertices, avatar.rigid_weights)
        seen = condition(avatar.config, expression, stands.turn, code(avatar, appearance))
        worn = avatar.field.wearing([appearance])
        ops = kernels.select("cpu").marching
        found = []
        for start in range(0, len(pixels), _RAYS):
            part = pixels[start : start + _RAYS]
            rays = camera_rays(camera, part % camera.width, part // camera.width)
            jitter = torch.full((len(part),), 0.5)
            around = ops.bounds(mesh.vertices, avatar.config.reach, rays.origins, rays.directions)
            first, last = ops.lattice(*around, jitter, step)
            wave = ops.march(
                mesh, rays.origins, rays.directions, first, last, jitter, step,
                wave=max(1, int((last - first).max()) + 1), clearance=space,
                band=avatar.config.reach,
            )  # fmt: skip
            packed, _ = pack(wave, jitter, step)
            taken = samples_of(packed, space, 0, seen, rays, stands)
            sigma, rgb = avatar.field(taken, worn)
            colour, opacity, _, _ = ops.composite(sigma, rgb, packed.t, step, taken.ray, len(part))
            found.append(torch.cat([colour, opacity[:, None]], 1))
    return torch.cat(found).numpy()
