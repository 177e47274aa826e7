"""What is seen in the frames of a video: faces, hands, and what tells good frames from bad."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from ..errors import Cancelled, InputError
from ..kernels.cpu.threads import each
from .cache import Cache
from .crop import edges, resize
from .decode import Frame, Source
from .detectors import HAND_POINTS, HANDS, Detector, HandDetector

LANDMARKS = 478
# frames looked at between two savings; detectors begin anew with each, some frames early, so that
# what is found does not depend on where the work was once interrupted
CHUNK, _WARMING = 256, 12
_BORDERS_AT = (0, 2, 4, 8, 16, 32, 64, 128, 192)  # of a chunk
_THUMB = 16
_FACE_SIDE = 96
_HAND_SIDE = 640  # pixels of the longer side are enough to find hands


@dataclass(eq=False)
class Observations:
    """What was seen in the F frames that show a face.

    landmarks [F, 478, 3] float32 pixels of the source frame (x right, y down from the top left
    corner; z relative, same scale, smaller is nearer); scores [F, 52] float32 in [0, 1] or None;
    score_names: the scores' ARKit names; frame_id [F] int32; missing: numbers of the frames
    without a face; width, height: of the source frame.
    """

    landmarks: np.ndarray
    scores: np.ndarray | None
    score_names: tuple[str, ...]
    frame_id: np.ndarray
    missing: list[int]
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.frame_id)

    def subset(self, rows: np.ndarray) -> Observations:
        """The frames at `rows` only; the others count as missing."""
        left_out = np.setdiff1d(np.arange(len(self)), rows)
        return Observations(
            self.landmarks[rows],
            None if self.scores is None else self.scores[rows],
            self.score_names,
            self.frame_id[rows],
            sorted([*self.missing, *self.frame_id[left_out].tolist()]),
            self.width,
            self.height,
        )


@dataclass(eq=False)
class Sightings:
    """Everything that is seen in the N frames of a source, before anyone has chosen.

    frame_id [N] int32; thumbs [N, 16, 16, 3] uint8; hands [N, 2, 21, 2] float32 pixels, NaN where
    there is none. Of the K faces, by rising frame: row [K] of their frame, landmarks [K, 478, 3],
    scores [K, 52] or [K, 0], sharpness [K] (see `sharpness`). tall, wide: see `crop.edges`.
    """

    frame_id: np.ndarray
    thumbs: np.ndarray
    hands: np.ndarray
    row: np.ndarray
    landmarks: np.ndarray
    scores: np.ndarray
    sharpness: np.ndarray
    tall: np.ndarray
    wide: np.ndarray
    score_names: tuple[str, ...]
    width: int
    height: int

    def observations(self, faces: np.ndarray) -> Observations:
        """The faces with the numbers `faces`, one a frame; the other frames count as missing."""
        rows = self.row[faces]
        missing = np.delete(self.frame_id, rows).tolist()
        return Observations(
            self.landmarks[faces],
            self.scores[faces] if self.scores.shape[1] else None,
            self.score_names,
            self.frame_id[rows],
            missing,
            self.width,
            self.height,
        )


_ARRAYS = ("frame_id", "thumbs", "hands", "row", "landmarks", "scores", "sharpness")
_STORED = (*_ARRAYS, "tall", "wide", "score_names", "size", "more", "warnings")


def observe(
    source: Source,
    every: int,
    make_detectors: Callable[[], tuple[Detector, HandDetector | None]],
    *,
    cache: Cache,
    key: str,
    tell: Callable[[int], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Sightings:
    """Looks at every `every`-th frame of `source`; `tell` hears how many are done.

    What `cache` has under `key` is not looked at again. Raises InputError naming the video where
    there is no face in it, and Cancelled; what is done by then is in the cache.
    """
    chunks: list[dict[str, np.ndarray]] = []
    while not chunks or chunks[-1]["more"]:
        found = cache.load(key, f"seen{len(chunks):05d}", _STORED)
        if found is None:
            break
        chunks.append(found)
    if chunks and not chunks[-1]["more"]:
        source.warnings.extend(w for w in chunks[-1]["warnings"].tolist())
    else:
        last = [number for chunk in chunks for number in chunk["frame_id"].tolist()][-_WARMING:]
        frames = source.frames(every, last[0] if last else 0)
        recent = deque(islice(frames, len(last)), _WARMING)
        while not chunks or chunks[-1]["more"]:
            if should_stop is not None and should_stop():
                raise _stopped()
            detectors = make_detectors()
            try:
                chunk = _chunk(
                    recent, frames, detectors, _counting(tell, len(chunks) * CHUNK), should_stop
                )
            finally:
                for detector in detectors:
                    if detector is not None:
                        detector.close()
            chunk["warnings"] = np.array(source.warnings, dtype=np.str_)
            cache.store(key, f"seen{len(chunks):05d}", chunk)
            chunks.append(chunk)
    return _joined(chunks, source)


def _counting(tell: Callable[[int], None] | None, done: int) -> Callable[[int], None]:
    return lambda count: tell(done + count) if tell else None


def _chunk(
    recent: deque[Frame],
    frames: Iterator[Frame],
    detectors: tuple[Detector, HandDetector | None],
    tell: Callable[[int], None],
    should_stop: Callable[[], bool] | None,
) -> dict[str, np.ndarray]:
    """The next CHUNK frames, after a second look at the `recent` ones, which it renews."""
    for frame in recent:
        _seen(detectors, frame.rgb)
    lists: dict[str, list] = {name: [] for name in (*_ARRAYS, "tall", "wide")}
    size: tuple[int, ...] = (0, 0)
    count = 0
    for frame in islice(frames, CHUNK):
        if should_stop is not None and should_stop():
            raise _stopped()
        size = frame.rgb.shape[:2]
        lists["frame_id"].append(frame.number)
        lists["thumbs"].append(_thumb(frame.rgb))
        faces, hands = _seen(detectors, frame.rgb)
        lists["hands"].append(hands)
        for landmarks, scores in faces:
            lists["row"].append(count)
            lists["landmarks"].append(landmarks)
            lists["scores"].append(np.zeros(0, np.float32) if scores is None else scores)
            lists["sharpness"].append(sharpness(frame.rgb, landmarks))
        if count in _BORDERS_AT:
            tall, wide = edges(frame.rgb)
            lists["tall"].append(tall)
            lists["wide"].append(wide)
        recent.append(frame)
        count += 1
        tell(count)
    arrays = {name: np.asarray(values) for name, values in lists.items()}
    names = detectors[0].score_names
    # a scripted or a failing network may score some faces only
    if len({len(scores) for scores in lists["scores"]}) > 1:
        arrays["scores"], names = np.zeros((len(lists["row"]), 0), np.float32), ()
    return {
        **arrays,
        "score_names": np.array(names, dtype=np.str_),
        "size": np.array(size),
        "more": np.array(count == CHUNK),
    }


def _joined(chunks: list[dict[str, np.ndarray]], source: Source) -> Sightings:
    starts = np.cumsum([0, *[len(chunk["frame_id"]) for chunk in chunks]])
    filled = [(start, c) for start, c in zip(starts, chunks, strict=False) if len(c["frame_id"])]
    if not any(len(chunk["row"]) for _, chunk in filled):
        raise InputError(
            f"{source.path}: no face was found in any of its {starts[-1]} frames; "
            "use a video in which the face is visible"
        )
    faces = [(start, chunk) for start, chunk in filled if len(chunk["row"])]
    scored = {chunk["scores"].shape[1] for _, chunk in faces}
    height, width = filled[0][1]["size"].tolist()

    def all_of(name: str) -> np.ndarray:
        return np.concatenate([chunk[name] for _, chunk in filled])

    def of_faces(name: str) -> np.ndarray:
        return np.concatenate([chunk[name] for _, chunk in faces]).astype(np.float32)

    return Sightings(
        all_of("frame_id").astype(np.int32),
        all_of("thumbs"),
        all_of("hands"),
        np.concatenate([chunk["row"] + start for start, chunk in faces]).astype(np.int64),
        of_faces("landmarks"),
        of_faces("scores") if len(scored) == 1 else np.zeros((len(of_faces("sharpness")), 0)),
        of_faces("sharpness"),
        all_of("tall"),
        all_of("wide"),
        tuple(faces[0][1]["score_names"].tolist()) if len(scored) == 1 else (),
        width,
        height,
    )


_Found = list[tuple[np.ndarray, np.ndarray | None]]


def _seen(
    detectors: tuple[Detector, HandDetector | None], rgb: np.ndarray
) -> tuple[_Found, np.ndarray]:
    """What `_faces` and `_hands` find, looked for at once."""
    detector, hand_detector = detectors
    looks = (lambda: _faces(detector, rgb), lambda: _hands(hand_detector, rgb))
    faces, hands = each(lambda index: looks[index](), 2)
    return faces, hands


def _faces(detector: Detector, rgb: np.ndarray) -> _Found:
    """Landmarks in pixels, and scores, of each face."""
    height, width = rgb.shape[:2]
    side = max(height, width)
    # the landmark model's region maths holds for square pictures only
    square = np.zeros((side, side, 3), np.uint8)
    square[:height, :width] = rgb
    return [
        ((face.landmarks * side).astype(np.float32), face.scores)
        for face in detector(square)
        if np.isfinite(face.landmarks).all()
    ]


def _hands(detector: HandDetector | None, rgb: np.ndarray) -> np.ndarray:
    """[2, 21, 2] pixels, NaN where there is no hand."""
    found = np.full((HANDS, HAND_POINTS, 2), np.nan, np.float32)
    if detector is not None:
        height, width = rgb.shape[:2]
        step = max(1, max(height, width) // _HAND_SIDE)
        hands = detector(np.ascontiguousarray(rgb[::step, ::step]))[:HANDS]
        found[: len(hands)] = hands * np.array([width, height], np.float32)
    return found


def sharpness(rgb: np.ndarray, landmarks: np.ndarray) -> float:
    """How much fine detail the face has: the variance of its Laplacian over its own variance, at
    one size for all faces. Comparable within a clip only."""
    low = landmarks[:, :2].min(axis=0).clip(0).astype(int)
    high = landmarks[:, :2].max(axis=0).astype(int) + 1
    window = rgb[low[1] : high[1], low[0] : high[0]]
    side = min(window.shape[:2])
    if side < 8:
        return 0.0
    top, left = (np.array(window.shape[:2]) - side) // 2
    square = window[top : top + side, left : left + side].astype(np.float32).mean(axis=2)
    grey = resize(np.ascontiguousarray(square[..., None]), _FACE_SIDE)[..., 0]
    inner = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * inner
    return float(laplacian.var() / (inner.var() + 1.0))


def _thumb(rgb: np.ndarray) -> np.ndarray:
    """uint8 [16, 16, 3]: means of blocks, of a raster where the picture is large."""
    height, width = rgb.shape[:2]
    step = max(1, min(height, width) // 128)
    small = rgb[::step, ::step]
    if min(small.shape[:2]) < _THUMB:
        small = np.repeat(np.repeat(small, _THUMB, axis=0), _THUMB, axis=1)
    rows, columns = (length // _THUMB for length in small.shape[:2])
    cut = small[: rows * _THUMB, : columns * _THUMB].astype(np.float32)
    means = cut.reshape(_THUMB, rows, _THUMB, columns, 3).mean(axis=(1, 3))
    return (means + 0.5).astype(np.uint8)


def _stopped() -> Cancelled:
    return Cancelled("tracking stopped; the same command goes on from here")
