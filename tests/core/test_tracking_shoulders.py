"""Shoulders followed through the studio's own pictures, whose truth is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pav_blender.core.collection import read_collection
from pav_blender.core.errors import Cancelled
from pav_blender.core.images import read_rgba
from pav_blender.core.tracking import shoulders
from pav_blender.core.tracking.landmark_model import axis_angles, rotations
from pav_blender.core.tracking.terms import ClipFit

STUDIO = Path(__file__).parents[2] / "data" / "studio3"
FRAMES = 24
BEHIND = 110


@pytest.fixture(scope="module")
def filmed():
    """Head, identity, the truth as the camera sees it, its windows and their corners and side."""
    collection = read_collection(STUDIO)
    clip = collection.clip("crop")
    rows = clip.indices("train")[:FRAMES]
    head, flip = collection.head, np.diag([1.0, -1.0, -1.0])
    to_camera = np.linalg.inv(clip.camera_to_world[rows].astype(np.float64))
    joint = head.joints(collection.betas)[0].astype(np.float64)
    turn, shift = flip @ to_camera[:, :3, :3], to_camera[:, :3, 3] @ flip
    pose = clip.pose[rows].astype(np.float64)
    pose[:, 0] = axis_angles(turn @ rotations(pose[:, 0]))
    place = np.einsum("fij,fj->fi", turn, joint + clip.translation[rows]) + shift - joint
    focal = float(clip.intrinsics[0, 0, 0])
    truth = ClipFit(focal, pose[FRAMES // 2, 0], pose, place, clip.expression[rows])
    greys = []
    for row in rows:
        rgba = read_rgba(collection.image_path(clip, int(row))).astype(np.float32)
        alpha = rgba[..., 3:] / 255
        rgb = (rgba[..., :3] * alpha + BEHIND * (1 - alpha)).astype(np.uint8)
        greys.append(shoulders.grey_window(rgb, np.zeros(2), clip.width))
    corners = np.tile(-clip.intrinsics[0, :2, 2].astype(np.float64), (FRAMES, 1))
    return head, collection.betas, truth, np.stack(greys), corners, clip.width


def _held_still(head, betas, truth):
    """As landmarks alone have it: shoulders turned one way throughout, the head where it is."""
    joints = head.joints(betas).astype(np.float64)
    bone, still = joints[1] - joints[0], rotations(truth.root)
    body = rotations(truth.pose[:, 0])
    pose = truth.pose.copy()
    pose[:, 0] = truth.root
    pose[:, 1] = axis_angles(still.T @ body @ rotations(pose[:, 1]))
    return replace(truth, pose=pose, translation=truth.translation + (body - still) @ bone)


def _turn_errors(fit, truth):
    """Degrees, apart from what is the same in all frames."""
    body = rotations(truth.pose[:, 0])
    turns = axis_angles(body.transpose(0, 2, 1) @ rotations(fit.pose[:, 0]))
    return np.degrees(np.linalg.norm(turns - np.median(turns, axis=0), axis=1))


def _posed(head, betas, fit):
    parts = (fit.expression, fit.pose, fit.translation)
    return head.pose(betas, *(part.astype(np.float32) for part in parts)).numpy()


def test_shoulders_turn_as_they_were_filmed_and_the_head_stays(filmed):
    head, betas, truth, *pictures = filmed
    still = _held_still(head, betas, truth)
    found = shoulders.follow(head, betas, still, *pictures)
    before, after = _turn_errors(still, truth), _turn_errors(found, truth)
    assert np.median(before) > 1.0
    assert np.median(after) < 0.3 * np.median(before)
    face = head.regions["face"]
    moved = _posed(head, betas, found)[:, face] - _posed(head, betas, still)[:, face]
    assert np.linalg.norm(moved, axis=2).max() < 1e-3
    assert (found.expression == still.expression).all()


def test_the_truth_stays(filmed):
    head, betas, truth, *pictures = filmed
    found = shoulders.follow(head, betas, truth, *pictures)
    assert np.median(_turn_errors(found, truth)) < 0.7


def test_what_shows_no_shoulders_is_left_as_it_is(filmed):
    head, betas, truth, greys, corners, side = filmed
    still = _held_still(head, betas, truth)
    above = corners - np.array([0, 2 * side])
    found = shoulders.follow(head, betas, still, greys, above, side)
    np.testing.assert_allclose(found.pose, still.pose, atol=1e-12)
    np.testing.assert_allclose(found.translation, still.translation, atol=1e-12)


def test_cancelled(filmed):
    head, betas, truth, *pictures = filmed
    with pytest.raises(Cancelled):
        shoulders.follow(head, betas, truth, *pictures, should_stop=lambda: True)
