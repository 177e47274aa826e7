"""The head fit on landmarks made from the head itself, where every parameter is known."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from pav_blender.core.errors import Cancelled, InputError
from pav_blender.core.head import builtin_head
from pav_blender.core.rendering.cameras import Camera
from pav_blender.core.tracking import bordered, equations
from pav_blender.core.tracking.fit import fit_head, world
from pav_blender.core.tracking.landmark_model import (
    OFFSETS_PATH,
    LandmarkModel,
    PointModel,
    axis_angles,
    rotation_derivatives,
    rotations,
)
from pav_blender.core.tracking.observe import Observations

SIDE, FOCAL, AWAY = 256, 420.0, 0.7
_BETAS = 20


def _truth(head, frames, seed, shake=1.0):
    random = np.random.default_rng(seed)
    time = np.linspace(0, 2 * np.pi, frames)
    names = head.expression_names
    pose = np.zeros((frames, len(head.joint_names), 3))
    pose[:, 1, 1] = 0.35 * shake * np.sin(time)
    pose[:, 1, 0] = 0.15 * shake * np.sin(2 * time)
    pose[:, 1, 2] = 0.1 * shake * np.cos(time)
    pose[:, 3:, 1] = 0.15 * np.sin(3 * time)[:, None]
    expression = np.zeros((frames, len(names)))
    expression[:, names.index("jawOpen")] = 0.4 * np.sin(time) ** 2
    for name in ("mouthSmileLeft", "mouthSmileRight"):
        expression[:, names.index(name)] = 0.5 * np.cos(time / 2) ** 2
    for name in ("eyeBlinkLeft", "eyeBlinkRight"):
        expression[:, names.index(name)] = np.exp(-(((time - 3) / 0.2) ** 2))
    translation = np.zeros((frames, 3))
    translation[:, 0] = 0.01 * np.sin(time)
    translation[:, 2] = -AWAY + 0.02 * np.cos(time)
    return random.normal(0, 0.7, _BETAS), expression, pose, translation


def _seen(head, truth, *, noise, seed=0, numbers=None):
    betas, expression, pose, translation = truth
    model = LandmarkModel(head, _BETAS)
    posed = model.pose(betas, expression, pose, translation)
    points = posed.points + model.strayed(posed)
    pixels = points[..., :2] * [FOCAL, -FOCAL] / -points[..., 2:] + SIDE / 2
    depth = -points[..., 2:] * FOCAL / AWAY
    landmarks = np.concatenate([pixels, depth - depth.mean(axis=1, keepdims=True)], axis=2)
    landmarks[..., :2] += np.random.default_rng(seed).normal(0, noise, pixels.shape)
    numbers = np.arange(len(pixels)) if numbers is None else numbers
    return Observations(
        landmarks.astype(np.float32), None, (), numbers.astype(np.int32), [], SIDE, SIDE
    )


@pytest.fixture(scope="module")
def head():
    return builtin_head()


@pytest.fixture(scope="module")
def fitted(head):
    """Two clips of one head, with noise; the truth, what was seen, and the fit."""
    one = _truth(head, 36, seed=1)
    two = (one[0], *_truth(head, 28, seed=2, shake=0.6)[1:])
    seen = [_seen(head, truth, noise=0.4, seed=i) for i, truth in enumerate((one, two))]
    return (one, two), seen, fit_head(head, seen)


def _points(head, fit, clip):
    model = LandmarkModel(head, len(fit.betas))
    return model.pose(fit.betas, clip.expression, clip.pose, clip.translation)


def _pixels(points, focal):
    return points[..., :2] * [focal, -focal] / -points[..., 2:] + SIDE / 2


def test_fit_finds_the_pixels_it_was_given_without_their_noise(head, fitted):
    truths, _, fit = fitted
    for truth, clip in zip(truths, fit.clips, strict=True):
        clean = _seen(head, truth, noise=0).landmarks[..., :2]
        posed = _points(head, fit, clip)
        points = posed.points + LandmarkModel(head, len(fit.betas)).strayed(posed)
        missed = np.linalg.norm(_pixels(points, clip.focal) - clean, axis=2)
        assert np.median(missed) < 0.5
        assert np.percentile(missed, 95) < 2


def test_fit_finds_the_turn_of_the_head(head, fitted):
    truths, _, fit = fitted
    for truth, clip in zip(truths, fit.clips, strict=True):
        found = _points(head, fit, clip).turns[:, 1]
        off = np.linalg.norm(axis_angles(rotations(truth[2][:, 1]).swapaxes(1, 2) @ found), axis=1)
        # how the head is tilted and how its face is shaped trade places: that part is the same
        # in all frames, and what is learnt from a clip does not see it
        assert np.degrees(np.median(off)) < 3
        motion = found[1:] @ found[:-1].swapaxes(1, 2)
        true = rotations(truth[2][:, 1])
        true_motion = true[1:] @ true[:-1].swapaxes(1, 2)
        apart = np.linalg.norm(axis_angles(motion @ true_motion.swapaxes(1, 2)), axis=1)
        assert np.degrees(np.median(apart)) < 0.5


def test_fit_finds_the_expression(head, fitted):
    truths, _, fit = fitted
    for name, least in (("jawOpen", 0.9), ("eyeBlinkLeft", 0.8), ("mouthSmileLeft", 0.8)):
        column = head.expression_names.index(name)
        found = np.concatenate([clip.expression[:, column] for clip in fit.clips])
        true = np.concatenate([truth[1][:, column] for truth in truths])
        assert np.corrcoef(found, true)[0, 1] > least, name


def test_eyes_follow_the_irises(head, fitted):
    truths, _, fit = fitted
    gaze = np.concatenate([clip.pose[:, 3, 1] for clip in fit.clips])
    true = np.concatenate([truth[2][:, 3, 1] for truth in truths])
    assert np.corrcoef(gaze, true)[0, 1] > 0.8


def test_one_head_of_the_models_size_and_a_root_that_holds_still(head, fitted):
    _, _, fit = fitted
    assert fit.betas.shape[0] <= len(head.shape_basis)
    shaped = head.landmarks(head.shaped(fit.betas.astype(np.float32)))
    mean = head.landmarks(head.template)
    size = np.linalg.norm(shaped - shaped.mean(0)) / np.linalg.norm(mean - mean.mean(0))
    assert abs(size - 1) < 0.03
    for clip in fit.clips:
        assert (clip.pose[:, 0] == clip.root).all()
        assert np.abs(clip.pose[:, 2]).max() < 0.05  # jawOpen opens the mouth, not the joint
        assert clip.expression.min() > -0.05
        assert clip.expression.max() < 1.05


def test_a_shaking_detector_does_not_shake_the_head(head):
    still = _truth(head, 30, seed=3, shake=0.0)
    noisy = _seen(head, still, noise=0.8, seed=5)
    # what makes real detections shake: all landmarks of a frame err together
    jitter = np.random.default_rng(6).normal(0, 0.5, (30, 1, 2))
    noisy.landmarks[..., :2] += jitter.astype(np.float32)
    clip = fit_head(head, [noisy]).clips[0]
    moved = np.diff(clip.translation[:, :2] - still[3][:, :2], axis=0)
    raw = np.diff(jitter[:, 0] * AWAY / FOCAL, axis=0)
    assert moved.std() < 0.6 * raw.std()


@pytest.mark.parametrize("sway", [0.0, 0.1])
def test_the_world_shows_the_same_picture(head, fitted, sway):
    """With shoulders that hold still throughout the clip, and with some that follow its frames."""
    _, _, fit = fitted
    clip = fit.clips[0]
    swaying = np.random.default_rng(4).normal(0, sway, (len(clip.pose), 3))
    pose = clip.pose.copy()
    pose[:, 0] = axis_angles(rotations(clip.root) @ rotations(swaying)) if sway else clip.root
    clip = replace(clip, pose=pose)
    moved, camera = world(head, fit.betas, clip)
    intrinsics = np.array([[clip.focal, 0, SIDE / 2], [0, clip.focal, SIDE / 2], [0, 0, 1]])
    before = _pixels(_points(head, fit, clip).points, clip.focal)
    points = _points(head, fit, moved).points
    for row in (0, 17):
        after, depth = Camera(SIDE, SIDE, intrinsics, camera).project(points[row])
        assert np.abs(after - before[row]).max() < 1e-6
        assert depth.min() > 0.3
    np.testing.assert_allclose(moved.pose[:, 0], swaying, atol=1e-7 if sway else 0)
    assert np.abs(np.median(moved.translation, axis=0)).max() < 5e-3
    assert camera[2, 3] > 0.3  # in front of the face, which looks along +z


def test_fit_is_the_same_every_time(head):
    seen = [_seen(head, _truth(head, 12, seed=4), noise=0.3)]
    first, second = fit_head(head, seen), fit_head(head, seen)
    assert np.array_equal(first.betas, second.betas)
    assert np.array_equal(first.clips[0].pose, second.clips[0].pose)


def test_frames_taken_together_or_in_pieces_make_one_fit(fitted, head, monkeypatch):
    _, seen, found = fitted
    assert len(seen[0]) > 2 * equations._CHUNK
    monkeypatch.setattr(equations, "_CHUNK", 1000)
    whole = fit_head(head, seen)
    assert np.abs(whole.betas - found.betas).max() < 1e-3
    for one, other in zip(whole.clips, found.clips, strict=True):
        assert one.focal == pytest.approx(other.focal, rel=1e-4)
        assert np.abs(one.pose - other.pose).max() < 1e-4


def test_gaps_and_very_short_clips(head):
    whole = _truth(head, 9, seed=8)
    numbers = np.array([0, 1, 2, 3, 40, 41, 42, 90, 91])
    fit = fit_head(head, [_seen(head, whole, noise=0.3, numbers=numbers)])
    assert np.isfinite(fit.clips[0].pose).all()
    single = tuple(value if value.ndim == 1 else value[:1] for value in whole)
    fit = fit_head(head, [_seen(head, single, noise=0.3)])
    assert fit.errors[0].shape == (1,)
    assert fit.errors[0][0] < 1


def test_stop_is_heeded(head):
    stop = threading.Event()
    seen = [_seen(head, _truth(head, 12, seed=4), noise=0.3)]
    with pytest.raises(Cancelled):
        fit_head(head, seen, progress=lambda _: stop.set(), should_stop=stop.is_set)


def test_a_head_without_landmarks_is_refused(head):
    bare = replace(
        head, landmark_triangles=np.zeros(0, np.int32), landmark_barycentrics=np.zeros((0, 3))
    )
    with pytest.raises(InputError, match="no landmark embedding"):
        LandmarkModel(bare, 4)


@pytest.mark.parametrize("correctives", [False, True])
def test_point_model_is_the_heads_and_its_derivatives_are_exact(head, correctives):
    random = np.random.default_rng(0)
    if correctives:  # as FLAME has them
        basis = random.normal(0, 1e-3, (36, *head.template.shape)).astype(np.float32)
        head = replace(head, pose_basis=basis)
    model = PointModel(head, 6, head.landmark_triangles, head.landmark_barycentrics)
    frames = 2
    betas, expression = random.normal(size=6), random.uniform(0, 1, (frames, model.expressions))
    pose, translation = random.normal(0, 0.3, (frames, 5, 3)), random.normal(size=(frames, 3))
    pose[0, 2] = 0
    posed = model.pose(betas, expression, pose, translation)
    full = head.pose(*(v.astype(np.float32) for v in (betas, expression, pose, translation)))
    assert np.abs(head.landmarks(full.numpy()) - posed.points).max() < 2e-6

    outer = random.normal(size=(frames, 478, 2, 3))
    slopes = model.jacobian(posed, pose, outer)

    def slope(index, change):
        values = [betas, expression, pose, translation]
        both = []
        for sign in (1, -1):
            moved = list(values)
            moved[index] = values[index] + sign * 1e-6 * change
            both.append(np.einsum("fldx,flx->fld", outer, model.pose(*moved).points))
        return (both[0] - both[1]) / 2e-6

    for column in (0, 5):
        change = np.eye(6)[column]
        assert np.abs(slope(0, change) - slopes.shape[..., column]).max() < 1e-5
    change = np.zeros_like(expression)
    change[:, 7] = 1
    assert np.abs(slope(1, change) - slopes.expression[..., 7]).max() < 1e-5
    for joint in range(5):
        for axis in range(3):
            change = np.zeros_like(pose)
            change[:, joint, axis] = 1
            assert np.abs(slope(2, change) - slopes.pose[..., 3 * joint + axis]).max() < 1e-5
    assert np.abs(slope(3, np.array([0, 1, 0.0])) - slopes.translation[..., 1]).max() < 1e-5


def test_rotations_and_their_derivatives_near_zero():
    for vector in ([0, 0, 0], [1e-7, 0, 2e-7], [0.3, -0.8, 0.1], [0, 3.0, 0]):
        vector = np.array(vector, np.float64)
        matrix = rotations(vector)
        assert np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        assert np.allclose(axis_angles(matrix), vector, atol=1e-8)
        slopes = rotation_derivatives(vector, matrix)
        for k in range(3):
            step = 1e-6 * np.eye(3)[k]
            numeric = (rotations(vector + step) - rotations(vector - step)) / 2e-6
            assert np.allclose(slopes[k], numeric, atol=1e-7)


@pytest.mark.parametrize("frames", [1, 2, 3, 7])
def test_bordered_solution_is_the_dense_one(frames):
    random = np.random.default_rng(frames)
    size, shared, clips = 4, 3, 2
    count = clips * frames * size
    normals, dense = [], np.zeros((count + shared, count + shared))
    right = np.zeros(count + shared)
    for clip in range(clips):
        half = random.normal(size=(frames, size, size + 2))
        own = half @ half.swapaxes(1, 2) + 8 * np.eye(size)
        border = random.normal(size=(frames, size, shared))
        common = 40 * np.eye(shared)
        gradient, pull = random.normal(size=(frames, size)), random.normal(size=shared)
        one, two = random.normal(size=(2, frames, size)) * 0.5
        normals.append(bordered.Normal(own, border, common, gradient, pull, (one, two)))
        start = clip * frames * size
        for frame in range(frames):
            at = start + frame * size
            dense[at : at + size, at : at + size] = own[frame]
            dense[at : at + size, count:] = border[frame]
            dense[count:, at : at + size] = border[frame].T
            right[at : at + size] = gradient[frame]
            for distance, coupling in ((1, one), (2, two)):
                if frame + distance < frames:
                    to = at + distance * size
                    dense[at : at + size, to : to + size] = np.diag(coupling[frame])
                    dense[to : to + size, at : at + size] = np.diag(coupling[frame])
        dense[count:, count:] += common
        right[count:] += pull
    dense[np.diag_indices(len(dense))] *= 1.1
    expected = -np.linalg.solve(dense, right)
    steps, last = bordered.solve(normals, 0.1)
    assert np.allclose(np.concatenate([*map(np.ravel, steps), last]), expected)


def test_landmarks_stand_where_the_detector_sees_them(head):
    """Off the built-in head's surface by what was measured, and turning with the head."""
    offsets = np.load(OFFSETS_PATH, allow_pickle=False)
    assert offsets.shape == (3, 478, 3)
    offsets, by_side = offsets[0], offsets[1:]
    assert 1e-4 < np.linalg.norm(offsets, axis=1).mean() < 6e-3
    plain = PointModel(head, 4, head.landmark_triangles, head.landmark_barycentrics)
    pose = np.zeros((1, len(head.joint_names), 3))
    pose[:, 1, 1] = 0.5
    nothing = np.zeros(4), np.zeros((1, len(head.expression_names))), pose, np.zeros((1, 3))
    moved = LandmarkModel(head, 4).pose(*nothing).points - plain.pose(*nothing).points
    turned = offsets @ rotations(pose[0, 1]).T
    still = head.skinning_weights[:, 1:].sum(axis=1) > 0.999
    skull = still[plain.corners].all(axis=1)
    skull &= head.skinning_weights[plain.corners, 1].min(axis=1) > 0.999
    assert skull.sum() > 100
    assert np.abs(moved[0, skull] - turned[skull]).max() < 1e-6
    # and by more the farther it is turned: here seen from its own right, by the sine of the turn
    model = LandmarkModel(head, 4)
    away = nothing[3] + (0, 0, -100)
    posed = model.pose(*nothing[:3], away)
    expected = -np.sin(0.5) * by_side[0] @ rotations(pose[0, 1]).T
    assert np.abs(model.strayed(posed)[0] - expected).max() < 1e-4
    other = replace(head, landmark_triangles=np.roll(head.landmark_triangles, 1))
    assert np.abs(LandmarkModel(other, 4).rest - PointModel(
        other, 4, other.landmark_triangles, other.landmark_barycentrics
    ).rest).max() == 0  # fmt: skip
