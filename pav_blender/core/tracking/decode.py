"""Video files to pictures, one at a time, upright and with square pixels.

`Video` and `pictures.PictureFolder` are both a `Source`.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..errors import InputError
from .cache import fingerprint

_LARGEST = 1 << 30  # bytes of a picture
_COVER_PICTURE = 0x400  # libavformat's AV_DISPOSITION_ATTACHED_PIC


@dataclass(frozen=True, eq=False)
class Frame:
    """number: its place in the video from 0; rgb: uint8 [H, W, 3]."""

    number: int
    rgb: np.ndarray


class Source(Protocol):
    """Where frames come from. rate: frames a second (0: not known); count: frames as declared
    (0: not known); warnings: one line for each thing that could not be decoded."""

    path: Path
    rate: float
    warnings: list[str]

    @property
    def count(self) -> int: ...

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Frames 0, every, 2 every, ... of those numbered from `start` to before `stop`."""
        ...

    def fingerprint(self) -> str:
        """Tells contents apart."""
        ...


@dataclass
class Video:
    """An opened description of a video; `frames` reads it anew each time. See `Source`."""

    path: Path
    rate: float
    count: int
    warnings: list[str] = field(default_factory=list)

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """See `Source`. What is damaged is passed over and told in `warnings`; a file in which
        nothing can be decoded raises InputError."""
        number, skipped = 0, 0
        ended_early = False
        size: tuple[int, ...] | None = None
        with _open(self.path) as container:
            stream = _video_stream(container, self.path)
            ratio = _pixel_aspect(stream)
            # one for all frames: a frame's own begins anew, which takes longer than decoding
            reformatter = _av().video.reformatter.VideoReformatter()
            for packet in _packets(container, stream):
                if packet is None:
                    ended_early = True
                    break
                for picture in _decoded(packet):
                    if stop is not None and number >= stop:
                        return
                    if picture is None:
                        skipped += 1
                        continue
                    number += 1
                    # the first one always, for its size is the clip's
                    if size is not None and (number <= start or (number - 1) % every):
                        continue
                    rgb = _upright(picture, ratio, reformatter)
                    size = size or rgb.shape
                    if rgb.shape != size:
                        skipped += 1
                    elif number > start and (number - 1) % every == 0:
                        yield Frame(number - 1, rgb)
        if number == 0:
            raise InputError(f"{self.path}: no picture in it can be decoded")
        if skipped or ended_early or number < self.count:
            self._warn(
                f"{self.path}: damaged or cut short; {number} "
                + (f"of {self.count} " if self.count > number else "")
                + "frames could be decoded"
            )

    def fingerprint(self) -> str:
        return fingerprint([self.path])

    def _warn(self, line: str) -> None:
        if line not in self.warnings:
            self.warnings.append(line)


def open_video(path: Path | str) -> Video:
    """Looks at a video file. Raises InputError: no such file, not a video, no video stream."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such video file")
    with _open(path) as container:
        stream = _video_stream(container, path)
        return Video(path, float(stream.average_rate or 0), int(stream.frames or 0))


def _av() -> Any:
    try:
        return importlib.import_module("av")
    except ImportError as error:
        raise InputError("PyAV, which reads videos, is missing; `pip install av`") from error


def _open(path: Path) -> Any:
    av = _av()
    try:
        return av.open(str(path))
    except (av.error.FFmpegError, ValueError, OSError) as error:
        raise InputError(f"{path}: not a readable video ({_reason(error)})") from error


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error).splitlines()[0]


def _video_stream(container: Any, path: Path) -> Any:
    streams = container.streams.video
    if not streams or streams[0].codec_context is None:
        raise InputError(f"{path}: has no video stream")
    # a sound file's cover picture is a video stream to the demuxer
    if _value(getattr(streams[0], "disposition", 0)) & _COVER_PICTURE:
        raise InputError(f"{path}: has no video stream, only a cover picture")
    streams[0].thread_type = "AUTO"
    return streams[0]


def _value(flags: Any) -> int:
    return int(getattr(flags, "value", flags))


def _packets(container: Any, stream: Any) -> Iterator[Any]:
    """Packets of the stream, then None where the file breaks off."""
    packets = container.demux(stream)
    while True:
        try:
            yield next(packets)
        except StopIteration:
            return
        except _av().error.FFmpegError:
            yield None
            return


def _decoded(packet: Any) -> Iterator[Any]:
    """The packet's pictures, or None once where it is damaged."""
    try:
        yield from packet.decode()
    except _av().error.FFmpegError:
        yield None


def _pixel_aspect(stream: Any) -> float:
    ratio = float(stream.codec_context.sample_aspect_ratio or 1)
    return ratio if 0.1 < ratio < 10 else 1.0


def _upright(picture: Any, ratio: float, reformatter: Any) -> np.ndarray:
    """Square pixels, then turned as the file's display matrix says."""
    width = max(1, round(picture.width * ratio))
    if 3 * width * picture.height > _LARGEST:
        raise InputError(f"a video of {width}x{picture.height} pixels is not read")
    rgb = reformatter.reformat(picture, width, picture.height, "rgb24").to_ndarray()
    quarter_turns = round(getattr(picture, "rotation", 0) / 90) % 4
    return np.ascontiguousarray(np.rot90(rgb, quarter_turns))
