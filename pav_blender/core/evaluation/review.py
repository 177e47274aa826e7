"""Looking a track over: mesh, landmarks and matte on the pictures, and each frame's error."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ..collection import Clip, Collection
from ..errors import Cancelled, InputError
from ..files import replacing
from ..images import write_rgba
from ..progress import Report
from ..rendering.rasterise import rasterise
from ..tracking.landmark_model import LandmarkModel
from ..tracking.sift import ranges
from ..training.frames import camera_of, load_picture
from .sheet import grid

_OVERLAYS = 6  # frames a clip
_LEFT_PUPIL, _RIGHT_PUPIL = 473, 468
_MESH, _SEEN, _MATTE = (0.2, 0.9, 0.5), (1.0, 0.85, 0.1), (1.0, 0.25, 0.7)
_STRIP = 24  # pixels of the error curve under a video


@dataclass(eq=False)
class Errors:
    """A clip's landmark errors. percent [F]: each frame's median distance between the landmarks
    that were seen and those of the tracked head, in percent of the distance of the pupils
    (the clip's median)."""

    clip: Clip
    percent: np.ndarray

    @property
    def median(self) -> float:
        return float(np.median(self.percent))

    @property
    def worst(self) -> int:
        """Number of the frame with the largest error."""
        return int(self.clip.frame_id[self.percent.argmax()])


def landmark_errors(collection: Collection, clip: Clip) -> Errors | None:
    """None where the clip's landmarks were not kept, as in a collection that nobody tracked."""
    seen = clip.landmarks
    if seen is None or seen.shape[1] <= _LEFT_PUPIL:
        return None
    away = np.empty(len(clip))
    points = _tracked(collection, clip)
    for row in range(len(clip)):
        pixels, _ = camera_of(clip, row).project(points[row])
        away[row] = np.median(np.linalg.norm(pixels - seen[row], axis=1))
    eyes = np.linalg.norm(seen[:, _LEFT_PUPIL] - seen[:, _RIGHT_PUPIL], axis=1)
    return Errors(clip, 100 * away / max(float(np.median(eyes)), 1e-6))


def _tracked(collection: Collection, clip: Clip) -> np.ndarray:
    """The tracked head's landmarks, where the detector would see them, [F, L, 3] metres."""
    if clip.vertices is not None:
        return np.asarray(collection.head.landmarks(clip.vertices))
    model = LandmarkModel(collection.head, len(collection.betas))
    posed = model.pose(collection.betas, clip.expression, clip.pose, clip.translation)
    from_camera = posed.points - clip.camera_to_world[:, None, :3, 3]
    return posed.points + model.strayed(replace(posed, points=from_camera))


def left_out(collection: Collection) -> list[tuple[str, str, str]]:
    """(clip or video, reason, frames) of everything the tracker left out; empty if not tracked."""
    rows = []
    for entry in _tracking(collection, "clips"):
        step = entry.get("every")
        for reason, numbers in _reasons(entry.get("left_out")).items():
            frames = ranges(numbers, step if isinstance(step, int) else 1)
            rows.append((str(entry.get("name")), reason, frames))
    for entry in _tracking(collection, "skipped"):
        frames = f"{entry.get('first')}-{entry.get('last')}"
        rows.append((str(entry.get("video")), str(entry.get("reason")), frames))
    return rows


def _tracking(collection: Collection, part: str) -> list[dict]:
    """What `pav track` wrote about clips or skipped shots; nothing where that is malformed."""
    tracking = collection.extra.get("tracking")
    entries = tracking.get(part) if isinstance(tracking, dict) else None
    return [
        entry for entry in (entries if isinstance(entries, list) else ()) if isinstance(entry, dict)
    ]


def _reasons(stored: Any) -> dict[str, list[int]]:
    """Also of collections that hold the numbers alone."""
    reasons = stored if isinstance(stored, dict) else {"not usable": stored}
    return {
        str(reason): [number for number in numbers if isinstance(number, int)]
        for reason, numbers in reasons.items()
        if isinstance(numbers, list) and numbers
    }


def overlay(collection: Collection, clip: Clip, row: int) -> np.ndarray:
    """The picture over grey with the mesh's edges (green), the landmarks that were seen (yellow)
    and the matte's edge (pink), float32 [H, W, 3] in [0, 1]."""
    rgba = load_picture(collection, clip, row).astype(np.float32) / 255
    shown = plain(rgba)
    vertices = collection.posed(clip, np.array([row]))[0]
    _, triangle, barycentric = rasterise(vertices, collection.head.triangles, camera_of(clip, row))
    edge = (triangle >= 0) & (barycentric.min(-1) < 0.06)
    shown[edge] = 0.55 * shown[edge] + 0.45 * np.array(_MESH)
    shown[_outline(rgba[..., 3] > 0.5)] = _MATTE
    if clip.landmarks is not None:
        at = np.floor(clip.landmarks[row]).astype(int)
        inside = (at >= 0).all(axis=1) & (at < [clip.width, clip.height]).all(axis=1)
        shown[at[inside, 1], at[inside, 0]] = _SEEN
    return shown.astype(np.float32)


def plain(rgba: np.ndarray) -> np.ndarray:
    """Straight RGBA in [0, 1] over dark grey, [H, W, 3]."""
    return rgba[..., :3] * rgba[..., 3:] + 0.25 * (1 - rgba[..., 3:])


def _outline(solid: np.ndarray) -> np.ndarray:
    """Pixels of `solid` next to others."""
    inner = solid.copy()
    inner[1:] &= solid[:-1]
    inner[:-1] &= solid[1:]
    inner[:, 1:] &= solid[:, :-1]
    inner[:, :-1] &= solid[:, 1:]
    return solid & ~inner


def write_overlays(collection: Collection, path: Path) -> None:
    """A sheet: a row a clip, up to six frames spread over it, the worst one among them."""
    rows = []
    for clip in collection.clips:
        at = np.linspace(0, len(clip) - 1, min(_OVERLAYS, len(clip))).round().astype(int)
        errors = landmark_errors(collection, clip)
        if errors is not None and len(at) > 2:
            worst = int(errors.percent.argmax())
            at[1 + np.abs(at[1:-1] - worst).argmin()] = worst
        rows.append([overlay(collection, clip, int(row)) for row in np.unique(at)])
    write_rgba(path, grid(rows))


def plot_errors(errors: list[Errors], path: Path) -> None:
    """Each clip's error by frame, as SVG or PNG. Raises InputError without matplotlib."""
    if path.suffix.lower() not in (".svg", ".png"):
        raise InputError(f"{path}: a plot ends in .svg or .png")
    try:
        matplotlib = importlib.import_module("matplotlib")
        figure_module = importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise InputError("plots need matplotlib: `pip install matplotlib`") from error
    figure = figure_module.Figure(figsize=(8, 1.2 + 1.6 * len(errors)), layout="constrained")
    for axes, one in zip(
        np.ravel(figure.subplots(len(errors), squeeze=False)), errors, strict=True
    ):
        order = np.argsort(one.clip.frame_id, kind="stable")
        frames, percent = one.clip.frame_id[order], one.percent[order]
        axes.plot(frames, percent, ".-", linewidth=0.8, markersize=3)
        axes.axhline(one.median, color="0.6", linewidth=0.8)
        axes.set(ylim=(0, max(1.0, 1.1 * float(percent.max()))), ylabel="% of eye distance")
        axes.set_title(f"{one.clip.name}: median {one.median:.2f} %", fontsize=9, loc="left")
        axes.grid(alpha=0.3)
    axes.set_xlabel("frame")
    with replacing(path) as temporary, matplotlib.rc_context({"svg.hashsalt": "pav"}):
        kind = path.suffix.lower()[1:]
        metadata = {"Date": None} if kind == "svg" else None
        figure.savefig(temporary, format=kind, metadata=metadata)


def write_video(
    collection: Collection,
    path: Path,
    *,
    progress: Report | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> None:
    """All clips one after another as an MP4: the picture, the overlay, and the error under both.

    Raises InputError without PyAV, or where it has no H.264 encoder; Cancelled.
    """
    if path.suffix.lower() != ".mp4":
        raise InputError(f"{path}: a video ends in .mp4")
    try:
        av = importlib.import_module("av")
    except ImportError as error:
        raise InputError("PyAV, which writes videos, is missing; `pip install av`") from error
    if "libx264" not in av.codecs_available:
        raise InputError("this PyAV has no H.264 encoder (libx264); `pip install av`")
    width = 2 * max(clip.width for clip in collection.clips)
    height = max(clip.height for clip in collection.clips) + _STRIP
    total, done = sum(len(clip) for clip in collection.clips), 0
    with replacing(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=_rate(collection))
        stream.width, stream.height, stream.pix_fmt = width, height + height % 2, "yuv420p"
        stream.options = {"crf": "20"}
        for clip in collection.clips:
            errors = landmark_errors(collection, clip)
            for row in range(len(clip)):
                if should_stop is not None and should_stop():
                    raise Cancelled(f"{path}: stopped; nothing was written")
                page = np.zeros((stream.height, width, 3), np.float32)
                _fill(page, collection, clip, row, errors)
                picture = (page.clip(0, 1) * 255 + 0.5).astype(np.uint8)
                frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
                container.mux(stream.encode(frame))
                done += 1
                if progress:
                    progress(done / total, clip=clip.name)
        container.mux(stream.encode())


def _fill(
    page: np.ndarray, collection: Collection, clip: Clip, row: int, errors: Errors | None
) -> None:
    rgba = load_picture(collection, clip, row).astype(np.float32) / 255
    half = page.shape[1] // 2
    page[: clip.height, : clip.width] = plain(rgba)
    page[: clip.height, half : half + clip.width] = overlay(collection, clip, row)
    if errors is None:
        return
    strip = page[-_STRIP:]
    columns = np.linspace(0, len(clip) - 1, page.shape[1]).round().astype(int)
    heights = errors.percent[columns] / max(2.0, float(errors.percent.max())) * (_STRIP - 2)
    bars = np.arange(_STRIP)[::-1, None] < heights
    strip[bars] = 0.4
    strip[:, columns == row] += 0.5


def _rate(collection: Collection) -> Fraction:
    """Frames a second of the first tracked video; 25 where it is not known."""
    rates = [entry.get("rate") for entry in _tracking(collection, "clips")]
    known = [rate for rate in rates if isinstance(rate, int | float) and 1 <= rate <= 240]
    return Fraction(known[0] if known else 25).limit_denominator(1001)
