"""From videos to a collection: decode, observe, crop, fit, cut out, write."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..collection import CollectionWriter
from ..errors import InputError
from ..head import BUILTIN, HeadModel, remember_head
from ..head.flame import version_of
from ..kernels.cpu.threads import each, torch_alone
from ..progress import Report
from . import detectors, shoulders
from .cache import Cache
from .fit import USUAL_RATE, HeadFit, fit_head, refine_head
from .looking import Shot, Take, choose_shots, sight
from .photo import windows as face_windows
from .pictures import open_source
from .sift import NO_FIT
from .terms import ClipFit
from .write import ShouldStop, Track, clip_of, frames_of, write_pictures

# parts of the whole work, as they were measured
_OBSERVING, _FITTING = 0.4, 0.35
_LANDMARKS_SHARE = 0.4  # of the fitting
# a frame whose median landmark misses by more than both does not show the face it should
_WORST_OF_MEDIAN, _WORST_OF_EYES = 3.0, 0.08


@dataclass(eq=False)
class TrackReport:
    """What `track` did.

    clips: one dict each (name, video, rate, every, frames, left_out: numbers of frames by reason,
    not_chosen: how many more could have been used, error_percent: the median landmark distance in
    percent of the distance between the pupils, focal_pixels, picture_moves); skipped: one dict a
    shot that became no clip (video, first, last, reason, left_out); warnings: one line each.
    """

    path: Path
    clips: list[dict]
    skipped: list[dict]
    warnings: list[str]


@torch_alone()
def track(
    videos: Sequence[Path | str],
    out: Path | str,
    *,
    size: int = 256,
    max_frames: int | None = 500,
    every: int = 1,
    appearances: Sequence[str] | None = None,
    head: str = "builtin",
    model: Path | str | None = None,
    cut_background: bool = True,
    cuts: bool = True,
    photo: bool = True,
    overwrite: bool = False,
    progress: Report | None = None,
    should_stop: ShouldStop | None = None,
) -> TrackReport:
    """Tracks the head in `videos` of one person and writes the collection `out`.

    videos: video files, or folders of pictures; size: side of the written pictures; every: which
    frames are looked at; max_frames: of these so many a shot, as different as can be; appearances:
    one name a video, or "NAME=video,video" (default: the files' names); head: "builtin" or a head
    file; model: a MediaPipe face landmarker `.task` file; cut_background: False writes pictures
    opaque; cuts: whether a video is split where it was cut; photo: whether the fit to the landmarks
    is refined by the pictures; progress(fraction, step=what). The last tenth of every clip becomes
    its test split. Raises InputError for videos that cannot be read or
    show no face, and Cancelled; then `out` is not there, and `out`.partial keeps what was found:
    the same call goes on from it.
    """
    _check(videos, size, every, max_frames)
    out = Path(out)
    if out.exists() and not (overwrite and (out / "collection.json").is_file()):
        raise InputError(f"{out}: exists already; choose another folder or give --overwrite")
    tell = progress or _silent
    head_model = remember_head(head)
    sources = [open_source(path) for path in videos]
    names = clip_names([source.path for source in sources])
    looks = appearance_names(names, appearances)
    cache = Cache(out.with_name(f"{out.name}.partial"))
    share = _OBSERVING / len(sources)
    takes = []
    for index, source in enumerate(sources):
        part = _part(tell, share * index, share)
        tell_frames = _counted(part, source.count // every, names[index])
        seen = sight(source, every, model, cache, tell_frames, should_stop)
        takes.append(Take(source, seen, every, names[index], looks[index]))
    looked = choose_shots(takes, max_frames, cuts=cuts)
    fits = fit_shots(
        head_model, looked.shots, photo, _part(tell, _OBSERVING, _FITTING), should_stop
    )
    fit = fits[-1]
    tracks = [
        _finish(
            shot,
            fit.clips[index],
            (fits[0].errors[index], fit.errors[index]),
            fit.eye_distances[index],
        )
        for index, shot in enumerate(looked.shots)
    ]
    reports = [track.report for track in tracks]
    warnings = [line for source in sources for line in source.warnings] + looked.warnings
    warnings += [cache.warning] if cache.warning else []
    if not detectors.finds_hands():
        warnings.append("this MediaPipe finds no hands: frames with a hand over the face stay in")
    extra = {"tracking": {"clips": reports, "skipped": looked.skipped, "warnings": warnings}}
    start = _OBSERVING + _FITTING
    share = (1 - start) / len(tracks)
    name = head_model.name if version_of(head_model) else head
    known = "" if head == BUILTIN else head_model.fingerprint
    with CollectionWriter(
        out, name, fit.betas, fingerprint=known, extra=extra, overwrite=overwrite
    ) as writer:
        for index, done in enumerate(tracks):
            clip = clip_of(head_model, fit.betas, done, size)
            writer.clip(clip)
            tell_clip = _part(tell, start + share * index, share)
            write_pictures(
                writer,
                head_model,
                fit.betas,
                clip,
                done,
                cut_background,
                cache,
                tell_clip,
                should_stop,
            )
    cache.remove()
    tell(1.0, step="done")
    return TrackReport(out, reports, looked.skipped, warnings)


def fit_shots(
    head: HeadModel,
    shots: Sequence[Shot],
    photo: bool,
    tell: Report,
    should_stop: ShouldStop | None = None,
) -> list[HeadFit]:
    """The fit to the shots' landmarks, and with `photo` then the one refined by their pictures."""
    seen = [shot.seen for shot in shots]
    rates = [shot.source.rate or USUAL_RATE for shot in shots]
    share = _LANDMARKS_SHARE if photo else 1.0
    fit = fit_head(
        head,
        seen,
        rates=rates,
        progress=lambda done: tell(share * done, step="fitting the head"),
        should_stop=should_stop,
    )
    if not photo:
        return [fit]
    pictures, greys = [], []
    for shot in shots:
        greys.append(np.empty((len(shot.seen), shoulders.SIDE, shoulders.SIDE), np.uint8))
        frames = _keeping(shot, greys[-1], should_stop)
        pictures.append(
            face_windows(frames, shot.seen.landmarks, shot.seen.width, shot.seen.height)
        )
    refined = refine_head(
        head,
        seen,
        fit,
        pictures,
        rates=rates,
        progress=lambda done: tell(share + (1 - share) * done, step="following the skin"),
        should_stop=should_stop,
    )
    return [fit, _with_shoulders(head, shots, refined, greys, should_stop)]


def _keeping(shot: Shot, greys: np.ndarray, should_stop: ShouldStop | None) -> Iterator[np.ndarray]:
    """A shot's frames; of each the window that is written is put into `greys`."""
    for row, rgb in frames_of(shot, np.arange(len(shot.seen)), should_stop):
        greys[row] = shoulders.grey_window(rgb, shot.crop.corners[row], shot.crop.side)
        yield rgb


def _with_shoulders(
    head: HeadModel,
    shots: Sequence[Shot],
    fit: HeadFit,
    greys: list[np.ndarray],
    should_stop: ShouldStop | None,
) -> HeadFit:
    clips = list(fit.clips)

    def follow(index: int) -> None:
        crop, seen = shots[index].crop, shots[index].seen
        corners = crop.corners - np.array([seen.width, seen.height]) / 2
        clips[index] = shoulders.follow(
            head, fit.betas, clips[index], greys[index], corners, crop.side, should_stop
        )

    each(follow, len(clips))
    return replace(fit, clips=clips)


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


def appearance_names(names: Sequence[str], wanted: Sequence[str] | None) -> list[str]:
    """The appearance of each video, by its clip's name: `wanted` holds one name a video, or any
    number of "NAME=clip,clip". Raises InputError for a clip that is not there, or named twice."""
    if not wanted:
        return list(names)
    if not any("=" in entry for entry in wanted):
        if len(wanted) != len(names):
            raise InputError(
                f"{len(wanted)} appearance names for {len(names)} videos; give one each, or "
                "NAME=clip,clip"
            )
        return list(wanted)
    looks: dict[str, str] = {}
    for entry in wanted:
        name, _, clips = entry.partition("=")
        for clip in [part.strip() for part in clips.split(",")]:
            if not name.strip() or clip not in names:
                raise InputError(
                    f"appearance {entry!r}: expected NAME=clip,clip with clips out of "
                    f"{', '.join(names)}"
                )
            if clip in looks:
                raise InputError(f"appearance {entry!r}: clip {clip} has one already")
            looks[clip] = name.strip()
    return [looks.get(name, name) for name in names]


def _check(videos: Sequence[Path | str], size: int, every: int, max_frames: int | None) -> None:
    if not videos:
        raise InputError("no video was given")
    if not 32 <= size <= 4096:
        raise InputError(f"size {size}: pictures have a side of 32 to 4096 pixels")
    if every < 1:
        raise InputError(f"every {every}: must be at least 1")
    if max_frames is not None and max_frames < 1:
        raise InputError(f"max frames {max_frames}: must be at least 1")


def _part(tell: Report, start: float, share: float) -> Report:
    return lambda fraction, **fields: tell(start + share * fraction, **fields)


def _counted(tell: Report, expected: int, name: str) -> Callable[[int], None]:
    return lambda done: tell(min(1.0, done / (expected or 500)), step=f"looking at {name}")


def _finish(
    shot: Shot, fit: ClipFit, both: tuple[np.ndarray, np.ndarray], eye_distance: float
) -> Track:
    """Leaves out frames whose landmarks the head cannot follow: most often an occluded face.

    both: errors [F] of the fit to landmarks alone, which tells such frames, and of the last one.
    """
    alone, errors = both
    limit = max(_WORST_OF_MEDIAN * float(np.median(alone)), _WORST_OF_EYES * eye_distance)
    rows = np.flatnonzero(alone <= limit)
    kept = ClipFit(fit.focal, fit.root, fit.pose[rows], fit.translation[rows], fit.expression[rows])
    left_out = dict(shot.left_out)
    if len(rows) < len(errors):
        left_out[NO_FIT] = np.delete(shot.seen.frame_id, rows).tolist()
    report = {
        "name": shot.name,
        "video": shot.source.path.name,
        "rate": shot.source.rate,
        "every": shot.every,
        "frames": len(rows),
        "left_out": left_out,
        "not_chosen": shot.not_chosen,
        "error_percent": round(100 * float(np.median(errors[rows])) / eye_distance, 3),
        "focal_pixels": round(fit.focal, 2),
        "picture_moves": not shot.crop.still,
    }
    return Track(shot, rows, kept, report)
