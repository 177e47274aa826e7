"""How the shoulders stand in each frame, told by what they wear.

Landmarks are of the face alone, so the fit keeps a clip's shoulders turned one way and hangs them
on the head. People sway and lean: here each frame's shoulders turn about the neck's joint until
cloth, collar and outline lie where the clip shows them on the whole. The head stays where it is.
Where the fit has the neck's joint is not quite where the person's is; turns make up for that too,
so they tell where shoulders are on the picture, and only roughly how a person leans.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..errors import Cancelled
from ..head import HeadModel
from ..head.geometry import vertex_normals
from .landmark_model import axis_angles, rotations
from .photo import SIDE, Pictures, feature, luminance, sample, scattered, templates
from .terms import ClipFit, project, project_slopes

_LEVELS = ((4, 12), (2, 6), (1, 6))  # pixels taken together, and steps at that size
_LOCAL = 11  # pixels of that size; cloth has less to see than a face, and more to be far off by
_POINTS, _TRIED = 600, 6_000
# Skinning weight of the root from which a point is followed. Meshes blend collars with the neck;
# what is worn there rests on the shoulders all the same, and is often all that a picture shows.
_TORSO = 0.4
_SPREAD = 0.1  # radians that shoulders turn from how a clip shows them on the whole
_INDEPENDENT = 0.05  # of residuals: neighbouring points tell nearly the same
_FLOOR = 0.05
_LONGEST, _STILL = 0.05, 1e-4  # radians a step, and those after which no more are taken
_FEWEST = 60  # points in the picture
# where most points look little more alike than if they turned with the head, pictures tell less
_DOUBT = 2
_SHARP = 6  # how sharply points that go with the head are told from those that do not


def grey_window(rgb: np.ndarray, corner: np.ndarray, side: int) -> np.ndarray:
    """`luminance` as uint8 [SIDE, SIDE]: a clip's are kept until its head is fitted."""
    return (luminance(rgb, corner, side).clip(0, 1) * 255 + 0.5).astype(np.uint8)


@dataclass(eq=False)
class _Torso:
    """Points of a clip's torso: arms [L, 3], from the neck's joint as the head has it at rest;
    normals [L, 3]; start [F, 3, 3]: how the fit has them turned; joint [F, 3]: where that is."""

    arms: np.ndarray
    normals: np.ndarray
    start: np.ndarray
    joint: np.ndarray
    focal: float


def follow(
    head: HeadModel,
    betas: np.ndarray,
    fit: ClipFit,
    greys: np.ndarray,
    corners: np.ndarray,
    side: int,
    should_stop: Callable[[], bool] | None = None,
) -> ClipFit:
    """The fit with each frame's shoulders where its picture shows them.

    greys uint8 [F, SIDE, SIDE]: windows of `side` source pixels whose left upper corners [F, 2]
    count from the picture's middle. A head whose neck does not stand on its root, or pictures that
    show too little of the shoulders, give the fit back as it is. Raises Cancelled.
    """
    neck = head.joint_names.index("neck") if "neck" in head.joint_names else 0
    if not neck or head.joint_parents[neck] != 0 or len(greys) < 2:
        return fit
    joints = head.joints(betas).astype(np.float64)
    bone = joints[neck] - joints[0]
    start = rotations(fit.pose[:, 0])
    joint = start @ bone + joints[0] + fit.translation
    points, normals = torso_points(head, betas)
    arms = points - joints[neck]
    few = slice(None, None, -(-len(greys) // 16))
    places = np.einsum("fij,lj->fli", start[few], arms) + joint[few, None]
    shown = _shown(project(places, fit.focal), corners[few], side)
    if len(shown) < _FEWEST:
        return fit
    torso = _Torso(arms[shown], normals[shown], start, joint, fit.focal)
    turns = _turned(torso, rotations(fit.pose[:, neck]), greys, corners, side, should_stop)
    pose = fit.pose.copy()
    pose[:, 0] = axis_angles(turns)
    pose[:, neck] = axis_angles(turns.transpose(0, 2, 1) @ start @ rotations(fit.pose[:, neck]))
    return replace(fit, pose=pose, translation=joint - joints[0] - turns @ bone)


def _turned(
    torso: _Torso,
    nods: np.ndarray,
    greys: np.ndarray,
    corners: np.ndarray,
    side: int,
    should_stop: Callable[[], bool] | None,
) -> np.ndarray:
    """The torso's turns [F, 3, 3], by coarse pictures, then finer; nods [F, 3, 3]: the neck's."""
    turns, trust = torso.start, 1.0
    for number, (level, steps) in enumerate(_LEVELS):
        pictures = _pictures(greys, corners, side, level)
        with_head = _look(torso, torso.start @ nods, pictures).stray
        for _ in range(steps):
            if should_stop is not None and should_stop():
                raise Cancelled("tracking stopped; the same command goes on from here")
            turns, moved = _step(torso, turns, pictures, with_head, trust)
            if moved < _STILL:
                break
        if number == 0:
            clear = float(np.median(with_head / _look(torso, turns, pictures).stray)) - 1
            trust = min(max(clear, 0.0), 1.0) ** _DOUBT
    return turns


def torso_points(head: HeadModel, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points [L, 3] spread by area over what turns with the root and faces forward, in random
    order, and their directions [L, 3]; always the same ones."""
    vertices = head.shaped(betas).astype(np.float64)
    torso = (head.skinning_weights[:, 0] >= _TORSO)[head.triangles].all(axis=1)
    a, b, c = (vertices[head.triangles[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    share = np.where(torso & (normal[:, 2] > 0), np.linalg.norm(normal, axis=1), 0.0)
    if not share.any():
        return np.zeros((0, 3)), np.zeros((0, 3))
    triangles, mix = scattered(share, _TRIED)
    corners = head.triangles[triangles]
    directions = vertex_normals(vertices, head.triangles)[corners]
    spread = [np.einsum("lv,lvx->lx", mix, values) for values in (vertices[corners], directions)]
    normals = spread[1] / np.linalg.norm(spread[1], axis=1, keepdims=True).clip(1e-12)
    return spread[0], normals


def _shown(pixels: np.ndarray, corners: np.ndarray, side: int) -> np.ndarray:
    """The first points [n] of pixels [F, L, 2] that most frames have in their window."""
    within = pixels - corners[:, None]
    inside = ((within > 0) & (within < side)).all(axis=2).mean(axis=0) > 0.5
    return np.flatnonzero(inside)[:_POINTS]


def _pictures(greys: np.ndarray, corners: np.ndarray, side: int, level: int) -> Pictures:
    size = SIDE // level
    small = greys.reshape(len(greys), size, level, size, level).mean(axis=(2, 4), dtype=np.float32)
    features = np.stack([feature(grey / 255, _LOCAL) for grey in small])
    return Pictures(features, corners.astype(np.float64), np.full(len(greys), size / side))


class _Look(NamedTuple):
    """Points as turned: arms and places [F, L, 3]; residual [F, L]: what they show more than usual;
    gradient [F, L, 2]: the picture's, a source pixel; base [F, L]: 1 where they can be seen;
    stray [L]: how far from its usual look a point mostly is."""

    arms: np.ndarray
    places: np.ndarray
    residual: np.ndarray
    gradient: np.ndarray
    base: np.ndarray
    stray: np.ndarray


def _look(torso: _Torso, turns: np.ndarray, pictures: Pictures) -> _Look:
    arms = np.einsum("fij,lj->fli", turns, torso.arms)
    places = arms + torso.joint[:, None]
    values, gradient, inside = sample(pictures, project(places, torso.focal))
    facing = -np.einsum("fij,lj,fli->fl", turns, torso.normals, places, optimize=True)
    base = (inside & (facing > 0)).astype(np.float64)
    residual = values - templates(values, base)[0]
    robust = np.minimum(np.abs(residual), 0.5) * base
    stray = robust.sum(axis=0) / base.sum(axis=0).clip(1) + 1e-3
    return _Look(arms, places, residual, gradient, base, stray)


def _step(
    torso: _Torso, turns: np.ndarray, pictures: Pictures, with_head: np.ndarray, trust: float
) -> tuple[np.ndarray, float]:
    """Turns [F, 3, 3] after one Gauss-Newton step, and the longest of its turns, radians.
    with_head [L]: how far points stray where they turn with the head."""
    look = _look(torso, turns, pictures)
    known = look.base.sum(axis=1) >= _FEWEST
    if not known.any():
        return turns, 0.0
    usual = max(_FLOOR, 1.48 * float(np.median(np.abs(look.residual[look.base > 0]))))
    robust = 1 / (1 + look.residual**2 / (4 * usual**2)) ** 2
    # hair that hangs over the shoulders turns with the head: what looks the same there is left out
    own = with_head**_SHARP / (with_head**_SHARP + look.stray**_SHARP)
    weights = trust * _INDEPENDENT * look.base * robust * own / usual**2
    slopes = np.einsum("flp,flpi->fli", look.gradient, project_slopes(look.places, torso.focal))
    slopes = np.cross(look.arms, slopes)  # by a turn of the point about the joint
    matrix = np.einsum("fl,fli,flj->fij", weights, slopes, slopes) + np.eye(3) / _SPREAD**2
    away = axis_angles(turns @ torso.start.transpose(0, 2, 1))
    right = np.einsum("fl,fli,fl->fi", weights, slopes, look.residual) + away / _SPREAD**2
    change = -np.linalg.solve(matrix, right[..., None])[..., 0] * known[:, None]
    length = np.linalg.norm(change, axis=1, keepdims=True)
    change *= np.minimum(1.0, _LONGEST / length.clip(1e-12))
    return rotations(change) @ turns, float(np.abs(change).max())
