"""Looking a collection over: what it holds, and what is wrong."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..collection import Clip, Collection
from ..errors import InputError
from ..progress import Report
from ..training.frames import camera_of, load_picture


@dataclass
class Findings:
    """summary: a dict for each clip; problems: one line each, naming the file."""

    summary: list[dict] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def check(collection: Collection, *, progress: Report | None = None) -> Findings:
    """Opens every picture. Arrays were checked when the collection was read."""
    findings = Findings()
    total = sum(len(clip) for clip in collection.clips)
    done = 0
    for clip in collection.clips:
        opaque, overlap = [], []
        for row in range(len(clip)):
            done += 1
            try:
                rgba = load_picture(collection, clip, row)
            except InputError as error:
                findings.problems.append(str(error))
                continue
            opaque.append(float((rgba[..., 3] > 127).mean()))
            if opaque[-1] == 0:
                findings.problems.append(f"{collection.image_path(clip, row)}: the matte is empty")
            overlap.append(_mesh_in_matte(collection, clip, row, rgba))
            if progress:
                progress(done / total, clip=clip.name)
        covered = float(np.mean(overlap)) if overlap else 0.0
        if covered < 0.8:
            findings.problems.append(
                f"{collection.path}: clip {clip.name}: only {covered:.0%} of the tracked face lies "
                "inside the matte; the track and the pictures do not belong together"
            )
        findings.summary.append(
            {
                "clip": clip.name,
                "appearance": clip.appearance,
                "frames": len(clip),
                **{split: len(clip.indices(split)) for split in ("train", "test", "view")},
                "size": f"{clip.width}x{clip.height}",
                "matte": round(float(np.mean(opaque)) if opaque else 0.0, 3),
                "face_in_matte": round(covered, 3),
            }
        )
    return findings


def _mesh_in_matte(collection: Collection, clip: Clip, row: int, rgba: np.ndarray) -> float:
    """Part of the face's vertices in the picture that project into the matte; of all, where the
    head does not say what its face is."""
    vertices = collection.posed(clip, np.array([row]))[0]
    face = vertices[collection.head.regions.get("face", slice(None))]
    pixels, depth = camera_of(clip, row).project(face)
    at = np.floor(pixels).astype(int)
    inside = (depth > 0) & (at >= 0).all(1) & (at[:, 0] < clip.width) & (at[:, 1] < clip.height)
    if not inside.any():
        return 0.0
    return float((rgba[at[inside, 1], at[inside, 0], 3] > 64).mean())
