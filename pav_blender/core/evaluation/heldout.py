"""How well an avatar shows frames it has not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..collection import Clip, Collection
from ..field.avatar import Avatar
from ..field.identities import own_appearances
from ..progress import Report
from ..rendering.render import RenderSettings, render
from ..training.frames import Frame, load_frames
from .metrics import fog, holes, over, psnr, ssim

BACKGROUND = 1.0  # pictures are compared before white


@dataclass(eq=False)
class Score:
    """One frame: whole picture and head pixels in dB; rendered [H, W, 4] in [0, 1].

    fog: mean opacity outside the matte; holes: what shows through inside it; both in [0, 1].
    """

    frame: Frame
    appearance: str
    psnr: float
    head_psnr: float
    ssim: float
    rendered: np.ndarray
    fog: float
    holes: float


def head_mask(rgba: np.ndarray) -> np.ndarray:
    """Pixels [H, W] of the person: where the matte (uint8) is more than half.

    Training has no other mask: it learns from all pixels about the person, each before a random
    background with the same matte as its share (`training.losses`). Scores take the same mattes.
    """
    return rgba[..., 3] > 127


def score(avatar: Avatar, frame: Frame, appearance: str, settings: RenderSettings) -> Score:
    """Renders a frame wearing `appearance` and compares it with the frame's own picture.

    `psnr` and `ssim` are of the whole picture before white, `head_psnr` of the head's pixels
    (`head_mask`) in the same pictures.
    """
    picture = render(
        avatar, frame.vertices, frame.camera, appearance, settings, expression=frame.expression
    )
    shown = np.floor(picture.rgba * 255 + 0.5) / 255  # as the file would hold it
    ours, truth = over(shown, BACKGROUND), over(frame.rgba / 255, BACKGROUND)
    return Score(
        frame,
        appearance,
        psnr(ours, truth),
        psnr(ours, truth, head_mask(frame.rgba)),
        ssim(ours, truth),
        shown,
        fog(picture.rgba[..., 3], frame.rgba[..., 3]),
        holes(picture.rgba[..., 3], frame.rgba[..., 3]),
    )


def held_out(
    avatar: Avatar,
    collection: Collection,
    *,
    splits: tuple[str, ...] = ("test",),
    per_appearance: int | None = None,
    settings: RenderSettings | None = None,
    progress: Report | None = None,
) -> list[Score]:
    """Scores of held-out frames, at most `per_appearance` each, spread over the clip; the
    collection's person must be one that the avatar learned."""
    settings = settings or RenderSettings()
    frames = chosen_frames(collection, splits, per_appearance)
    names = own_appearances(avatar, collection)
    scores = []
    for done, frame in enumerate(frames):
        scores.append(score(avatar, frame, names[frame.appearance], settings))
        if progress:
            progress((done + 1) / len(frames), frame=frame.name, psnr=scores[-1].psnr)
    return scores


def chosen_frames(
    collection: Collection, splits: tuple[str, ...], per_appearance: int | None
) -> list[Frame]:
    """Frames of the splits, evenly spread, at most `per_appearance` of each appearance."""
    frames: list[Frame] = []
    for appearance in collection.appearances:
        for clip, row in chosen_rows(collection, appearance, splits, per_appearance):
            frames += load_frames(collection, clip, np.array([row]), targets=False)
    return frames


def chosen_rows(
    collection: Collection, appearance: str, splits: tuple[str, ...], at_most: int | None
) -> list[tuple[Clip, int]]:
    """Rows of an appearance's clips in any of the splits: all, or `at_most`, evenly spread."""
    clips = [c for c in collection.clips if c.appearance == appearance]
    rows = [(clip, int(row)) for clip in clips for row in clip.indices(*splits)]
    if at_most is None or len(rows) <= at_most:
        return rows
    return [rows[i] for i in np.linspace(0, len(rows) - 1, at_most).round().astype(int)]
