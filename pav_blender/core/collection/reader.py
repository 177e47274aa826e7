"""Reading a collection, with every array checked before anything is computed from it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import check_folder_name
from ..head import HeadModel, load_head
from ..reading import read_arrays, read_json
from .checks import check_size, checked_frames, finite
from .model import ARRAYS, FORMAT, VERSION, Clip, Collection
from .writer import OFFSET_FILE, check_name


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
    except InputError as error:
        raise InputError(f"{meta_path}: {error}") from error
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
    if os.path.exists(path / head_name):  # a head file, which other folders call otherwise
        head_name = str((path / head_name).resolve())
    return Collection(path, head_name, head, betas, clips, extra, offset)


def _read_offset(root: Path, head: HeadModel) -> np.ndarray:
    path = root / OFFSET_FILE
    offset = read_arrays(path, ["offset"]).get("offset")
    if offset is None or offset.shape != head.template.shape or not finite(offset).all():
        raise InputError(f"{path}: 'offset' must hold {head.template.shape} finite numbers")
    return np.asarray(offset, np.float32)


def _read_clip(
    root: Path, head: HeadModel, name: str, appearance: str, width: int, height: int
) -> Clip:
    path = root / "clips" / name / "frames.npz"
    check_size(root, name, width, height)
    if not path.resolve().is_relative_to(root.resolve()):
        raise InputError(f"{path}: a link that leads out of the collection; nothing there is read")
    if not path.exists():
        raise InputError(f"{path}: no such file; the collection is incomplete")
    arrays = checked_frames(
        path,
        read_arrays(path, ARRAYS),
        len(head.expression_basis),
        len(head.joint_names),
        len(head.template),
        len(head.landmark_triangles),
    )
    return Clip(name, appearance, width, height, **arrays)
