"""A folder of pictures read as a clip: natural order, one size, any format OpenImageIO reads."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..images import read_rgba, read_scene_linear
from ..rendering.colour import linear_to_srgb
from .cache import fingerprint
from .decode import Frame, Source, open_video

DISPLAYED = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".tga", ".ppm")
SCENE_LINEAR = (".exr", ".hdr")
_BEHIND = 128  # grey under pictures with alpha


def natural(name: str) -> list[tuple[int, int | str]]:
    """A sort key: frame2 before frame10."""
    parts = re.findall(r"\d+|\D+", name.lower())
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in parts]


@dataclass
class PictureFolder:
    """The pictures of a folder; a frame's number is its place in their order. See `Source`."""

    path: Path
    files: list[Path]
    rate: float = 0.0
    warnings: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        return len(self.files)

    def frames(self, every: int = 1, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """See `Source`. Pictures that are damaged, or of another size than the first, are passed
        over and told in `warnings`; InputError where none is left."""
        size: tuple[int, ...] | None = None
        for number, path in enumerate(self.files[:stop]):
            if size is not None and (number < start or number % every):
                continue
            try:
                rgb = _read(path)
            except InputError as error:
                self._warn(str(error))
                continue
            size = size or rgb.shape
            if rgb.shape != size:
                self._warn(
                    f"{path}: {rgb.shape[1]}x{rgb.shape[0]} pixels in a folder of "
                    f"{size[1]}x{size[0]}; passed over"
                )
            elif number >= start and number % every == 0:
                yield Frame(number, rgb)
        if size is None:
            raise InputError(f"{self.path}: none of its {self.count} pictures can be read")

    def fingerprint(self) -> str:
        return fingerprint(self.files)

    def _warn(self, line: str) -> None:
        if line not in self.warnings:
            self.warnings.append(line)


def open_source(path: Path | str) -> Source:
    """A video file, or a folder of pictures. Raises InputError for anything else."""
    path = Path(path)
    if not path.is_dir():
        return open_video(path)
    files = [
        entry
        for entry in path.iterdir()
        if entry.suffix.lower() in DISPLAYED + SCENE_LINEAR and not entry.name.startswith(".")
    ]
    if not files:
        raise InputError(
            f"{path}: a folder without pictures; give a video, or a folder of png, jpg, exr, ..."
        )
    return PictureFolder(path, sorted(files, key=lambda entry: (natural(entry.name), entry.name)))


def _read(path: Path) -> np.ndarray:
    """uint8 [H, W, 3], display-referred; what has alpha stands over grey."""
    if path.suffix.lower() in SCENE_LINEAR:
        linear = read_scene_linear(path)
        # premultiplied: laid over the grey in the light, as a renderer does
        over = linear[..., :3] + (1 - linear[..., 3:].clip(0, 1)) * (_BEHIND / 255) ** 2.2
        return (linear_to_srgb(over).clip(0, 1) * 255 + 0.5).astype(np.uint8)
    rgba = read_rgba(path)
    if (rgba[..., 3] == 255).all():
        return np.ascontiguousarray(rgba[..., :3])
    alpha = rgba[..., 3:].astype(np.float32) / 255
    return (rgba[..., :3] * alpha + _BEHIND * (1 - alpha) + 0.5).astype(np.uint8)
