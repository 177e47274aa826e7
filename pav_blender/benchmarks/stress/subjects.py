"""What is stressed: a head trained for seconds, and a ball with random weights."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh

from ...core.collection import Collection, read_collection
from ...core.config import Config
from ...core.evaluation.heldout import chosen_frames
from ...core.field.avatar import Avatar
from ...core.kernels.cpu.threads import torch_alone
from ...core.rendering.cameras import Camera
from ...core.training.frames import halved, load_frames
from ...core.training.prepare import new_avatar
from ...core.training.trainer import Trainer
from ...studio import DEFAULT_COLLECTION

SMALL = dataclasses.replace(
    Config(),
    levels=8,
    log2_entries=14,
    finest_resolution=256,
    shoulder_levels=4,
    hidden=32,
    occupancy_resolution=64,
    rays=1024,
    iterations=150,
    step=2e-3,
)
_EVERY = 6  # of the training frames


@dataclass(eq=False)
class Head:
    """An avatar, a pose of it, and a camera before it."""

    avatar: Avatar
    vertices: np.ndarray
    expression: np.ndarray
    camera: Camera
    collection: Collection | None = None


def make(folder: Path, collection_path: Path = DEFAULT_COLLECTION) -> Path:
    """Trains the head into `folder`, unless it is there."""
    path = folder / "subject.pav"
    if path.is_file():
        return path
    collection = read_collection(collection_path)
    frames = [
        halved(frame)
        for clip in collection.clips
        for frame in load_frames(collection, clip, clip.indices("train")[::_EVERY])
    ]
    avatar = new_avatar(collection, frames, SMALL)
    trainer = Trainer(avatar, frames)
    with torch_alone():
        while trainer.done < 1:
            trainer.iterate()
    avatar.save(path)
    return path


def head_of(folder: Path, collection_path: Path = DEFAULT_COLLECTION) -> Head:
    """The trained head as in the middle held-out frame, 64 x 64 pixels."""
    avatar = Avatar.load(make(folder, collection_path))
    collection = read_collection(collection_path)
    own = [f for f in chosen_frames(collection, ("test",), None) if f.appearance == 0]
    frame = own[len(own) // 2]
    camera = frame.camera.resized(64, 64)
    return Head(avatar, frame.vertices, frame.expression, camera, collection)


def ball_of(appearances: int = 2) -> Head:
    """A ball of 0.1 m in a random field, 48 x 48 pixels."""
    shape = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    vertices = np.asarray(shape.vertices, np.float32)
    triangles = np.asarray(shape.faces, np.int32)
    return ball_on(vertices, triangles, appearances)


def ball_on(vertices: np.ndarray, triangles: np.ndarray, appearances: int = 2) -> Head:
    """The same with other triangles; weights go by vertex, so that the field is the same."""
    config = dataclasses.replace(SMALL, occupancy_resolution=32, reach=0.04)
    names = [f"look {row}" for row in range(appearances)]
    uvs = np.stack([vertices[:, 0], vertices[:, 1]], 1) * 4 + 0.5
    avatar = Avatar.create(config, names, vertices, triangles, uvs, triangles, ("smile", "frown"))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for values in (avatar.field.tables, avatar.field.still_tables):
            values.copy_(0.15 * (2 * torch.rand(values.shape, generator=generator) - 1))
        avatar.field.colour.weights[-1].mul_(6)  # loud
    camera = Camera(
        48,
        48,
        np.array([[110.0, 0, 24], [0, 110.0, 24], [0, 0, 1]]),
        np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]]),
    )
    return Head(avatar, vertices.copy(), np.zeros(2, np.float32), camera)
