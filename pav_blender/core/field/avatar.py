"""An avatar: the field, the canonical mesh it hangs on, the space it fills; one `.pav` file."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch

from ..config import Config
from ..errors import InputError
from ..files import check_folder_name, replacing
from ..head import HeadModel, load_head
from ..reading import first_line
from .field import Field
from .identities import check_shapes, identity, read_identities
from .limits import overflowing

FORMAT = "pav-avatar"
VERSION = 2
_LARGEST_HEADER = 16 << 20
_LARGEST_HALF = float(torch.finfo(torch.float16).max)
# kinds of values and sizes of what lies beside the weights; None: any, V: the canonical vertices
_ARRAYS: dict[str, tuple[torch.dtype, tuple[int | str | None, ...]]] = {
    "mesh.canonical_vertices": (torch.float32, ("V", 3)),
    "mesh.triangles": (torch.int32, (None, 3)),
    "mesh.uvs": (torch.float32, (None, 2)),
    "mesh.uv_triangles": (torch.int32, (None, 3)),
    "mesh.rigid_weights": (torch.float32, ("V",)),
    "space.box_min": (torch.float32, (3,)),
    "space.occupied": (torch.uint8, (None, None)),
}
_HEAD = ("head.betas", "head.offset")  # of one person or of several: see `check_shapes`
_LARGEST_BOX = 1e3  # metres


@dataclass(eq=False)
class Avatar:
    """Everything a picture needs beside a posed mesh, a camera and an appearance.

    canonical_vertices [V, 3] metres; triangles [T, 3] int32; uvs [U, 2], uv_triangles [T, 3];
    rigid_weights [V], how much a vertex says where the head's own axes are; box_min [3] and
    box_size: the cube of canonical space, metres, that the field fills; occupied
    [A, G, G, G] bool: its cells that are not empty, an appearance. The mask is part of the model:
    outside it nothing was trained. Of several people (`identities`: each one's appearances; none
    where there is but one person) betas are [P, B] and head_offset [P, V, 3]: see `.identities`.
    """

    config: Config
    field: Field
    appearances: list[str]
    canonical_vertices: np.ndarray
    triangles: np.ndarray
    uvs: np.ndarray
    uv_triangles: np.ndarray
    rigid_weights: np.ndarray
    box_min: np.ndarray
    box_size: float
    occupied: np.ndarray
    head_name: str
    head_fingerprint: str
    betas: np.ndarray
    expression_names: tuple[str, ...]
    record: dict[str, Any] = field(default_factory=dict)
    head_offset: np.ndarray | None = None  # [V, 3] metres, the person's own beside the betas
    identities: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def create(
        cls,
        config: Config,
        appearances: list[str],
        canonical_vertices: np.ndarray,
        triangles: np.ndarray,
        uvs: np.ndarray,
        uv_triangles: np.ndarray,
        expression_names: tuple[str, ...],
        **rest: Any,
    ) -> Avatar:
        """An untrained avatar; weights follow `config.seed`. Further fields have defaults."""
        torch.manual_seed(config.seed)
        low, high = canonical_vertices.min(0), canonical_vertices.max(0)
        size = float((high - low).max()) + 2 * config.reach
        cells = (config.occupancy_resolution,) * 3
        corner_uvs = torch.from_numpy(np.ascontiguousarray(uvs[uv_triangles], np.float32))
        network = Field(
            config,
            len(appearances),
            len(expression_names),
            torch.from_numpy(np.array(triangles, np.int32, order="C")),
            corner_uvs,
            len(canonical_vertices),
            len(rest.get("identities", ())),
        )
        if "occupied" not in rest:
            rest["occupied"] = np.ones((len(appearances), *cells), bool)
        values: dict[str, Any] = {
            "rigid_weights": np.ones(len(canonical_vertices), np.float32),
            "box_min": ((low + high) / 2 - size / 2).astype(np.float32),
            "box_size": size,
            "head_name": "",
            "head_fingerprint": "",
            "betas": np.zeros(0, np.float32),
        }
        return cls(
            config,
            network,
            list(appearances),
            np.ascontiguousarray(canonical_vertices, np.float32),
            np.ascontiguousarray(triangles, np.int32),
            np.ascontiguousarray(uvs, np.float32),
            np.ascontiguousarray(uv_triangles, np.int32),
            expression_names=tuple(expression_names),
            **(values | rest),
        )

    def appearance_index(self, name: str) -> int:
        """Row of an appearance; InputError naming the ones there are."""
        if name not in self.appearances:
            raise InputError(
                f"unknown appearance {name!r}; the avatar has {', '.join(self.appearances)}"
            )
        return self.appearances.index(name)

    def save(self, path: Path | str, *, half: bool = False) -> None:
        """Writes the `.pav` file, whole or not at all.

        half: tables, features and networks in two bytes a number; those of a tensor that holds a
        value beyond the largest of float16 stay in four.
        """
        tensors = {f"field.{k}": v.contiguous() for k, v in self.field.state_dict().items()}
        if half:
            tensors = {k: _halved(v) for k, v in tensors.items()}
        arrays = {
            "mesh.canonical_vertices": self.canonical_vertices,
            "mesh.triangles": self.triangles,
            "mesh.uvs": self.uvs,
            "mesh.uv_triangles": self.uv_triangles,
            "mesh.rigid_weights": self.rigid_weights,
            "space.box_min": self.box_min,
            "space.occupied": np.packbits(self.occupied.reshape(len(self.appearances), -1), 1),
            "head.betas": np.asarray(self.betas, np.float32),
        }
        if self.head_offset is not None:
            arrays["head.offset"] = np.asarray(self.head_offset, np.float32)
        # copies: safetensors refuses tensors that share memory, as a mesh and its UVs may
        tensors |= {k: torch.from_numpy(np.array(v, order="C")) for k, v in arrays.items()}
        header = {
            "format": FORMAT,
            "version": VERSION,
            "config": self.config.to_json(),
            "appearances": self.appearances,
            "expression_names": list(self.expression_names),
            "head": {"name": self.head_name, "fingerprint": self.head_fingerprint},
            "box_size": self.box_size,
            "colour_space": "sRGB",
            "record": self.record,
        }
        if self.identities:
            header["identities"] = self.identities
        with replacing(path) as temporary:
            safetensors.torch.save_file(tensors, temporary, {"pav": json.dumps(header)})

    @classmethod
    def load(cls, path: Path | str) -> Avatar:
        """Reads a `.pav` file. InputError, one line, for what is not one or does not fit."""
        path = Path(path)
        header = read_header(path)
        try:
            return _assemble(header, read_tensors(path))
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise InputError(f"{path}: a damaged avatar file ({first_line(error)})") from error


def read_tensors(path: Path) -> dict[str, torch.Tensor]:
    """What a safetensors file holds, in memory of its own: another program that writes into the
    file must not change, or with its end take away, what was read. InputError for a damaged one."""
    try:
        with safetensors.safe_open(path, framework="pt") as stored:
            return {key: stored.get_tensor(key).clone() for key in stored.keys()}  # noqa: SIM118
    except (safetensors.SafetensorError, ValueError, RuntimeError, TypeError, OSError) as error:
        raise InputError(f"damaged ({first_line(error)})") from error


def _halved(values: torch.Tensor) -> torch.Tensor:
    fits = values.numel() == 0 or float(values.abs().max()) <= _LARGEST_HALF
    return values.to(torch.float16) if fits else values


def head_of(avatar: Avatar, appearance: str | None = None) -> HeadModel:
    """The head model that an avatar was trained on, with the offset of the person that an
    appearance is of (None: there is but one). InputError where the model is another by now."""
    who = identity(avatar, appearance)
    return who.of(load_head(avatar.head_name, avatar.head_fingerprint))


def read_header(path: Path | str) -> dict[str, Any]:
    """The JSON header of a `.pav` file alone: settings, names, record. Cheap."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such avatar file")
    header = read_metadata(path)
    if header.get("format") != FORMAT:
        raise InputError(f"{path}: not an avatar file (.pav)")
    if header.get("version") != VERSION:
        raise InputError(
            f"{path}: avatar version {header.get('version')!r:.80}; this program reads {VERSION}"
        )
    try:
        _check_header(header)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path}: a field of its header is missing or malformed") from error
    return header


def read_metadata(path: Path) -> dict[str, Any]:
    """The JSON object that our safetensors files carry; {} where there is none that is whole."""
    try:
        with open(path, "rb") as stream:
            start = stream.read(8)
            size = struct.unpack("<Q", start)[0] if len(start) == 8 else 0
            if not 0 < size <= min(_LARGEST_HEADER, path.stat().st_size):
                return {}
            header = json.loads(json.loads(stream.read(size))["__metadata__"]["pav"])
    except (ValueError, KeyError, TypeError, RecursionError):
        return {}
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    return header if isinstance(header, dict) else {}


def _check_header(header: dict[str, Any]) -> None:
    """InputError, or what a wrong kind of value raises, for a header whose parts are not as
    `Avatar.save` writes them."""
    Config.from_json(header["config"])
    names = header["appearances"]
    if not isinstance(names, list) or not names or len(set(names)) < len(names):
        raise InputError("the appearances' names are missing, or one is there twice")
    for name in names:
        for part in name.split("/") if isinstance(name, str) else [name]:  # person/look
            check_folder_name(part, "appearance")
    read_identities(header)
    expressions, head = header["expression_names"], header["head"]
    texts = [*expressions, head["name"], head["fingerprint"]]
    if not isinstance(expressions, list) or not all(isinstance(text, str) for text in texts):
        raise InputError("the names of the head or of its expressions are no texts")
    if not 0 < float(header["box_size"]) < _LARGEST_BOX:
        raise InputError(
            f"box_size {header['box_size']!r:.80}: metres, above 0 and below {_LARGEST_BOX:g}"
        )
    if not isinstance(header["record"], dict):
        raise InputError("the record of its training is malformed")


def _check_arrays(tensors: dict[str, torch.Tensor]) -> None:
    """InputError for a tensor that is not finite, or beside the weights of a wrong kind or size."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not torch.isfinite(tensor).all():
            raise InputError(f"the values of {name!r:.80} are not finite")
    count = len(tensors["mesh.canonical_vertices"])
    for name, (kind, sizes) in _ARRAYS.items():
        found = tensors.get(name)
        wanted = [count if size == "V" else size for size in sizes]
        shape = None if found is None else tuple(found.shape)
        fits = shape is not None and len(shape) == len(wanted)
        if found is None or found.dtype != kind or not fits or any(
            size not in (None, there) for size, there in zip(wanted, shape or (), strict=True)
        ):  # fmt: skip
            what = "missing" if found is None else f"{found.dtype} {shape}"
            raise InputError(f"{name} is {what}; {kind} {wanted} expected")
    for name in _HEAD:
        if name in tensors and tensors[name].dtype != torch.float32:
            raise InputError(f"{name} is {tensors[name].dtype}; float32 expected")


def _check_weights(
    config: Config, header: dict[str, Any], vertices: int, tensors: dict[str, torch.Tensor]
) -> None:
    """InputError unless the settings give just these tensors; nothing is allocated to find out."""
    with torch.device("meta"):
        expected = Field(
            config,
            len(header["appearances"]),
            len(header["expression_names"]),
            torch.zeros(1, 3, dtype=torch.int32),
            torch.zeros(1, 3, 2),
            vertices,
            len(header.get("identities", ())),
        ).state_dict()
    for name, tensor in expected.items():
        found = tensors.get(f"field.{name}")
        if found is None or found.shape != tensor.shape:
            shape = None if found is None else f"{found.dtype} {tuple(found.shape)}"
            raise InputError(
                f"the weights {name!r} are {shape}, the settings ask for {tuple(tensor.shape)}"
            )
        if found.dtype not in (torch.float32, torch.float16):
            raise InputError(f"the weights {name!r} are {found.dtype}, not float32 or float16")


def _assemble(header: dict[str, Any], tensors: dict[str, torch.Tensor]) -> Avatar:
    config = Config.from_json(header["config"])
    appearances = list(header["appearances"])
    identities = read_identities(header)
    _check_arrays(tensors)
    mesh = {k.split(".")[1]: v.numpy() for k, v in tensors.items() if k.startswith("mesh.")}
    vertices, triangles = mesh["canonical_vertices"], mesh["triangles"]
    _check_indices("triangles", triangles, len(vertices))
    _check_indices("uv_triangles", mesh["uv_triangles"], len(mesh["uvs"]))
    if len(mesh["uv_triangles"]) != len(triangles):
        raise InputError("triangles and uv_triangles differ in number")
    _check_weights(config, header, len(vertices), tensors)
    cells = config.occupancy_resolution
    packed = tensors["space.occupied"].numpy()
    if packed.shape != (len(appearances), -(-(cells**3) // 8)):
        raise InputError(f"the occupancy has shape {packed.shape}; {cells} cells a side expected")
    betas = tensors["head.betas"].numpy()
    offset = tensors["head.offset"].numpy() if "head.offset" in tensors else None
    check_shapes(identities, betas, offset, len(vertices))
    bits = np.unpackbits(packed, axis=1, count=cells**3)
    avatar = Avatar.create(
        config,
        appearances,
        vertices,
        triangles,
        mesh["uvs"],
        mesh["uv_triangles"],
        tuple(header["expression_names"]),
        rigid_weights=mesh["rigid_weights"],
        box_min=tensors["space.box_min"].numpy(),
        box_size=float(header["box_size"]),
        occupied=bits.astype(bool).reshape(len(appearances), cells, cells, cells),
        head_name=header["head"]["name"],
        head_fingerprint=header["head"]["fingerprint"],
        betas=betas,
        head_offset=offset,
        identities=identities,
        record=header["record"],
    )
    state = {k[6:]: v for k, v in tensors.items() if k.startswith("field.")}
    avatar.field.load_state_dict(state)
    part = overflowing(avatar.field)
    if part is not None:
        raise InputError(f"the weights of {part!r} are so large that its values overflow float32")
    return avatar


def _check_indices(name: str, array: np.ndarray, limit: int) -> None:
    if len(array) == 0 or array.min() < 0 or array.max() >= limit:
        raise InputError(f"{name} names vertices outside 0 to {limit - 1}")
