"""A normalised person as a collection: pictures cut out and labelled, in parallel."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from ...cores import threads
from ...errors import InputError
from ...images import read_gray, read_rgba
from ...progress import Report
from ..model import LABELS
from ..writer import CollectionWriter
from .normalise import NormalClip, Person
from .parsed import LEAVE, Picture


def write_person(
    person: Person,
    path: Path,
    *,
    overwrite: bool = False,
    progress: Report | None = None,
) -> None:
    """Writes the collection, whole or not at all. InputError names a picture that does not fit."""
    extra = {
        "imported": [
            {"clip": c.clip.name, "tool": c.tool, "lost": c.lost, "notes": c.notes}
            for c in person.clips
        ]
    }
    total = sum(len(each.clip) for each in person.clips)
    done = 0
    with CollectionWriter(
        path,
        person.head.name,
        person.betas,
        fingerprint=person.head.fingerprint,
        offset=person.offset,
        extra=extra,
        overwrite=overwrite,
    ) as writer:
        for each in person.clips:
            with ThreadPoolExecutor(threads()) as pool:
                jobs = [pool.submit(_write, writer, each, row) for row in range(len(each.clip))]
                try:
                    for job in as_completed(jobs):
                        job.result()
                        done += 1
                        if progress:
                            progress(done / total, clip=each.clip.name)
                except BaseException:
                    for job in jobs:
                        job.cancel()
                    raise
            writer.clip(each.clip)


def _write(writer: CollectionWriter, each: NormalClip, row: int) -> None:
    clip, picture = each.clip, each.pictures[row]
    rgba = cut_out(picture, (clip.height, clip.width))
    number = int(clip.frame_id[row])
    writer.image(clip.name, number, rgba)
    if picture.labels:
        writer.labels(clip.name, number, labelled(picture, rgba[..., 3]))


def cut_out(picture: Picture, size: tuple[int, int]) -> np.ndarray:
    """The picture with its matte as alpha, uint8 [H, W, 4]; InputError where sizes differ."""
    rgba = read_rgba(picture.image)
    _check_size(picture.image, rgba, size)
    if picture.matte is not None:
        matte = _gray8(picture.matte)
        _check_size(picture.matte, matte, size)
        cut_already = bool((rgba[..., 3] < 255).any())
        rgba[..., 3] = np.minimum(rgba[..., 3], matte)  # often the one is a copy of the other
        if not cut_already:
            rgba[..., :3] = without_background(rgba[..., :3], rgba[..., 3])
    return rgba


def without_background(colour: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Takes a plain background out of soft edges: VHAP's pictures lie on white.

    colour uint8 [H, W, 3], alpha uint8 [H, W]. Unchanged where the hidden part is not plain.
    """
    hidden = alpha == 0
    soft = (alpha > 0) & (alpha < 255)
    if hidden.mean() < 0.01 or not soft.any():
        return colour
    outside = colour[hidden].astype(np.float32)
    background = outside.mean(0)
    if outside.std(0).max() > 2:
        return colour
    part = alpha[soft].astype(np.float32)[:, None] / 255
    clean = (colour[soft] - (1 - part) * background) / part
    result = colour.copy()
    result[soft] = np.clip(np.round(clean), 0, 255).astype(np.uint8)
    return result


def labelled(picture: Picture, alpha: np.ndarray) -> np.ndarray:
    """The picture's labels [H, W]; what the matte hides is background."""
    labels = np.full(alpha.shape, LABELS.index("background"), np.uint8)
    for path, table in picture.labels:
        layer = _gray8(path)
        _check_size(path, layer, alpha.shape)
        found = table[layer]
        labels = np.where(found == LEAVE, labels, found)
    labels[alpha == 0] = LABELS.index("background")
    return labels


def _gray8(path: Path) -> np.ndarray:
    gray = read_gray(path)
    if gray.dtype == np.uint16:
        return (gray // 257).astype(np.uint8)
    if gray.dtype != np.uint8:
        raise InputError(f"{path}: {gray.dtype} pixels; 8 or 16 bits are expected")
    return gray


def _check_size(path: Path, pixels: np.ndarray, size: tuple[int, ...]) -> None:
    if pixels.shape[:2] != tuple(size):
        raise InputError(
            f"{path}: {pixels.shape[1]}x{pixels.shape[0]} pixels; the clip has {size[1]}x{size[0]}"
        )
