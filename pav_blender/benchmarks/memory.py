"""Memory: of a training on five long clips of 512x512 pixels, and of a picture of that size."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from ..core.collection import Clip, Collection, CollectionWriter
from ..core.errors import PavError
from ..core.evaluation.report import Claim
from ..core.images import read_rgba
from ..core.progress import Report
from .measure import Options, plot, show, subject

_CLIPS = 5
_FRAMES = 400
_SIZE = 512
_ITERATIONS = 400  # each of four frames: as many poses are remembered as ever will be

_PEAK = """
from pav_blender.benchmarks.peak import peak_bytes
print(peak_bytes())
"""
_TRAIN = f"""
import dataclasses, sys
from pav_blender.core.collection import read_collection
from pav_blender.core.config import Config
from pav_blender.core.training.prepare import load_training_frames, new_avatar
from pav_blender.core.training.trainer import Trainer
collection = read_collection(sys.argv[1])
frames = load_training_frames(collection)
assert len(frames) == {_CLIPS * _FRAMES}
config = dataclasses.replace(Config(), iterations={_ITERATIONS})
trainer = Trainer(new_avatar(collection, frames, config), frames)
while trainer.done < 1:
    trainer.iterate()
{_PEAK}"""
_RENDER = f"""
import sys
from pav_blender.core.collection import read_collection
from pav_blender.core.evaluation.heldout import chosen_frames
from pav_blender.core.field.avatar import Avatar
from pav_blender.core.rendering.render import render
avatar, collection = Avatar.load(sys.argv[1]), read_collection(sys.argv[2])
frame = chosen_frames(collection, ("test",), 1)[0]
camera = frame.camera.resized({_SIZE}, {_SIZE})
render(avatar, frame.vertices, camera, avatar.appearances[0])
{_PEAK}"""


def run(options: Options, progress: Report | None = None) -> tuple[dict[str, Any], list[Claim]]:
    _, collection = subject(options, progress)
    large = options.out / "memory_collection"
    if not large.is_dir():
        _enlarged(collection, large, progress)
    rows = [
        _measured(f"training, {_CLIPS} x {_FRAMES} frames", _TRAIN, large),
        _measured("a picture", _RENDER, options.out / "subject.pav", collection.path),
    ]
    show(rows)
    plot(
        options.out / "memory.svg",
        lambda axes: axes.bar([r["what"] for r in rows], [r["peak_gb"] for r in rows]),
        f"Greatest memory at {_SIZE} x {_SIZE} pixels",
        "",
        "GB",
    )
    claims = [
        Claim.at_most(f"memory of training, {_SIZE}", rows[0]["peak_gb"], 8, "GB"),
        Claim.at_most(f"memory of a picture, {_SIZE}", rows[1]["peak_gb"], 2, "GB"),
    ]
    return {"processes": rows}, claims


def _enlarged(collection: Collection, path: Path, progress: Report | None) -> None:
    """Clips of `_FRAMES` frames of `_SIZE` pixels: those of the collection, enlarged and over
    again. What a picture shows does not change what it takes."""
    with CollectionWriter(
        path,
        collection.head_name,
        collection.betas,
        fingerprint=collection.head.fingerprint,
        offset=collection.head_offset,
    ) as writer:
        for number in range(_CLIPS):
            source = collection.clips[number % len(collection.clips)]
            own = source.indices("train")
            rows = own[np.arange(_FRAMES) % len(own)]
            name = f"clip{number}"
            scale = np.diag([_SIZE / source.width, _SIZE / source.height, 1.0])
            writer.clip(
                Clip(
                    name,
                    name,
                    _SIZE,
                    _SIZE,
                    source.expression[rows],
                    source.pose[rows],
                    source.translation[rows],
                    scale @ source.intrinsics[rows],
                    source.camera_to_world[rows],
                    np.arange(_FRAMES, dtype=np.int32),
                    np.full(_FRAMES, "train"),
                )
            )
            _pictures(collection, source, own, writer, name)
            if progress:
                progress((number + 1) / _CLIPS, clip=name)


def _pictures(
    collection: Collection, source: Clip, rows: np.ndarray, writer: CollectionWriter, name: str
) -> None:
    """The first frames' pictures; later frames have the same files under other names."""
    folder = writer.root / "clips" / name / "images"
    for frame in range(_FRAMES):
        if frame < len(rows):
            small = read_rgba(collection.image_path(source, rows[frame]))
            across = np.arange(_SIZE) * small.shape[1] // _SIZE
            down = np.arange(_SIZE) * small.shape[0] // _SIZE
            writer.image(name, frame, small[down][:, across])
        else:
            os.link(folder / f"{frame % len(rows):06d}.png", folder / f"{frame:06d}.png")


def _measured(what: str, script: str, *arguments: Path) -> dict[str, Any]:
    """A process of its own: seconds, and the most memory it held."""
    started = time.perf_counter()
    command = [sys.executable, "-c", script, *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise PavError(f"{what}: {(done.stderr.strip() or 'it was killed').splitlines()[-1]}")
    return {
        "what": what,
        "peak_gb": round(int(done.stdout.split()[-1]) / 1e9, 2),
        "seconds": round(time.perf_counter() - started, 1),
    }
