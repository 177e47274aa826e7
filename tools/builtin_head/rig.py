"""Five joints and their weights out of MakeHuman's 163 bones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from tools.builtin_head.cut import METRES, Cut, sphere_centre
from tools.builtin_head.identity import Identity

JOINTS = ("root", "neck", "jaw", "left_eye", "right_eye")
PARENTS = np.array([-1, 0, 1, 1, 1], np.int32)
# How far each bone of the neck chain follows our one neck joint: graded, so that a turned head
# twists the neck from the collar bones to the skull
_NECK_SHARE = {"neck01": 0.2, "neck02": 0.5, "neck03": 0.85}
_NECK_PLACE = 0.45  # of the way from MakeHuman's joint-neck (C7) to joint-head (top of the spine)
_SMOOTHING = 12  # passes over the neck's weights
_REACH = 0.045  # metres: vertices this near a joint's ring regress it


@dataclass(frozen=True)
class Rig:
    regressor: np.ndarray  # [J,V]
    weights: np.ndarray  # [V,J]


def build_rig(cut: Cut, identity: Identity, triangles: np.ndarray) -> Rig:
    jaw = _jaw_weights(cut)
    neck = _neck_weights(cut, triangles)
    weights = np.zeros((cut.vertex_count, len(JOINTS)))
    weights[:, 2] = jaw
    weights[:, 1] = neck * (1 - jaw)
    weights[:, 0] = (1 - neck) * (1 - jaw)
    for side in range(2):
        weights[cut.eye_slice(side)] = np.eye(len(JOINTS))[3 + side]
    return Rig(_regressor(cut, identity, triangles), weights)


def _hinge(cut: Cut, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3,3] and pivot [3] of the lower teeth in the jawOpen target.

    positions: [V,3] decimetres; the target's displacements are added to them.
    """
    teeth = cut.members("helper-lower-teeth")
    before = positions[teeth]
    after = before + cut.displace(cut.source.face_units["jawOpen"])[teeth]
    u, _, vt = np.linalg.svd((before - before.mean(0)).T @ (after - after.mean(0)))
    rotation = (u @ vt).T
    shift = after.mean(0) - rotation @ before.mean(0)
    pivot = np.linalg.lstsq(np.eye(3) - rotation, shift, rcond=None)[0]
    pivot[0] = 0.0
    return rotation, pivot


def _jaw_weights(cut: Cut) -> np.ndarray:
    """How far each vertex [V] follows the lower teeth when the jawOpen target opens the mouth."""
    rest = cut.rest
    rotation, pivot = _hinge(cut, rest)
    rigid = (rest - pivot) @ (rotation - np.eye(3)).T
    moved = cut.displace(cut.source.face_units["jawOpen"])
    share = (moved * rigid).sum(1) / np.maximum((rigid**2).sum(1), 1e-6)
    share[cut.members("helper-lower-teeth") | cut.members("helper-tongue")] = 1.0
    share[cut.members("helper-upper-teeth")] = 0.0
    return np.clip(share, 0, 1)


def _neck_weights(cut: Cut, triangles: np.ndarray) -> np.ndarray:
    """Share [V] of head and neck motion, smooth between the skull (1) and the shoulders (0)."""
    source = cut.source
    follows = {}
    for bone in source.bone_weights:
        chain = [bone]
        while source.bone_parents[chain[-1]]:
            chain.append(source.bone_parents[chain[-1]])
        follows[bone] = 1.0 if "head" in chain else _NECK_SHARE.get(bone, 0.0)
    total = np.zeros(cut.vertex_count)
    share = np.zeros(cut.vertex_count)
    for bone, weights in source.bone_weights.items():
        kept = cut.bone(weights)
        total += kept
        share += kept * follows[bone]
    share = np.divide(share, total, out=np.ones_like(share), where=total > 1e-6)
    solid = cut.members("helper-upper-teeth") | cut.members("helper-lower-teeth")
    share[solid | cut.members("helper-tongue")] = 1.0
    average = _neighbour_average(triangles, cut.vertex_count)
    for _ in range(_SMOOTHING):
        share = 0.5 * share + 0.5 * (average @ share)
    share[share > 0.995] = 1.0
    share[share < 0.005] = 0.0
    return 0.5 * (share + share[cut.mirror])


def _neighbour_average(triangles: np.ndarray, count: int) -> sp.csr_matrix:
    i = triangles[:, [0, 1, 2]].ravel()
    j = triangles[:, [1, 2, 0]].ravel()
    adjacency = sp.coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    adjacency = ((adjacency + adjacency.T) > 0).astype(float)
    degree = np.maximum(adjacency.sum(1).A1, 1)
    return sp.diags(1 / degree) @ adjacency


def _regressor(cut: Cut, identity: Identity, triangles: np.ndarray) -> np.ndarray:
    """[J,V]: every joint as an affine mean of vertices that moves as it does under identity."""
    source = cut.source

    def cube(name: str) -> tuple[np.ndarray, np.ndarray]:
        index = source.group_vertices(name)
        return identity.helper_template[index].mean(0), identity.helper_basis[:, index].mean(1)

    base, top = cube("joint-neck"), cube("joint-head")
    neck = tuple((1 - _NECK_PLACE) * a + _NECK_PLACE * b for a, b in zip(base, top, strict=True))
    # the hinge goes with the lower teeth, so that the joint and the jawOpen target agree
    pivot = METRES * _hinge(cut, identity.template / METRES)[1]
    jaw = (pivot, identity.basis[:, cut.members("helper-lower-teeth")].mean(1))
    body = np.ones(cut.vertex_count, bool)
    for group in ("helper-upper-teeth", "helper-lower-teeth", "helper-tongue"):
        body &= ~cut.members(group)
    for side in range(2):
        body[cut.eye_slice(side)] = False
    rows = []
    for place, moves in (base, neck, jaw):
        distance = np.abs(identity.template[:, 1:] - place[1:])
        near = body & (np.linalg.norm(distance, axis=1) < 2.2 * _REACH)
        rows.append(_affine_mean(identity, near, place, moves))
    rows = [0.5 * (row + row[cut.mirror]) for row in rows]
    for side in range(2):
        mask = np.zeros(cut.vertex_count, bool)
        mask[cut.eye_slice(side)] = True
        # an affine mean that is the centre of a sphere stays it when the sphere moves and grows
        rows.append(_affine_mean(identity, mask, sphere_centre(identity.template[mask]), None))
    return np.array(rows)


def _affine_mean(
    identity: Identity, candidates: np.ndarray, place: np.ndarray, moves: np.ndarray | None
) -> np.ndarray:
    """Small weights [V] summing to 1 whose mean is ``place`` [3] and moves by ``moves`` [B,3].

    Ridge least squares for the moves, if any, under exact constraints for the place and the sum.
    """
    index = np.flatnonzero(candidates)
    points = identity.template[index]
    gram, goal = np.eye(len(index)), np.zeros(len(index))
    if moves is not None:
        basis = identity.basis[:, index]  # [B,n,3]
        design = np.moveaxis(basis, 1, 2).reshape(-1, len(index)) * 1000  # millimetres
        gram = design.T @ design + 20.0 * gram
        goal = design.T @ moves.reshape(-1) * 1000
    constraints = np.vstack([np.ones(len(index)), (points - place).T * 100])
    values = np.array([1.0, 0.0, 0.0, 0.0])
    system = np.block([[gram, constraints.T], [constraints, np.zeros((4, 4))]])
    solution = np.linalg.lstsq(system, np.concatenate([goal, values]), rcond=None)[0]
    row = np.zeros(len(candidates))
    row[index] = solution[: len(index)]
    return row
