"""Reading and writing pictures through OpenImageIO. Row 0 is the top."""

from __future__ import annotations

import contextlib
import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from .errors import InputError
from .files import replacing
from .reading import check_unpacked, file_size, first_line

_NONE, _AVERAGE = 8, 64  # libpng's names for a row's filter
_UNPACKED = 1 << 30  # bytes that the pixels of any file may take: 8K in half floats with depth
_LARGEST_SIDE = 65536
_FORMATS = ("png", "jpeg", "tiff", "openexr", "hdr", "targa", "bmp", "webp", "pnm")


def _oiio() -> ModuleType:
    try:
        return importlib.import_module("OpenImageIO")
    except ImportError as error:
        raise InputError(
            "OpenImageIO is missing from this Python; `pip install OpenImageIO`"
        ) from error


def _open(path: Path | str) -> Any:
    """OpenImageIO's reader of a picture, after a look at its head."""
    oiio = _oiio()
    if not Path(path).is_file():
        raise InputError(f"{path}: no such picture")
    # associated alpha would multiply the colours of a straight-alpha PNG on reading
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise InputError(f"{path}: not a readable picture ({first_line(oiio.geterror())})")
    try:
        if source.format_name() not in _FORMATS:
            raise InputError(f"{path}: a picture of the kind {source.format_name()} is not read")
        _check_size(path, source.spec())
    except InputError:
        source.close()
        raise
    return source


def _check_size(path: Path | str, spec: Any) -> None:
    """InputError for more pixels than a file of its size holds: before memory is taken for them."""
    sides = spec.width, spec.height
    if not (min(sides) > 0 and max(sides) <= _LARGEST_SIDE and spec.nchannels > 0):
        raise InputError(f"{path}: a picture of {sides[0]}x{sides[1]} pixels")
    needed = sides[0] * sides[1] * max(1, spec.depth) * spec.nchannels * spec.channel_bytes()
    check_unpacked(path, max(needed, spec.image_bytes(True)), file_size(path), _UNPACKED)


def _read(path: Path | str, formats: str) -> np.ndarray:
    source = _open(path)
    try:
        native = source.spec().format
        kind = formats if formats != "native" else str(native)
        pixels = source.read_image(kind)
        problem = source.geterror()
    finally:
        source.close()
    if pixels is None or problem:
        raise InputError(f"{path}: the picture is damaged ({first_line(problem)})")
    return np.asarray(pixels)


def read_rgba(path: Path | str) -> np.ndarray:
    """Reads a picture as uint8 [H, W, 4] with straight alpha; an absent alpha reads 255.

    Raises InputError for a missing or damaged file.
    """
    pixels = _read(path, "uint8")
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    channels = pixels.shape[2]
    if channels < 3:
        colour = np.repeat(pixels[..., :1], 3, axis=2)
        alpha = pixels[..., 1:2]
    else:
        colour, alpha = pixels[..., :3], pixels[..., 3:4]
    if alpha.shape[2] == 0:
        alpha = np.full((*pixels.shape[:2], 1), 255, np.uint8)
    return np.ascontiguousarray(np.concatenate([colour, alpha], axis=2))


def read_scene_linear(path: Path | str) -> np.ndarray:
    """Reads an EXR or HDR picture as float32 [H, W, 4], premultiplied; an absent alpha reads 1.

    Raises InputError for a missing or damaged file, and for pixels that are not finite.
    """
    pixels = _read(path, "float")
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.shape[2] < 3:
        pixels = np.concatenate([np.repeat(pixels[..., :1], 3, axis=2), pixels[..., 1:2]], axis=2)
    if pixels.shape[2] == 3:
        pixels = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=2)
    pixels = np.ascontiguousarray(pixels[..., :4], np.float32)
    bad = int((~np.isfinite(pixels)).any(2).sum())
    if bad:
        raise InputError(f"{path}: {bad} pixels are not finite numbers; render or save it anew")
    return pixels


def check(path: Path | str) -> None:
    """Reads a picture, every part of it, to its end. InputError for a missing or damaged file."""
    source = _open(path)
    try:
        part = 0
        while source.seek_subimage(part, 0):
            _check_size(path, source.spec())
            channels = source.spec().nchannels
            pixels = source.read_image(part, 0, 0, channels, str(source.spec().format))
            if pixels is None or source.has_error:
                problem = first_line(source.geterror())
                raise InputError(f"{path}: the picture is damaged ({problem})")
            part += 1
        source.geterror()  # that there is no further part
    finally:
        source.close()


def read_metadata(path: Path | str) -> dict[str, str]:
    """The texts that a picture carries, by name; those that are not UTF-8 are left out. InputError
    where its head cannot be read."""
    source = _open(path)
    found = {}
    try:
        for item in source.spec().extra_attribs:
            with contextlib.suppress(UnicodeDecodeError):
                found[item.name] = str(item.value)
        return found
    finally:
        source.close()


def read_gray(path: Path | str) -> np.ndarray:
    """Reads the first channel as it is stored: uint8, uint16 or float32, [H, W]."""
    pixels = _read(path, "native")
    return np.ascontiguousarray(pixels if pixels.ndim == 2 else pixels[..., 0])


def write_rgba(
    path: Path | str,
    pixels: np.ndarray,
    *,
    bits: int = 8,
    metadata: dict[str, Any] | None = None,
) -> None:
    """Writes a PNG with straight alpha, whole or not at all.

    pixels: [H, W, 4], uint8, or float in [0, 1] which is rounded to `bits` (8 or 16).
    """
    if bits not in (8, 16):
        raise InputError(f"{path}: a PNG has 8 or 16 bits a channel, not {bits}")
    kind = np.uint8 if bits == 8 else np.uint16
    if pixels.dtype != kind:
        top = float(np.iinfo(kind).max)
        source_top = 255.0 if pixels.dtype == np.uint8 else 1.0
        scaled = np.clip(pixels.astype(np.float64) / source_top, 0, 1) * top
        pixels = np.floor(scaled + 0.5).astype(kind)
    _write(path, pixels, "uint8" if bits == 8 else "uint16", metadata)


def write_gray(
    path: Path | str, pixels: np.ndarray, *, metadata: dict[str, Any] | None = None
) -> None:
    """Writes one channel, [H, W] uint8 or uint16, as a PNG."""
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: a grey PNG takes uint8 or uint16, not {pixels.dtype}")
    _write(path, pixels[..., None], str(pixels.dtype), metadata)


def write_exr(
    path: Path | str,
    rgba: np.ndarray,
    depth: np.ndarray | None = None,
    metadata: dict[str, Any] | None = None,
) -> None:
    """Writes scene-linear premultiplied [H, W, 4] as half, with depth [H, W] as float `Z`."""
    oiio = _oiio()
    pixels = np.asarray(rgba, np.float32)
    names: tuple[str, ...] = ("R", "G", "B", "A")
    kinds = [oiio.HALF] * 4
    if depth is not None:
        pixels = np.concatenate([pixels, np.asarray(depth, np.float32)[..., None]], axis=2)
        names, kinds = (*names, "Z"), [*kinds, oiio.FLOAT]
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, oiio.FLOAT)
    spec.channelnames = names
    spec.channelformats = tuple(oiio.TypeDesc(kind) for kind in kinds)
    spec.alpha_channel = 3
    _save(path, spec, pixels, metadata)


def _write(
    path: Path | str, pixels: np.ndarray, kind: str, metadata: dict[str, Any] | None
) -> None:
    oiio = _oiio()
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("png:compressionLevel", 4)
    # one filter for all rows: as small as the best for each, in two thirds of the time
    spec.attribute("png:filter", _AVERAGE if channels > 1 else _NONE)
    _save(path, spec, pixels, metadata)


def _save(path: Path | str, spec: Any, pixels: np.ndarray, metadata: dict[str, Any] | None) -> None:
    oiio = _oiio()
    path = Path(path)
    for key, value in (metadata or {}).items():
        spec.attribute(key, value if isinstance(value, int | float) else str(value))
    with replacing(path) as temporary:
        sink = oiio.ImageOutput.create(str(temporary))
        if sink is None or not sink.open(str(temporary), spec):
            raise InputError(f"{path}: cannot write a {path.suffix} picture")
        good = sink.write_image(np.ascontiguousarray(pixels))
        problem = sink.geterror()
        sink.close()
        if not good:
            raise InputError(f"{path}: cannot write the picture ({problem.strip()})")
