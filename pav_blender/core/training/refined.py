"""The refined collection: the same pictures, with what training corrected of their track."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..collection import Clip, Collection, CollectionWriter
from ..errors import Cancelled
from ..progress import Report
from .corrections import corrected_clip
from .frames import Frame, load_frames
from .refiner import OFF, Refiner

_NOTE = (
    "pose and expressions were corrected by an avatar trained on this collection, those of test "
    "and view frames too, each from its own picture: scores on them are not of an unseen track"
)


def refined_writer(
    collection: Collection, path: Path | str, extra: dict[str, Any]
) -> CollectionWriter:
    """A writer for the refined collection; InputError where one can't be put at `path`."""
    return CollectionWriter(
        path,
        collection.head_name,
        collection.betas,
        fingerprint=collection.head.fingerprint,
        offset=collection.head_offset,
        extra={**collection.extra, **extra},
    )


def correct_collection(
    refiner: Refiner,
    *,
    progress: Report | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> None:
    """Corrects every frame of the clips where that helps, by the avatar as it is now."""
    clips = [c for c in refiner.collection.clips if refiner.verdicts[c.name].kept != OFF]
    total = sum(len(clip) for clip in clips)
    for done, name in enumerate(refiner.correct_all(_tracked(refiner.collection, clips)), 1):
        if progress:
            progress(done / total, frame=name)
        if should_stop is not None and should_stop():
            raise Cancelled("refining was stopped; `--resume` goes on")


def _tracked(collection: Collection, clips: list[Clip]) -> Iterator[Frame]:
    for clip in clips:
        for row in range(len(clip)):
            yield from load_frames(collection, clip, np.array([row]), targets=False)


def write_refined(refiner: Refiner, path: Path | str) -> None:
    """Writes the corrected track; pictures are linked where the disk can, else copied."""
    collection = refiner.collection
    weights = refiner.trainer.avatar.rigid_weights
    extra = {"refinement": {"note": _NOTE, "clips": refiner.record()}}
    with refined_writer(collection, path, extra) as writer:
        for clip in collection.clips:
            corrections = refiner.corrections(clip)
            writer.clip(corrected_clip(collection, clip, refiner.space, corrections, weights))
            for folder in ("images", "labels", "depth"):
                _same(collection.path, writer.root, f"clips/{clip.name}/{folder}")


def _same(source: Path, target: Path, folder: str) -> None:
    """The files of a folder, where there is one, under the same names."""
    if not (source / folder).is_dir():
        return
    (target / folder).mkdir(parents=True)
    for path in sorted((source / folder).glob("*.png")):
        place = target / folder / path.name
        try:
            os.link(path, place)
        except OSError:  # another disk, or one without links
            shutil.copyfile(path, place)
