"""Writing so that a final name never holds half a file, and only where it was meant to go."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from .errors import InputError

_lock = threading.Lock()
# names of devices on Windows
_RESERVED = {"CON", "PRN", "AUX", "NUL", *(f"{n}{i}" for n in ("COM", "LPT") for i in range(1, 10))}


@contextlib.contextmanager
def replacing(path: Path | str) -> Iterator[Path]:
    """Yields a temporary path beside `path`; renames it to `path` when the block ends well.

    On an error the temporary file is removed and whatever stood at `path` stays.
    Raises InputError where the folder cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{path.stem}.partial-", suffix=path.suffix, dir=path.parent
        )
    except OSError as error:
        raise InputError(f"{path}: cannot write there: {error.strerror}") from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def new_folder(path: Path | str) -> Iterator[Path]:
    """Yields a temporary folder beside `path`; renames it to `path` when the block ends well.

    On an error what was written is removed. Raises InputError where `path` exists already or the
    folder that should hold it cannot be written.
    """
    path = Path(path)
    if path.exists():
        raise InputError(f"{path}: exists already; choose another folder or remove it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.partial-", dir=path.parent))
    except OSError as error:
        raise InputError(f"{path}: cannot write there: {error.strerror}") from error
    try:
        yield temporary
        temporary.chmod(0o777 & ~_umask())
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def check_folder_name(name: str, what: str) -> str:
    """Returns `name`, or raises InputError where it could not name a folder: a picture's path may
    be made of it, and then it must not lead anywhere else."""
    fits = 0 < len(name) <= 100 and name.isprintable() and not set(name) & set('/\\:*?"<>|')
    if not fits or name != name.strip(" .") or name.upper() in _RESERVED:
        raise InputError(
            f"{what} {name[:100]!r} cannot name a folder: use no / \\ : * ? \" < > |, no '.' or "
            "space at its ends, and at most 100 characters"
        )
    return name


def write_text(path: Path | str, text: str) -> None:
    """Writes a whole UTF-8 text file, or nothing."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _umask() -> int:
    with _lock:  # two threads between these lines would leave the process without a mask
        mask = os.umask(0)
        os.umask(mask)
    return mask
