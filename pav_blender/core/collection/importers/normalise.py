"""Parsed clips of one person in one world: the head's root rests at its origin, cameras move.

What a tool put into the root's turn and shift goes into the camera, so that clips whose head moved
and clips whose camera moved come out alike, and pictures show the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ...errors import InputError
from ...head import HeadModel
from ...head.flame import EYELIDS, VERSIONS, version_of
from ...images import read_rgba
from ...progress import Report
from ..model import Clip
from ..writer import check_name
from .parsed import JOINTS, VERTICES, ParsedClip, Picture
from .registration import fit_pose, fit_shape
from .rotations import matrices

SHAPES = ("mean", "first")
EXPLAINED = 1e-4  # metres: parameters that pose a mesh as near as this stand for it
_ANOTHER = 0.02  # metres: a mesh as far as this on average is not what was tracked
_CHUNK = 64
_FIT_FRAMES = 8
_ROUNDS = 4


@dataclass(eq=False)
class NormalClip:
    """A clip as it will be written, its pictures, and what there is to say about it."""

    clip: Clip
    pictures: list[Picture]
    tool: str
    shape_distance: float  # metres between its own neutral head and the shared one, mean
    has_matte: bool
    lost: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass(eq=False)
class Person:
    """Clips of one person with the identity they share."""

    head: HeadModel
    betas: np.ndarray
    offset: np.ndarray | None
    clips: list[NormalClip]


def normalise(
    parsed: list[ParsedClip],
    head: HeadModel,
    *,
    shapes: str = "mean",
    tracked_with: str = "",
    hold_out: int | None = None,
    progress: Report | None = None,
) -> Person:
    """One person out of parsed clips.

    shapes: "mean" of the clips' identities, or the "first" one's. tracked_with: the FLAME that the
    sources were tracked with, where it is not their tools' usual. hold_out: frames at the end of a
    clip to test on, where its source says nothing (None: the tool's habit).
    Raises InputError for a head that does not fit the tracks, and for clips of the same name.
    """
    if shapes not in SHAPES:
        raise InputError(f"--shapes {shapes!r}: one of {', '.join(SHAPES)}")
    if tracked_with and tracked_with not in VERSIONS:
        raise InputError(f"--tracked-with {tracked_with!r}: one of {', '.join(VERSIONS)}")
    for clip in parsed:
        check_version(clip, head, tracked_with)
        _check_counts(clip, head)
    names = [clip.name for clip in parsed]
    for name in names:
        check_name(name, "clip name")
        if names.count(name) > 1:
            raise InputError(f"two clips are called {name!r}; name the sources: NAME=PATH")
    betas = [_own_shape(clip, head) for clip in parsed]
    with_offset = any(clip.offset is not None for clip in parsed)
    zero = np.zeros(head.template.shape)
    offsets = [zero if clip.offset is None else clip.offset for clip in parsed]
    shared = betas[0] if shapes == "first" else np.mean(betas, 0)
    shared = np.asarray(shared, np.float32)
    offset = offsets[0] if shapes == "first" else np.mean(offsets, 0)
    neutral = head.shaped(shared) + offset
    clips = []
    for at, (clip, own, own_offset) in enumerate(zip(parsed, betas, offsets, strict=True)):
        clips.append(_normal(clip, head, own, own_offset, hold_out))
        distance = np.linalg.norm(head.shaped(own) + own_offset - neutral, axis=1).mean()
        clips[-1].shape_distance = float(distance)
        if progress:
            progress((at + 1) / len(parsed), clip=clip.name)
    return Person(head, shared, np.asarray(offset, np.float32) if with_offset else None, clips)


def check_version(clip: ParsedClip, head: HeadModel, tracked_with: str = "") -> None:
    """InputError unless the head is the FLAME that the clip's numbers belong to."""
    if clip.head:
        if clip.head != head.fingerprint:
            raise InputError(
                f"clip {clip.name} was exported with the head of the fingerprint {clip.head[:12]}; "
                f"{head.name!r} has {head.fingerprint[:12]}: name that head with --head (heads "
                "other than FLAME lie beside the exported clips: head.npz)"
            )
        return
    wanted, found = tracked_with or clip.flame, version_of(head)
    if not found or head.vertex_count != VERTICES:
        raise InputError(
            f"clip {clip.name} ({clip.tool}) was tracked with FLAME {wanted}; the head "
            f"{head.name!r} is not FLAME: give FLAME's model with --head"
        )
    if found != wanted:
        raise InputError(
            f"clip {clip.name} ({clip.tool}) was tracked with FLAME {wanted}, whose expressions "
            f"mean something else with {head.name}: give FLAME {wanted} with --head, or, if the "
            f"track was made with {head.name} after all, say --tracked-with '{found}'"
        )


def _check_counts(clip: ParsedClip, head: HeadModel) -> None:
    for meshes in (clip.vertices, clip.moving_offset, clip.canonical, clip.offset):
        if meshes is not None and meshes.shape[-2] != head.vertex_count:
            raise InputError(
                f"clip {clip.name}: meshes of {meshes.shape[-2]} vertices; {head.name} has "
                f"{head.vertex_count}"
            )


def _own_shape(clip: ParsedClip, head: HeadModel) -> np.ndarray:
    """The clip's betas, float32 [B]; solved from its meshes where its tool wrote none."""
    if clip.shape is not None:
        return np.asarray(clip.shape, np.float32)[: len(head.shape_basis)]
    count = len(head.expression_names)
    if clip.canonical is not None:
        betas = fit_shape(head, clip.canonical[None], np.zeros((1, count)), head.canonical_pose())
        return betas.astype(np.float32)
    if clip.vertices is None:
        raise InputError(f"clip {clip.name}: neither an identity nor meshes")
    rows = np.unique(np.linspace(0, len(clip) - 1, _FIT_FRAMES).round().astype(int))
    expression = _expression(clip, head)[rows]
    pose = np.zeros((len(rows), len(head.joint_names), 3))
    for _ in range(_ROUNDS):
        betas = fit_shape(head, clip.vertices[rows], expression, pose)
        pose, expression = fit_pose(head, betas, expression, clip.vertices[rows])
    return fit_shape(head, clip.vertices[rows], expression, pose).astype(np.float32)


def _expression(clip: ParsedClip, head: HeadModel) -> np.ndarray:
    """The clip's expressions in the head's order, eyelids among them, [F, E] float64."""
    values = np.zeros((len(clip), len(head.expression_names)))
    count = min(values.shape[1], clip.expression.shape[1])  # files are padded with zeros
    values[:, :count] = clip.expression[:, :count]
    if clip.eyelids is not None and EYELIDS[0] in head.expression_names:
        for column, name in enumerate(EYELIDS):
            values[:, head.expression_names.index(name)] = clip.eyelids[:, column]
    return values


def _pose(clip: ParsedClip, head: HeadModel) -> np.ndarray:
    """The clip's turns by the head's own joints, [F, J, 3]."""
    pose = np.zeros((len(clip), len(head.joint_names), 3))
    pose[:, 0] = clip.pose[:, 0]
    for column, name in enumerate(JOINTS[1:], start=1):
        if name in head.joint_names:
            pose[:, head.joint_names.index(name)] = clip.pose[:, column]
    return pose


def _normal(
    clip: ParsedClip,
    head: HeadModel,
    betas: np.ndarray,
    offset: np.ndarray,
    hold_out: int | None,
) -> NormalClip:
    notes: list[str] = []
    lost = list(clip.lost)
    expression, pose = _expression(clip, head), _pose(clip, head)
    head = head.with_offset(offset) if offset.any() else head
    vertices = clip.vertices
    if clip.shape is None and vertices is not None:
        pose, expression = fit_pose(head, betas, expression, vertices)
        notes.append("identity, jaw and eyes were fitted to the meshes")
    elif vertices is not None and not clip.head:
        pose = _eyes_in_order(head, betas, expression, pose, vertices, notes)
    has_lids = EYELIDS[0] in head.expression_names
    if vertices is None and clip.eyelids is not None and has_lids:
        vertices = _lids_last(head, betas, expression, pose)
    still = fixed_head(head, betas, expression, pose, clip)
    translation = np.zeros((len(clip), 3))
    pose[:, 0] = 0
    if vertices is not None:
        vertices = _unmoved(vertices, still)
    elif clip.moving_offset is not None:
        vertices = _posed(head, betas, expression, pose, clip.moving_offset)
    if clip.eyelids is not None and np.abs(clip.eyelids).max() > 1e-6 and not has_lids:
        if vertices is None:
            lost.append("eyelids (put l_eyelid.npy and r_eyelid.npy beside FLAME's model)")
        else:
            notes.append("eyelids are in the meshes only; l_eyelid.npy and r_eyelid.npy beside "
                         "FLAME's model would make them expressions")  # fmt: skip
    if vertices is not None:
        vertices = _beyond_parameters(head, betas, expression, pose, vertices, notes, clip.name)
    intrinsics, width, height, has_matte = _pixels(clip, notes)
    result = Clip(
        name=clip.name,
        appearance=clip.appearance or clip.name,
        width=width,
        height=height,
        expression=expression.astype(np.float32),
        pose=pose.astype(np.float32),
        translation=translation.astype(np.float32),
        intrinsics=intrinsics.astype(np.float32),
        camera_to_world=(np.linalg.inv(still) @ clip.camera_to_world).astype(np.float32),
        frame_id=clip.frame_id,
        split=_split(clip, hold_out, notes),
        vertices=vertices,
    )
    return NormalClip(result, clip.pictures, clip.tool, 0.0, has_matte, lost, clip.skipped, notes)


def fixed_head(
    head: HeadModel, betas: np.ndarray, expression: np.ndarray, pose: np.ndarray, clip: ParsedClip
) -> np.ndarray:
    """Motions [F, 4, 4] of the head as a whole: the root's turn about its joint, and the shift."""
    root = (head.joint_regressor[0].astype(np.float64) @ head.shaped(betas))[None]
    if head.joints_follow_expression:
        moves = np.tensordot(head.expression_basis.astype(np.float64), head.joint_regressor[0],
                             axes=(1, 0))  # fmt: skip
        root = root + expression @ moves
    turns = matrices(pose[:, 0])
    motion = np.tile(np.eye(4), (len(pose), 1, 1))
    motion[:, :3, :3] = turns
    motion[:, :3, 3] = root - np.einsum("fij,fj->fi", turns, np.broadcast_to(root, (len(pose), 3)))
    motion[:, :3, 3] += clip.translation
    return motion


def _unmoved(vertices: np.ndarray, motion: np.ndarray) -> np.ndarray:
    if np.allclose(motion, np.eye(4), atol=1e-12):
        return vertices
    turned = np.empty(vertices.shape, np.float32)
    for row, (mesh, matrix) in enumerate(zip(vertices, motion, strict=True)):
        turned[row] = (mesh - matrix[:3, 3]) @ matrix[:3, :3]
    return turned


def _posed(
    head: HeadModel,
    betas: np.ndarray,
    expression: np.ndarray,
    pose: np.ndarray,
    offset: np.ndarray | None = None,
) -> np.ndarray:
    parts = []
    for start in range(0, len(pose), _CHUNK):
        rows = slice(start, start + _CHUNK)
        moved = expression[rows], pose[rows], np.zeros((len(pose[rows]), 3))
        more = None if offset is None else offset[rows]
        parts.append(head.pose(betas, *moved, offset=more).numpy())
    return np.concatenate(parts)


def _lids_last(
    head: HeadModel, betas: np.ndarray, expression: np.ndarray, pose: np.ndarray
) -> np.ndarray:
    """Meshes whose eyelids close after skinning, as metrical-tracker has it, [F, V, 3]."""
    lids = [head.expression_names.index(name) for name in EYELIDS]
    bare = expression.copy()
    bare[:, lids] = 0
    closing = np.tensordot(expression[:, lids], head.expression_basis[lids], axes=1)
    return _posed(head, betas, bare, pose) + closing.astype(np.float32)


def _eyes_in_order(
    head: HeadModel,
    betas: np.ndarray,
    expression: np.ndarray,
    pose: np.ndarray,
    vertices: np.ndarray,
    notes: list[str],
) -> np.ndarray:
    """Trackers dispute which eye comes first: the meshes tell."""
    rows = np.unique(np.linspace(0, len(pose) - 1, _FIT_FRAMES).round().astype(int))
    swapped = pose[:, [0, 1, 2, 4, 3]]
    errors = [
        np.abs(_posed(head, betas, expression[rows], each[rows]) - vertices[rows]).mean()
        for each in (pose, swapped)
    ]
    if errors[1] < 0.9 * errors[0] and errors[0] - errors[1] > 1e-7:
        notes.append("the eyes were in the other order, as its meshes show")
        return swapped
    return pose


def _beyond_parameters(
    head: HeadModel,
    betas: np.ndarray,
    expression: np.ndarray,
    pose: np.ndarray,
    vertices: np.ndarray,
    notes: list[str],
    name: str,
) -> np.ndarray | None:
    """The meshes, or None where the parameters pose them just so."""
    distance = np.empty(vertices.shape[:2], np.float32)
    for start in range(0, len(pose), _CHUNK):
        rows = slice(start, start + _CHUNK)
        away = _posed(head, betas, expression[rows], pose[rows]) - vertices[rows]
        distance[rows] = np.linalg.norm(away, axis=2)
    if not distance.mean() < _ANOTHER:
        raise InputError(
            f"clip {name}: its meshes lie {distance.mean():.3g} m from what its parameters pose on "
            f"{head.name}: another head, another unit, or another FLAME"
        )
    if distance.max() <= EXPLAINED:
        return None
    notes.append(
        f"the meshes are kept: the parameters alone miss them by {1000 * distance.mean():.2f} mm "
        f"on average, {1000 * distance.max():.1f} mm at most"
    )
    return np.asarray(vertices, np.float32)


def _pixels(clip: ParsedClip, notes: list[str]) -> tuple[np.ndarray, int, int, bool]:
    """Intrinsics for the size that the pictures have, that size, and whether there is a matte."""
    first = clip.pictures[0]
    rgba = read_rgba(first.image)
    height, width = rgba.shape[:2]
    across, down = width / clip.width, height / clip.height
    if abs(across - down) > 0.01 * across:
        raise InputError(
            f"{first.image}: {width}x{height} pixels; the track is of {clip.width}x{clip.height}"
        )
    if (width, height) != (clip.width, clip.height):
        notes.append(f"pictures of {width}x{height}, tracked at {clip.width}x{clip.height}")
    scale = np.diag([across, down, 1.0])
    has_matte = first.matte is not None or bool((rgba[..., 3] < 255).any())
    return scale @ clip.intrinsics, width, height, has_matte


def _split(clip: ParsedClip, hold_out: int | None, notes: list[str]) -> np.ndarray:
    split = clip.split.copy()
    count = clip.habit if hold_out is None else hold_out
    if (split != "train").any() or not count:
        return split
    if hold_out is None and len(split) < 2 * count:
        count = len(split) // 5
        notes.append(
            f"{len(split)} frames are too few to hold out {clip.habit}, as is usual: "
            f"the last {count} are the test set"
        )
    if count >= len(split):
        raise InputError(f"clip {clip.name}: --hold-out {count} leaves none of {len(split)} frames")
    split[len(split) - count :] = "test"
    return split
