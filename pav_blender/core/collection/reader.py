"""Reading a collection, with every array checked before anything is computed from it."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..head import HeadModel, load_head
from .model import FORMAT, SPLITS, VERSION, Clip, Collection
from .writer import OFFSET_FILE, check_name

_LARGEST_SIDE = 16384
_OPTIONAL = ("vertices", "landmarks")


def read_collection(path: Path | str) -> Collection:
    """Reads the collection in folder `path`; pictures stay on disk until they are asked for.

    Raises InputError, one line naming the file and the fault.
    """
    path = Path(path)
    meta_path = path / "collection.json"
    if not path.is_dir():
        raise InputError(f"{path}: no such collection folder")
    if not meta_path.is_file():
        raise InputError(f"{path}: not a collection (it has no collection.json)")
    try:
        meta = json.loads(meta_path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(f"{meta_path}: not readable as JSON ({error})") from error
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        raise InputError(f"{meta_path}: not a collection file (its format is not {FORMAT!r})")
    if meta.get("version") != VERSION:
        raise InputError(
            f"{meta_path}: version {meta.get('version')!r}; this program reads {VERSION}"
        )
    try:
        head_name = str(meta["head"]["name"])
        fingerprint = str(meta["head"].get("fingerprint", ""))
        has_offset = bool(meta["head"].get("offset", False))
        betas = np.asarray(meta["head"]["betas"], np.float32).reshape(-1)
        entries = [
            (
                check_name(str(entry["name"]), "clip name"),
                str(entry["appearance"]),
                int(entry["width"]),
                int(entry["height"]),
            )
            for entry in meta["clips"]
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{meta_path}: a field is missing or malformed ({error})") from error
    if not entries:
        raise InputError(f"{meta_path}: the collection has no clips")
    if len({entry[0] for entry in entries}) < len(entries):
        raise InputError(f"{meta_path}: two clips have the same name")
    try:
        head = load_head(head_name, fingerprint, beside=path)
    except InputError as error:
        raise InputError(f"{meta_path}: {error}") from error
    if len(betas) > len(head.shape_basis) or not np.isfinite(betas).all():
        raise InputError(
            f"{meta_path}: {len(betas)} identity coefficients; head {head_name!r} takes "
            f"{len(head.shape_basis)} finite ones at most"
        )
    offset = _read_offset(path, head) if has_offset else None
    if offset is not None:
        head = head.with_offset(offset)
    clips = [_read_clip(path, head, *entry) for entry in entries]
    extra = dict(meta.get("extra") or {})
    if (path / head_name).exists():  # a head file, which other folders call otherwise
        head_name = str((path / head_name).resolve())
    return Collection(path, head_name, head, betas, clips, extra, offset)


def _read_offset(root: Path, head: HeadModel) -> np.ndarray:
    path = root / OFFSET_FILE
    try:
        with np.load(path, allow_pickle=False) as stored:
            offset = np.asarray(stored["offset"], np.float32)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: missing or damaged ({error})") from error
    if offset.shape != head.template.shape or not np.isfinite(offset).all():
        raise InputError(f"{path}: 'offset' must hold {head.template.shape} finite numbers")
    return offset


def _read_clip(
    root: Path, head: HeadModel, name: str, appearance: str, width: int, height: int
) -> Clip:
    path = root / "clips" / name / "frames.npz"
    if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
        raise InputError(f"{root}: clip {name}: a picture size of {width}x{height}")
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; the collection is incomplete") from error
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: damaged ({error})") from error
    _check_arrays(path, arrays, head)
    return Clip(
        name=name,
        appearance=appearance,
        width=width,
        height=height,
        expression=arrays["expression"],
        pose=arrays["pose"],
        translation=arrays["translation"],
        intrinsics=arrays["intrinsics"],
        camera_to_world=arrays["camera_to_world"],
        frame_id=arrays["frame_id"],
        split=arrays["split"],
        vertices=arrays.get("vertices"),
        landmarks=arrays.get("landmarks"),
    )


def _check_arrays(path: Path, arrays: dict[str, np.ndarray], head: HeadModel) -> None:
    """InputError for the first array that is missing or wrong; numbers become float32 and int32."""
    ids = arrays.get("frame_id")
    if ids is None:
        raise InputError(f"{path}: the array 'frame_id' is missing")
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        raise InputError(f"{path}: 'frame_id' is {ids.dtype} {ids.shape}, expected whole numbers")
    count = len(ids)
    if count == 0:
        raise InputError(f"{path}: the clip has no frames")
    if len(np.unique(ids)) < count or ids.min() < 0 or ids.max() > np.iinfo(np.int32).max:
        raise InputError(f"{path}: 'frame_id' must hold different numbers from 0 up")
    arrays["frame_id"] = ids.astype(np.int32)
    shapes = {
        "expression": (count, len(head.expression_basis)),
        "pose": (count, len(head.joint_names), 3),
        "translation": (count, 3),
        "intrinsics": (count, 3, 3),
        "camera_to_world": (count, 4, 4),
        "split": (count,),
        "vertices": (count, len(head.template), 3),
        "landmarks": (count, len(head.landmark_triangles), 2),
    }
    for key, shape in shapes.items():
        if key not in arrays:
            if key in _OPTIONAL:
                continue
            raise InputError(f"{path}: the array {key!r} is missing")
        if arrays[key].shape != shape:
            raise InputError(f"{path}: {key!r} has shape {arrays[key].shape}, expected {shape}")
        if key == "split":
            continue
        if arrays[key].dtype.kind not in "fiu":
            raise InputError(f"{path}: {key!r} holds {arrays[key].dtype}, not numbers")
        with np.errstate(over="ignore"):  # what is too large is infinite, and told
            arrays[key] = np.ascontiguousarray(arrays[key], np.float32)
        bad = ~np.isfinite(arrays[key].reshape(count, -1)).all(axis=1)
        if bad.any():
            frame = arrays["frame_id"][np.flatnonzero(bad)[0]]
            raise InputError(f"{path}: {key!r} is not finite at frame {frame}")
    unknown = sorted(set(np.unique(arrays["split"]).tolist()) - set(SPLITS))
    if unknown:
        raise InputError(f"{path}: unknown split {unknown}; use {', '.join(SPLITS)}")
