"""Reading the pickles of other programs without running anything they name.

A pickle is a program that may name any function. Here every name it asks for stands for an inert
class of ours that keeps what it was given; arrays, sparse matrices and chumpy's objects are put
together afterwards from those parts. Other names are refused. Not even numpy's own reconstruction
sees a file's bytes before their size is checked.
"""

from __future__ import annotations

import io
import math
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np

from .errors import InputError
from .reading import MIB, first_line, read_bytes, read_member

_LARGEST = 2048 * MIB  # bytes of a file, and of one array
_DENSE = 256 * MIB  # bytes of a sparse matrix, written out
_DEEPEST = 40
_MOST = 2_000_000  # values: a list may hold another many times over, which is small in a file


class _Parts:
    """Keeps its arguments and its state, and does nothing with them."""

    arguments: tuple = ()  # made by __new__ alone, an object has no others
    state: Any = None

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Parts):
    pass


class _Dtype(_Parts):
    pass


class _Scalar(_Parts):
    pass


class _Buffer(_Parts):
    pass


class _Sparse(_Parts):
    kind = ""


class _Csc(_Sparse):
    kind = "csc"


class _Csr(_Sparse):
    kind = "csr"


class _Coo(_Sparse):
    kind = "coo"


class _Chumpy(_Parts):
    """An array of the library chumpy: the numbers are its state's `x`."""


class _reconstruct(_Parts):  # a class: a function's attributes would be the file's to set
    """What numpy and Python 2 make an empty object with; only for the classes above."""

    def __new__(cls, kind: Any, *_: Any) -> Any:
        if not (isinstance(kind, type) and issubclass(kind, _Parts)):
            raise pickle.UnpicklingError("it asks for an object of a class that is not allowed")
        return kind()


class _encode(_Parts):
    """How Python 3 writes bytes for Python 2."""

    def __new__(cls, text: Any, encoding: Any = "latin1") -> Any:
        if not isinstance(text, str) or encoding != "latin1":
            raise pickle.UnpicklingError("it asks for a text encoding that is not allowed")
        return text.encode("latin1")


_ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _encode,
    ("copy_reg", "_reconstructor"): _reconstruct,
    ("copyreg", "_reconstructor"): _reconstruct,
    ("__builtin__", "object"): _Parts,
    ("builtins", "object"): _Parts,
    ("__builtin__", "set"): _Parts,  # chumpy keeps some beside its numbers
    ("builtins", "set"): _Parts,
    ("collections", "OrderedDict"): dict,
}
for _core in ("numpy.core", "numpy._core"):
    _ALLOWED[_core + ".multiarray", "_reconstruct"] = _reconstruct
    _ALLOWED[_core + ".multiarray", "scalar"] = _Scalar
    _ALLOWED[_core + ".numeric", "_frombuffer"] = _Buffer
for _class in (_Csc, _Csr, _Coo):
    for _module in (f"scipy.sparse.{_class.kind}", f"scipy.sparse._{_class.kind}"):
        _ALLOWED[_module, f"{_class.kind}_matrix"] = _class
        _ALLOWED[_module, f"{_class.kind}_array"] = _class


class _Unpickler(pickle._Unpickler):
    """Python's own in Python: the one in C takes the memory that a damaged file asks for (of a
    place in its memo, or of bytes that are not there) before it looks whether it can be so."""

    # no buffers outside the file, no registered codes, nothing that is named by a number
    dispatch = {  # noqa: RUF012
        code: load
        for code, load in pickle._Unpickler.dispatch.items()
        if bytes([code])
        not in (
            pickle.PERSID, pickle.EXT1, pickle.EXT2, pickle.EXT4, pickle.NEXT_BUFFER,
            pickle.READONLY_BUFFER,
        )
    }  # fmt: skip

    def load_bytes(self: Any) -> None:
        (length,) = struct.unpack("<Q", self.read(8))
        self.append(self.read(length))

    dispatch[pickle.BYTEARRAY8[0]] = load_bytes  # as any bytes: Python's takes them beforehand

    def find_class(self, module: str, name: str) -> Any:
        if module == "chumpy" or module.startswith("chumpy."):
            return _Chumpy
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it asks for '{module}.{name}', which is not allowed")
        return _ALLOWED[module, name]

    def persistent_load(self, identity: Any) -> Any:
        raise pickle.UnpicklingError("it holds a torch tensor where a numpy array is expected")


def read_pickle(path: Path | str) -> Any:
    """What a pickle file holds: dicts, lists, strings, numbers and arrays. Nothing is executed.

    Python 2 strings are read as latin-1. Sparse matrices come as scipy's csc, chumpy objects as
    arrays. Raises InputError for what is cut short, is no pickle, or names anything else.
    """
    return loads(read_bytes(path, _LARGEST), path)


def read_torch(path: Path | str) -> Any:
    """What `torch.save` of plain containers and numpy arrays wrote; the same rules apply."""
    return loads(read_member(path, "data.pkl"), path)


def loads(content: bytes, path: Path | str) -> Any:
    """As `read_pickle`, of bytes; `path` is named in errors."""
    try:
        return _Plain().of(_Unpickler(io.BytesIO(content), encoding="latin1").load())
    except EOFError as error:
        raise InputError(f"{path}: cut short at {len(content)} bytes; copy it again") from error
    except pickle.UnpicklingError as error:
        text = first_line(error)
        if "truncated" in text or "exhausted" in text:
            raise InputError(f"{path}: cut short at {len(content)} bytes; copy it again") from error
        raise InputError(f"{path}: refused to unpickle it: {text}") from error
    except RecursionError as error:
        raise InputError(f"{path}: refused to unpickle it: nested too deeply") from error
    except Exception as error:
        # damaged bytes make the unpickler raise almost anything; none of it ran foreign code
        raise InputError(f"{path}: not a readable pickle ({first_line(error)})") from error


class _Plain:
    """Plain values out of the parts that a pickle named."""

    def __init__(self) -> None:
        self._values, self._bytes = _MOST, _LARGEST

    def _spend(self, size: int) -> None:
        """What a file names many times counts every time: who uses it may write it out."""
        self._values, self._bytes = self._values - 1, self._bytes - size
        if self._values < 0 or self._bytes < 0:
            raise pickle.UnpicklingError("it holds more than such files do")

    def of(self, value: Any, depth: int = 0) -> Any:
        if depth > _DEEPEST:
            raise pickle.UnpicklingError("nested too deeply")
        self._spend(len(value) if isinstance(value, str | bytes) else 0)
        if isinstance(value, dict):
            return {self.of(k, depth + 1): self.of(v, depth + 1) for k, v in value.items()}
        if isinstance(value, list | tuple):
            return type(value)([self.of(item, depth + 1) for item in value])
        if isinstance(value, _Array):
            return self._array(value, depth)
        if isinstance(value, _Scalar):
            dtype, raw = (*value.arguments, b"")[:2]
            self._spend(len(raw))
            return np.frombuffer(_raw(raw), _dtype(dtype), 1)[0]
        if isinstance(value, _Buffer):
            raw, dtype, shape, order = value.arguments
            self._spend(len(raw))
            return np.frombuffer(_raw(raw), _dtype(dtype)).reshape(shape, order=order).copy()
        if isinstance(value, _Sparse):
            return self._sparse(value, depth)
        if isinstance(value, _Chumpy):
            state = value.state[0] if isinstance(value.state, tuple) else value.state
            if not isinstance(state, dict) or "x" not in state:
                raise pickle.UnpicklingError("a chumpy object in it has no values of its own")
            return self.of(state["x"], depth + 1)
        if isinstance(value, _Parts) or callable(value):
            raise pickle.UnpicklingError("it holds an object that is not an array")
        return value

    def _array(self, value: _Array, depth: int) -> Any:
        state = value.state
        if not isinstance(state, tuple) or len(state) < 4:
            raise pickle.UnpicklingError("an array in it is incomplete")
        shape, dtype, fortran, raw = state[-4:]
        shape = tuple(int(n) for n in shape)
        size = math.prod(shape)
        if isinstance(dtype, _Dtype) and dtype.arguments and str(dtype.arguments[0])[:1] == "O":
            if len(raw) != size:
                raise pickle.UnpicklingError("an array's size is not that of its values")
            return self.of(list(raw), depth + 1)
        kind, data = _dtype(dtype), _raw(raw)
        size *= kind.itemsize
        if size != len(data) or min(shape, default=0) < 0:
            raise pickle.UnpicklingError("an array's size is not that of its values")
        self._spend(size)
        array = np.frombuffer(data, kind).reshape(shape, order="F" if fortran else "C")
        return array.astype(kind.newbyteorder("="))

    def _sparse(self, value: _Sparse, depth: int) -> Any:
        from scipy import sparse

        state = value.state
        if not isinstance(state, dict):
            raise pickle.UnpicklingError("a sparse matrix in it is incomplete")
        state = {str(k).lstrip("_"): self.of(v, depth + 1) for k, v in state.items()}
        rows, columns = (int(n) for n in state["shape"])
        if not 0 <= rows * columns * 8 <= _DENSE:
            raise pickle.UnpicklingError(f"a sparse matrix of {rows} by {columns}")
        self._spend(rows * columns * 8)
        if value.kind == "coo":
            parts: tuple = (state["data"], (state["row"], state["col"]))
        else:
            parts = (state["data"], state["indices"], state["indptr"])
        make = {"csc": sparse.csc_matrix, "csr": sparse.csr_matrix, "coo": sparse.coo_matrix}
        matrix = make[value.kind](parts, shape=(rows, columns))
        if hasattr(matrix, "check_format"):
            matrix.check_format(full_check=True)
        return matrix.tocsc()


def _raw(raw: Any) -> bytes:
    if isinstance(raw, str):  # Python 2's str
        raw = raw.encode("latin1")
    if not isinstance(raw, bytes | bytearray):
        raise pickle.UnpicklingError("an array's values are not bytes")
    return bytes(raw)


def _dtype(value: Any) -> np.dtype:
    code = value.arguments[0] if isinstance(value, _Dtype) and value.arguments else None
    if isinstance(code, bytes):
        code = code.decode("latin1")
    if not isinstance(code, str) or code[:1] not in "biufcSU":
        raise pickle.UnpicklingError(f"an array of type {code!r} is not allowed")
    state = value.state
    order = state[1] if isinstance(state, tuple) and len(state) > 1 else "|"
    if isinstance(order, bytes):
        order = order.decode("latin1")
    plain = np.dtype(code)
    if plain.hasobject or plain.fields or plain.itemsize == 0:
        raise pickle.UnpicklingError(f"an array of type {code!r} is not allowed")
    return plain.newbyteorder("<" if order == "<" else ">" if order == ">" else "=")
