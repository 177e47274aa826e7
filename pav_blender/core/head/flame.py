"""FLAME's own files: the models of 2020 and 2023 as their makers' pickles, or converted to npz.

FLAME (Li et al. 2017, https://flame.is.tue.mpg.de) may be used under its own licence, which each
user accepts there; its files are never part of this program or of an avatar. What lies beside a
model is read with it: texture coordinates, masks, landmarks, eyelids (`COMPANIONS`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..pickles import read_pickle
from ..reading import member_names, read_arrays
from .flame_parts import drawn_regions, masks_of, read_eyelids, read_landmarks, read_uvs
from .model import HeadModel

WHERE = "get it from https://flame.is.tue.mpg.de (sign in, accept its licence, download the model)"
VERTICES, JOINTS, SHAPES, EXPRESSIONS = 5023, 5, 300, 100
VERSIONS = ("2020", "2023", "2023 Open")
MODELS = ("generic_model.pkl", "flame2023.pkl", "flame2023_no_jaw.pkl", "flame2023_Open.pkl")
JOINT_NAMES = ("root", "neck", "jaw", "left_eye", "right_eye")
EYELIDS = ("eyelid_left", "eyelid_right")

# what may lie beside a model, by the names their makers gave them
COMPANIONS = {
    "uvs": ("head_template.obj", "head_template_mesh.obj"),
    "masks": ("FLAME_masks.pkl",),
    "landmarks": ("mediapipe_landmark_embedding.npz",),
    "left_eyelid": ("l_eyelid.npy",),
    "right_eyelid": ("r_eyelid.npy",),
}

_KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "kintree_table", "weights", "f")
_OTHERS = {6890: "SMPL", 10475: "SMPL-X", 778: "MANO"}


@dataclass(frozen=True)
class FlameFiles:
    """A model file, what was found beside it, and which FLAME it is ("" where nothing says so)."""

    model: Path
    version: str = ""
    uvs: Path | None = None
    masks: Path | None = None
    landmarks: Path | None = None
    left_eyelid: Path | None = None
    right_eyelid: Path | None = None


def find_flame(path: Path | str, version: str = "") -> FlameFiles:
    """The model at `path` (a file, or a folder that holds one) and what lies beside it.

    Raises InputError where there is no model, or a folder holds several.
    """
    path = Path(path)
    if path.is_dir():
        models = [path / name for name in MODELS if (path / name).is_file()]
        if len(models) != 1:
            found = ", ".join(m.name for m in models) or "none"
            raise InputError(
                f"{path}: {found} of {', '.join(MODELS)} in this folder; name the model file"
            )
        path = models[0]
    if not path.is_file():
        raise InputError(f"{path}: no such head file; FLAME's model is needed: {WHERE}")
    if version and version not in VERSIONS:
        raise InputError(f"FLAME version {version!r}: one of {', '.join(VERSIONS)}")
    beside = {}
    for part, names in COMPANIONS.items():
        places = [path.parent / name for name in names]
        beside[part] = next((place for place in places if place.is_file()), None)
    if (beside["left_eyelid"] is None) != (beside["right_eyelid"] is None):
        raise InputError(f"{path.parent}: only one of l_eyelid.npy and r_eyelid.npy is there")
    return FlameFiles(path, version or _version_of(path.name), **beside)


def read_flame(files: FlameFiles | Path | str) -> HeadModel:
    """A FLAME model as a head: identity, expressions (and eyelids), correctives, joints, parts.

    Raises InputError for anything that is no FLAME model, saying what it looks like instead.
    """
    if not isinstance(files, FlameFiles):
        files = find_flame(files)
    content = _content(files.model)
    version = files.version or ("2020" if "vert_sym_idxs" in content else "")
    if not version:
        raise InputError(
            f"{files.model}: FLAME 2020 or 2023? The file's name does not say; add "
            f"--flame-version with one of {', '.join(repr(v) for v in VERSIONS)}"
        )
    arrays = _arrays(files.model, content)
    expressions = arrays["shapedirs"][SHAPES:]
    names = [f"exp_{number:03d}" for number in range(len(expressions))]
    if files.left_eyelid and files.right_eyelid:
        lids = [read_eyelids(p, VERTICES) for p in (files.left_eyelid, files.right_eyelid)]
        expressions = np.concatenate([expressions, lids])
        names += EYELIDS
    triangles, weights, template = arrays["f"], arrays["weights"], arrays["v_template"]
    regressor = arrays["J_regressor"]
    uvs, uv_triangles, notes = read_uvs(files.uvs, template, triangles)
    notes += f"; regions {f'of {files.masks.name}' if files.masks else 'drawn from its geometry'}"
    drawn = drawn_regions(template, weights, regressor @ template)
    regions = drawn | (masks_of(files.masks, VERTICES) if files.masks else {})
    try:
        head = HeadModel(
            name=f"FLAME {version}",
            template=template,
            triangles=triangles,
            uvs=uvs,
            uv_triangles=uv_triangles,
            shape_basis=arrays["shapedirs"][:SHAPES],
            expression_basis=expressions,
            expression_names=tuple(names),
            pose_basis=arrays["posedirs"],
            joint_names=JOINT_NAMES,
            joint_parents=arrays["kintree_table"],
            joint_regressor=regressor,
            skinning_weights=weights,
            regions=regions,
            landmark_triangles=np.zeros(0),
            landmark_barycentrics=np.zeros((0, 3)),
            origin=f"{files.model.name}, flame.is.tue.mpg.de, under FLAME's licence; {notes}",
            joints_follow_expression=True,
        )
    except InputError as error:
        raise InputError(f"{files.model}: {error}; {WHERE}") from error
    return read_landmarks(files.landmarks, head) if files.landmarks else head


def version_of(head: HeadModel) -> str:
    """ "2020", "2023" or "2023 Open" of a head read here; "" of any other."""
    name = head.name.removeprefix("FLAME ")
    return name if name in VERSIONS and name != head.name else ""


def looks_like_flame(path: Path) -> bool:
    """Whether `path` may be FLAME's (a folder of it, a pickle, an npz with its arrays)."""
    if path.is_dir() or path.suffix == ".pkl":
        return True
    names = member_names(path)
    return "v_template.npy" in names if names else path.suffix != ".npz"


def _version_of(name: str) -> str:
    name = name.lower()
    if "2023" in name:
        return "2023 Open" if "open" in name else "2023"
    return "2020" if "generic_model" in name or "2020" in name else ""


def _content(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as stream:
            start = stream.read(512)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    text = start.lstrip().lower()
    if not start:
        raise InputError(f"{path}: an empty file; {WHERE}")
    if text.startswith((b"<!doctype", b"<html", b"<?xml", b"<head")):
        raise InputError(
            f"{path}: a web page, not a model: the download was answered by a login page; {WHERE}"
        )
    if start.startswith(b"version https://git-lfs"):
        raise InputError(f"{path}: a Git LFS pointer, not the file itself; run `git lfs pull`")
    if start.startswith(b"PK"):
        return _npz(path)
    content = read_pickle(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: a pickle of something else than a head model; {WHERE}")
    return {str(key): value for key, value in content.items()}


def _npz(path: Path) -> dict[str, Any]:
    names = member_names(path)
    if names and not any(name.endswith(".npy") for name in names):
        inside = next((n for n in names if n.endswith(".pkl")), "the .pkl file")
        raise InputError(f"{path}: a zip archive; unpack it and name {inside} from it")
    try:
        return dict(read_arrays(path))
    except InputError as error:
        if "pickled objects" in str(error):
            raise InputError(
                f"{path}: it holds pickled objects; convert the model again with plain arrays "
                "(J_regressor as J_regressor.toarray()), or name the .pkl"
            ) from error
        raise InputError(f"{error}; copy it again") from error


def _arrays(path: Path, content: dict[str, Any]) -> dict[str, np.ndarray]:
    """The model's arrays in our order of axes, each checked; InputError says what it may be."""
    template = content.get("v_template")
    if template is None:
        what = "the masks of FLAME" if "left_eyeball" in content else "something else"
        raise InputError(f"{path}: no FLAME model but {what} (it has no v_template); {WHERE}")
    count = len(np.atleast_1d(_dense(template)))
    if count != VERTICES:
        other = _OTHERS.get(count, "another model")
        raise InputError(
            f"{path}: {other} ({count} vertices), not FLAME ({VERTICES} vertices); {WHERE}"
        )
    missing = [key for key in _KEYS if key not in content]
    if missing:
        raise InputError(f"{path}: FLAME without {', '.join(missing)}; {WHERE}")
    try:
        arrays = {key: np.asarray(_dense(content[key]), np.float64) for key in _KEYS}
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: an array is malformed ({error}); {WHERE}") from error
    wanted = {
        "v_template": (VERTICES, 3),
        "shapedirs": (VERTICES, 3, SHAPES + EXPRESSIONS),
        "posedirs": (VERTICES, 3, 9 * (JOINTS - 1)),
        "J_regressor": (JOINTS, VERTICES),
        "kintree_table": (2, JOINTS),
        "weights": (VERTICES, JOINTS),
        "f": (len(arrays["f"]), 3),
    }
    for key, shape in wanted.items():
        if arrays[key].shape != shape:
            raise InputError(
                f"{path}: {key} has shape {list(arrays[key].shape)}, FLAME's is {list(shape)}"
            )
        if not np.isfinite(arrays[key]).all():
            raise InputError(f"{path}: {key} has values that are not finite; copy the file again")
    parents = arrays["kintree_table"][0].copy()
    parents[0] = -1  # stored as 2^32 - 1
    faces = arrays["f"]
    if (faces < 0).any() or (faces >= VERTICES).any() or (np.abs(parents) >= JOINTS).any():
        raise InputError(f"{path}: f or kintree_table has indices out of range; {WHERE}")
    arrays["kintree_table"] = parents.astype(np.int32)
    arrays["f"] = faces.astype(np.int32)
    for key in ("shapedirs", "posedirs"):
        arrays[key] = np.moveaxis(arrays[key], 2, 0)
    return arrays


def _dense(value: Any) -> Any:
    return value.toarray() if hasattr(value, "toarray") else value
