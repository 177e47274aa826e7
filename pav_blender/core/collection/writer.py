"""Writing a collection: into a temporary folder, renamed when it is whole."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from pathlib import Path
from types import TracebackType

import numpy as np

from ..errors import InputError
from ..files import check_folder_name, replacing, write_text
from ..head.builtin import BUILTIN
from ..images import write_gray, write_rgba
from .checks import check_size, checked_frames, finite
from .model import ARRAYS, FORMAT, VERSION, Clip

OFFSET_FILE = "head_offset.npz"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


def check_name(name: str, what: str) -> str:
    """Returns `name`, or raises InputError where it could not name a folder on every system."""
    if not _NAME.fullmatch(name):
        raise InputError(
            f"{what} {name!r}: use letters, digits, '_', '-' and '.', at most 64, "
            "beginning with a letter or digit"
        )
    return name


def _name_from(folder: Path, head_name: str) -> str:
    if head_name == BUILTIN or not os.path.exists(head_name):
        return head_name
    try:
        return Path(os.path.relpath(Path(head_name).resolve(), folder.resolve())).as_posix()
    except ValueError:  # another drive
        return str(Path(head_name).resolve())


class CollectionWriter:
    """Context manager: `root` is the folder being written, `path` where it goes at the end.

    An error inside the block removes what was written. Raises InputError where `path` exists,
    unless `overwrite` says to replace a collection (and nothing but a collection), and for what
    `read_collection` would refuse, as far as that can be told without the head.

    head_name: "builtin", a head file, which is named from the collection's folder so that both may
    be moved together, or the name of a head that is found by its `fingerprint`. offset [V, 3]
    metres: what the person has beside the betas.
    """

    def __init__(
        self,
        path: Path | str,
        head_name: str,
        betas: np.ndarray,
        *,
        fingerprint: str = "",
        offset: np.ndarray | None = None,
        extra: dict | None = None,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        if self.path.exists() and not (overwrite and (self.path / "collection.json").is_file()):
            what = "is not a collection" if overwrite else "exists already"
            raise InputError(f"{self.path}: {what}; choose another folder or remove it")
        betas = np.ravel(betas)
        if not finite(betas).all():
            raise InputError(f"{self.path}: identity coefficients that are not finite")
        if offset is not None and not (np.shape(offset)[1:] == (3,) and finite(offset).all()):
            raise InputError(f"{self.path}: the offset must hold [V, 3] finite numbers")
        name = _name_from(self.path, head_name)
        head: dict = {"name": name, "betas": [float(b) for b in betas]}
        if fingerprint:
            head["fingerprint"] = fingerprint
        if offset is not None:
            head["offset"] = True
        self._offset = offset
        self._meta: dict = {
            "format": FORMAT,
            "version": VERSION,
            "head": head,
            "clips": [],
            "extra": extra or {},
        }
        self.root = self.path

    def __enter__(self) -> CollectionWriter:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            partial = tempfile.mkdtemp(prefix=f"{self.path.name}.partial-", dir=self.path.parent)
        except OSError as error:
            raise InputError(f"{self.path}: cannot write there: {error.strerror}") from error
        self.root = Path(partial)
        self.root.chmod(0o755)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None or not self._meta["clips"]:
            shutil.rmtree(self.root, ignore_errors=True)
            if kind is None:
                raise InputError(f"{self.path}: a collection needs a clip; nothing was written")
            return
        if self._offset is not None:
            np.savez_compressed(self.root / OFFSET_FILE, offset=np.asarray(self._offset, "f4"))
        write_text(self.root / "collection.json", json.dumps(self._meta, indent=1) + "\n")
        if self.path.exists():
            shutil.rmtree(self.path)
        self.root.rename(self.path)

    def image(self, clip_name: str, frame_id: int, rgba: np.ndarray) -> None:
        """rgba: uint8 [H, W, 4], straight alpha; colour where alpha is 0 is written as 0."""
        hidden = rgba[..., 3:4] == 0
        write_rgba(self._file("images", clip_name, frame_id), np.where(hidden, 0, rgba))

    def labels(self, clip_name: str, frame_id: int, labels: np.ndarray) -> None:
        """labels: uint8 [H, W], indices into LABELS."""
        write_gray(self._file("labels", clip_name, frame_id), labels)

    def depth(self, clip_name: str, frame_id: int, depth: np.ndarray) -> None:
        """depth: metres [H, W] along the camera's z; written as tenths of millimetres, 0 = none."""
        tenths = np.where(np.isfinite(depth), depth * 1e4, 0)
        coded = np.clip(np.round(tenths), 0, 65535).astype(np.uint16)
        write_gray(self._file("depth", clip_name, frame_id), coded)

    def clip(self, clip: Clip) -> None:
        """Writes frames.npz and registers the clip."""
        check_name(clip.name, "clip name")
        check_folder_name(clip.appearance, "appearance")
        where = f"{self.path}: clip {clip.name}"
        if clip.name in [known["name"] for known in self._meta["clips"]]:
            raise InputError(f"{where}: two clips have the same name")
        check_size(self.path, clip.name, clip.width, clip.height)
        arrays = {name: getattr(clip, name) for name in ARRAYS}
        arrays = {name: np.asarray(array) for name, array in arrays.items() if array is not None}
        arrays = checked_frames(where, arrays)
        folder = self.root / "clips" / clip.name
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(folder / "frames.npz") as temporary, open(temporary, "wb") as stream:
            np.savez_compressed(stream, **arrays)
        self._meta["clips"].append(
            {
                "name": clip.name,
                "appearance": clip.appearance,
                "width": int(clip.width),
                "height": int(clip.height),
            }
        )

    def _file(self, kind: str, clip_name: str, frame_id: int) -> Path:
        check_name(clip_name, "clip name")
        return self.root / "clips" / clip_name / kind / f"{int(frame_id):06d}.png"
