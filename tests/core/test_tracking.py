"""From video files to a collection: decoding, observing, cropping, mattes, and what goes wrong."""

import os
import struct
import sys
import threading
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

av = pytest.importorskip("av")

from pav_blender.core.collection import read_collection  # noqa: E402
from pav_blender.core.errors import Cancelled, InputError  # noqa: E402
from pav_blender.core.head import builtin_head  # noqa: E402
from pav_blender.core.images import read_rgba  # noqa: E402
from pav_blender.core.tracking import matte, track  # noqa: E402
from pav_blender.core.tracking.cache import Cache  # noqa: E402
from pav_blender.core.tracking.crop import (  # noqa: E402
    Crop,
    content_box,
    cut,
    edges,
    plan_crop,
)
from pav_blender.core.tracking.decode import open_video  # noqa: E402
from pav_blender.core.tracking.detectors import Face, quiet  # noqa: E402
from pav_blender.core.tracking.landmark_model import LandmarkModel  # noqa: E402
from pav_blender.core.tracking.observe import Observations, observe  # noqa: E402
from pav_blender.core.tracking.sift import ranges  # noqa: E402
from pav_blender.core.tracking.spread import splits  # noqa: E402
from pav_blender.core.tracking.track import clip_names  # noqa: E402

CLIPS = Path(__file__).resolve().parents[3] / "shared" / "clips"
HEIGHT, WIDTH = 120, 160
detectors = sys.modules["pav_blender.core.tracking.detectors"]


def write_video(path, pictures, *, rate=25, sound=False, aspect=None, turn=None):
    with av.open(str(path), "w") as container:
        if pictures is not None:
            stream = container.add_stream("mpeg4", rate=rate)
            height, width = pictures[0].shape[:2]
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.bit_rate = 4_000_000
            if aspect:
                stream.codec_context.sample_aspect_ratio = aspect
            for picture in pictures:
                frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        if sound:
            stream = container.add_stream("aac", rate=16000)
            frame = av.AudioFrame(format="fltp", layout="mono", samples=1024)
            frame.sample_rate = 16000
            for plane in frame.planes:
                plane.update(bytes(plane.buffer_size))
            container.mux(stream.encode(frame))
            container.mux(stream.encode())
    return path


def grey_steps(count):
    """Frames told apart by their brightness, with a mark in the upper left corner."""
    pictures = []
    for number in range(count):
        picture = np.full((HEIGHT, WIDTH, 3), 20 + 8 * number, np.uint8)
        picture[:30, :40] = 250
        pictures.append(picture)
    return pictures


@pytest.fixture(scope="module")
def steps(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("video") / "steps.mp4", grey_steps(12))


def test_decoding_gives_every_frame_or_those_asked_for(steps):
    video = open_video(steps)
    frames = list(video.frames())
    assert [frame.number for frame in frames] == list(range(12))
    assert video.rate == 25
    assert [abs(float(f.rgb[80, 80].mean()) - 20 - 8 * f.number) < 4 for f in frames] == [True] * 12
    assert [frame.number for frame in video.frames(every=5)] == [0, 5, 10]
    assert [frame.number for frame in video.frames(2, 3, 9)] == [4, 6, 8]
    assert video.warnings == []


def test_a_video_cut_short_gives_what_is_left_and_a_warning(tmp_path):
    random = np.random.default_rng(0)
    noisy = [random.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(20)]
    whole = write_video(tmp_path / "whole.avi", noisy)
    data = whole.read_bytes()
    part = tmp_path / "part.avi"
    part.write_bytes(data[: len(data) * 6 // 10])
    video = open_video(part)
    assert 5 < len(list(video.frames())) < 20
    assert len(video.warnings) == 1
    assert "part.avi" in video.warnings[0]
    assert "cut short" in video.warnings[0]


def test_damage_in_the_middle_is_passed_over(tmp_path):
    random = np.random.default_rng(0)
    noisy = [random.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(20)]
    path = write_video(tmp_path / "hurt.avi", noisy)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 30_000] = random.integers(0, 255, 30_000, dtype=np.uint8).tobytes()
    path.write_bytes(bytes(data))
    assert len(list(open_video(path).frames())) > 8


def test_pixels_that_are_not_square_are_made_so(tmp_path):
    path = write_video(tmp_path / "wide.mp4", grey_steps(2), aspect=Fraction(2))
    assert next(open_video(path).frames()).rgb.shape == (HEIGHT, 2 * WIDTH, 3)


# the first two rows of the display matrix in a file of a telephone held upright, and so on
@pytest.mark.parametrize(
    ("clockwise", "matrix", "corner"),
    [(90, (0, 1, -1, 0), (0, -1)), (180, (-1, 0, 0, -1), (-1, -1)), (270, (0, -1, 1, 0), (-1, 0))],
)
def test_pictures_are_turned_upright(steps, tmp_path, clockwise, matrix, corner):
    content = bytearray(steps.read_bytes())
    place = content.index(b"tkhd") + 44  # the track's header, then times, layer and volume
    a, b, c, d = (value << 16 for value in matrix)
    content[place : place + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path = tmp_path / "turned.mp4"
    path.write_bytes(content)
    rgb = next(open_video(path).frames()).rgb
    assert rgb.shape[:2] == ((HEIGHT, WIDTH) if clockwise == 180 else (WIDTH, HEIGHT))
    assert rgb[corner].min() > 200
    assert (rgb > 200).all(axis=2).sum() == pytest.approx(30 * 40, rel=0.1)


@pytest.mark.parametrize("kind", ["missing", "text", "empty", "folder", "sound"])
def test_what_is_not_a_video_is_told_in_one_line(tmp_path, kind):
    path = tmp_path / "clip.mp4"
    if kind == "text":
        path.write_text("hello, this is no video\n" * 40)
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "folder":
        path.mkdir()
    elif kind == "sound":
        path = write_video(tmp_path / "clip.m4a", None, sound=True)
    with pytest.raises(InputError) as caught:
        track([path], tmp_path / "out")
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert {entry.name for entry in tmp_path.iterdir()} <= {path.name}


def test_wrong_settings_are_refused(steps, tmp_path):
    for wrong in ({"size": 8}, {"every": 0}, {"max_frames": 0}, {"appearances": ["a", "b"]}):
        with pytest.raises(InputError):
            track([steps], tmp_path / "out", **wrong)
    with pytest.raises(InputError, match="no video"):
        track([], tmp_path / "out")
    (tmp_path / "there").mkdir()
    with pytest.raises(InputError, match="exists already"):
        track([steps], tmp_path / "there")


@pytest.mark.faces
def test_a_video_without_a_face_is_named_and_nothing_is_written(tmp_path):
    pytest.importorskip("mediapipe", reason="the optional mediapipe is not installed")
    random = np.random.default_rng(0)
    noise = [random.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(3)]
    path = write_video(tmp_path / "noise.mp4", noise)
    with pytest.raises(InputError, match="no face was found") as caught:
        track([path], tmp_path / "out")
    assert "noise.mp4" in str(caught.value)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["noise.mp4", "out.partial"]


def test_without_mediapipe_the_error_says_what_to_install(steps, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mediapipe", None)
    with pytest.raises(InputError, match=r"pip install mediapipe==0\.10\.21"):
        track([steps], tmp_path / "out")


def test_a_landmark_model_that_is_none_is_refused(steps, tmp_path):
    pytest.importorskip("mediapipe", reason="the optional mediapipe is not installed")
    with pytest.raises(InputError, match="no such landmark model"):
        track([steps], tmp_path / "out", model=tmp_path / "absent.task")
    (tmp_path / "bad.task").write_bytes(b"nothing")
    with pytest.raises(InputError, match="not a face landmarker"):
        track([steps], tmp_path / "out", model=tmp_path / "bad.task")


def test_quiet_keeps_native_chatter_and_gives_the_stream_back(capfd):
    with quiet():
        os.write(2, b"chatter")
    os.write(2, b"kept")
    assert capfd.readouterr().err == "kept"


def test_threads_that_are_quiet_at_once_give_the_stream_back(capfd):
    """Each alone would keep what the other silenced, or silence what the other gave back."""
    entered, both = threading.Event(), threading.Event()

    def first():
        with quiet():
            entered.set()
            both.wait(10)

    thread = threading.Thread(target=first)
    thread.start()
    assert entered.wait(10)
    with quiet():
        both.set()
        thread.join(10)
        os.write(2, b"chatter")
    os.write(2, b"kept")
    assert capfd.readouterr().err == "kept"


class _Scripted:
    """A detector that finds landmarks as written, and none where they are None."""

    score_names = ()

    def __init__(self, landmarks):
        self._landmarks = iter(landmarks)

    def __call__(self, rgb):
        assert rgb.shape[0] == rgb.shape[1]
        found = next(self._landmarks)
        return [] if found is None else [Face(found / rgb.shape[0], None)]

    def close(self):
        pass


def test_frames_without_a_face_are_left_out_and_listed(steps):
    points = np.full((478, 3), 60, np.float32)
    script = [points, None, points, None, None, points] + [points] * 6
    detector = _Scripted(script)
    sightings = observe(
        open_video(steps), 1, lambda: (detector, None), cache=Cache(None), key="steps"
    )
    seen = sightings.observations(np.arange(len(sightings.row)))
    assert seen.missing == [1, 3, 4]
    assert seen.frame_id.tolist() == [0, 2, 5, 6, 7, 8, 9, 10, 11]
    assert (seen.width, seen.height) == (WIDTH, HEIGHT)
    assert np.allclose(seen.landmarks, 60)
    fewer = seen.subset(np.array([0, 2]))
    assert fewer.missing == [1, 2, 3, 4, 6, 7, 8, 9, 10, 11]


def _face_at(centres, size=100, width=640, height=480):
    """Landmarks of faces `size` high about `centres` [F,2]."""
    angle = np.linspace(0, 2 * np.pi, 478, endpoint=False)
    ring = np.stack([0.4 * size * np.sin(angle), 0.5 * size * np.cos(angle), 0 * angle], 1)
    ring[10], ring[152] = (0, -0.5 * size, 0), (0, 0.5 * size, 0)
    middles = np.pad(np.asarray(centres, np.float64), ((0, 0), (0, 1)))
    landmarks = (middles[:, None] + ring).astype(np.float32)
    ids = np.arange(len(landmarks), dtype=np.int32)
    return Observations(landmarks, None, (), ids, [], width, height)


def test_the_window_holds_still_for_a_head_that_does():
    random = np.random.default_rng(0)
    seen = _face_at(random.normal((320, 240), 5, (40, 2)))
    crop = plan_crop(seen, (0, 0, 640, 480), "clip")
    assert crop.still
    left, top = crop.corners[0]
    assert left < 320 - 60 < 320 + 60 < left + crop.side
    assert top < 240 - 50 - 30  # hair
    assert top + crop.side > 240 + 50 + 40  # neck


def test_the_window_follows_a_wandering_head_smoothly():
    path = np.stack([np.linspace(150, 490, 120), np.full(120, 240.0)], 1)
    path += np.random.default_rng(1).normal(0, 3, path.shape)
    crop = plan_crop(_face_at(path), (0, 0, 640, 480), "clip")
    assert not crop.still
    middles = crop.corners + crop.side / 2
    assert np.abs(middles[:, 0] - path[:, 0]).max() < 50
    assert np.abs(np.diff(crop.corners[:, 0], 2)).max() <= 2


def _box(samples):
    return content_box(*(np.stack(strips) for strips in zip(*map(edges, samples), strict=True)))


def test_black_bars_stay_outside_and_dark_backgrounds_inside():
    random = np.random.default_rng(0)
    samples = random.integers(40, 255, (6, 100, 140, 3), dtype=np.uint8)
    assert _box(samples) == (0, 0, 140, 100)
    barred = samples.copy()
    barred[:, :17] = 16
    barred[:, :, 130:] = 16
    left, top, right, bottom = _box(barred)
    assert (left, bottom) == (0, 100)
    assert 17 <= top <= 19
    assert 128 <= right <= 130
    # a black studio: no line where it ends, only a person in the middle
    studio = np.full((6, 100, 140, 3), 5, np.uint8)
    studio[:, 30:, 50:90] = 180
    assert _box(studio) == (0, 0, 140, 100)
    crop = plan_crop(_face_at([[320, 90]] * 8), (0, 67, 640, 480), "clip")
    assert crop.corners[0, 1] >= 67


def test_a_head_too_small_is_refused():
    with pytest.raises(InputError, match="tiny"):
        plan_crop(_face_at([[320, 240]] * 5, size=12), (0, 0, 640, 480), "tiny")


def test_intrinsics_follow_the_window():
    crop = Crop(200, np.array([[200, 120], [230, 150]]))
    matrices = crop.intrinsics(500.0, 640, 480, 100)
    # the source's middle, (320, 240), seen through the second window and halved
    assert matrices[1] @ [0, 0, 1] == pytest.approx([45, 45, 1])
    assert matrices[0, 0, 0] == 250
    picture = np.zeros((480, 640, 3), np.uint8)
    picture[240:244, 320:324] = 255
    found = cut(picture, crop.corners[1], 200, 100)[..., 0]
    rows, columns = np.nonzero(found > 0.5)
    assert set(columns) == {45, 46}
    assert set(rows) == {45, 46}


def _disc(side, radius, soft=2.0):
    y, x = np.mgrid[:side, :side] + 0.5
    away = np.hypot(x - side / 2, y - side / 2)
    return ((radius - away) / soft + 0.5).clip(0, 1).astype(np.float32)


def test_the_matte_is_soft_and_its_colours_are_the_persons():
    side = 256
    alpha = _disc(side, 80, soft=8)[..., None]
    person, wall = np.array([0.3, 0.15, 0.1]), np.array([1.0, 1.0, 1.0])
    picture = (alpha * person + (1 - alpha) * wall).astype(np.float32)
    rgba = matte.cut_out(picture, (alpha[..., 0] * 255).astype(np.uint8))
    assert rgba[128, 128, 3] == 1
    assert rgba[2, 2, 3] == 0
    edge = (rgba[..., 3] > 0.2) & (rgba[..., 3] < 0.8)
    assert edge.sum() > 500
    assert np.abs(rgba[edge][:, :3] - person).mean() < 0.1
    assert np.abs(picture[edge] - person).mean() > 0.3  # what an avatar would have learnt
    small = matte.shrink(rgba, 64)
    assert small.shape == (64, 64, 4)
    edge = (small[..., 3] > 0.2) & (small[..., 3] < 0.8)
    assert np.abs(small[edge][:, :3] - person).mean() < 0.1


def test_masks_waver_less_after_steadying():
    random = np.random.default_rng(0)
    masks = (_disc(256, 80) * 200 + random.integers(0, 55, (6, 256, 256))).astype(np.uint8)
    still = np.zeros((6, 3, 2))
    steady = matte.steadied(masks, still, np.ones(5))
    assert (
        np.diff(steady.astype(float), axis=0).std()
        < 0.6 * np.diff(masks.astype(float), axis=0).std()
    )
    # across a gap, or where the head has moved, a neighbour would leave its ghost
    ghosts = np.zeros((4, 256, 256), np.uint8)
    ghosts[2:, :100] = 255
    assert 0 < matte.steadied(ghosts, still[:4], np.ones(3))[1].max() < 255
    assert np.array_equal(matte.steadied(ghosts, still[:4], np.array([1, 5, 1])), ghosts)
    moved = still[:4].copy()
    moved[2:] = 9
    assert np.array_equal(matte.steadied(ghosts, moved, np.ones(3)), ghosts)


def test_hair_lost_in_one_frame_comes_back_where_the_head_is_then():
    frames = 8
    masks = np.zeros((frames, 256, 256), np.uint8)
    scalps = np.zeros_like(masks)
    ring = np.stack([np.cos(np.arange(9)), np.sin(np.arange(9))], 1) * 40
    points = np.empty((frames, 9, 2))
    for row in range(frames):
        shift = 3 * row
        masks[row] = np.roll(255 * (_disc(256, 70) > 0.5), shift, axis=1)
        scalps[row] = np.roll(255 * (_disc(256, 62) > 0.5), shift, axis=1)
        points[row] = ring + np.array([128 + shift, 128])
    whole = masks.copy()
    masks[3, :100] = 0
    mended = matte.agreed(masks, np.zeros((frames, 3)), points, scalps)
    lost = (whole[3] > 0) & (masks[3] == 0)
    assert (mended[3][lost] > 200).mean() > 0.9
    assert (mended[3][whole[3] == 0] > 100).mean() < 0.01
    assert np.array_equal(mended[0] > 127, whole[0] > 127)


def test_names_splits_andranges():
    names = clip_names([Path("a/My clip!.mp4"), Path("b/My clip!.mov"), Path("c/ü.mp4")])
    assert names == ["My_clip", "My_clip_2", "clip"]
    assert splits(1).tolist() == ["train"]
    assert splits(5).tolist() == ["train"] * 4 + ["test"]
    assert (splits(100) == "test").sum() == 10
    assert ranges([1, 2, 3, 7, 9, 10]) == "1-3, 7, 9-10"
    assert ranges([0, 4, 8, 16], 4) == "0-8, 16"


class _Leaning:
    """Sees `faces` of a picture, or of its mirror image, always somewhat to the right of where
    they are, and smiling on the left."""

    def __init__(self, faces, mirrored=False):
        self.score_names = ("mouthSmileLeft", "mouthSmileRight", "jawOpen")
        self._faces, self._mirrored = faces, mirrored
        self.closed = False

    def __call__(self, rgb):
        seen = [face.copy() for face in self._faces]
        if self._mirrored:
            seen = [face[detectors.mirror_partners()] for face in seen]
            for face in seen:
                face[:, 0] = 1 - face[:, 0]
        scores = np.array([0.8, 0.2, 0.4], np.float32)
        return [Face(face + np.array([0.004, 0, 0], np.float32), scores) for face in seen]

    def close(self):
        self.closed = True


def test_looking_both_ways_takes_out_what_a_detector_leans_to_a_side():
    head = builtin_head()
    face = (0.5 + np.asarray(head.landmarks(head.template)) * [1, -1, -1]).astype(np.float32)
    other = face * np.float32(0.5)
    partners = detectors.mirror_partners()
    assert (partners[partners] == np.arange(478)).all()
    assert partners[33] == 263  # the eyes' outer corners
    # the mirror image shows another order of faces, and one of them not at all
    for again, seen in (([other, face], 2), ([face], 2), ([], 2)):
        plain, mirrored = _Leaning([face, other]), _Leaning(again, mirrored=True)
        both = detectors.BothWays(plain, mirrored)
        found = both(np.zeros((8, 8, 3), np.uint8))
        assert len(found) == seen
        centred = 0.0 if again else 0.004
        assert np.abs(found[0].landmarks - face - np.float32([centred, 0, 0])).max() < 1e-4
        assert found[0].scores == pytest.approx([0.5, 0.5, 0.4] if again else [0.8, 0.2, 0.4])
        left_over = 0.0 if len(again) == 2 else 0.004
        assert np.abs(found[1].landmarks - other - np.float32([left_over, 0, 0])).max() < 1e-4
        both.close()
        assert plain.closed
        assert mirrored.closed


# a made-up video whose head is known: the whole road without a network


@pytest.fixture
def made_up(tmp_path, monkeypatch):
    """A video of grey noise, and a detector that sees the built-in head turning in it."""
    head = builtin_head()
    frames = 14
    random = np.random.default_rng(0)
    base = random.integers(60, 200, (200, 240, 3), dtype=np.uint8)
    path = write_video(tmp_path / "me.mp4", [base] * frames)
    pose = np.zeros((frames, 5, 3))
    pose[:, 1, 1] = np.linspace(-0.2, 0.2, frames)
    translation = np.tile([0.0, 0.02, -0.8], (frames, 1))
    expression = np.zeros((frames, len(head.expression_names)))
    model = LandmarkModel(head, 4)
    points = model.pose(np.zeros(4), expression, pose, translation).points
    pixels = points[..., :2] * [500, -500] / -points[..., 2:] + [120, 100]
    depth = -points[..., 2:] * 500 / 0.8
    landmarks = np.concatenate([pixels, depth - depth.mean()], axis=2).astype(np.float32)
    script = [*landmarks[:5], None, *landmarks[6:]]
    monkeypatch.setattr(detectors, "make_detector", lambda model: _Scripted(script))
    monkeypatch.setattr(detectors, "make_hand_detector", lambda: None)
    monkeypatch.setattr(detectors, "detector_name", lambda model: "scripted")
    monkeypatch.setattr(detectors, "finds_hands", lambda: False)
    monkeypatch.setattr(matte, "segmenter_name", lambda: "scripted")
    return path, tmp_path / "out", landmarks


class _Round:
    """A segmenter that sees a disc."""

    def __call__(self, rgb):
        return (_disc(256, 100) * 255).astype(np.uint8)

    def close(self):
        pass


def test_the_whole_road(made_up, monkeypatch):
    path, out, landmarks = made_up
    monkeypatch.setattr(matte, "Segmenter", _Round)
    told = []
    report = track(
        [path],
        out,
        size=96,
        appearances=["grey"],
        photo=False,  # the pictures show nothing of the head that the detector tells of
        progress=lambda done, step: told.append(done),
    )
    assert told == sorted(told)
    assert told[-1] == 1
    assert report.clips[0]["left_out"] == {"no face": [5]}
    assert report.clips[0]["error_percent"] < 0.5
    collection = read_collection(out)
    clip = collection.clip("me")
    assert clip.appearance == "grey"
    assert clip.frame_id.tolist() == [*range(5), *range(6, 14)]
    assert clip.split.tolist() == ["train"] * 12 + ["test"]
    assert (clip.pose[:, 0] == 0).all()
    assert (clip.camera_to_world == clip.camera_to_world[0]).all()
    rgba = read_rgba(collection.image_path(clip, 0))
    assert rgba.shape == (96, 96, 4)
    assert 0.2 < (rgba[..., 3] > 127).mean() < 0.9

    # the mesh in the collection lands on the landmarks in its pictures
    from pav_blender.core.rendering.cameras import Camera

    camera = Camera(96, 96, clip.intrinsics[8], clip.camera_to_world[8])
    pixels, _ = camera.project(collection.head.landmarks(collection.posed(clip, [8])[0]))
    seen = landmarks[clip.frame_id[8], :, :2]
    scale = camera.intrinsics[0, 0] / report.clips[0]["focal_pixels"]
    back = (pixels - camera.intrinsics[:2, 2]) / scale + [120, 100]
    # the detector sees them a millimetre or two off the surface
    assert np.median(np.linalg.norm(back - seen, axis=1)) < 1.3


@pytest.mark.parametrize("when", [1, 20, 40])
def test_stopping_leaves_nothing_but_what_to_go_on_from(made_up, monkeypatch, when):
    path, out, _ = made_up
    monkeypatch.setattr(matte, "Segmenter", _Round)
    asked = []

    def should_stop():
        asked.append(1)
        return len(asked) >= when

    with pytest.raises(Cancelled):
        track([path], out, size=64, should_stop=should_stop)
    left = {entry.name for entry in out.parent.iterdir()}
    assert left <= {path.name, "out.partial"}
    assert not out.exists()


@pytest.mark.faces
@pytest.mark.skipif(not CLIPS.is_dir(), reason=f"no real clips at ../shared/clips ({CLIPS})")
def test_a_real_clip(tmp_path):
    pytest.importorskip("mediapipe", reason="the optional mediapipe is not installed")
    out = tmp_path / "real"
    report = track([CLIPS / "president_a.mp4"], out, size=128, every=12)
    assert report.clips[0]["left_out"] == {}
    assert report.clips[0]["error_percent"] < 2.5
    assert not report.clips[0]["picture_moves"]
    collection = read_collection(out)
    clip = collection.clips[0]
    rgba = read_rgba(collection.image_path(clip, 3)).astype(float)
    assert rgba[..., 3][:, :6].mean() < 200  # background beside the head
    assert rgba[40:90, 45:80, 3].min() > 200  # the face is in the middle, and whole
    assert rgba[:2, :, 3].max() < 40  # the black bar is outside, and nobody reaches the top
