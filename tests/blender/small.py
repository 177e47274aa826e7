"""A tiny avatar and a tiny collection for tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pav_blender.core.collection import Clip, CollectionWriter
from pav_blender.core.config import Config
from pav_blender.core.field.avatar import Avatar
from pav_blender.core.head import builtin_head

APPEARANCES = ["morning", "evening"]
WIDTH, HEIGHT = 48, 40
FRAMES = 4


def write_avatar(path: Path, seed: int = 1, appearances: list[str] = APPEARANCES) -> Path:
    """An untrained avatar with strong random colours: every setting changes its picture."""
    import torch

    head = builtin_head()
    betas = np.zeros(len(head.shape_basis), np.float32)
    config = Config(
        levels=4,
        log2_entries=10,
        finest_resolution=64,
        hidden=16,
        latent_channels=4,
        occupancy_resolution=24,
        density_bias=-3.0,
        reach=0.03,
        seed=seed,
    )
    avatar = Avatar.create(
        config,
        appearances,
        head.canonical(betas),
        head.triangles,
        head.uvs,
        head.uv_triangles,
        head.expression_names,
        head_name="builtin",
        head_fingerprint=head.fingerprint,
        betas=betas,
    )
    with torch.no_grad():
        for name, value in avatar.field.named_parameters():
            if "colour" in name or "latent" in name:
                value.mul_(4.0)
    avatar.save(path)
    return path


def write_collection(path: Path) -> Path:
    """One clip "walk" of a turning, talking head; its frame numbers start at 3."""
    head = builtin_head()
    rng = np.random.default_rng(0)
    angle = np.linspace(-0.4, 0.4, FRAMES)
    pose = np.zeros((FRAMES, len(head.joint_names), 3), np.float32)
    pose[:, 1, 1], pose[:, 2, 0] = angle, np.abs(angle)
    camera = np.diag([1.0, -1, -1, 1])
    camera[:3, 3] = 0.02, -0.02, 0.7
    intrinsics = np.array([[64.0, 0, WIDTH / 2 - 2.5], [0, 64, HEIGHT / 2 + 1.5], [0, 0, 1]])
    clip = Clip(
        name="walk",
        appearance="morning",
        width=WIDTH,
        height=HEIGHT,
        expression=rng.uniform(0, 0.6, (FRAMES, len(head.expression_names))).astype(np.float32),
        pose=pose,
        translation=rng.normal(0, 0.01, (FRAMES, 3)).astype(np.float32),
        intrinsics=np.repeat(intrinsics[None], FRAMES, 0).astype(np.float32),
        camera_to_world=np.repeat(camera[None], FRAMES, 0).astype(np.float32),
        frame_id=np.arange(3, 3 + FRAMES, dtype=np.int32),
        split=np.array(["train", "train", "test", "test"]),
    )
    with CollectionWriter(path, "builtin", np.zeros(len(head.shape_basis), np.float32)) as writer:
        picture = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
        for frame in clip.frame_id:
            writer.image(clip.name, int(frame), picture)
        writer.clip(clip)
    return path
