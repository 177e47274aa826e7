"""A small collection made without Cycles: the built-in head, painted and rasterised."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pav_blender.core.collection import Clip, CollectionWriter
from pav_blender.core.head import builtin_head
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.rendering.rasterise import rasterise

APPEARANCES = ("plain", "bushy")


def paint(head, which: int) -> np.ndarray:
    """Vertex colours [V, 3]: skin with stripes by height, and a scalp of the appearance's own."""
    y = head.template[:, 1]
    skin = np.array([[0.85, 0.65, 0.55], [0.6, 0.42, 0.3]][which])
    colour = np.tile(skin, (len(y), 1)) * (0.85 + 0.15 * np.sin(y * 400))[:, None]
    colour[head.regions["scalp"]] = [[0.2, 0.12, 0.08], [0.7, 0.7, 0.75]][which]
    colour[head.regions["lips"]] = [0.7, 0.25, 0.25]
    return np.clip(colour, 0, 1)


def grown(head, vertices: np.ndarray, which: int) -> np.ndarray:
    """The second appearance has a scalp that stands out: other geometry, not only paint."""
    if which == 0:
        return vertices
    scalp = head.regions["scalp"]
    centre = vertices[scalp].mean(0)
    out = vertices.copy()
    out[scalp] += 0.15 * (vertices[scalp] - centre)
    return out


def make_toy(
    path: Path,
    *,
    frames: int = 8,
    size: int = 64,
    seed: int = 0,
    betas: tuple[float, ...] = (0, 0, 0, 0),
    painted: tuple[int, int] = (0, 1),
) -> Path:
    """Writes two clips of `frames` frames (the last two held out) and returns `path`.

    betas: whose head it is; painted: which look (`paint`) each appearance has.
    """
    random = np.random.default_rng(seed)
    head = builtin_head()
    betas = np.array(betas, np.float32)
    centre = head.shaped(betas)[head.regions["face"]].mean(0)
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = np.diag([1, -1, -1])
    camera_to_world[:3, 3] = centre + np.array([0, 0, 0.75])
    focal = 2.0 * size
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    camera = Camera(size, size, intrinsics, camera_to_world)
    with CollectionWriter(path, "builtin", betas) as writer:
        for which, name in zip(painted, APPEARANCES, strict=True):
            pose = np.zeros((frames, len(head.joint_names), 3), np.float32)
            pose[:, 1, 1] = np.linspace(-0.5, 0.5, frames)
            pose[:, 1, 0] = random.uniform(-0.1, 0.1, frames)
            expression = np.zeros((frames, len(head.expression_names)), np.float32)
            expression[:, head.expression_names.index("jawOpen")] = random.uniform(0, 1, frames)
            translation = np.zeros((frames, 3), np.float32)
            posed = head.pose(betas, expression, pose, translation).numpy()
            for row in range(frames):
                rgba = draw(head, posed[row], camera, which)
                writer.image(name, row, rgba)
            split = np.array(["train"] * (frames - 2) + ["test"] * 2)
            writer.clip(
                Clip(
                    name=name,
                    appearance=name,
                    width=size,
                    height=size,
                    expression=expression,
                    pose=pose,
                    translation=translation,
                    intrinsics=np.tile(intrinsics, (frames, 1, 1)),
                    camera_to_world=np.tile(camera_to_world, (frames, 1, 1)),
                    frame_id=np.arange(frames),
                    split=split,
                )
            )
    return path


def draw(head, posed: np.ndarray, camera: Camera, which: int) -> np.ndarray:
    """uint8 [H, W, 4], three by three samples a pixel."""
    fine = camera.resized(camera.width * 3, camera.height * 3)
    shape = grown(head, posed, which)
    _, triangle, barycentric = rasterise(shape, head.triangles, fine)
    colours = paint(head, which)[head.triangles[triangle]]
    colour = (colours * barycentric[..., None]).sum(2)
    alpha = (triangle >= 0).astype(np.float64)
    grid = (camera.height, 3, camera.width, 3)
    covered = alpha.reshape(grid).mean((1, 3))
    summed = (colour * alpha[..., None]).reshape(*grid, 3).mean((1, 3))
    straight = summed / np.maximum(covered, 1e-6)[..., None]
    return np.round(np.concatenate([straight, covered[..., None]], 2) * 255).astype(np.uint8)
