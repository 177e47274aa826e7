"""Damage to files, the same every time: of bytes, and of what JSON, .npz and safetensors say."""

from __future__ import annotations

import copy
import io
import json
import random
import struct
import zipfile
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np

DEEP = "[" * 100_000
BOMB, ZEROS = 300 << 20, bytes(1 << 20)
NUMBERS = (0, 1, -1, 0x7F, 0xFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1)
NAMES = (
    "../x", "/etc/passwd", "C:\\x.png", "\\\\host\\share", "a\0b", "a\nb", "\ud800", "", ".",
    "..", "con", "x" * 5000,
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, -1, 0, 1, 1 << 31, 1 << 40, 10**400, -(10**400), 0.5, 1e300, float("nan"),
    float("inf"), [], {}, [[]], [None], {"a": 1}, *NAMES,
)  # fmt: skip
KINDS = ("f8", "f2", "i1", "u8", "?", "c8", "U4", "S4", "M8[s]", "i4,f4", "O")


def of_bytes(whole: bytes, rng: random.Random) -> bytes:
    """Cut short, bits turned, extreme numbers written over others, parts lost or repeated."""
    data = bytearray(whole)
    at = rng.randrange(len(data) or 1)
    match rng.randrange(6):
        case 0:
            del data[at:]
        case 1:
            for _ in range(rng.choice((1, 1, 2, 8, 64))):
                if data:
                    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        case 2:  # mostly in the head, where sizes stand
            at = rng.randrange(min(len(data), 256) or 1) if rng.random() < 0.7 else at
            size, order = rng.choice((1, 2, 4, 8)), rng.choice(("little", "big"))
            number = rng.choice(NUMBERS) & ((1 << 8 * size) - 1)
            data[at : at + size] = number.to_bytes(size, order)
        case 3:
            del data[at : at + rng.choice((1, 4, 100, 10_000))]
        case 4:
            data[at:at] = data[at : at + 200] or b"\0"
        case 5:
            data[at:at] = rng.randbytes(rng.choice((1, 8, 64)))
    return bytes(data)


def _places(value: Any, found: list[tuple[Any, Any]]) -> list[tuple[Any, Any]]:
    keys = list(value) if isinstance(value, dict) else range(len(value))
    for key in keys:
        found.append((value, key))
        if isinstance(value[key], dict | list):
            _places(value[key], found)
    return found


def of_object(content: Any, rng: random.Random) -> Any:
    """A JSON object in which one value is missing, hostile, or at another's place."""
    changed = copy.deepcopy(content)
    places = _places(changed, [])
    # what stands high up is as often struck as the many numbers below
    inside, key = rng.choice(places[:40]) if rng.random() < 0.5 else rng.choice(places)
    match rng.randrange(4):
        case 0:
            del inside[key]
        case 1 | 2:
            inside[key] = rng.choice(VALUES)
        case 3:
            other, place = rng.choice(places)
            inside[key] = copy.deepcopy(other[place])
    return changed


def of_json(whole: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.3:
        return of_bytes(whole, rng)
    if rng.random() < 0.7:
        return json.dumps(of_object(json.loads(whole), rng)).encode()
    text = whole.decode()
    first = text.index('"', 1)
    key = text[first : text.index(":", first)]
    return rng.choice(
        (
            DEEP.encode(),
            text.replace("{", '{"a":' + DEEP + ",", 1).encode(),
            text.replace("1", "1" * 5000, 1).encode(),
            text.replace("{", "{" + f"{key}: 1,", 1).encode(),  # twice the same key
            text.encode("utf-16"),
            b"\xff\xfe\x00" + whole,
            whole + b"}",
            b"null",
            b"[]",
            b"{}",
            b'"' + b"x" * 1000,
        )
    )


def npy(shape: tuple[int, ...], kind: str = "<f4", data: bytes = bytes(64)) -> bytes:
    """An .npy file whose header may say anything."""
    stream = io.BytesIO()
    header = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + data


def zipped(members: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", kind) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return stream.getvalue()


@cache
def bomb(name: str, head: bytes = b"") -> bytes:
    """An archive with one member of `head` and BOMB zeros: a thousandth of that."""
    stream = io.BytesIO()
    packed = zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
    with packed as archive, archive.open(name, "w") as member:
        member.write(head)
        for _ in range(BOMB >> 20):
            member.write(ZEROS)
    return stream.getvalue()


def of_array(array: np.ndarray, rng: random.Random) -> bytes:
    """An .npy file of another kind, size or content than the array had."""
    match rng.randrange(7):
        case 0:
            shape = rng.choice(
                ((1 << 40,), (1 << 20, 1 << 20, 1 << 20), (-1,), (0,), (), (2**33, 0))
            )
            return npy(shape)
        case 1:
            kind = np.dtype(rng.choice(KINDS))
            array = np.zeros(array.shape, kind)
        case 2:
            array = array[..., None] if rng.random() < 0.5 else array.ravel()
        case 3:
            array = array[:-1] if array.ndim and len(array) else np.zeros(3)
        case 4:
            bad = rng.choice((np.nan, np.inf, 1e300, -1e30, -1))
            array = np.array(array, np.float64 if array.dtype.kind in "iufb" else array.dtype)
            if array.size and array.dtype.kind == "f":
                array.ravel()[rng.randrange(array.size)] = bad
        case 5:
            array = np.zeros(rng.choice(((), (0,), (1, 1, 1, 1), (7,))), array.dtype)
        case 6:
            array = np.asfortranarray(array)
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def of_npy(whole: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.5:
        return of_bytes(whole, rng)
    return of_array(np.load(io.BytesIO(whole)), rng)


def of_npz(whole: bytes, rng: random.Random) -> bytes:
    if rng.random() < 0.4:
        return of_bytes(whole, rng)
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(members))
    kind = rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    match rng.randrange(6):
        case 0:
            del members[name]
        case 1 | 2:
            members[name] = of_array(np.load(io.BytesIO(members[name])), rng)
        case 3:
            return bomb(name, npy((BOMB,), "|u1", b""))
        case 4:
            members = {rng.choice(("../x.npy", "/x.npy", "C:x.npy", "x")): b"", **members}
        case 5:
            kind = rng.choice((zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2))
    return zipped(members, kind)


def of_tensors(whole: bytes, rng: random.Random) -> bytes:
    """A safetensors file: its length, its header, the JSON that is a text in that."""
    if rng.random() < 0.4:
        return of_bytes(whole, rng)
    (size,) = struct.unpack("<Q", whole[:8])
    header, data = json.loads(whole[8 : 8 + size]), whole[8 + size :]
    match rng.randrange(5):
        case 0:
            return struct.pack("<Q", rng.choice(NUMBERS) & ((1 << 64) - 1)) + whole[8:]
        case 1:
            raw = rng.choice((DEEP, '{"__metadata__":' + DEEP, "{}", "null", '{"a":1,"a":2}'))
        case 2:
            raw = json.dumps(of_object(header, rng))
        case 3:
            inner = of_object(json.loads(header["__metadata__"]["pav"]), rng)
            header["__metadata__"]["pav"] = rng.choice((json.dumps(inner),) * 9 + (DEEP,))
            raw = json.dumps(header)
        case _:  # the same bytes under another kind or size
            tensors = [value for key, value in header.items() if key != "__metadata__"]
            one = rng.choice(tensors)
            if rng.random() < 0.5:
                one["dtype"] = rng.choice(("F64", "F16", "BF16", "I8", "U8", "BOOL", "F8_E4M3"))
            else:
                one["shape"] = rng.choice(
                    ([], [0], [1 << 40], one["shape"][::-1], [1, *one["shape"]])
                )
            raw = json.dumps(header)
    text = raw.encode("utf-8", "surrogatepass")
    return struct.pack("<Q", len(text)) + text + data


def of_zip(whole: bytes, rng: random.Random) -> bytes:
    """An archive of other things than .npy files."""
    if rng.random() < 0.6:
        return of_bytes(whole, rng)
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(list(members))
    match rng.randrange(4):
        case 0:
            members[name] = of_bytes(members[name], rng)
        case 1:
            members = {rng.choice(("../x", "/x", "C:x")): b"", **members}
        case 2:
            return bomb(name)
        case 3:
            del members[name]
    return zipped(members)


Damage = Callable[[bytes, random.Random], bytes]
BY_KIND: dict[str, Damage] = {
    "bytes": of_bytes,
    "json": of_json,
    "npy": of_npy,
    "npz": of_npz,
    "tensors": of_tensors,
    "zip": of_zip,
}


def damaged(kind: str, whole: bytes, count: int, seed: int) -> Iterator[bytes]:
    """`count` damaged files, and first what any file may be: nothing, cut at its end."""
    yield b""
    yield whole[:-1]
    yield whole[: len(whole) // 2]
    for number in range(count):
        yield BY_KIND[kind](whole, random.Random(f"{kind} {seed} {number}"))
