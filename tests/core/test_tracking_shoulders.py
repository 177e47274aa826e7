"""Shoulders followed through the studio's own pictures, whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
import studio_truth

from pav_blender.core.errors import Cancelled
from pav_blender.core.tracking import shoulders
from pav_blender.core.tracking.landmark_model import axis_angles, rotations

FRAMES = 24


@pytest.fixture(scope="module")
def crop():
    return studio_truth.filmed("crop", FRAMES)


def _follow(seen, fit, *, above=0, **options):
    """above: how many pixels the windows lie above the pictures."""
    side = seen.clip.width
    greys = np.stack([shoulders.grey_window(rgb, np.zeros(2, int), side) for rgb in seen.pictures])
    corner = -seen.clip.intrinsics[0, :2, 2].astype(np.float64) - [0, above]
    corners = np.tile(corner, (len(greys), 1))
    return shoulders.follow(seen.head, seen.betas, fit, greys, corners, side, **options)


def _turn_error(fit, truth):
    """Degrees, a frame's median, apart from what is the same in all frames."""
    body = rotations(truth.pose[:, 0])
    turns = axis_angles(body.transpose(0, 2, 1) @ rotations(fit.pose[:, 0]))
    return np.median(np.degrees(np.linalg.norm(turns - np.median(turns, axis=0), axis=1)))


def _face(seen, fit):
    parts = (part.astype(np.float32) for part in (fit.expression, fit.pose, fit.translation))
    return seen.head.pose(seen.betas, *parts).numpy()[:, seen.head.regions["face"]]


def test_shoulders_turn_as_they_were_filmed_and_the_head_stays(crop):
    still = studio_truth.held_still(crop)
    found = _follow(crop, still)
    before = _turn_error(still, crop.fit)
    assert before > 1.0
    assert _turn_error(found, crop.fit) < 0.3 * before
    assert np.linalg.norm(_face(crop, found) - _face(crop, still), axis=2).max() < 1e-3
    assert (found.expression == still.expression).all()


def test_the_truth_stays(crop):
    assert _turn_error(_follow(crop, crop.fit), crop.fit) < 0.7


@pytest.mark.parametrize(("frames", "least"), [(24, 1.0), (45, 0.8)])
def test_long_hair_does_not_turn_them(frames, least):
    """In fewer frames they turn less, and there is less to tell them from hair by."""
    seen = studio_truth.filmed("long", frames)
    still = studio_truth.held_still(seen)
    assert _turn_error(_follow(seen, still), seen.fit) < least * _turn_error(still, seen.fit)


def test_what_goes_with_the_head_is_not_followed(crop):
    """A head that turns as the shoulders were filmed: pictures cannot tell whose turn that is."""
    still = studio_truth.held_still(crop)
    body = rotations(still.root).T @ rotations(crop.fit.pose[:, 0])
    pose = still.pose.copy()
    pose[:, 1] = axis_angles(body)
    found = _follow(crop, replace(still, pose=pose))
    assert _turn_error(found, crop.fit) > 0.8 * _turn_error(still, crop.fit)


def test_what_shows_no_shoulders_is_left_as_it_is(crop):
    still = studio_truth.held_still(crop)
    assert _follow(crop, still, above=2 * crop.clip.width) is still


def test_cancelled(crop):
    with pytest.raises(Cancelled):
        _follow(crop, crop.fit, should_stop=lambda: True)
