"""Filming a collection: clips of one person, an appearance each, with the exact truth."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.collection import Clip, CollectionWriter
from ..core.errors import InputError
from ..core.files import write_text
from ..core.head import builtin_head
from ..core.progress import Report
from .appearances import APPEARANCES, Appearance, build_scene
from .camera import intrinsics_of, look_at
from .identity import identity
from .motion import perform
from .passes import Passes, clean_labels, straight_colour
from .person import Person, build_person
from .scene import LABEL, StudioScene

VIEWS = (-42.0, -28.0, 28.0, 42.0)  # degrees of orbit of the held-out cameras
FRAME_HEIGHT = 0.41  # metres that the picture spans at the head's distance


@dataclass(eq=False)
class Shot:
    """One picture to take."""

    frame_id: int
    split: str
    expression: np.ndarray
    pose: np.ndarray
    translation: np.ndarray
    intrinsics: np.ndarray
    camera_to_world: np.ndarray


@dataclass(eq=False)
class Picture:
    rgba: np.ndarray  # uint8 [H,W,4], straight
    labels: np.ndarray  # uint8 [H,W]
    depth: np.ndarray  # float32 [H,W], inf where empty
    vertices: np.ndarray  # [V,3]


def render_collection(
    out: Path, *, appearances: int = 3, frames: int = 60, size: int = 256, seed: int = 0,
    performance: int = 0, views=VIEWS, truth: str = "full", progress: Report | None = None,
    overwrite: bool = False, samples: int | None = None, first: int = 1,
) -> Path:  # fmt: skip
    """Render `appearances` clips of `frames` pictures of `size` x `size` and write a collection.

    `first` is the number of the first look, from 1: another person may have others.
    `views` are orbit angles in degrees of held-out cameras, one extra picture a clip each. `truth`
    "full" adds the posed vertices and depth to the parameters, labels and mattes. `performance`
    numbers what the person does, before which camera: the same person in the same looks is filmed
    doing other things. `samples`: of a pixel (`Passes.expose`). progress(fraction, step=what).
    The result depends on the arguments only. Raises InputError.
    """
    _check(appearances, frames, size, performance, truth, first, 1 if samples is None else samples)
    head = builtin_head()
    person = build_person(head, identity(head, seed))
    looks = APPEARANCES[first - 1 :][:appearances]
    total, done = appearances * (frames + len(views)), 0
    extra = {
        "made_by": "pav studio", "seed": seed, "frames": frames, "truth": truth,
        "performance": performance,
        "head_fingerprint": head.fingerprint,
    }  # fmt: skip
    if samples is not None:
        extra["samples"] = samples
    with CollectionWriter(out, "builtin", person.betas, extra=extra, overwrite=overwrite) as writer:
        for look in looks:
            shots = plan(person, look, frames, size, (seed, performance), views)
            vertices = []
            with filming(person, look, size, seed) as take:
                for shot in shots:
                    picture = take(shot, samples)
                    writer.image(look.name, shot.frame_id, picture.rgba)
                    writer.labels(look.name, shot.frame_id, picture.labels)
                    if truth == "full":
                        writer.depth(look.name, shot.frame_id, picture.depth)
                        vertices.append(picture.vertices)
                    done += 1
                    if progress:
                        progress(done / total, step=f"filming {look.name} {shot.frame_id}")
            writer.clip(_clip(look, shots, size, vertices))
        others = {"performance": performance, "first": first, "samples": samples}
        note = _note(appearances, frames, size, seed, truth, len(views), others)
        write_text(writer.root / "README.md", note)
    return Path(out)


def _note(
    appearances: int,
    frames: int,
    size: int,
    seed: int,
    truth: str,
    views: int,
    others: dict[str, int | None],
) -> str:
    """What the folder is, how it was made, and whose it is."""
    usual = {"performance": 0, "first": 1, "samples": None}
    more = "".join(f" --{name} {n}" for name, n in others.items() if n != usual[name])
    return f"""# A synthetic person in {appearances} appearances

Made by one command; nobody was filmed:

    pav studio THIS_FOLDER --appearances {appearances} --frames {frames} --size {size} \\
        --seed {seed} --truth {truth}{more}

One clip an appearance: {frames} frames of one performance (the last sixth is held out: split
"test") and {views} pictures from cameras that no clip used (split "view"). Cycles renders the
built-in head model, refined, with hair, clothes and light of its own. Beside the pictures
(straight alpha: the alpha is the matte) lie labels, one number a pixel, and in `frames.npz` the
exact camera and head parameters of every frame.

Licence: CC0 1.0 (public domain), https://creativecommons.org/publicdomain/zero/1.0/
"""


def _check(
    appearances: int,
    frames: int,
    size: int,
    performance: int,
    truth: str,
    first: int,
    samples: int,
) -> None:
    for what, value, low, high in (
        ("first", first, 1, len(APPEARANCES)),
        ("appearances", appearances, 1, len(APPEARANCES) + 1 - first),
        ("frames", frames, 2, 100_000),
        ("size", size, 32, 4096),
        ("performance", performance, 0, 100_000),
        ("samples", samples, 1, 65_536),
    ):
        if not low <= value <= high:
            raise InputError(f"{what} {value}: give {low} to {high}")
    if truth not in ("full", "light"):
        raise InputError(f"truth {truth!r}: use 'full' or 'light'")


def plan(
    person: Person, look: Appearance, frames: int, size: int, seeds: tuple[int, int], views=VIEWS
) -> list[Shot]:
    """The shots of one clip: training frames, the last sixth held out, then other cameras.

    seeds: of the person and of the performance.
    """
    seed, performance = seeds
    others = [performance] if performance else []
    rng = np.random.default_rng([seed, 100 + APPEARANCES.index(look), *others])
    motion = perform(person.head, frames, rng)
    height = FRAME_HEIGHT * rng.uniform(0.97, 1.04)
    distance = rng.uniform(1.05, 1.35)
    intrinsics = intrinsics_of(size * distance / height, size)
    middle = person.joints[1] * [1, 0, 1] + [0, 0.1 * person.landmarks.chin[1] - 0.012, 0.02]
    azimuth, elevation = rng.uniform(-6, 6), rng.uniform(-3, 6)
    held_out = max(1, round(frames / 6))
    shots = []
    drift = 0.25 * np.stack(
        [np.sin(np.arange(frames) / rng.uniform(9, 15) + rng.uniform(0, 6)) for _ in range(2)], 1
    )
    for k in range(frames):
        view = orbit(middle, distance, azimuth + drift[k, 0], elevation + drift[k, 1])
        split = "test" if k >= frames - held_out else "train"
        shots.append(
            Shot(k, split, motion.expression[k], motion.pose[k], motion.translation[k],
                 intrinsics, view)
        )  # fmt: skip
    chosen = np.linspace(0, frames - held_out - 1, len(views) + 2)[1:-1].round().astype(int)
    for number, (angle, k) in enumerate(zip(views, chosen, strict=True)):
        view = orbit(middle, distance, angle, elevation + rng.uniform(-4, 8))
        shots.append(
            Shot(frames + number, "view", motion.expression[k], motion.pose[k],
                 motion.translation[k], intrinsics, view)
        )  # fmt: skip
    return shots


def orbit(target: np.ndarray, distance: float, azimuth: float, elevation: float) -> np.ndarray:
    """camera_to_world of a camera round `target`; degrees, azimuth + is the person's left."""
    a, e = np.radians([azimuth, elevation])
    away = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    return look_at(target + distance * away, target)


@contextlib.contextmanager
def filming(
    person: Person, look: Appearance, size: int, seed: int
) -> Iterator[Callable[[Shot, int | None], Picture]]:
    """Builds the appearance's scene; yields a function that takes one picture: of a shot, with so
    many samples (`Passes.expose`)."""
    with contextlib.ExitStack() as stack:
        studio = build_scene(person, look, seed)
        stack.callback(studio.close)
        passes = Passes(studio.scene, size)
        stack.callback(passes.close)

        def take(shot: Shot, samples: int | None) -> Picture:
            passes.expose(samples)
            return _take(studio, passes, shot, size)

        yield take


def _take(studio: StudioScene, passes: Passes, shot: Shot, size: int) -> Picture:
    posed = studio.pose(shot.expression, shot.pose, shot.translation)
    studio.aim(shot.intrinsics, shot.camera_to_world, size)
    with quiet():
        colour, matte = passes.colour(), passes.matte()
        labels, depth = passes.labels_and_depth()
    labels = clean_labels(labels, matte, (LABEL["scalp_hair"], LABEL["facial_hair"]))
    straight = np.concatenate([straight_colour(colour), matte[..., None]], axis=2)
    rgba = np.round(255 * np.clip(straight, 0, 1)).astype(np.uint8)
    rgba[rgba[..., 3] == 0] = 0
    return Picture(rgba, labels, depth, posed)


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Blender's lines about saved files go nowhere while this holds."""
    sys.stdout.flush()
    saved, sink = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1)
    try:
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(sink)


def _clip(look: Appearance, shots: list[Shot], size: int, vertices: list[np.ndarray]) -> Clip:
    def stacked(name: str) -> np.ndarray:
        return np.stack([getattr(shot, name) for shot in shots])

    return Clip(
        name=look.name, appearance=look.name, width=size, height=size,
        expression=stacked("expression"), pose=stacked("pose"),
        translation=stacked("translation"), intrinsics=stacked("intrinsics"),
        camera_to_world=stacked("camera_to_world"),
        frame_id=np.array([shot.frame_id for shot in shots], np.int32),
        split=np.array([shot.split for shot in shots]),
        vertices=np.stack(vertices) if vertices else None,
    )  # fmt: skip
