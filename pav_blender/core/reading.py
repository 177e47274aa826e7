"""Reading what somebody else may have made: sizes are checked before memory is taken, and nothing
in a file is ever run. What is damaged raises InputError, one line that names the file."""

from __future__ import annotations

import hashlib
import json
import math
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np

from .errors import InputError

MIB = 1 << 20
LARGEST_JSON = 16 * MIB
_LARGEST = 8192 * MIB
_UNPACKED = 256 * MIB  # bytes that any packed file may hold;
_PACKED = 64  # others at most so many times their own size
_CHUNK = 8 * MIB
# what zipfile, zlib and numpy raise at bytes that are no archive of theirs
_DAMAGE = (
    OSError, ValueError, EOFError, KeyError, IndexError, TypeError, OverflowError, MemoryError,
    RuntimeError, SyntaxError, tokenize.TokenError, struct.error, zlib.error, zipfile.BadZipFile,
)  # fmt: skip


def file_size(path: Path | str, largest: int = _LARGEST) -> int:
    """Bytes of a plain file. InputError where there is none, or a larger one; what is no file (a
    pipe, a device) is never opened, for that might wait for ever."""
    try:
        found = Path(path).stat()
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no such file") from error
    if not stat.S_ISREG(found.st_mode):
        raise InputError(f"{path}: not a file")
    if found.st_size > largest:
        raise InputError(
            f"{path}: {found.st_size // MIB} MiB; at most {largest // MIB} are read of such a file"
        )
    return found.st_size


def read_bytes(path: Path | str, largest: int = _LARGEST) -> bytes:
    """A whole file. InputError where it is missing, too large, or may not be read."""
    file_size(path, largest)
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def digest(path: Path | str) -> str:
    """The SHA-256 of a file's contents, hex."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_json(path: Path | str, largest: int = LARGEST_JSON) -> dict[str, Any]:
    """A JSON file with an object in it, no key twice. InputError for anything else."""
    try:
        content = json.loads(read_bytes(path, largest), object_pairs_hook=_object)
    except (ValueError, RecursionError) as error:
        reason = "nested too deeply" if isinstance(error, RecursionError) else first_line(error)
        raise InputError(f"{path}: not readable as JSON ({reason})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: not a JSON object")
    return content


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) < len(pairs):
        raise ValueError("a key is there twice")
    return content


def read_arrays(path: Path | str, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """The arrays of an .npz file by name; with `names` those of them that are there, and nothing
    else is unpacked. InputError where it is damaged, would unpack to too much, or holds objects."""
    size = file_size(path)
    try:
        with zipfile.ZipFile(path) as archive:
            members = {
                info.filename.removesuffix(".npy"): info
                for info in archive.infolist()
                if info.filename.endswith(".npy")
            }
            wanted = [name for name in (members if names is None else names) if name in members]
            check_unpacked(path, sum(members[name].file_size for name in wanted), size)
            return {name: _member(archive, members[name]) for name in wanted}
    except InputError:
        raise
    except _DAMAGE as error:
        raise InputError(f"{path}: damaged, or not an .npz file ({first_line(error)})") from error


def read_array(path: Path | str) -> np.ndarray:
    """The array of an .npy file. InputError where it is damaged or holds objects."""
    size = file_size(path)
    try:
        with Path(path).open("rb") as stream:
            return _array(stream, size)
    except _DAMAGE as error:
        raise InputError(f"{path}: damaged, or not an .npy file ({first_line(error)})") from error


def read_member(path: Path | str, ending: str) -> bytes:
    """The only member of a zip archive whose name has that ending. InputError where there is none
    or several, where it would unpack to too much, or is damaged."""
    size = file_size(path)
    try:
        with zipfile.ZipFile(path) as archive:
            found = [info for info in archive.infolist() if info.filename.endswith(ending)]
            if len(found) != 1:
                raise InputError(f"{path}: an archive with {len(found)} files {ending}, not one")
            check_unpacked(path, found[0].file_size, size)
            _check_packing(found[0])
            return archive.read(found[0])
    except InputError:
        raise
    except _DAMAGE as error:
        raise InputError(f"{path}: a damaged archive ({first_line(error)})") from error


def member_names(path: Path | str) -> list[str]:
    """The names in a zip archive; none where the file is no archive."""
    try:
        file_size(path)
        with zipfile.ZipFile(path) as archive:
            return archive.namelist()
    except (InputError, *_DAMAGE):
        return []


def stored_members(path: Path | str) -> list[str]:
    """The names in a zip archive whose members are not packed and whole by their checksums; none
    where the file is anything else."""
    try:
        size = file_size(path)
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            packed = any(info.compress_type != zipfile.ZIP_STORED for info in members)
            if packed or sum(info.file_size for info in members) > size or archive.testzip():
                return []
            return [info.filename for info in members]
    except (InputError, *_DAMAGE):
        return []


def check_unpacked(path: Path | str, size: int, packed: int, free: int = _UNPACKED) -> None:
    """InputError where a file of `packed` bytes would unpack to far more than such files do."""
    if size > min(max(free, _PACKED * packed), _LARGEST):
        raise InputError(
            f"{path}: {packed} bytes that would unpack to {size // MIB} MiB; refused as hostile"
        )


def first_line(error: object) -> str:
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__


def _check_packing(info: zipfile.ZipInfo) -> None:
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{info.filename[:80]!r} is packed in an unknown way")


def _member(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    _check_packing(info)
    with archive.open(info) as stream:
        return _array(stream, info.file_size)


def _array(stream: IO[bytes], size: int) -> np.ndarray:
    """An array out of `size` bytes. numpy's own reader takes the memory that a header asks for
    before it looks whether the file holds as much."""
    form = np.lib.format
    version = form.read_magic(stream)
    headers = {(1, 0): form.read_array_header_1_0, (2, 0): form.read_array_header_2_0}
    if version not in headers:
        raise ValueError(f"an array of version {version}")
    shape, fortran, kind = headers[version](stream)
    if kind.hasobject:
        raise ValueError("it holds pickled objects")
    count = math.prod(shape)
    needed = count * kind.itemsize
    if min(shape, default=0) < 0 or (count and not needed) or needed != size - stream.tell():
        raise ValueError("an array's size is not that of its values")
    raw = np.empty(needed, np.uint8)
    for start in range(0, needed, _CHUNK):
        part = stream.read(min(_CHUNK, needed - start))
        if len(part) < min(_CHUNK, needed - start):
            raise EOFError("cut short")
        raw[start : start + len(part)] = np.frombuffer(part, np.uint8)
    if stream.read(1):  # that also has a zip's checksum looked at
        raise ValueError("an array's size is not that of its values")
    array = raw.view(kind) if needed else np.zeros(0, kind)
    return array.reshape(shape[::-1]).T if fortran else array.reshape(shape)
