"""What an interrupted `track` has found already, kept beside the collection it was making.

One folder, `OUT.partial`, one folder in it for each combination of video and settings; a file in
it is whole or not there. What does not belong to this work, or is damaged, is not used.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..files import replacing, write_text
from ..reading import read_arrays

FORMAT = "pav-track-cache 1"
_MARK = "pav-track-cache.txt"
_NOTE = (
    f"{FORMAT}\nWhat an unfinished `pav track` has found so far; the same command goes on from\n"
    "here. It goes when the collection is complete, and can be deleted at any time.\n"
)


class Cache:
    """Arrays by key and name in `folder`; without a folder nothing is kept and nothing found.

    A folder of that name that is not a cache is left alone: `warning` says so then.
    """

    def __init__(self, folder: Path | None) -> None:
        self.warning: str | None = None
        if folder is not None and folder.exists() and not (folder / _MARK).is_file():
            self.warning = f"{folder}: not left by `pav track`, so nothing is kept for resuming"
            folder = None
        self._folder = folder

    def load(self, key: str, name: str, wanted: Iterable[str]) -> dict[str, np.ndarray] | None:
        """The arrays stored under `key` and `name`, or None where they are not, or not whole."""
        if self._folder is None:
            return None
        wanted = list(wanted)
        try:
            found = read_arrays(self._folder / key / f"{name}.npz", wanted)
        except InputError:
            return None
        return found if len(found) == len(wanted) else None

    def store(self, key: str, name: str, arrays: dict[str, np.ndarray]) -> None:
        """Raises InputError where the folder cannot be written."""
        if self._folder is None:
            return
        if not (self._folder / _MARK).is_file():
            write_text(self._folder / _MARK, _NOTE)
        path = self._folder / key / f"{name}.npz"
        try:
            with replacing(path) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, **arrays)
        except OSError as error:
            raise InputError(f"{path}: cannot write there: {error.strerror}") from error

    def remove(self) -> None:
        if self._folder is not None and (self._folder / _MARK).is_file():
            shutil.rmtree(self._folder, ignore_errors=True)


def key_of(*parts: object) -> str:
    """A name for a combination of values; arrays count with their bytes."""
    digest = hashlib.blake2b(FORMAT.encode(), digest_size=16)
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype}{part.shape}".encode() + part.tobytes())
        else:
            digest.update(repr(part).encode() + b"\0")
    return digest.hexdigest()


def fingerprint(files: Iterable[Path]) -> str:
    """Names and contents of files, as one number. Raises InputError for one that is unreadable."""
    digest = hashlib.blake2b(digest_size=16)
    for path in files:
        digest.update(path.name.encode("utf-8", "surrogateescape") + b"\0")
        try:
            state = path.stat()
            digest.update(_contents(path, state.st_size, state.st_mtime_ns))
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    return digest.hexdigest()


@lru_cache(maxsize=4096)
def _contents(path: Path, _size: int, _changed: int) -> bytes:
    """A file's contents as one number, read once while the file stays as it is."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).digest()
