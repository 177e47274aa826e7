"""Measuring a track against the truth, on errors that were put there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pav_blender.benchmarks.track import claims, film
from pav_blender.core.collection import read_collection
from pav_blender.core.errors import InputError
from pav_blender.core.evaluation.tracking import compare
from pav_blender.core.images import read_rgba
from pav_blender.core.tracking import shoulders, track
from pav_blender.core.tracking.decode import open_video
from pav_blender.core.tracking.landmark_model import axis_angles, rotations

STUDIO = Path(__file__).parents[2] / "data" / "studio3"


@pytest.fixture(scope="module")
def truth():
    return _first(12)


def _first(frames):
    collection = read_collection(STUDIO)
    clip = collection.clips[0]
    rows = clip.indices("train")[:frames]
    parts = ("expression", "pose", "translation", "intrinsics", "camera_to_world", "frame_id")
    few = replace(
        clip, split=clip.split[rows], **{name: getattr(clip, name)[rows] for name in parts}
    )
    few.vertices = None
    return replace(collection, clips=[few])


def _found(truth, **changes):
    clip = replace(truth.clips[0], **changes)
    focal = float(clip.intrinsics[0, 0, 0])
    extra = {"tracking": {"clips": [{"name": clip.name, "focal_pixels": focal}]}}
    return replace(truth, clips=[clip], extra=extra)


def test_the_truth_has_no_error(truth):
    errors = compare(truth, _found(truth))
    assert errors.frames == errors.filmed == 12
    assert errors.reprojection_px < 1e-3
    assert errors.rotation_deg < 1e-2
    assert errors.rotation_mean_deg < 1e-2
    assert errors.yaw_percent < 0.1
    assert errors.shoulders_px < 1e-3
    assert errors.expression_mm < 1e-3
    assert errors.shape_mm < 1e-3
    assert errors.focal_percent == 0
    assert errors.jitter == pytest.approx(1, abs=1e-4)


def test_a_turn_and_a_smile_too_much_are_told_apart(truth):
    pose = truth.clips[0].pose.astype(np.float64)
    turned = pose.copy()
    turned[:, 1] = axis_angles(rotations(pose[:, 1]) @ rotations(np.radians([0, 2.0, 0])))
    errors = compare(truth, _found(truth, pose=turned.astype(np.float32)))
    assert errors.rotation_deg == pytest.approx(2, abs=0.01)
    assert errors.expression_mm < 1e-3
    assert errors.reprojection_px > 0.5
    wide = truth.clips[0].expression.copy()
    wide[:, truth.head.expression_names.index("mouthSmileLeft")] += 0.5
    errors = compare(truth, _found(truth, expression=wide))
    assert errors.rotation_deg < 1e-2
    assert errors.expression_mm > 0.2


def test_a_turn_too_far_is_told_apart_from_a_head_that_looks_aside(truth):
    """Of a turn error, what is the same throughout a clip, and what grows with the turn."""
    pose = truth.clips[0].pose.astype(np.float64)
    camera = truth.clips[0].camera_to_world[:, :3, :3].astype(np.float64)
    shoulders = np.linalg.inv(camera) @ rotations(pose[:, 0])
    turns = shoulders @ rotations(pose[:, 1])
    left, _, right = np.linalg.svd(turns.mean(axis=0))
    swing = axis_angles(turns @ (left @ right).T)
    aside = np.tile(np.radians([0.0, 2.0, 0.0]), (len(pose), 1))
    farther = swing * (0, 0.1, 0)
    for more, mean, share in ((aside, 2, 0), (farther - farther.mean(axis=0), 0, 10)):
        turned = pose.copy()
        turned[:, 1] = axis_angles(np.linalg.inv(shoulders) @ rotations(more) @ turns)
        errors = compare(truth, _found(truth, pose=turned.astype(np.float32)))
        assert errors.rotation_mean_deg == pytest.approx(mean, abs=0.05)
        assert errors.yaw_percent == pytest.approx(share, abs=0.5)


def test_shoulders_are_told_apart_from_the_head_and_from_how_they_rest(truth):
    """Shoulders lean by 3 degrees under a head that stays: in every other frame, then in all."""
    pose = truth.clips[0].pose.astype(np.float64)
    lean = rotations(np.radians([0, 0, 3.0]))
    found = []
    for leaning in (np.arange(len(pose)) % 2 == 1, np.ones(len(pose), bool)):
        bent, shift = pose.copy(), truth.clips[0].translation.copy()
        was = rotations(pose[leaning, 0])
        body = was @ lean
        bent[leaning, 0] = axis_angles(body)
        turned = body.transpose(0, 2, 1) @ was @ rotations(pose[leaning, 1])
        bent[leaning, 1] = axis_angles(turned)
        joints = truth.head.joints(truth.betas)
        shift[leaning] += (was - body) @ (joints[1] - joints[0])
        change = {"pose": bent.astype(np.float32), "translation": shift.astype(np.float32)}
        found.append(compare(truth, _found(truth, **change)))
    assert found[0].shoulders_px > 1
    assert found[1].shoulders_px < 0.2 * found[0].shoulders_px
    assert max(errors.rotation_deg for errors in found) < 1e-2
    assert max(errors.reprojection_px for errors in found) < 0.1


def test_another_person_with_the_same_motion(truth):
    other = replace(_found(truth), betas=truth.betas * 0.5)
    errors = compare(truth, other)
    assert errors.shape_mm > 1
    assert errors.expression_mm < errors.shape_mm
    assert errors.face_mm > errors.expression_mm


def test_trembling_is_counted_against_the_truths_own(truth):
    shaken = truth.clips[0].translation.copy()
    shaken[::2, 0] += 0.004
    errors = compare(truth, _found(truth, translation=shaken))
    assert errors.jitter > 1.5


def test_frames_may_have_been_filmed_smaller(truth):
    """The same track, its focal length told in the pixels of frames half as wide."""
    found = _found(truth)
    found.extra["tracking"]["clips"][0]["focal_pixels"] /= 2
    half = compare(truth, found, size=truth.clips[0].width // 2)
    assert half.reprojection_px < 1e-3
    assert half.focal_percent < 1e-4
    assert half.jitter == pytest.approx(1, abs=1e-4)
    assert compare(truth, found).reprojection_px > 1


def test_what_cannot_be_compared_is_said(truth):
    with pytest.raises(InputError, match="focal length"):
        compare(truth, replace(truth, extra={}))
    numbers = truth.clips[0].frame_id + 1000
    with pytest.raises(InputError, match="shares no frame"):
        compare(truth, _found(truth, frame_id=numbers))


def test_a_film_shows_the_clip_before_a_room(truth, tmp_path):
    clip = truth.clips[0]
    frames = list(open_video(film(truth, clip, tmp_path / "a.mp4", 128, seed=3)).frames())
    assert len(frames) == len(clip)
    rgba = read_rgba(truth.image_path(clip, 5)).reshape(128, 2, 128, 2, 4).mean(axis=(1, 3))
    shown = frames[5].rgb.astype(float)
    assert shown.shape == (128, 128, 3)
    inside, outside = rgba[..., 3] == 255, rgba[..., 3] == 0
    assert np.abs(shown - rgba[..., :3])[inside].mean() < 8
    assert shown[outside].min() > 20  # a room, not the black of hidden pixels


@pytest.mark.faces
def test_tracked_shoulders_stay_on_what_they_wear(tmp_path, monkeypatch):
    pytest.importorskip("mediapipe", reason="the optional mediapipe is not installed")
    truth = _first(30)
    clip = truth.clips[0]
    video = film(truth, clip, tmp_path / f"{clip.name}.mp4", clip.width, seed=3)

    def errors():
        done = track([video], tmp_path / "out", size=96, cuts=False, overwrite=True)
        return compare(truth, read_collection(done.path))

    followed = errors()
    monkeypatch.setattr(shoulders, "follow", lambda head, betas, fit, *pictures: fit)
    hung = errors()
    assert followed.shoulders_px < 0.85 * hung.shoulders_px
    # the face is where it was, but for the skin between jaw and neck
    assert followed.reprojection_px == pytest.approx(hung.reprojection_px, abs=0.1)
    assert followed.rotation_deg == pytest.approx(hung.rotation_deg, abs=1e-3)


def test_a_bad_track_meets_no_claim():
    row = {"size": 512, "reprojection_px": 9.0, "rotation_deg": 9.0, "expression_mm": 9.0,
           "jitter": 9.0, "seconds_a_frame": 9.0}  # fmt: skip
    assert not any(claim.met for claim in claims([row, {**row, "size": 256}]))
