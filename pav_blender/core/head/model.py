"""A head model: a template mesh, linear identity and expression bases, and a small joint tree.

The deformation is that of SMPL and FLAME (Li et al. 2017, "Learning a model of facial shape and
expression from 4D scans"): identity and expression are added to the template, joints are read off
the shaped template, pose correctives are added, and linear blend skinning turns the rest. The
float64 twin of :meth:`HeadModel.pose` is :func:`pav_blender.core.head.oracle.pose`.

Metres, +y up, the face looks toward +z, the person's left is +x. Rotations are axis-angle vectors
in radians: a positive x turn of the jaw opens it, a positive x turn of the neck nods, a positive y
turn of the neck turns the face to the person's left.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError

if TYPE_CHECKING:
    import torch

CANONICAL_JAW_DEGREES = 12.0  # INSTA's canonical space: the lips do not touch
_BASES = ("shape_basis", "expression_basis", "pose_basis")


@dataclass(frozen=True, eq=False)
class HeadModel:
    """An animatable head.

    ``V`` vertices, ``T`` triangles, ``U`` texture vertices, ``B`` identity, ``E`` expression and
    ``P`` corrective components, ``J`` joints. Arrays are C-contiguous and read only. The
    constructor raises :class:`InputError` where shapes, indices or values do not fit together.
    """

    name: str
    template: np.ndarray  # [V,3] float32, metres
    triangles: np.ndarray  # [T,3] int32
    uvs: np.ndarray  # [U,2] float32, v up
    uv_triangles: np.ndarray  # [T,3] int32 into uvs
    shape_basis: np.ndarray  # [B,V,3] float32, one standard deviation of the population each
    expression_basis: np.ndarray  # [E,V,3] float32
    expression_names: tuple[str, ...]
    pose_basis: np.ndarray  # [P,V,3] float32, P = 0 or 9 * (J - 1)
    joint_names: tuple[str, ...]
    joint_parents: np.ndarray  # [J] int32, -1 for the root
    joint_regressor: np.ndarray  # [J,V] float32
    skinning_weights: np.ndarray  # [V,J] float32
    regions: dict[str, np.ndarray]  # name -> bool [V]
    landmark_triangles: np.ndarray  # [L] int32, L = 478 (MediaPipe's order) or 0
    landmark_barycentrics: np.ndarray  # [L,3] float32
    origin: str
    # FLAME reads its joints off the expression too; others off the identity alone
    joints_follow_expression: bool = False

    def __post_init__(self) -> None:
        for field in _FLOATS:
            _freeze(self, field, np.float32)
        for field in _INTEGERS:
            _freeze(self, field, np.int32)
        regions = {}
        for name, mask in self.regions.items():
            regions[name] = np.ascontiguousarray(mask, bool)
            regions[name].flags.writeable = False
        object.__setattr__(self, "regions", regions)
        object.__setattr__(self, "expression_names", tuple(map(str, self.expression_names)))
        object.__setattr__(self, "joint_names", tuple(map(str, self.joint_names)))
        _check(self)

    @property
    def vertex_count(self) -> int:
        return len(self.template)

    def pose(self, betas, expression, pose, translation, offset=None) -> torch.Tensor:
        """Vertices of posed heads, differentiable in every argument.

        betas: [B] or [F,B]; expression: [F,E]; pose: [F,J,3] axis-angle, radians; translation:
        [F,3], metres; offset: [V,3] or [F,V,3], metres, added to the template. Arrays or tensors;
        shorter betas and expressions use the leading components.
        Returns [F,V,3] on the device of ``pose``; float64 where any argument is a float64 tensor,
        else float32. Raises :class:`InputError` for shapes that do not fit.
        """
        import torch  # here, so that a head can be read and rigged where there is no torch

        from .skinning import pose_vertices

        arguments = (betas, expression, pose, translation)
        double = any(torch.is_tensor(a) and a.dtype == torch.float64 for a in arguments)
        dtype = torch.float64 if double else torch.float32
        device = pose.device if torch.is_tensor(pose) else torch.device("cpu")
        betas, expression, pose, translation = (
            _tensor(argument, device, dtype) for argument in arguments
        )
        self._check_parameters(betas.shape, expression.shape, pose.shape, translation.shape)
        tensors = self.tensors(device, dtype)
        if offset is not None:
            tensors = {**tensors, "template": tensors["template"] + _tensor(offset, device, dtype)}
        return pose_vertices(tensors, betas, expression, pose, translation)

    def with_offset(self, offset: np.ndarray) -> HeadModel:
        """The head of one person: `offset` [V,3], metres, is added to the template.

        It keeps the fingerprint of the model it came from: an offset is part of an identity, as
        betas are, and what moves the one moves the other.
        """
        offset = np.asarray(offset, np.float32)
        if offset.shape != self.template.shape or not np.isfinite(offset).all():
            raise InputError(
                f"an offset of shape {list(offset.shape)}; head '{self.name}' takes "
                f"{list(self.template.shape)} finite numbers"
            )
        person = dataclasses.replace(self, template=self.template + offset)
        person.__dict__["fingerprint"] = self.fingerprint
        return person

    def shaped(self, betas) -> np.ndarray:
        """The neutral head of an identity: betas [B] -> [V,3] float32."""
        betas = _vector(betas, len(self.shape_basis), "identity")
        return self.template + np.tensordot(betas, self.shape_basis[: len(betas)], 1)

    def joints(self, betas) -> np.ndarray:
        """Joint positions of an identity: betas [B] -> [J,3] float32."""
        return self.joint_regressor @ self.shaped(betas)

    def canonical(self, betas) -> np.ndarray:
        """Neutral expression, the jaw open by 12 degrees: betas [B] -> [V,3] float32.

        Heads without a joint called "jaw" stay neutral.
        """
        betas = _vector(betas, len(self.shape_basis), "identity")
        expression = np.zeros((1, len(self.expression_names)), np.float32)
        still = np.zeros((1, 3), np.float32)
        return self.pose(betas, expression, self.canonical_pose(), still)[0].numpy()

    def canonical_pose(self) -> np.ndarray:
        """The jaw, if there is one, open by 12 degrees: [1,J,3] float32."""
        pose = np.zeros((1, len(self.joint_names), 3), np.float32)
        if "jaw" in self.joint_names:
            pose[0, self.joint_names.index("jaw"), 0] = math.radians(CANONICAL_JAW_DEGREES)
        return pose

    def landmarks(self, vertices):
        """Landmark positions [...,L,3] on vertices [...,V,3] (array or tensor, differentiable)."""
        corners = self.triangles[self.landmark_triangles]
        if isinstance(vertices, np.ndarray):
            return (vertices[..., corners, :] * self.landmark_barycentrics[..., None]).sum(-2)
        import torch

        index = torch.tensor(corners, dtype=torch.long, device=vertices.device)
        weights = torch.tensor(self.landmark_barycentrics).to(vertices)
        return (vertices[..., index, :] * weights[..., None]).sum(-2)

    @cached_property
    def fingerprint(self) -> str:
        """sha256 (hex) of the template, the triangles and the bases."""
        digest = hashlib.sha256()
        for field in ("template", "triangles", *_BASES):
            array = getattr(self, field)
            digest.update(f"{field}{array.shape}".encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

    @cached_property
    def _tensor_cache(self) -> dict:
        return {}

    def tensors(self, device: torch.device, dtype: torch.dtype) -> dict[str, torch.Tensor]:
        import torch

        key = (str(device), dtype)
        if key not in self._tensor_cache:
            tensors = {
                field: torch.tensor(getattr(self, field)).to(device, dtype) for field in _POSED
            }
            tensors["joint_expression"] = self._joint_expression(tensors)
            self._tensor_cache[key] = {**tensors, "joint_parents": self.joint_parents.tolist()}
        return self._tensor_cache[key]

    def _joint_expression(self, tensors: dict[str, torch.Tensor]) -> torch.Tensor:
        """How far each expression moves the joints, [E,J,3]; [0,J,3] where none does."""
        basis = tensors["expression_basis"]
        basis = basis if self.joints_follow_expression else basis[:0]
        return tensors["joint_regressor"] @ basis

    def _check_parameters(self, betas, expression, pose, translation) -> None:
        frames = pose[0] if len(pose) == 3 else None
        wanted = (
            ("betas", betas, len(self.shape_basis), ((), (frames,))),
            ("expression", expression, len(self.expression_basis), ((frames,),)),
        )
        if frames is None or tuple(pose[1:]) != (len(self.joint_names), 3):
            raise InputError(
                f"pose has shape {list(pose)}; head '{self.name}' needs "
                f"[frames, {len(self.joint_names)}, 3] (joints {', '.join(self.joint_names)})"
            )
        for name, shape, count, leading in wanted:
            if not shape or tuple(shape[:-1]) not in leading or shape[-1] > count:
                raise InputError(
                    f"{name} has shape {list(shape)}; head '{self.name}' needs "
                    f"[{frames}, at most {count}]"
                )
        if tuple(translation) != (frames, 3):
            raise InputError(f"translation has shape {list(translation)}; [{frames}, 3] is needed")


_FLOATS = (
    "template", "uvs", *_BASES, "joint_regressor", "skinning_weights", "landmark_barycentrics",
)  # fmt: skip
_INTEGERS = ("triangles", "uv_triangles", "joint_parents", "landmark_triangles")
_POSED = ("template", *_BASES, "joint_regressor", "skinning_weights")


def _freeze(head: HeadModel, field: str, dtype: type) -> None:
    values = np.asarray(getattr(head, field))
    if dtype is np.int32 and values.dtype.kind in "iu" and values.dtype != np.int32:
        # an index too large for int32 must not come round as one that fits
        limits = np.iinfo(np.int32)
        values = np.clip(values.astype(np.int64), limits.min, limits.max)
    with np.errstate(over="ignore"):  # what is too large is infinite, and told
        array: np.ndarray = np.ascontiguousarray(values, dtype)
    if array.flags.writeable:
        array = array.copy() if array is getattr(head, field) else array
        array.flags.writeable = False
    object.__setattr__(head, field, array)


def _tensor(values, device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    import torch

    if torch.is_tensor(values):
        return values.to(device, dtype)
    return torch.tensor(np.asarray(values), dtype=dtype, device=device)


def _vector(values, count: int, what: str) -> np.ndarray:
    values = np.asarray(values, np.float32)
    if values.ndim != 1 or len(values) > count:
        raise InputError(
            f"{what} coefficients have shape {list(values.shape)}; at most [{count}] is needed"
        )
    return values


def _check(head: HeadModel) -> None:
    """Raise :class:`InputError` naming the first field that does not fit the others."""
    vertices, joints = len(head.template), len(head.joint_names)
    count = len(head.landmark_triangles)
    correctives = len(head.pose_basis)
    shapes = {
        "template": (vertices, 3),
        "triangles": (len(head.triangles), 3),
        "uvs": (len(head.uvs), 2),
        "uv_triangles": (len(head.triangles), 3),
        "shape_basis": (len(head.shape_basis), vertices, 3),
        "expression_basis": (len(head.expression_names), vertices, 3),
        "pose_basis": (correctives, vertices, 3),
        "joint_parents": (joints,),
        "joint_regressor": (joints, vertices),
        "skinning_weights": (vertices, joints),
        "landmark_triangles": (count,),
        "landmark_barycentrics": (count, 3),
    }
    for field, shape in shapes.items():
        found = getattr(head, field).shape
        _require(head, found == shape, f"{field} has shape {list(found)}, not {list(shape)}")
    for region, mask in head.regions.items():
        found = mask.shape
        _require(head, found == (vertices,), f"region '{region}' has shape {list(found)}")
    for field in _FLOATS:
        _require(head, np.isfinite(getattr(head, field)).all(), f"{field} has values not finite")
    for field, limit in (
        ("triangles", vertices),
        ("uv_triangles", len(head.uvs)),
        ("landmark_triangles", len(head.triangles)),
    ):
        index = getattr(head, field)
        inside = not index.size or (index.min() >= 0 and index.max() < limit)
        _require(head, inside, f"{field} has indices outside 0..{limit - 1}")
    _require(head, vertices > 0 and len(head.triangles) > 0, "the mesh is empty")
    _require(head, joints > 0, "there are no joints")
    unique = len(set(head.expression_names)) == len(head.expression_names)
    _require(head, unique, "expression_names has a name twice")
    _require(
        head,
        correctives in (0, 9 * (joints - 1)),
        f"pose_basis has {correctives} components, not 0 or {9 * (joints - 1)}",
    )
    parents = head.joint_parents
    ordered = parents[0] == -1 and (parents[1:] >= 0).all()
    ordered = ordered and (parents[1:] < np.arange(1, joints)).all()
    _require(head, ordered, "joint_parents must start with -1 and name earlier joints only")
    for field, axis in (("skinning_weights", 1), ("joint_regressor", 1)):
        off = np.abs(getattr(head, field).astype(np.float64).sum(axis) - 1).max()
        _require(head, off < 1e-3, f"{field} rows sum to 1 only within {off:.2g}")


def _require(head: HeadModel, condition, message: str) -> None:
    if not condition:
        raise InputError(f"head '{head.name}': {message}")
