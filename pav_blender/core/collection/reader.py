"""Reading a collection, with every array checked before anything is computed from it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import check_folder_name
from ..head import HeadModel, load_head
from ..reading import read_arrays, read_json
from .model import FORMAT, SPLITS, VERSION, Clip, Collection
from .writer import OFFSET_FILE, check_name

_LARGEST_SIDE = 16384
_ARRAYS = (
    "expression", "pose", "translation", "intrinsics", "camera_to_world", "frame_id", "split",
    "vertices", "landmarks",
)  # fmt: skip


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
    meta = read_json(meta_path)
    if meta.get("format") != FORMAT:
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
                check_folder_name(str(entry["appearance"]), "appearance"),
                int(entry["width"]),
                int(entry["height"]),
            )
            for entry in meta["clips"]
        ]
        extra = dict(meta.get("extra") or {})
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
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
    if (path / head_name).exists():  # a head file, which other folders call otherwise
        head_name = str((path / head_name).resolve())
    return Collection(path, head_name, head, betas, clips, extra, offset)


def _read_offset(root: Path, head: HeadModel) -> np.ndarray:
    path = root / OFFSET_FILE
    offset = read_arrays(path, ["offset"]).get("offset")
    if offset is None or offset.shape != head.template.shape or not _finite(offset).all():
        raise InputError(f"{path}: 'offset' must hold {head.template.shape} finite numbers")
    return np.asarray(offset, np.float32)


def _finite(array: np.ndarray) -> np.ndarray:
    """Where an array's values are numbers that stay finite as float32."""
    if array.dtype.kind not in "iuf":
        return np.zeros(array.shape, bool)
    with np.errstate(over="ignore"):
        return np.isfinite(array.astype(np.float32))


def _read_clip(
    root: Path, head: HeadModel, name: str, appearance: str, width: int, height: int
) -> Clip:
    path = root / "clips" / name / "frames.npz"
    if not (0 < width <= _LARGEST_SIDE and 0 < height <= _LARGEST_SIDE):
        raise InputError(f"{root}: clip {name}: a picture size of {width}x{height}")
    if not path.resolve().is_relative_to(root.resolve()):
        raise InputError(f"{path}: a link that leads out of the collection; nothing there is read")
    if not path.exists():
        raise InputError(f"{path}: no such file; the collection is incomplete")
    arrays = read_arrays(path, _ARRAYS)
    count = np.size(arrays.get("frame_id", ()))
    if count == 0:
        raise InputError(f"{path}: the clip has no frames (no 'frame_id')")
    joints, vertices = len(head.joint_names), len(head.template)
    shapes = {
        "expression": (count, len(head.expression_basis)),
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
        shapes["landmarks"] = (count, len(head.landmark_triangles), 2)
    for key, shape in shapes.items():
        if key not in arrays:
            raise InputError(f"{path}: the array {key!r} is missing")
        if arrays[key].shape != shape:
            raise InputError(f"{path}: {key!r} has shape {arrays[key].shape}, expected {shape}")
        kinds = {"frame_id": "iu", "split": "U"}.get(key, "iuf")
        if arrays[key].dtype.kind not in kinds:
            raise InputError(f"{path}: {key!r} holds {arrays[key].dtype}, which it cannot")
        if kinds == "iuf":
            bad = ~_finite(arrays[key]).reshape(count, -1).all(axis=1)
            if bad.any():
                frame = arrays["frame_id"][np.flatnonzero(bad)[0]]
                raise InputError(f"{path}: {key!r} is not finite at frame {frame}")
            arrays[key] = np.ascontiguousarray(arrays[key], np.float32)
    if (arrays["frame_id"] > np.iinfo(np.int32).max).any():
        raise InputError(f"{path}: 'frame_id' has numbers beyond 2147483647")
    if len(np.unique(arrays["frame_id"])) < count or (arrays["frame_id"] < 0).any():
        raise InputError(f"{path}: 'frame_id' must hold different numbers from 0 up")
    unknown = sorted(set(np.unique(arrays["split"]).tolist()) - set(SPLITS))
    if unknown:
        raise InputError(f"{path}: unknown split {unknown}; use {', '.join(SPLITS)}")
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
        frame_id=arrays["frame_id"].astype(np.int32),
        split=arrays["split"],
        vertices=arrays.get("vertices"),
        landmarks=arrays.get("landmarks"),
    )
