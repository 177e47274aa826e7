"""The same bits for the same seed: pictures and trainings, run again and on other threads."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import os
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from ...core.collection import Collection
from ...core.config import Config
from ...core.evaluation.metrics import over
from ...core.evaluation.report import Claim
from ...core.field.avatar import Avatar
from ...core.kernels.cpu.threads import torch_alone
from ...core.rendering.render import RenderSettings, render
from ...core.training.frames import Frame
from ...core.training.prepare import load_training_frames, new_avatar
from ...core.training.trainer import Trainer
from .steps import differences

_SIZE, _ITERATIONS = 128, 40
_SMALL = {
    "log2_entries": 14,
    "levels": 8,
    "finest_resolution": 256,
    "rays": 1024,
    "occupancy_resolution": 64,
}


@contextlib.contextmanager
def on_threads(count: int) -> Iterator[None]:
    """Kernels on so many threads inside the block."""
    before = os.environ.get("PAV_THREADS")
    os.environ["PAV_THREADS"] = str(count)
    try:
        yield
    finally:
        if before is None:
            del os.environ["PAV_THREADS"]
        else:
            os.environ["PAV_THREADS"] = before


def measure(
    avatar: Avatar, frame: Frame, collection: Collection, iterations: int = _ITERATIONS
) -> tuple[list[dict[str, Any]], list[Claim]]:
    """Rows of what was run twice: whether each bit is the same, and how far numbers differ."""
    pictures = [_picture(avatar, frame, threads, 1 << 13) for threads in (1, 2, 2)]
    pictures.append(_picture(avatar, frame, 2, 1 << 10))
    frames = load_training_frames(collection)
    config = dataclasses.replace(Config(), iterations=iterations, **_SMALL)  # type: ignore[arg-type]
    new = new_avatar(collection, frames, config)
    trained = [_trained(new, frames, threads) for threads in (1, 1, 2, 2)]
    rows = [
        _row("picture: two threads, again", pictures[1], pictures[2]),
        _row("picture: one thread and two", pictures[0], pictures[1]),
        _row("picture: in eighths of the pieces", pictures[1], pictures[3]),
        _row("training: one thread, again", trained[0], trained[1]),
        _row("training: two threads, again", trained[2], trained[3]),
        _row("training: one thread and two", trained[0], trained[2]),
    ]
    return rows, [Claim.at_least(row["twice"], float(row["same bits"]), 1, "") for row in rows[:5]]


def _row(name: str, a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> dict[str, Any]:
    """Of a picture its RGBA; of a training its numbers, and a picture of it."""
    same = all(x.tobytes() == y.tobytes() for x, y in zip(a, b, strict=True))
    off = differences(over(a[0], 1.0), over(b[0], 1.0))
    largest = max(float(np.abs(x - y).max()) for x, y in zip(a[1:], b[1:], strict=True))
    return {
        "twice": name,
        "same bits": same,
        "picture: largest": off["max"],
        "picture: psnr": off["psnr"],
        "numbers: largest": largest,
    }


def _picture(avatar: Avatar, frame: Frame, threads: int, chunk: int) -> tuple[np.ndarray, ...]:
    camera = frame.camera.resized(_SIZE, _SIZE)
    settings = RenderSettings(chunk=chunk)
    name = avatar.appearances[frame.appearance]
    with on_threads(threads):
        found = render(avatar, frame.vertices, camera, name, settings, expression=frame.expression)
    return found.rgba, np.where(np.isfinite(found.depth), found.depth, 0)


def _trained(new: Avatar, frames: list[Frame], threads: int) -> tuple[np.ndarray, ...]:
    """A picture of a short training, and all its numbers."""
    avatar = copy.deepcopy(new)
    with on_threads(threads):
        trainer = Trainer(avatar, frames)
        while trainer.done < 1:
            with torch_alone():
                trainer.iterate()
    rgba = _picture(avatar, frames[0], 1, 1 << 13)[0]
    state = avatar.field.state_dict().values()
    return rgba, torch.cat([v.reshape(-1) for v in state]).numpy(), avatar.occupied.astype(np.uint8)
