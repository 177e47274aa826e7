"""Which frames a track uses: cuts, people, reasons, spread; with made-up sightings, no network."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.errors import InputError
from pav_blender.core.head import builtin_head
from pav_blender.core.tracking import sift
from pav_blender.core.tracking.landmark_model import LandmarkModel
from pav_blender.core.tracking.looking import SHORTEST, Take, choose_shots
from pav_blender.core.tracking.observe import Sightings, sharpness
from pav_blender.core.tracking.people import apart, choose, follow, shape_of
from pav_blender.core.tracking.pictures import natural
from pav_blender.core.tracking.shots import cut_into_shots
from pav_blender.core.tracking.spread import farthest, splits, spread
from pav_blender.core.tracking.track import appearance_names

WIDTH, HEIGHT = 640, 360


@pytest.fixture(scope="module")
def model():
    return LandmarkModel(builtin_head(), 12)


def heads(model, betas, yaw, shift=0.0, opened=None):
    """Landmarks of a head [F, 478, 3], as a detector gives them, turned by `yaw` [F] and `shift`
    pixels beside the middle."""
    frames = len(yaw)
    pose = np.zeros((frames, 5, 3))
    pose[:, 1, 1] = yaw
    expression = np.zeros((frames, model.expressions))
    if opened is not None:
        expression[:, model.head.expression_names.index("jawOpen")] = opened
    translation = np.tile([0.0, 0.0, -1.0], (frames, 1))
    points = model.pose(np.asarray(betas, float), expression, pose, translation).points
    pixels = points[..., :2] * [600, -600] / -points[..., 2:] + [WIDTH / 2 + shift, HEIGHT / 2]
    depth = -points[..., 2:] * 600
    return np.concatenate([pixels, depth - depth.mean(axis=1, keepdims=True)], axis=2)


def sightings(faces, thumbs=None):
    """faces: a list a frame of landmarks [478, 3]."""
    row = np.array([i for i, here in enumerate(faces) for _ in here], np.int64)
    landmarks = np.array([face for here in faces for face in here], np.float32)
    count = len(faces)
    grey = np.full((count, 16, 16, 3), 120, np.uint8)
    return Sightings(
        np.arange(count, dtype=np.int32),
        grey if thumbs is None else thumbs,
        np.full((count, 2, 21, 2), np.nan, np.float32),
        row,
        landmarks,
        np.zeros((len(row), 0), np.float32),
        np.ones(len(row), np.float32),
        np.full((1, HEIGHT, 64), 99, np.uint8),
        np.full((1, WIDTH, 64), 99, np.uint8),
        (),
        WIDTH,
        HEIGHT,
    )


class Named:
    """A source that is only asked for its name."""

    def __init__(self, path):
        self.path, self.rate, self.count, self.warnings = path, 25.0, 0, []


def chosen(tmp_path, *seen, most=None, cuts=True):
    takes = [
        Take(Named(tmp_path / f"{name}.mp4"), one, 1, name, name)
        for name, one in zip("abc", seen, strict=False)
    ]
    return choose_shots(takes, most, cuts=cuts)


def rooms(*lengths):
    """Thumbnails of one noisy room after another."""
    random = np.random.default_rng(3)
    parts = []
    for length in lengths:
        room = random.integers(0, 255, (1, 16, 16, 3))
        room = room * np.array(random.uniform(0.3, 1, 3))
        parts.append(np.clip(room + random.normal(0, 3, (length, 16, 16, 3)), 0, 255))
    return np.concatenate(parts).astype(np.uint8)


def test_each_shot_becomes_a_clip_and_short_ones_are_listed(model, tmp_path):
    faces = [[face] for face in heads(model, np.zeros(12), np.linspace(-0.2, 0.2, 44))]
    seen = sightings(faces, rooms(20, 4, 20))
    assert [len(rows) for rows in cut_into_shots(seen)] == [20, 4, 20]
    looked = chosen(tmp_path, seen)
    assert [shot.name for shot in looked.shots] == ["a_1", "a_2"]
    assert {shot.appearance for shot in looked.shots} == {"a"}
    assert looked.shots[1].seen.frame_id.tolist() == list(range(24, 44))
    (skipped,) = looked.skipped
    assert (skipped["first"], skipped["last"], skipped["reason"]) == (20, 23, sift.SHORT_SHOT)
    named = [Take(Named(tmp_path / name), seen, 1, name, name) for name in ("a_2", "a")]
    names = [shot.name for shot in choose_shots(named, None).shots]
    assert names == ["a_2_1", "a_2_2", "a_1", "a_3"]
    whole = chosen(tmp_path, seen, cuts=False)
    assert [(shot.name, len(shot.seen)) for shot in whole.shots] == [("a", 44)]


def test_what_moves_is_no_cut(model):
    faces = [[face] for face in heads(model, np.zeros(12), np.zeros(30))]
    assert len(cut_into_shots(sightings(faces))) == 1
    # the camera turns: everything changes, evenly
    wide = rooms(1)[0].repeat(4, axis=1)[:, :64]
    panned = np.stack([wide[:, i : i + 16] for i in range(30)])
    assert len(cut_into_shots(sightings(faces, panned))) == 1
    # light comes up over a second
    light = (rooms(1) * np.linspace(0.3, 1, 30)[:, None, None, None]).astype(np.uint8)
    assert len(cut_into_shots(sightings(faces, light))) == 1


def test_single_photographs_are_one_clip_with_a_warning(model, tmp_path):
    faces = [[face] for face in heads(model, np.zeros(12), np.linspace(-0.3, 0.3, 9))]
    for lengths in ([1] * 9, [3] * 3):  # each in a room of its own; three bursts
        looked = chosen(tmp_path, sightings(faces, rooms(*lengths)))
        assert [len(shot.seen) for shot in looked.shots] == [9]
    assert "photographs" in looked.warnings[0]
    assert SHORTEST > 3


def test_the_person_is_the_face_that_comes_back(model, tmp_path):
    random = np.random.default_rng(0)
    person, other, third = random.normal(0, 1.5, (3, 12))
    yaw = np.linspace(-0.15, 0.15, 14)
    mine, theirs = heads(model, person, yaw, -120), heads(model, other, -yaw, 120)
    both = sightings([list(pair) for pair in zip(theirs, mine, strict=True)])
    alone = sightings([[face] for face in heads(model, person, yaw[::-1], 60)])
    assert apart(shape_of(mine), shape_of(theirs)) > 2 * apart(
        shape_of(mine), shape_of(alone.landmarks)
    )
    looked = chosen(tmp_path, both, alone)
    assert looked.warnings == []
    assert np.allclose(looked.shots[0].seen.landmarks, mine, atol=1e-3)
    assert len(looked.shots[1].seen) == 14
    # nobody of the first clip is in the other: told, and its own face is used
    stranger = sightings([[face] for face in heads(model, third, yaw)])
    looked = chosen(tmp_path, alone, stranger)
    assert len(looked.warnings) == 1
    assert len(looked.shots) == 2


def test_frames_that_show_only_another_are_listed(model, tmp_path):
    random = np.random.default_rng(0)
    person, other = random.normal(0, 1.5, (2, 12))
    yaw = np.linspace(-0.1, 0.1, 30)
    faces = [[face] for face in heads(model, person, yaw, -120)]
    faces[12:15] = [[face] for face in heads(model, other, yaw[:3], 120)]
    faces[20] = []
    (shot,) = chosen(tmp_path, sightings(faces)).shots
    assert shot.left_out == {sift.OTHER_FACE: [12, 13, 14], sift.NO_FACE: [20]}
    assert len(shot.seen) == 26


def test_two_faces_are_followed_through_gaps(model):
    yaw = np.zeros(12)
    left, right = heads(model, np.zeros(12), yaw, -120), heads(model, np.zeros(12), yaw, 120)
    faces = [[b, a] if i % 2 else [a, b] for i, (a, b) in enumerate(zip(left, right, strict=True))]
    faces[5] = faces[5][:1]
    seen = sightings(faces)
    tracks = follow(seen, 0, 0, np.arange(12))
    assert sorted(len(track.faces) for track in tracks) == [11, 12]
    for track in tracks:
        middles = seen.landmarks[track.faces].mean(axis=(1, 2))
        assert np.ptp(middles) < 5
    kept, absent = choose(tracks)
    assert len(kept) == 1  # of two alike the larger, never two faces in a frame
    assert absent == []


def test_hands_over_the_face_and_beside_it(model):
    seen = sightings([[face] for face in heads(model, np.zeros(12), np.zeros(30))])
    middle = seen.landmarks[0, :, :2].mean(axis=0)
    fan = np.random.default_rng(0).uniform(-15, 15, (21, 2))
    seen.hands[8:11, 0] = middle + fan
    seen.hands[14, 1] = middle + fan  # found again: it was there in between
    seen.hands[20:, 0] = middle + np.array([200, 0]) + fan
    bad = sift.covered(seen, np.arange(30))
    assert np.flatnonzero(bad).tolist() == list(range(6, 17))
    assert not sift.covered(seen, np.arange(20, 30)).any()


def test_blur_and_jumps_are_found(model):
    seen = sightings(
        [[face] for face in heads(model, np.zeros(12), 0.3 * np.sin(np.arange(40) / 5))]
    )
    seen.sharpness[:] = np.random.default_rng(0).uniform(0.7, 1.3, 40)
    seen.sharpness[[4, 5]] = 0.1
    steady = seen.landmarks.copy()
    steady[:, [13, 14]] += np.random.default_rng(1).normal(0, 9, (40, 2, 3))  # lips may move
    seen.landmarks[:] = steady
    assert not sift.jumping(seen, np.arange(40)).any()
    seen.landmarks[17, :150, 0] += 25
    faces, left_out = sift.sift(seen, np.arange(40), np.arange(40))
    assert left_out == {sift.BLURRED: [4, 5], sift.JUMPING: [17]}
    assert len(faces) == 37


def test_a_blurred_picture_is_less_sharp_whatever_its_light_and_size():
    random = np.random.default_rng(0)
    hill = 100 * np.exp(-(np.linspace(-2, 2, 200) ** 2))
    sharp = 60 + hill[:, None] * hill[None] / 100 + random.uniform(0, 60, (200, 200))
    sharp = np.repeat(sharp[..., None], 3, axis=2)
    soft = sharp.copy()
    for _ in range(8):
        soft = (soft + np.roll(soft, 1, 0) + np.roll(soft, 1, 1)) / 3
    points = np.array([[10, 10, 0], [190, 190, 0]], np.float32)
    values = [sharpness(p.astype(np.uint8), points) for p in (sharp, sharp * 0.3, soft)]
    assert values[1] == pytest.approx(values[0], rel=0.05)
    assert values[2] < 0.2 * values[0]
    assert sharpness(sharp.astype(np.uint8), points / 100) == 0


def test_chosen_frames_differ_more_than_evenly_spaced_ones(model):
    # a long look ahead, one turn of the head, one word
    yaw, opened = np.zeros(400), np.zeros(400)
    yaw[200:220] = 0.6 * np.sin(np.linspace(0, np.pi, 20))
    opened[300:310] = 0.8
    seen = sightings([[face] for face in heads(model, np.zeros(12), yaw, opened=opened)])
    seen = seen.observations(np.arange(400))
    rows = spread(seen, 20)
    assert len(rows) == 20
    assert (np.diff(rows) > 0).all()
    even = np.linspace(0, 399, 20).astype(int)
    assert yaw[rows].max() > 0.55
    assert np.count_nonzero(yaw[rows] > 0.1) > np.count_nonzero(yaw[even] > 0.1) + 3
    assert opened[rows].max() == 0.8
    held = rows[splits(20) == "test"]
    assert (held >= 360).all()
    assert (rows[splits(20) == "train"] < 360).all()
    assert np.array_equal(spread(seen, None), np.arange(400))
    assert np.array_equal(spread(seen, 400), np.arange(400))
    assert len(spread(seen, 1)) == 1


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 30), st.integers(0, 40), st.integers(0, 5))
def test_farthest_points_are_distinct_and_in_order(count, wanted, seed):
    features = np.random.default_rng(seed).integers(0, 3, (count, 2)).astype(float)
    rows = farthest(features, wanted)
    assert len(rows) == min(count, wanted)
    assert (np.diff(rows) > 0).all()


def test_appearances_by_clip_or_in_order():
    names = ["a", "b", "c"]
    assert appearance_names(names, None) == names
    assert appearance_names(names, ["x", "y", "x"]) == ["x", "y", "x"]
    assert appearance_names(names, ["beard=b,c"]) == ["a", "beard", "beard"]
    for wrong in (["x"], ["x=d"], ["x=a", "y=a"], ["=a"], ["x=a", "y"], ["x=a,a"]):
        with pytest.raises(InputError, match="appearance"):
            appearance_names(names, wrong)


def test_natural_order():
    names = ["f10.png", "f2.png", "F1.png", "a.png", "10.png", "9.png", "f2b.png"]
    ordered = ["9.png", "10.png", "a.png", "F1.png", "f2.png", "f2b.png", "f10.png"]
    assert sorted(names, key=natural) == ordered


@given(st.lists(st.text(max_size=6)))
def test_any_names_can_be_ordered(names):
    assert len(sorted(names, key=natural)) == len(names)


@given(st.sets(st.integers(0, 60)))
def test_ranges_name_every_number_once(numbers):
    back = []
    for part in filter(None, sift.ranges(list(numbers)).split(", ")):
        first, _, last = part.partition("-")
        back += range(int(first), int(last or first) + 1)
    assert back == sorted(numbers)
