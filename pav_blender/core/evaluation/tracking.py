"""How far a tracked collection is from the truth that a studio collection holds."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from ..collection import Clip, Collection
from ..deformation.rigid import head_rotation
from ..errors import InputError
from ..head.geometry import vertex_normals
from ..tracking.landmark_model import axis_angles, rotations


@dataclass(frozen=True)
class TrackErrors:
    """Medians over the frames of all clips unless said otherwise.

    frames: compared, of `filmed`; reprojection_px: a frame's median distance of face vertices on
    the picture, source pixels; reprojection_worst_px: its 95th percentile over frames;
    rotation_deg: of the head to the camera; of that, rotation_mean_deg: of a clip's mean turn, and
    yaw_percent: how much more or less the head is found to turn to the side than it does, both
    means of clips; shoulders_px: as reprojection, of the torso's front,
    each vertex less what it misses by throughout the clip, for clothes hide a torso's shape (NaN: a
    clip has none in its pictures); expression_mm: a frame's mean distance of the face's vertices in
    the head's frame, each measured from its own neutral face; face_mm: the same of the vertices
    themselves, each head laid on the other rigidly over the clips' neutral face; shape_mm: mean
    distance of the neutral faces, laid on each other; focal_percent: mean of clips; jitter: the
    face's mean acceleration on the picture over the truth's, frame to frame.
    """

    frames: int
    filmed: int
    reprojection_px: float
    reprojection_worst_px: float
    rotation_deg: float
    rotation_mean_deg: float
    yaw_percent: float
    shoulders_px: float
    expression_mm: float
    face_mm: float
    shape_mm: float
    focal_percent: float
    jitter: float

    def row(self) -> dict[str, float]:
        return {name: round(float(value), 4) for name, value in asdict(self).items()}


@dataclass(eq=False)
class _Both:
    """A clip's face as it is and as it was found, the frames both have."""

    pixels: tuple[np.ndarray, np.ndarray]  # [F,V,2] source pixels
    local: tuple[np.ndarray, np.ndarray]  # [F,V,3] in the head's frame, metres
    turns: tuple[np.ndarray, np.ndarray]  # [F,3,3] head to camera
    swayed: np.ndarray  # [F] the torso, source pixels
    numbers: np.ndarray  # [F]
    focal: tuple[float, float]  # of the source frame's pixels


def compare(truth: Collection, found: Collection, *, size: int | None = None) -> TrackErrors:
    """Errors of `found`, tracked on the pictures of `truth`'s clips, name for name.

    Both are of one head model; size: the source frames' side in pixels, where the truth's pictures
    were resized (default: their own); `found` says each clip's focal length in source pixels, as
    `track` does. Raises InputError.
    """
    if truth.head.fingerprint != found.head.fingerprint:
        raise InputError(f"{found.path}: tracked with another head than {truth.path}")
    face = np.flatnonzero(truth.head.regions["face"])
    neutral = tuple(
        _head_frame(c.head, c.head.shaped(c.betas), c.betas)[face] for c in (truth, found)
    )
    turn = head_rotation(neutral[1], neutral[0], np.ones(len(face)))
    shift = neutral[0].mean(axis=0) - turn @ neutral[1].mean(axis=0)
    laid = neutral[1] @ turn.T + shift
    clips = [_both(truth, found, clip.name, face, size) for clip in found.clips]
    reprojection = np.concatenate([_apart(*both.pixels) for both in clips])
    rotation = np.concatenate([_angles(*both.turns) for both in clips])
    parts = np.abs([_turn_parts(*both.turns) for both in clips])
    expression, whole, jitters = [], [], []
    for both in clips:
        real, seen = both.local
        moved = np.linalg.norm((real - neutral[0]) - (seen - neutral[1]) @ turn.T, axis=2)
        expression.append(moved.mean(axis=1))
        whole.append(np.linalg.norm(seen @ turn.T + shift - real, axis=2).mean(axis=1))
        jitters.append([_shake(pixels, both.numbers) for pixels in both.pixels])
    shaken = np.array(jitters).sum(axis=0)
    return TrackErrors(
        frames=len(reprojection),
        filmed=sum(len(truth.clip(c.name).indices("train", "test")) for c in found.clips),
        reprojection_px=float(np.median(reprojection)),
        reprojection_worst_px=float(np.percentile(reprojection, 95)),
        rotation_deg=float(np.median(rotation)),
        rotation_mean_deg=float(parts[:, 0].mean()),
        yaw_percent=100 * float(parts[:, 1].mean()),
        shoulders_px=float(np.median(np.concatenate([both.swayed for both in clips]))),
        expression_mm=1e3 * float(np.median(np.concatenate(expression))),
        face_mm=1e3 * float(np.median(np.concatenate(whole))),
        shape_mm=1e3 * float(np.linalg.norm(laid - neutral[0], axis=1).mean()),
        focal_percent=100 * float(np.mean([abs(np.log(c.focal[1] / c.focal[0])) for c in clips])),
        jitter=float(shaken[1] / max(shaken[0], 1e-9)),
    )


def _both(
    truth: Collection, found: Collection, name: str, face: np.ndarray, size: int | None
) -> _Both:
    focal = next(
        (c["focal_pixels"] for c in found.extra.get("tracking", {}).get("clips", [])
         if c["name"] == name),
        None,
    )  # fmt: skip
    if focal is None:
        raise InputError(f"{found.path}: says nothing of clip {name}'s focal length")
    real, seen = truth.clip(name), found.clip(name)
    _, a, b = np.intersect1d(real.frame_id, seen.frame_id, return_indices=True)
    if len(a) == 0:
        raise InputError(f"{found.path}: clip {name} shares no frame with {truth.path}")
    scale = 1.0 if size is None else size / real.width
    centre = scale * np.array([real.width / 2, real.height / 2])
    true_focal = scale * float(real.intrinsics[0, 0, 0])
    there = _seen(truth, real, a, true_focal, centre)
    here = _seen(found, seen, b, float(focal), centre)
    return _Both(
        (there[0][:, face], here[0][:, face]),
        (there[1][:, face], here[1][:, face]),
        (there[2], here[2]),
        _swaying(truth, there[0], here[0], 2 * centre),
        real.frame_id[a],
        (true_focal, float(focal)),
    )


def _seen(
    collection: Collection, clip: Clip, rows: np.ndarray, focal: float, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels [F,V,2] of the source frame, places [F,V,3] in the head's frame, turns [F,3,3]."""
    vertices = collection.posed(clip, rows).astype(np.float64)
    to_camera = np.linalg.inv(clip.camera_to_world[rows].astype(np.float64))
    own = np.einsum("fij,fvj->fvi", to_camera[:, :3, :3], vertices) + to_camera[:, None, :3, 3]
    pixels = own[..., :2] / own[..., 2:] * focal + centre
    pose = clip.pose[rows].astype(np.float64)
    head = rotations(pose[:, 0])
    still = pose.copy()
    still[:, 0] = 0
    names = collection.head.joint_names
    if "neck" in names:
        head = head @ rotations(pose[:, names.index("neck")])
        still[:, names.index("neck")] = 0
    posed = collection.head.pose(
        collection.betas,
        clip.expression[rows],
        still.astype(np.float32),
        np.zeros((len(rows), 3), np.float32),
    )
    local = _head_frame(collection.head, posed.numpy().astype(np.float64), collection.betas)
    return pixels, local, to_camera[:, :3, :3] @ head


def _head_frame(head, vertices: np.ndarray, betas: np.ndarray) -> np.ndarray:
    """Places seen from the neck joint of the identity."""
    joint = head.joint_names.index("neck") if "neck" in head.joint_names else 0
    return vertices - head.joints(betas)[joint].astype(np.float64)


def _apart(real: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return np.median(np.linalg.norm(real - seen, axis=2), axis=1)


def _angles(real: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Degrees between rotations [F,3,3]."""
    between = np.einsum("fij,fik->fjk", real, seen)
    cosine = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arccos(cosine.clip(-1, 1)))


def _turn_parts(real: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    """Degrees between the mean turns of a clip's rotations [F,3,3], and by what share of the way to
    the side, about the picture's vertical, they are found to turn too far."""
    missed = axis_angles(seen @ real.transpose(0, 2, 1))
    left, _, right = np.linalg.svd(real.mean(axis=0))
    swing = axis_angles(real @ (left @ right).T)[:, 1]
    swing -= swing.mean()
    share = float(swing @ missed[:, 1]) / max(float(swing @ swing), 1e-9)
    return float(np.degrees(np.linalg.norm(missed.mean(axis=0)))), share


def _swaying(truth: Collection, real: np.ndarray, seen: np.ndarray, size: np.ndarray) -> np.ndarray:
    """[F] how far torso vertices are apart on pictures of size [2], of all vertices [F,V,2], less
    what is the same throughout."""
    head = truth.head
    torso = head.skinning_weights[:, 0] > 0.5
    torso &= vertex_normals(head.template, head.triangles)[:, 2] > 0  # no picture shows a back
    torso &= ((real > 0) & (real < size)).all(axis=(0, 2))
    if not torso.any():
        return np.full(len(real), np.nan)
    apart = seen[:, torso] - real[:, torso]
    return np.median(np.linalg.norm(apart - np.median(apart, axis=0), axis=2), axis=1)


def _shake(pixels: np.ndarray, numbers: np.ndarray) -> float:
    """Summed mean length of second differences over frames that follow one another."""
    even = np.flatnonzero((np.diff(numbers)[:-1] == 1) & (np.diff(numbers)[1:] == 1)) + 1
    bends = pixels[even - 1] - 2 * pixels[even] + pixels[even + 1]
    return float(np.linalg.norm(bends, axis=2).mean(axis=1).sum())
