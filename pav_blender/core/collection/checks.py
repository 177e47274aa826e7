"""What the arrays of a clip must be, for who reads them and for who writes them."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from .model import SPLITS

_LARGEST_SIDE = 16384
_LARGEST_NUMBER = np.iinfo(np.int32).max
ANY = -1  # stands for a size that is not known


def finite(array: np.ndarray) -> np.ndarray:
    """Where an array's values are numbers that stay finite as float32."""
    if array.dtype.kind not in "iuf":
        return np.zeros(array.shape, bool)
    with np.errstate(over="ignore"):
        return np.isfinite(array.astype(np.float32))


def check_size(where: object, name: str, width: int, height: int) -> None:
    """InputError where no picture is of that size."""
    if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
        raise InputError(f"{where}: clip {name}: a picture size of {width}x{height}")


def checked_frames(
    where: object,
    arrays: dict[str, np.ndarray],
    expressions: int = ANY,
    joints: int = ANY,
    vertices: int = ANY,
    landmarks: int = ANY,
) -> dict[str, np.ndarray]:
    """The arrays of a `Clip` by name as they are stored and computed with: float32, and int32
    numbers of frames. InputError, which begins with `where`, for any that cannot be.
    """
    count = np.size(arrays.get("frame_id", ()))
    if count == 0:
        raise InputError(f"{where}: the clip has no frames (no 'frame_id')")
    shapes = {
        "expression": (count, expressions),
        "pose": (count, joints, 3),
        "translation": (count, 3),
        "intrinsics": (count, 3, 3),
        "camera_to_world": (count, 4, 4),
        "frame_id": (count,),
        "split": (count,),
    }
    if "vertices" in arrays:
        shapes["vertices"] = (count, vertices, 3)
    if "landmarks" in arrays:
        shapes["landmarks"] = (count, landmarks, 2)
    found = {}
    for key, shape in shapes.items():
        if key not in arrays:
            raise InputError(f"{where}: the array {key!r} is missing")
        array = arrays[key]
        if not _fits(array.shape, shape):
            expected = str(shape).replace(str(ANY), "any")
            raise InputError(f"{where}: {key!r} has shape {array.shape}, expected {expected}")
        kinds = {"frame_id": "iu", "split": "U"}.get(key, "iuf")
        if array.dtype.kind not in kinds:
            raise InputError(f"{where}: {key!r} holds {array.dtype}, which it cannot")
        if kinds == "iuf":
            bad = ~finite(array).reshape(count, -1).all(axis=1)
            if bad.any():
                frame = arrays["frame_id"][np.flatnonzero(bad)[0]]
                raise InputError(f"{where}: {key!r} is not finite at frame {frame}")
            array = np.ascontiguousarray(array, np.float32)
        found[key] = array
    numbers = found["frame_id"]
    if (numbers > _LARGEST_NUMBER).any():
        raise InputError(f"{where}: 'frame_id' has numbers beyond {_LARGEST_NUMBER}")
    if len(np.unique(numbers)) < count or (numbers < 0).any():
        raise InputError(f"{where}: 'frame_id' must hold different numbers from 0 up")
    unknown = sorted(set(np.unique(found["split"]).tolist()) - set(SPLITS))
    if unknown:
        raise InputError(f"{where}: unknown split {unknown}; use {', '.join(SPLITS)}")
    return found | {"frame_id": numbers.astype(np.int32)}


def _fits(shape: tuple[int, ...], expected: tuple[int, ...]) -> bool:
    pairs = zip(shape, expected, strict=False)
    return len(shape) == len(expected) and all(b in (a, ANY) for a, b in pairs)
