"""The fitted frames as a collection: the clip, its pictures cut out, labels and landmarks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from ..collection import Clip, CollectionWriter
from ..errors import Cancelled, InputError
from ..head import HeadModel
from ..kernels.cpu.threads import run_chunks
from ..progress import Report
from ..rendering.cameras import Camera
from ..rendering.rasterise import rasterise
from . import labels, matte
from .cache import Cache, key_of
from .crop import cut
from .fit import world
from .landmark_model import RIGID
from .looking import Shot
from .spread import splits
from .terms import ClipFit

ShouldStop = Callable[[], bool]
_CHUNK = 128  # masks between two savings
_AT_ONCE = 8  # windows in memory


@dataclass(eq=False)
class Track:
    """A shot's usable frames: `rows` of what was seen, and the fit of just those."""

    shot: Shot
    rows: np.ndarray
    fit: ClipFit
    report: dict

    @property
    def frame_id(self) -> np.ndarray:
        return self.shot.seen.frame_id[self.rows]


def clip_of(head: HeadModel, betas: np.ndarray, track: Track, size: int) -> Clip:
    """The clip as the collection has it, with pictures of `size` pixels."""
    shot, rows = track.shot, track.rows
    fit, camera = world(head, betas, track.fit)
    matrices = shot.crop.intrinsics(fit.focal, shot.seen.width, shot.seen.height, size)
    return Clip(
        name=shot.name,
        appearance=shot.appearance,
        width=size,
        height=size,
        expression=fit.expression.astype(np.float32),
        pose=fit.pose.astype(np.float32),
        translation=fit.translation.astype(np.float32),
        intrinsics=matrices[rows].astype(np.float32),
        camera_to_world=np.tile(camera.astype(np.float32), (len(rows), 1, 1)),
        frame_id=track.frame_id,
        split=splits(len(rows)),
        landmarks=landmarks_in(track, size).astype(np.float32),
    )


def landmarks_in(track: Track, side: int) -> np.ndarray:
    """What was seen, in pixels of pictures of `side`, [F, 478, 2]."""
    crop, rows = track.shot.crop, track.rows
    places = track.shot.seen.landmarks[rows, :, :2].astype(np.float64)
    return (places - crop.corners[rows][:, None]) * (side / crop.side)


def windows(
    shot: Shot, rows: np.ndarray, side: int, should_stop: ShouldStop | None = None
) -> Iterator[np.ndarray]:
    """The windows of a shot's frames `rows` (of `shot.seen`, ascending), read from its source
    again: float32 [side, side, 3] in [0, 1], in order. Raises Cancelled, and InputError where the
    source has changed since."""
    for row, rgb in frames_of(shot, rows, should_stop):
        yield cut(rgb, shot.crop.corners[row], shot.crop.side, side)


def frames_of(
    shot: Shot, rows: np.ndarray, should_stop: ShouldStop | None = None
) -> Iterator[tuple[int, np.ndarray]]:
    """A row and its whole frame, uint8 [H, W, 3]; otherwise as `windows`."""
    numbers = shot.seen.frame_id[rows]
    row_of = {int(number): int(row) for number, row in zip(numbers, rows, strict=True)}
    given = 0
    for frame in shot.source.frames(shot.every, int(numbers[0]), int(numbers[-1]) + 1):
        row = row_of.get(frame.number)
        if row is None:
            continue
        if should_stop is not None and should_stop():
            raise Cancelled("tracking stopped; the same command goes on from here")
        given += 1
        yield row, frame.rgb
    if given < len(rows):
        raise InputError(f"{shot.source.path}: changed while it was read; track it again")


def write_pictures(
    writer: CollectionWriter,
    head: HeadModel,
    betas: np.ndarray,
    clip: Clip,
    track: Track,
    cut_background: bool,
    cache: Cache,
    tell: Report,
    should_stop: ShouldStop | None,
) -> None:
    """images/ and, where the background is cut away, labels/ of a clip."""
    count = len(clip)
    work = min(track.shot.crop.side, clip.width * 3 // 2)
    masks = None
    if cut_background:
        masks = masks_of(
            track.shot, track.rows, work, cache, lambda n: _cutting(tell, n, clip), should_stop
        )
        masks = _mended(masks, head, betas, clip, track)
    parts = labels.of_triangles(head)

    def write(some: list[tuple[int, np.ndarray]]) -> None:
        for row, picture in some:
            write_one(row, picture)

    def write_one(row: int, picture: np.ndarray) -> None:
        if masks is None:
            rgba = np.concatenate([picture, np.ones_like(picture[..., :1])], axis=2)
        else:
            rgba = matte.cut_out(picture, masks[row])
        rgba = (matte.shrink(rgba, clip.width) * 255 + 0.5).astype(np.uint8)
        number = int(clip.frame_id[row])
        writer.image(clip.name, number, rgba)
        if masks is not None:
            writer.labels(clip.name, number, labels.label(head, parts, betas, clip, row, rgba))

    pictures = enumerate(windows(track.shot, track.rows, work, should_stop))
    while some := list(islice(pictures, _AT_ONCE)):
        run_chunks(lambda i, j, some=some: write(some[i:j]), len(some), 1)
        tell(0.4 + 0.6 * (some[-1][0] + 1) / count, step=f"writing {clip.name}")


def _cutting(tell: Report, done: int, clip: Clip) -> None:
    tell(0.4 * done / len(clip), step=f"cutting out {clip.name}")


def masks_of(
    shot: Shot,
    rows: np.ndarray,
    side: int,
    cache: Cache,
    tell: Callable[[int], None],
    should_stop: ShouldStop | None = None,
) -> np.ndarray:
    """The segmenter's masks of a shot's frames `rows`, uint8 [F, 256, 256]; cached.

    side: of the windows that it sees; tell(frames done). Raises Cancelled.
    """
    crop, numbers = shot.crop, shot.seen.frame_id[rows]
    parts = (matte.segmenter_name(), shot.source.fingerprint(), shot.every, crop.side, side)
    key = key_of("masks", *parts, crop.corners[rows], numbers)
    masks = np.empty((len(rows), matte.MASK_SIDE, matte.MASK_SIDE), np.uint8)
    done = 0
    while done < len(rows):
        found = cache.load(key, f"masks{done // _CHUNK:05d}", ("masks",))
        if found is None or found["masks"].shape != masks[done : done + _CHUNK].shape:
            break
        masks[done : done + _CHUNK] = found["masks"]
        done = min(done + _CHUNK, len(rows))
    if done == len(rows):
        return masks
    segmenter = matte.Segmenter()
    try:
        for picture in windows(shot, rows[done:], side, should_stop):
            masks[done] = segmenter(picture)
            done += 1
            tell(done)
            if done % _CHUNK == 0 or done == len(rows):
                first = (done - 1) // _CHUNK * _CHUNK
                cache.store(key, f"masks{first // _CHUNK:05d}", {"masks": masks[first:done]})
    finally:
        segmenter.close()
    return masks


def _mended(
    masks: np.ndarray, head: HeadModel, betas: np.ndarray, clip: Clip, track: Track
) -> np.ndarray:
    """The masks made steady, with the hair and the skull that the network lost."""
    places = landmarks_in(track, matte.MASK_SIDE)[:, RIGID]
    masks = matte.steadied(masks, places, np.diff(track.frame_id))
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

    def draw(start: int, stop: int) -> None:
        for row in range(start, stop):
            camera = Camera(
                clip.width, clip.height, clip.intrinsics[row], clip.camera_to_world[row]
            )
            one = slice(row, row + 1)
            posed = head.pose(betas, clip.expression[one], clip.pose[one], clip.translation[one])
            _, index, _ = rasterise(
                posed[0].numpy(), triangles, camera.resized(matte.MASK_SIDE, matte.MASK_SIDE)
            )
            masks[row] = matte.eroded(index >= 0)

    run_chunks(draw, len(clip), 4)
    return masks
