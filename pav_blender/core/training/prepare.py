"""What happens once before training: frames read, space carved, an untrained avatar made."""

from __future__ import annotations

import numpy as np

from ..collection import Collection
from ..config import Config
from ..errors import InputError
from ..field.avatar import Avatar
from ..progress import Report
from .carving import carve, hull_box, reach_of
from .frames import Frame, load_frames
from .people import People


def load_training_frames(
    collection: Collection | People, progress: Report | None = None
) -> list[Frame]:
    """Every frame of the "train" split; InputError where an appearance has none."""
    frames: list[Frame] = []
    if isinstance(collection, People):
        for done, (name, own) in enumerate(collection.collections.items()):
            read = _part(progress, done, len(collection.collections))
            frames += [collection.joined(name, f) for f in load_training_frames(own, read)]
        return frames
    total = max(1, sum(len(clip.indices("train")) for clip in collection.clips))

    def report(part: float, **fields: object) -> None:
        if progress:
            progress((len(frames) + part * len(rows)) / total, **fields)

    for clip in collection.clips:
        rows = clip.indices("train")
        frames += load_frames(collection, clip, rows, progress=report)
    for index, name in enumerate(collection.appearances):
        if not any(f.appearance == index and f.rgba[..., 3].any() for f in frames):
            raise InputError(
                f"{collection.path}: appearance {name!r} has no training frame with an opaque pixel"
            )
    return frames


def new_avatar(collection: Collection | People, frames: list[Frame], config: Config) -> Avatar:
    """An untrained avatar whose space is carved by the mattes of the frames."""
    people = collection if isinstance(collection, People) else None
    first = collection.first if isinstance(collection, People) else collection
    head = first.head
    canonical = people.canonical if people else head.canonical(first.betas)
    groups = [
        [f for f in frames if f.appearance == index] for index in range(len(collection.appearances))
    ]
    reaches = [
        reach_of(canonical, head.triangles, head.regions, group, config.reach) for group in groups
    ]
    corner, size = hull_box(canonical, head.triangles, frames, np.max(reaches, axis=0))
    cells = config.occupancy_resolution
    coarse = -(-cells // 2)  # the hull is smooth: its cells may be twice as large
    hulls = [
        carve(canonical, head.triangles, group, reach, corner, size * 2 * coarse / cells, coarse)
        for group, reach in zip(groups, reaches, strict=True)
    ]
    occupied = np.stack([_doubled(hull)[:cells, :cells, :cells] for hull in hulls])
    if config.one_geometry:
        occupied[:] = occupied.any(axis=0)
    return Avatar.create(
        config,
        collection.appearances,
        canonical,
        head.triangles,
        head.uvs,
        head.uv_triangles,
        head.expression_names,
        rigid_weights=rigid_weights(head.regions, len(canonical)),
        box_min=corner,
        box_size=size,
        occupied=occupied,
        head_name=first.head_name,
        head_fingerprint=head.fingerprint,
        betas=collection.betas,
        head_offset=collection.head_offset,
        identities=people.identities if people else {},
        record={
            "frames": {
                name: sum(f.appearance == index for f in frames)
                for index, name in enumerate(collection.appearances)
            }
        },
    )


def _part(progress: Report | None, done: int, count: int) -> Report | None:
    """The report of one of `count` equal parts of a work."""
    if progress is None:
        return None
    return lambda fraction, **fields: progress((done + fraction) / count, **fields)


def _doubled(cells: np.ndarray) -> np.ndarray:
    """Each cell cut into eight."""
    for axis in range(3):
        cells = cells.repeat(2, axis)
    return cells


def rigid_weights(regions: dict[str, np.ndarray], vertices: int) -> np.ndarray:
    """1 for vertices that move with the skull, as far as the regions tell; else all 1."""
    weights = np.zeros(vertices, np.float32)
    for name in ("scalp", "ears"):
        if name in regions:
            weights[regions[name]] = 1
    return weights if weights.sum() >= 3 else np.ones(vertices, np.float32)
