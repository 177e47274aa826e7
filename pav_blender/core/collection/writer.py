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
from .model import FORMAT, SPLITS, VERSION, Clip

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
    if head_name == BUILTIN or not Path(head_name).exists():
        return head_name
    try:
        return Path(os.path.relpath(Path(head_name).resolve(), folder.resolve())).as_posix()
    except ValueError:  # another drive
        return str(Path(head_name).resolve())


class CollectionWriter:
    """Context manager: `root` is the folder being written, `path` where it goes at the end.

    An error inside the block removes what was written. Raises InputError where `path` exists,
    unless `overwrite` says to replace a collection (and nothing but a collection).

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
        name = _name_from(self.path, head_name)
        head: dict = {"name": name, "betas": [float(b) for b in np.ravel(betas)]}
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
        if kind is not None:
            shutil.rmtree(self.root, ignore_errors=True)
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
        unknown = set(np.unique(clip.split)) - set(SPLITS)
        if unknown:
            raise InputError(f"clip {clip.name}: unknown split {sorted(unknown)}; use {SPLITS}")
        arrays = {
            "expression": np.asarray(clip.expression, np.float32),
            "pose": np.asarray(clip.pose, np.float32),
            "translation": np.asarray(clip.translation, np.float32),
            "intrinsics": np.asarray(clip.intrinsics, np.float32),
            "camera_to_world": np.asarray(clip.camera_to_world, np.float32),
            "frame_id": np.asarray(clip.frame_id, np.int32),
            "split": np.asarray(clip.split, "<U8"),
        }
        if clip.vertices is not None:
            arrays["vertices"] = np.asarray(clip.vertices, np.float32)
        if clip.landmarks is not None:
            arrays["landmarks"] = np.asarray(clip.landmarks, np.float32)
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
