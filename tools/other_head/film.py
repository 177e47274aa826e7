"""Clips of the formula head, rasterised: a collection."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pav_blender.core.collection import Clip, CollectionWriter
from pav_blender.core.head import load_head
from pav_blender.core.head.geometry import vertex_normals
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.rasterise import rasterise

from . import shape

LOOKS = ("plain", "fancy")
_LIGHT = np.array([0.35, 0.55, 0.76])
_FINER = 3


def film(
    path: Path, head_path: Path, d: np.ndarray, *, frames: int = 28, size: int = 160, seed: int = 0
) -> Path:
    """Writes a clip a look of `frames` frames, every seventh held out, and returns `path`.

    d [V, 3]: the directions on the ball of the head's vertices.
    """
    head, rng = load_head(head_path), np.random.default_rng(seed)
    names = (head.joint_names.index("neck"), head.joint_names.index("jaw"))
    pose_at = np.eye(4)
    pose_at[:3, :3] = np.diag([1, -1, -1])
    pose_at[:3, 3] = 0, -0.04, 0.8
    lens = np.array([[2.3 * size, 0, size / 2], [0, 2.3 * size, size / 2], [0, 0, 1]])
    camera = Camera(size, size, lens, pose_at)
    with CollectionWriter(
        path, str(head_path), np.zeros(0), fingerprint=head.fingerprint
    ) as writer:
        for look, name in enumerate(LOOKS):
            time = np.linspace(0, 2 * np.pi, frames, endpoint=False)
            pose = np.zeros((frames, len(head.joint_names), 3), np.float32)
            pose[:, names[0]] = np.stack(
                [0.18 * np.sin(2 * time), 0.75 * np.sin(time + look), 0.08 * np.cos(time)], 1
            )
            pose[:, names[1], 0] = 0.16 * np.clip(np.sin(3 * time), 0, 1)
            expression = rng.uniform(0, 0.8, (frames, len(head.expression_names)))
            translation = rng.normal(0, 0.004, (frames, 3)).astype(np.float32)
            posed = head.pose([], expression, pose, translation).numpy()
            for row in range(frames):
                writer.image(name, row, draw(head, d, posed[row], camera, look))
            writer.clip(
                Clip(
                    name=name,
                    appearance=name,
                    width=size,
                    height=size,
                    expression=expression,
                    pose=pose,
                    translation=translation,
                    intrinsics=np.tile(lens, (frames, 1, 1)),
                    camera_to_world=np.tile(pose_at, (frames, 1, 1)),
                    frame_id=np.arange(frames),
                    split=np.where(np.arange(frames) % 7 == 3, "test", "train"),
                )
            )
    return path


def draw(head, d: np.ndarray, posed: np.ndarray, camera: Camera, look: int) -> np.ndarray:
    """uint8 [H, W, 4], lit from the front left, several samples a pixel."""
    normals = vertex_normals(posed, head.triangles)
    outside = shape.grown(d, posed, normals, look)
    normals = vertex_normals(outside, head.triangles)
    shaded = shape.paint(d, look) * (0.45 + 0.6 * np.clip(normals @ _LIGHT, 0, 1))[:, None]
    fine = camera.resized(camera.width * _FINER, camera.height * _FINER)
    _, triangle, barycentric = rasterise(outside, head.triangles, fine)
    colour = (shaded[head.triangles[triangle]] * barycentric[..., None]).sum(2)
    alpha = (triangle >= 0).astype(float)[..., None]
    grid = (camera.height, _FINER, camera.width, _FINER, -1)
    covered = alpha.reshape(grid).mean((1, 3))
    mean = (colour * alpha).reshape(grid).mean((1, 3)) / np.maximum(covered, 1e-6)
    return np.round(np.clip(np.concatenate([mean, covered], 2), 0, 1) * 255).astype(np.uint8)
