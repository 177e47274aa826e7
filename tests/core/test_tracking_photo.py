"""Photo-consistency on the studio's own pictures, whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
import studio_truth

from pav_blender.core.tracking import fit as fitting
from pav_blender.core.tracking import photo, terms
from pav_blender.core.tracking.fit import HeadFit, refine_head
from pav_blender.core.tracking.landmark_model import LandmarkModel, axis_angles, rotations
from pav_blender.core.tracking.observe import Observations
from pav_blender.core.tracking.terms import Photo, project

FRAMES = 16


@pytest.fixture(scope="module")
def filmed():
    """A studio clip: its truth as a fit, its frames, and landmarks without an error."""
    whole = studio_truth.filmed("crop", FRAMES)
    fit = studio_truth.held_still(whole)
    seen = _seen(LandmarkModel(whole.head, len(whole.betas)), whole.betas, fit, whole.clip.width)
    return whole.head, whole.betas, fit, seen, whole.pictures


def _seen(model, betas, fit, side):
    posed = model.pose(betas, fit.expression, fit.pose, fit.translation)
    pixels = project(posed.points + model.strayed(posed), fit.focal) + side / 2
    landmarks = np.concatenate([pixels, np.zeros_like(pixels[..., :1])], axis=2)
    numbers = np.arange(len(pixels), dtype=np.int32)
    return Observations(landmarks.astype(np.float32), None, (), numbers, [], side, side)


def _windows(seen, pictures):
    return photo.windows(pictures, seen.landmarks, seen.width, seen.height)


def _turned_wrong(fit, degrees):
    """Each frame's head turned by an error of its own about its neck."""
    wrong = np.radians(np.random.default_rng(5).normal(0, degrees, (FRAMES, 3)))
    pose = fit.pose.copy()
    pose[:, 1] = axis_angles(rotations(pose[:, 1]) @ rotations(wrong))
    return replace(fit, pose=pose)


def _turn_errors(fit, truth):
    """Degrees, apart from what is the same in all frames."""
    between = np.swapaxes(rotations(truth.pose[:, 1]), 1, 2) @ rotations(fit.pose[:, 1])
    turns = axis_angles(between)
    return np.degrees(np.linalg.norm(turns - np.median(turns, axis=0), axis=1))


def test_pictures_mend_what_landmarks_get_wrong(filmed, monkeypatch):
    """Landmarks that lie about each frame's turn: the skin tells it better, if it is listened to
    alone (landmarks without scatter weigh more than a detector's)."""
    monkeypatch.setattr(fitting, "_LANDMARKS_LEFT", 0.001)
    head, betas, truth, seen, pictures = filmed
    wrong = _turned_wrong(truth, 1.5)
    lied = _seen(LandmarkModel(head, len(betas)), betas, wrong, seen.width)
    start = HeadFit(betas, [wrong], [], [])
    found = refine_head(head, [lied], start, [_windows(seen, pictures)], rates=[10.0])
    before, after = _turn_errors(wrong, truth), _turn_errors(found.clips[0], truth)
    assert np.median(before) > 1.5
    assert np.median(after) < 0.5 * np.median(before)


def test_pictures_leave_the_truth_alone(filmed, monkeypatch):
    """With the say of twice as many frames: sixteen let what heads usually are pull too hard."""
    monkeypatch.setattr(terms, "_PHOTO_INDEPENDENT", 2 * terms._PHOTO_INDEPENDENT)
    head, betas, truth, seen, pictures = filmed
    start = HeadFit(betas, [truth], [], [])
    found = refine_head(head, [seen], start, [_windows(seen, pictures)], rates=[10.0])
    assert np.median(_turn_errors(found.clips[0], truth)) < 0.65
    shown = _seen(LandmarkModel(head, len(betas)), found.betas, found.clips[0], seen.width)
    off = np.linalg.norm(shown.landmarks - seen.landmarks, axis=2)
    assert np.median(off) < 0.7


def test_the_face_looks_more_alike_where_the_head_truly_is(filmed):
    head, betas, truth, seen, pictures = filmed
    points = photo.face_points(head, len(betas))

    def unlike(fit):
        term = Photo(points, _windows(seen, pictures))
        term.look(betas, fit)
        residual, inside = term.residual(betas, fit)
        return np.median(np.abs(residual[(term.seen > 0.5) & inside]))

    assert unlike(truth) < 0.8 * unlike(_turned_wrong(truth, 1.5))


def test_photo_slopes_are_the_costs(filmed):
    """The gradient that `linearised` gives against differences of the cost."""
    head, betas, truth, seen, pictures = filmed
    fit = _turned_wrong(truth, 1.0)
    term = Photo(photo.face_points(head, len(betas)), _windows(seen, pictures))
    term.look(betas, fit)
    term.weigh(betas, fit)
    residual, slopes = term.linearised(betas, fit, slice(0, 1))
    gradient = 2 * (slopes[0].T @ residual[0])
    for column, axis, step in ((1, 1, 1e-4), (0, 0, 1e-4)):  # the neck's turn and nod
        costs = []
        for sign in (1, -1):
            pose = fit.pose.copy()
            pose[0, 1, axis] += sign * step
            costs.append(term.cost(betas, replace(fit, pose=pose)))
        assert gradient[column] == pytest.approx((costs[0] - costs[1]) / (2 * step), rel=0.1)


def test_steep_places_keep_their_say_where_skin_is_a_pixel_off(monkeypatch):
    """A nostril a pixel off its place differs as much as a hand before a cheek; it is no hand."""
    residual = np.random.default_rng(0).normal(0, 0.1, (6, 400))
    steep, hidden = np.arange(400) < 40, np.arange(400) >= 360
    residual[:, steep | hidden] = 0.6
    gradient = np.zeros((6, 400, 2))
    gradient[:, steep, 0] = 0.6 * 0.5  # a source pixel, of which a window's has two
    whole = np.ones((6, 400))
    windows = photo.Pictures(np.zeros((6, 4, 4), np.int8), np.zeros((6, 2)), np.full(6, 0.5))
    term = Photo(None, windows, seen=whole)
    monkeypatch.setattr(term, "_compared", lambda *_: (residual, whole > 0, gradient))
    term.weigh(None, None)
    plain = term.weights[:, 40:360].mean()
    assert term.weights[:, steep].mean() > 0.5 * plain
    assert term.weights[:, hidden].mean() < 0.1 * plain


def test_a_hand_before_the_face_does_not_enter_the_template():
    random = np.random.default_rng(0)
    look = random.normal(0, 1, 50)
    values = look + random.normal(0, 0.02, (20, 50))
    values[:5, :20] = 3.0
    found, _ = photo.templates(values, np.ones_like(values))
    assert np.abs(found - look).max() < 0.1
    assert np.abs(values.mean(axis=0) - look).max() > 0.3


def test_points_of_the_far_cheek_are_hidden(filmed):
    head, betas, truth, seen, pictures = filmed
    points = photo.face_points(head, len(betas))
    pose = truth.pose.copy()
    pose[:, 0] = 0
    pose[:, 1] = (0, np.radians(75), 0)
    fit = replace(truth, pose=pose)
    posed = points.pose(betas, fit.expression, fit.pose, fit.translation)
    looked = _seen(LandmarkModel(head, len(betas)), betas, fit, seen.width)
    windows = photo.windows(pictures, looked.landmarks, seen.width, seen.height)
    shown = photo.visible(points, betas, fit, posed.points, windows)[0]
    side = (head.template[points.corners].mean(axis=1))[:, 0]
    assert shown[side < -0.04].mean() > 0.8
    assert shown[side > 0.04].mean() < 0.3


def test_a_window_may_reach_beyond_the_frame():
    frame = np.full((40, 30, 3), 90, np.uint8)
    landmarks = np.zeros((1, 478, 3), np.float32)
    landmarks[0, :, 0] = np.linspace(-10, 50, 478)
    landmarks[0, :, 1] = np.linspace(-20, 60, 478)
    pictures = photo.windows([frame], landmarks, 30, 40)
    assert pictures.features.shape == (1, photo.SIDE, photo.SIDE)
    values, gradient, inside = photo.sample(pictures, np.array([[[0.0, 0.0], [500.0, 0.0]]]))
    assert inside.tolist() == [[True, False]]
    assert np.isfinite(values).all()
    assert (gradient == 0).all()


def test_a_point_that_leaves_its_window_makes_no_jump(filmed):
    """A jump in the cost, however small, stops the whole fit: no step of any length lowers it."""
    head, betas, truth, seen, pictures = filmed
    term = Photo(photo.face_points(head, len(betas)), _windows(seen, pictures))
    term.look(betas, truth)
    term.weigh(betas, truth)
    costs, inside = [], []
    for aside in np.linspace(0.1, 0.101, 300):  # metres: half of the face is outside
        fit = replace(truth, translation=truth.translation + np.array([aside, 0, 0]))
        costs.append(term.cost(betas, fit))
        inside.append(term.residual(betas, fit)[1])
    assert (inside[0] & ~inside[-1] & (term.weights > 0)).sum() > 100
    steps = np.abs(np.diff(costs))
    assert steps.max() < 3 * np.median(steps)
