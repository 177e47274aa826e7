"""`pav bench track`: the tracker against the studio's exact truth, and what each part of it gives.

Clips of three people are filmed by Cycles (once: they stay beside the results), laid over a room,
encoded as video, and tracked as anybody's video would be.
"""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np

from ..core.collection import Clip, Collection, CollectionWriter, read_collection
from ..core.config import Config
from ..core.errors import InputError
from ..core.evaluation.heldout import held_out
from ..core.evaluation.report import Claim
from ..core.evaluation.tracking import TrackErrors, compare
from ..core.images import read_rgba
from ..core.progress import Report
from ..core.rendering.render import RenderSettings
from ..core.tracking.crop import resize
from ..core.tracking.track import track
from ..core.training.train import train
from ..studio import render_collection
from .measure import Options, plot, show

SEEDS, SIZES = (1, 2, 3), (512, 256)
_LOOKS, _FRAMES, _SAMPLES = 2, 30, 12
_RATE = 10  # pictures a second at which the studio's performances are right
_QUALITY = "14"  # of the encoder (CRF): what a good camera's file has
_SIDE = 256  # of the avatars' pictures in the ablation
# a training's iterations in the ablation: the same work for all
_ITERATIONS = 800


def run(options: Options, progress: Report | None = None) -> tuple[dict[str, Any], list[Claim]]:
    """Measures; writes track.svg. Filming the people takes about ten minutes, the first time."""
    folder = options.out / "track"
    people = [_person(folder, seed, progress) for seed in SEEDS]
    rows = []
    for person, seed in zip(people, SEEDS, strict=True):
        for size in SIZES:
            videos = films(person, folder / f"seed{seed}_{size}", size)
            found, seconds = _tracked(videos, size, options, person)
            rows.append({"seed": seed, "size": size, **_row(person, found, seconds, size)})
    show(rows)
    steps = _ablation(people[0], folder / f"seed{SEEDS[0]}_{SIZES[0]}", options, progress)
    show(steps)
    plot(
        options.out / "track.svg",
        lambda axes: _draw(axes, steps),
        "What each part of the fit gives",
        "seconds a frame",
        "reprojection, pixels of 512",
    )
    return {"clips": rows, "ablation": steps}, claims(rows)


def claims(rows: Sequence[dict[str, Any]]) -> list[Claim]:
    """Of the three people's means at 512 pixels; the slowest for the time."""
    large = [row for row in rows if row["size"] == SIZES[0]]

    def mean(name: str) -> float:
        return float(np.mean([row[name] for row in large]))

    return [
        Claim.at_most("vertex reprojection at 512, median", mean("reprojection_px"), 1.5, "px"),
        Claim.at_most("rotation of the head, median", mean("rotation_deg"), 1.0, "deg"),
        Claim.at_most("face expression, median", mean("expression_mm"), 1.5, "mm"),
        Claim.at_most("jitter over the truth's", mean("jitter"), 1.5, "x"),
        Claim.at_most("a frame, slowest", max(row["seconds_a_frame"] for row in large), 0.3, "s"),
    ]


def _person(folder: Path, seed: int, progress: Report | None) -> Collection:
    path = folder / f"seed{seed}"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        tell = progress or (lambda fraction, **fields: None)
        render_collection(
            path, appearances=_LOOKS, frames=_FRAMES, size=max(SIZES), seed=seed, views=(),
            truth="light", samples=_SAMPLES,
            progress=lambda fraction, step: tell(fraction, step=f"person {seed}: {step}"),
        )  # fmt: skip
    return read_collection(path)


def films(person: Collection, folder: Path, size: int) -> list[Path]:
    """A video a clip, `size` pixels a side, of the person before a room; made anew."""
    folder.mkdir(parents=True, exist_ok=True)
    return [
        film(person, clip, folder / f"{clip.name}.mp4", size, number)
        for number, clip in enumerate(person.clips)
    ]


def film(person: Collection, clip: Clip, path: Path, size: int, seed: int) -> Path:
    room = _room(size, seed)
    with av.open(str(path), "w") as container:
        # one thread: what the encoder writes depends on their number
        options = {"crf": _QUALITY, "threads": "1"}
        stream = container.add_stream("libx264", rate=_RATE, options=options)
        stream.width = stream.height = size
        stream.pix_fmt = "yuv420p"
        for row in clip.indices("train", "test"):
            rgba = read_rgba(person.image_path(clip, int(row))).astype(np.float32) / 255
            rgba[..., :3] *= rgba[..., 3:]
            small = resize(rgba, size).clip(0, 1)
            picture = small[..., :3] + room * (1 - small[..., 3:])
            whole = (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(whole, format="rgb24")))
        container.mux(stream.encode())
    return path


def _room(size: int, seed: int) -> np.ndarray:
    """A blurred background, float32 [S,S,3]."""
    coarse = np.random.default_rng(seed).uniform(0.2, 0.8, (5, 5, 3)).astype(np.float32)
    return resize(coarse, size).clip(0, 1)


def _tracked(
    videos: list[Path], size: int, options: Options, person: Collection, *, photo: bool = True
) -> tuple[Collection, float]:
    """The videos' track, and the seconds it took a frame, from the file to the written pictures."""
    out = videos[0].parent / ("photo" if photo else "landmarks")
    started = time.perf_counter()
    report = track(
        videos, out, size=min(size, _SIDE), model=options.landmark_model, cuts=False, photo=photo,
        overwrite=True,
    )  # fmt: skip
    seconds = time.perf_counter() - started
    found = read_collection(report.path)
    if {clip.name for clip in found.clips} != {clip.name for clip in person.clips}:
        raise InputError(f"{out}: not every clip was tracked")
    return found, seconds / sum(len(clip) for clip in person.clips)


def _row(person: Collection, found: Collection, seconds: float, size: int) -> dict[str, Any]:
    errors = compare(person, found, size=size)
    return {**_short(errors), "seconds_a_frame": round(seconds, 3)}


def _short(errors: TrackErrors) -> dict[str, Any]:
    return {**errors.row(), "frames": errors.frames, "filmed": errors.filmed}


def _ablation(
    person: Collection, folder: Path, options: Options, progress: Report | None
) -> list[dict[str, Any]]:
    """A shape a clip from landmarks, one shape for all, with pictures, and with the track refined
    in training; and how good an avatar becomes that is trained on each."""
    videos = [folder / f"{clip.name}.mp4" for clip in person.clips]
    alone, seconds = [], 0.0
    for video in videos:
        report_path = folder / f"{video.stem}_alone"
        started = time.perf_counter()
        track([video], report_path, size=_SIDE, model=options.landmark_model, cuts=False,
              photo=False, overwrite=True)  # fmt: skip
        seconds += time.perf_counter() - started
        alone.append(read_collection(report_path))
    apart = _joined(alone, folder / "apart")
    frames = sum(len(clip) for clip in person.clips)
    kinds: list[tuple[str, Collection, dict[str, Any]]] = []
    errors = [compare(person, one).row() for one in alone]
    means = {name: round(float(np.mean([row[name] for row in errors])), 3) for name in errors[0]}
    means |= {name: int(sum(row[name] for row in errors)) for name in ("frames", "filmed")}
    kinds.append(
        ("landmarks, a shape a clip", apart, {**means, "seconds_a_frame": seconds / frames})
    )
    for name, photo in (("landmarks, one shape", False), ("and pictures", True)):
        found, took = _tracked(videos, max(SIZES), options, person, photo=photo)
        kinds.append((name, found, _row(person, found, took, max(SIZES))))
    rows = []
    for number, (name, found, fields) in enumerate(kinds):
        fields |= _avatar(found, folder / f"ablation{number}.pav", None, progress)
        rows.append({"fit": name, **fields})
    refined = folder / "refined"
    shutil.rmtree(refined, ignore_errors=True)
    trained = _avatar(kinds[-1][1], folder / "refined.pav", refined, progress)
    fields = {**compare(person, read_collection(refined)).row(), **_counts(kinds[-1][2])}
    rows.append({"fit": "and refined in training", **fields, **trained})
    return rows


def _counts(row: dict[str, Any]) -> dict[str, Any]:
    return {name: row[name] for name in ("frames", "filmed", "seconds_a_frame")}


def _avatar(
    found: Collection, out: Path, refined: Path | None, progress: Report | None
) -> dict[str, float]:
    """Trains on a track; dB over the head of held-out frames, as that track has them, and
    seconds."""
    config = dataclasses.replace(Config(), iterations=_ITERATIONS, refine_poses=refined is not None)
    started = time.perf_counter()
    avatar = train(found, out, config, refined=refined, progress=progress)
    seconds = time.perf_counter() - started
    scores = held_out(avatar, found, settings=RenderSettings())
    psnr = float(np.mean([score.head_psnr for score in scores]))
    return {"avatar_head_psnr": round(psnr, 2), "training_s": round(seconds)}


def _joined(parts: list[Collection], out: Path) -> Collection:
    """Clips with an identity each in one collection: their meshes are kept as vertices."""
    first = parts[0]
    extra = {"tracking": {"clips": [c for p in parts for c in p.extra["tracking"]["clips"]]}}
    with CollectionWriter(out, first.head_name, first.betas, extra=extra, overwrite=True) as writer:
        for part in parts:
            clip = part.clips[0]
            vertices = part.posed(clip, np.arange(len(clip)))
            writer.clip(dataclasses.replace(clip, vertices=vertices))
            images = f"clips/{clip.name}/images"
            shutil.copytree(part.path / images, writer.root / images)
    return read_collection(out)


def _draw(axes: Any, rows: list[dict[str, Any]]) -> None:
    for row in rows:
        axes.plot([row["seconds_a_frame"]], [row["reprojection_px"]], "o", label=row["fit"])
    axes.legend()
