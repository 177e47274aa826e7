"""From an avatar to a textured mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ..errors import InputError
from ..field.avatar import Avatar, head_of
from ..field.identities import identity
from ..head.geometry import vertex_normals
from ..progress import Report
from ..rendering.render import Scene, pose_scene
from .surface import surface
from .texture import paint, unwrap

SPACING = 0.0025  # metres


@dataclass(eq=False)
class Baked:
    """vertices [V, 3] metres; normals [V, 3]; triangles [T, 3] int32; uvs [V, 2], v up; texture
    [S, S, 3] in [0, 1], display-referred sRGB, row 0 at v = 1."""

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    uvs: np.ndarray
    texture: np.ndarray


def neutral_scene(avatar: Avatar, appearance: str) -> Scene:
    """The avatar at rest, its mouth closed, wearing an appearance."""
    who = identity(avatar, appearance)
    vertices = head_of(avatar, appearance).shaped(who.betas)
    with torch.inference_mode():
        return pose_scene(avatar, vertices, appearance)


def bake(
    scene: Scene,
    *,
    texture: int = 2048,
    triangles: int = 50_000,
    spacing: float = SPACING,
    progress: Report | None = None,
) -> Baked:
    """The field of a posed avatar as a mesh of about so many triangles and a square texture.

    Raises InputError for sizes that make none.
    """
    if not 16 <= texture <= 8192:
        raise InputError(f"a texture of {texture} pixels: from 16 to 8192")
    if triangles < 100:
        raise InputError(f"{triangles} triangles: at least 100")

    def stage(start: float, end: float) -> Report | None:
        if progress is None:
            return None
        report = progress
        return lambda fraction, **f: report(start + fraction * (end - start), **f)

    points, faces = surface(scene, spacing, triangles, progress=stage(0, 0.5))
    normals = vertex_normals(points, faces)
    source, corners, uvs = unwrap(points, faces, texture)
    vertices, normals = points[source], normals[source]
    painted = paint(scene, vertices, normals, corners, uvs, texture, progress=stage(0.7, 1))
    return Baked(vertices, normals, corners, uvs, painted)
