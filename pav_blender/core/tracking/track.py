"""From videos to a collection: decode, observe, crop, fit, cut out, write."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..collection import Clip, CollectionWriter
from ..errors import Cancelled, InputError
from ..head import HeadModel, load_head
from ..progress import Report
from ..rendering.cameras import Camera
from ..rendering.rasterise import rasterise
from . import matte
from .crop import Crop, content_box, cut, plan_crop
from .decode import Frame, Video, open_video
from .fit import ClipFit, fit_head, world
from .landmark_model import RIGID
from .observe import Observations, make_detector, observe

ShouldStop = Callable[[], bool]

TEST_SHARE = 0.1
# parts of the whole work, as they were measured
_OBSERVING, _FITTING = 0.35, 0.25
_BOX_SAMPLES = 12
# a frame whose median landmark misses by more than both does not show the face it should
_WORST_OF_MEDIAN, _WORST_OF_EYES = 3.0, 0.08


@dataclass(eq=False)
class TrackReport:
    """What `track` did: one dict a clip (name, video, rate, frames, left_out: numbers of unused
    frames, error_percent: the median landmark distance in percent of the distance between the
    pupils, focal_pixels, picture_moves), and warnings, one line each."""

    path: Path
    clips: list[dict]
    warnings: list[str]


@dataclass(eq=False)
class _Source:
    video: Video
    name: str
    appearance: str
    every: int
    limit: int | None
    seen: Observations
    crop: Crop


def track(
    videos: Sequence[Path | str],
    out: Path | str,
    *,
    size: int = 256,
    max_frames: int | None = 1000,
    every: int = 1,
    appearances: Sequence[str] | None = None,
    head: str = "builtin",
    model: Path | str | None = None,
    cut_background: bool = True,
    overwrite: bool = False,
    progress: Report | None = None,
    should_stop: ShouldStop | None = None,
) -> TrackReport:
    """Tracks the head in `videos` of one person and writes the collection `out`.

    size: side of the written pictures; every, max_frames: which frames of each video; appearances:
    one name a video (default: the files' names; videos may share one); head: "builtin" or a head
    file; model: a MediaPipe face landmarker `.task` file; cut_background: False writes pictures
    opaque; progress(fraction, step=what). The last tenth of every clip becomes its test split.
    Raises InputError for videos that cannot be read or show no face, and Cancelled; then nothing
    is written.
    """
    _check(videos, size, every, max_frames, appearances)
    out = Path(out)
    if out.exists() and not (overwrite and (out / "collection.json").is_file()):
        raise InputError(f"{out}: exists already; choose another folder or give --overwrite")
    tell = progress or _silent
    head_model = load_head(head)
    opened = [open_video(path) for path in videos]
    names = clip_names([video.path for video in opened])
    share = _OBSERVING / len(opened)
    sources = [
        _look(
            video,
            names[index],
            appearances[index] if appearances else names[index],
            (every, max_frames),
            model,
            _part(tell, share * index, share),
            should_stop,
        )
        for index, video in enumerate(opened)
    ]
    fit = fit_head(
        head_model,
        [source.seen for source in sources],
        progress=lambda done: tell(_OBSERVING + _FITTING * done, step="fitting the head"),
        should_stop=should_stop,
    )
    warnings = [line for video in opened for line in video.warnings]
    tracks = [
        _finish(source, fit.clips[index], fit.errors[index], fit.eye_distances[index])
        for index, source in enumerate(sources)
    ]
    reports = [track.report for track in tracks]
    extra = {"tracking": {"clips": reports, "warnings": warnings}}
    start = _OBSERVING + _FITTING
    share = (1 - start) / len(tracks)
    with CollectionWriter(out, head, fit.betas, extra=extra, overwrite=overwrite) as writer:
        for index, done in enumerate(tracks):
            clip = _clip(head_model, fit.betas, done, size)
            writer.clip(clip)
            tell_clip = _part(tell, start + share * index, share)
            _write_pictures(
                writer, head_model, fit.betas, clip, done, cut_background, tell_clip, should_stop
            )
    tell(1.0, step="done")
    return TrackReport(out, reports, warnings)


@dataclass(eq=False)
class _Track:
    """A source's usable frames: `rows` of what was seen, and the fit of just those."""

    source: _Source
    rows: np.ndarray
    fit: ClipFit
    report: dict


def _silent(fraction: float, **fields: object) -> None:
    pass


def clip_names(paths: Sequence[Path]) -> list[str]:
    """A name for each video, from its file's: safe as a folder, and different from the others."""
    names: list[str] = []
    for path in paths:
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", path.stem).strip("_-")[:48] or "clip"
        name, count = stem, 2
        while name in names:
            name, count = f"{stem}_{count}", count + 1
        names.append(name)
    return names


def _check(
    videos: Sequence[Path | str],
    size: int,
    every: int,
    max_frames: int | None,
    appearances: Sequence[str] | None,
) -> None:
    if not videos:
        raise InputError("no video was given")
    if not 32 <= size <= 4096:
        raise InputError(f"size {size}: pictures have a side of 32 to 4096 pixels")
    if every < 1:
        raise InputError(f"every {every}: must be at least 1")
    if max_frames is not None and max_frames < 1:
        raise InputError(f"max frames {max_frames}: must be at least 1")
    if appearances is not None and len(appearances) != len(videos):
        raise InputError(
            f"{len(appearances)} appearance names for {len(videos)} videos; give one each"
        )


def _part(tell: Report, start: float, share: float) -> Report:
    return lambda fraction, **fields: tell(start + share * fraction, **fields)


def _look(
    video: Video,
    name: str,
    appearance: str,
    which: tuple[int, int | None],
    model: Path | str | None,
    tell: Report,
    should_stop: ShouldStop | None,
) -> _Source:
    samples: list[np.ndarray] = []
    every, limit = which
    expected = max(1, min(video.count // every or 500, limit or 10**9))
    seen_frames = 0

    def on_frame(frame: Frame) -> None:
        nonlocal seen_frames
        if seen_frames % max(1, expected // _BOX_SAMPLES) == 0 and len(samples) < 2 * _BOX_SAMPLES:
            samples.append(frame.rgb)
        seen_frames += 1
        tell(min(1.0, seen_frames / expected), step=f"looking at {name}")

    detector = make_detector(model)
    try:
        seen = observe(
            video.frames(every, limit),
            detector,
            name=str(video.path),
            on_frame=on_frame,
            should_stop=should_stop,
        )
    finally:
        detector.close()
    box = content_box(np.stack(samples))
    crop = plan_crop(seen, box, str(video.path))
    return _Source(video, name, appearance, every, limit, seen, crop)


def _finish(source: _Source, fit: ClipFit, errors: np.ndarray, eye_distance: float) -> _Track:
    """Leaves out frames whose landmarks the head cannot follow: most often an occluded face."""
    limit = max(_WORST_OF_MEDIAN * float(np.median(errors)), _WORST_OF_EYES * eye_distance)
    rows = np.flatnonzero(errors <= limit)
    kept = ClipFit(fit.focal, fit.root, fit.pose[rows], fit.translation[rows], fit.expression[rows])
    seen = source.seen
    left_out = sorted([*seen.missing, *np.delete(seen.frame_id, rows).tolist()])
    report = {
        "name": source.name,
        "video": source.video.path.name,
        "rate": source.video.rate,
        "frames": len(rows),
        "left_out": left_out,
        "error_percent": round(100 * float(np.median(errors[rows])) / eye_distance, 3),
        "focal_pixels": round(fit.focal, 2),
        "picture_moves": not source.crop.still,
    }
    return _Track(source, rows, kept, report)


def splits(count: int) -> np.ndarray:
    """The last tenth (one frame at least, of two or more) is held out, [count] '<U8'."""
    split = np.full(count, "train", "<U8")
    held = max(1, round(count * TEST_SHARE)) if count > 1 else 0
    split[count - held :] = "test"
    return split


def _clip(head: HeadModel, betas: np.ndarray, track: _Track, size: int) -> Clip:
    source, rows = track.source, track.rows
    fit, camera = world(head, betas, track.fit)
    matrices = source.crop.intrinsics(fit.focal, source.seen.width, source.seen.height, size)
    return Clip(
        name=source.name,
        appearance=source.appearance,
        width=size,
        height=size,
        expression=fit.expression.astype(np.float32),
        pose=fit.pose.astype(np.float32),
        translation=fit.translation.astype(np.float32),
        intrinsics=matrices[rows].astype(np.float32),
        camera_to_world=np.tile(camera.astype(np.float32), (len(rows), 1, 1)),
        frame_id=source.seen.frame_id[rows],
        split=splits(len(rows)),
    )


def _write_pictures(
    writer: CollectionWriter,
    head: HeadModel,
    betas: np.ndarray,
    clip: Clip,
    track: _Track,
    cut_background: bool,
    tell: Report,
    should_stop: ShouldStop | None,
) -> None:
    count = len(clip)
    work = min(track.source.crop.side, clip.width * 3 // 2)
    masks = None
    if cut_background:
        segmenter = matte.Segmenter()
        try:
            masks = np.empty((count, matte.MASK_SIDE, matte.MASK_SIDE), np.uint8)
            for row, picture in enumerate(_windows(track, work, should_stop)):
                masks[row] = segmenter(picture)
                tell(0.4 * row / count, step=f"cutting out {clip.name}")
        finally:
            segmenter.close()
        masks = _mended(matte.steadied(masks), head, betas, clip, track)
    for row, picture in enumerate(_windows(track, work, should_stop)):
        if masks is None:
            rgba = np.concatenate([picture, np.ones_like(picture[..., :1])], axis=2)
        else:
            rgba = matte.cut_out(picture, masks[row])
        rgba = matte.shrink(rgba, clip.width)
        writer.image(clip.name, int(clip.frame_id[row]), (rgba * 255 + 0.5).astype(np.uint8))
        tell(0.4 + 0.6 * row / count, step=f"writing {clip.name}")


def _mended(
    masks: np.ndarray, head: HeadModel, betas: np.ndarray, clip: Clip, track: _Track
) -> np.ndarray:
    """The masks with the hair and the skull that the network lost."""
    crop = track.source.crop
    places = track.source.seen.landmarks[track.rows][:, RIGID, :2].astype(np.float64)
    places = (places - crop.corners[track.rows][:, None]) * (matte.MASK_SIDE / crop.side)
    scalps = _silhouettes(head, betas, clip, ("scalp",))
    skulls = _silhouettes(head, betas, clip, ("face", "scalp"))
    turns = track.fit.pose[:, 1 if len(head.joint_names) > 1 else 0]
    return np.maximum(matte.agreed(masks, turns, places, scalps), skulls)


def _silhouettes(
    head: HeadModel, betas: np.ndarray, clip: Clip, regions: tuple[str, ...]
) -> np.ndarray:
    """Where the fitted head's regions surely are, uint8 [F,256,256]."""
    masks = np.zeros((len(clip), matte.MASK_SIDE, matte.MASK_SIDE), np.uint8)
    solid = np.zeros(head.vertex_count, bool)
    for region in regions:
        if region in head.regions:
            solid |= head.regions[region]
    triangles = head.triangles[solid[head.triangles].all(axis=1)]
    if len(triangles) == 0:
        return masks
    for row in range(len(clip)):
        camera = Camera(clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row])
        one = slice(row, row + 1)
        posed = head.pose(betas, clip.expression[one], clip.pose[one], clip.translation[one])
        _, index, _ = rasterise(
            posed[0].numpy(), triangles, camera.resized(matte.MASK_SIDE, matte.MASK_SIDE)
        )
        masks[row] = matte.eroded(index >= 0)
    return masks


def _windows(track: _Track, side: int, should_stop: ShouldStop | None) -> Iterator[np.ndarray]:
    """The kept frames' windows, float32 [side, side, 3], in order."""
    source = track.source
    row_of = {int(source.seen.frame_id[row]): row for row in track.rows}
    for frame in source.video.frames(source.every, source.limit):
        row = row_of.get(frame.number)
        if row is None:
            continue
        if should_stop is not None and should_stop():
            raise Cancelled("tracking stopped; nothing was written")
        yield cut(frame.rgb, source.crop.corners[row], source.crop.side, side)
