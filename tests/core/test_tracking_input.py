"""Tracking what people have: folders, shots, sizes, rates, light, damage; stopping and going on."""

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("mediapipe", reason="the optional mediapipe is not installed")

import av
import filmed

from pav_blender.cli import main
from pav_blender.core.collection import LABELS, read_collection
from pav_blender.core.errors import Cancelled, InputError
from pav_blender.core.evaluation import review
from pav_blender.core.images import read_gray, read_rgba, write_exr, write_rgba
from pav_blender.core.tracking import labels, track
from pav_blender.core.tracking import observe as observing
from pav_blender.core.tracking.cache import Cache, key_of
from pav_blender.core.tracking.pictures import open_source

ROOT = Path(__file__).resolve().parents[2]


def opaque(picture):
    return np.dstack([picture, np.full(picture.shape[:2], 255, np.uint8)])


def digests(folder):
    return {
        path.relative_to(folder): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Two shots and a short one between; blurred frames in the first. Tracked once."""
    folder = tmp_path_factory.mktemp("scene")
    pictures = [filmed.frame("crop", row) for row in range(14)]
    pictures += [filmed.frame("long", row, seed=1) for row in range(4)]
    pictures += [filmed.frame("grey", row, seed=2) for row in range(14, 26)]
    for at in (5, 6):
        soft = pictures[at].astype(np.float32)
        for _ in range(12):
            soft = (soft + np.roll(soft, 1, 0) + np.roll(soft, -1, 0)) / 3
            soft = (soft + np.roll(soft, 1, 1) + np.roll(soft, -1, 1)) / 3
        pictures[at] = (soft + 0.5).astype(np.uint8)
    video = filmed.film(folder / "scene.mp4", pictures)
    report = track([video], folder / "out", size=96)
    return video, folder / "out", report


@pytest.mark.faces
def test_shots_reasons_labels_and_landmarks_reach_the_collection(scene):
    _, out, report = scene
    assert [(clip["name"], clip["frames"]) for clip in report.clips] == [
        ("scene_1", 12),
        ("scene_2", 12),
    ]
    assert report.clips[0]["left_out"] == {"blurred": [5, 6]}
    assert [(shot["first"], shot["last"], shot["reason"]) for shot in report.skipped] == [
        (14, 17, "shot too short")
    ]
    collection = read_collection(out)
    assert collection.appearances == ["scene"]
    stored = json.loads((out / "collection.json").read_text())["extra"]["tracking"]
    assert stored["clips"] == report.clips
    clip = collection.clip("scene_1")
    assert clip.landmarks.shape == (12, 478, 2)
    shown = read_gray(collection.labels_path(clip, 4))
    alpha = read_rgba(collection.image_path(clip, 4))[..., 3]
    assert shown.shape == (96, 96)
    assert set(np.unique(shown[alpha < 10])) == {0}
    assert {LABELS.index(n) for n in ("face", "lips", "scalp_hair", "cloth")} <= set(
        np.unique(shown).tolist()
    )
    assert not out.with_name("out.partial").exists()


@pytest.mark.faces
def test_check_shows_the_track(scene, tmp_path, capsys):
    _, out, report = scene
    sheet, plot, video = (tmp_path / name for name in ("sheet.png", "plot.svg", "review.mp4"))
    code = main(
        ["check", str(out), "--out", str(sheet), "--plot", str(plot), "--video", str(video)]
    )
    told = capsys.readouterr().out
    assert code == 0
    told_error = re.search(r"scene_1: landmarks within ([\d.]+) % of the eye distance", told)
    assert float(told_error[1]) == pytest.approx(report.clips[0]["error_percent"], abs=0.006)
    assert "scene_1: left out, blurred: 5-6" in told
    assert "scene.mp4: left out, shot too short: 14-17" in told
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert sum(1 for _ in container.decode(stream)) == 24
    # six overlays a row, two rows, four pixels between
    assert read_rgba(sheet).shape[:2] == (2 * 100 + 4, 6 * 100 + 4)
    assert plot.read_text().count("median") == 2


@pytest.mark.faces
def test_a_wrong_track_shows_in_its_error(scene):
    collection = read_collection(scene[1])
    clip = collection.clips[0]
    good = review.landmark_errors(collection, clip)
    moved = replace(clip, translation=clip.translation.copy())
    moved.translation[3] += [0.01, 0, 0]
    bad = review.landmark_errors(collection, moved)
    assert bad.worst == clip.frame_id[3]
    assert bad.percent[3] > 8  # 1 cm of some 6
    assert np.allclose(np.delete(bad.percent, 3), np.delete(good.percent, 3))
    assert review.landmark_errors(collection, replace(clip, landmarks=None)) is None


@pytest.mark.faces
def test_check_refuses_what_it_cannot_draw(scene, tmp_path, capsys):
    for option, name in (("--video", "a.avi"), ("--plot", "a.gif")):
        assert main(["check", str(scene[1]), option, str(tmp_path / name)]) == 2
    studio = ["check", str(filmed.STUDIO), "--plot", str(tmp_path / "a.svg")]
    assert main(studio) == 2
    assert "no landmarks" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.faces
@pytest.mark.slow
def test_the_same_input_gives_the_same_files(scene, tmp_path):
    video, out, _ = scene
    track([video], tmp_path / "again", size=96)
    assert digests(tmp_path / "again") == digests(out)


@pytest.mark.faces
def test_stopped_anywhere_and_going_on_gives_the_same(tmp_path_factory, tmp_path, monkeypatch):
    pictures = [filmed.frame("crop", row) for row in range(10)]
    video = filmed.film(tmp_path_factory.mktemp("video") / "ten.mp4", pictures)
    monkeypatch.setattr(observing, "CHUNK", 4)
    track([video], tmp_path / "whole", size=96)
    asked, looked = [0], []
    original = observing._chunk

    def chunk(recent, frames, *rest):
        looked.append(len(recent))
        return original(recent, frames, *rest)

    monkeypatch.setattr(observing, "_chunk", chunk)

    def stop_after(count):
        asked[0] = 0

        def should_stop():
            asked[0] += 1
            return asked[0] > count

        return should_stop

    out = tmp_path / "out"
    for count in (7, 22):
        with pytest.raises(Cancelled, match="tracking stopped"):
            track([video], out, size=96, should_stop=stop_after(count))
        assert not out.exists()
        assert {p.name for p in tmp_path.iterdir()} <= {"out.partial", "whole"}
    calls = len(looked)
    track([video], out, size=96)
    assert len(looked) == calls  # everything was seen before
    assert digests(out) == digests(tmp_path / "whole")
    assert not out.with_name("out.partial").exists()


@pytest.mark.faces
@pytest.mark.parametrize(
    "how", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)]
)
def test_stopped_from_outside_nothing_stands_under_the_final_name(scene, tmp_path, how):
    video, out, _ = scene
    command = [sys.executable, "-m", "pav_blender", "track", str(video), "--size", "96"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        [*command, "--out", str(tmp_path / "out")],
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
    )
    marker = tmp_path / "out.partial"
    deadline = time.monotonic() + 60
    while not marker.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(how)
    told = process.communicate(timeout=60)[1]
    if how == signal.SIGINT:
        assert process.returncode == 1
        assert "pav: tracking stopped; the same command goes on from here" in told
    assert marker.exists()
    assert not (tmp_path / "out").exists()
    track([video], tmp_path / "out", size=96)
    assert digests(tmp_path / "out") == digests(out)


def test_a_cache_of_something_else_is_not_used(tmp_path):
    cache = Cache(tmp_path / "a.partial")
    cache.store("key", "one", {"x": np.arange(3)})
    assert cache.load("key", "one", ["x"])["x"].tolist() == [0, 1, 2]
    assert cache.load("other", "one", ["x"]) is None
    assert cache.load("key", "one", ["x", "y"]) is None
    path = tmp_path / "a.partial" / "key" / "one.npz"
    whole = path.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", whole.replace(b"x.npy", b"z.npy")):
        path.write_bytes(damage)
        assert cache.load("key", "one", ["x"]) is None
    np.savez(path, x=np.array([{}], dtype=object))  # pickled: never read
    assert cache.load("key", "one", ["x"]) is None
    cache.remove()
    assert list(tmp_path.iterdir()) == []
    # a folder of somebody's is neither used nor removed
    (tmp_path / "b.partial").mkdir()
    (tmp_path / "b.partial" / "thesis.txt").write_text("mine")
    cache = Cache(tmp_path / "b.partial")
    assert "b.partial" in cache.warning
    cache.store("key", "one", {"x": np.arange(3)})
    cache.remove()
    assert [p.name for p in (tmp_path / "b.partial").iterdir()] == ["thesis.txt"]
    assert key_of("a", 1) != key_of("a", "1") != key_of(np.arange(2), "a")


@pytest.mark.faces
@pytest.mark.slow
def test_another_setting_looks_again(scene, tmp_path, monkeypatch):
    video, _, _ = scene
    asked = []

    def stop_late():
        asked.append(1)
        return len(asked) > 40

    with pytest.raises(Cancelled):
        track([video], tmp_path / "out", size=96, should_stop=stop_late)
    report = track([video], tmp_path / "out", size=96, every=2, cut_background=False)
    assert all(
        number % 2 == 0 for c in report.clips for n in c["left_out"].values() for number in n
    )
    assert len(read_collection(tmp_path / "out").clips[0]) <= 16


@pytest.mark.faces
def test_a_folder_of_pictures_in_natural_order(tmp_path):
    folder = tmp_path / "Anna's photos"
    folder.mkdir()
    for row in range(12):
        write_rgba(folder / f"p{row}.png", opaque(filmed.frame("crop", row)))
    (folder / "notes.txt").write_text("not a picture")
    (folder / "p5.png").write_bytes(b"\x89PNG broken")
    write_rgba(folder / "p12.png", opaque(filmed.frame("crop", 12, width=322)))
    report = track([folder], tmp_path / "out", size=64)
    clip = read_collection(tmp_path / "out").clips[0]
    assert clip.name == "Anna_s_photos"
    assert clip.frame_id.tolist() == [0, 1, 2, 3, 4, 6, 7, 8, 9, 10, 11]
    text = "\n".join(report.warnings)
    assert "p5.png" in text
    assert "p12.png: 322x240 pixels in a folder of 320x240" in text


def test_pictures_of_any_kind_read_alike(tmp_path):
    picture = filmed.frame("crop", 0)
    linear = (picture / 255.0).astype(np.float32)
    linear = np.where(linear <= 0.04045, linear / 12.92, ((linear + 0.055) / 1.055) ** 2.4)
    for kind in ("png", "exr", "jpg"):
        (tmp_path / kind).mkdir()
    write_rgba(tmp_path / "png" / "a.png", opaque(picture))
    write_exr(tmp_path / "exr" / "a.exr", np.dstack([linear, np.ones(linear.shape[:2])]))
    import OpenImageIO as oiio

    sink = oiio.ImageOutput.create("a.jpg")
    sink.open(str(tmp_path / "jpg" / "a.jpg"), oiio.ImageSpec(320, 240, 3, "uint8"))
    sink.write_image(picture)
    sink.close()
    grey = np.dstack([np.repeat(picture[..., :1], 3, axis=2), np.full((240, 320), 128, np.uint8)])
    (tmp_path / "alpha").mkdir()
    write_rgba(tmp_path / "alpha" / "a.PNG", grey)
    for kind, within in (("png", 0), ("exr", 1), ("jpg", 12)):
        (frame,) = open_source(tmp_path / kind).frames()
        assert frame.rgb.dtype == np.uint8
        away = np.abs(frame.rgb.astype(int) - picture)
        assert np.percentile(away, 99) <= within, kind
    (frame,) = open_source(tmp_path / "alpha").frames()
    assert abs(int(frame.rgb[0, 0, 0]) - (int(picture[0, 0, 0]) + 128) / 2) <= 1
    with pytest.raises(InputError, match="without pictures"):
        open_source(tmp_path)


@pytest.mark.faces
@pytest.mark.parametrize(
    ("height", "width", "rate", "light"),
    [
        (144, 256, 15, "plain"),
        (640, 360, 60, "plain"),
        pytest.param(2160, 3840, 30, "plain", marks=pytest.mark.slow),
        (240, 320, 24, "grey"),
        (240, 320, 24, "dark"),
    ],
)
def test_any_size_rate_and_light(tmp_path, height, width, rate, light):
    pictures = [filmed.frame("crop", row, height=height, width=width) for row in (0, 4)]
    if light == "grey":
        pictures = [np.repeat(p.mean(2, keepdims=True).astype(np.uint8), 3, 2) for p in pictures]
    elif light == "dark":
        pictures = [(p * 0.12).astype(np.uint8) for p in pictures]
    video = filmed.film(tmp_path / "clip.mkv", pictures, rate)
    report = track([video], tmp_path / "out", size=64)
    (clip,) = report.clips
    assert clip["frames"] == 2
    assert clip["rate"] == rate
    assert clip["error_percent"] < 3
    collection = read_collection(tmp_path / "out")
    rgba = read_rgba(collection.image_path(collection.clips[0], 1))
    face = np.floor(collection.clips[0].landmarks[1]).astype(int).clip(0, 63)
    assert (rgba[face[:, 1], face[:, 0], 3] > 200).mean() > 0.95


@pytest.mark.faces
def test_a_clip_cut_off_gives_what_there_is_and_says_so(tmp_path, capsys):
    pictures = [filmed.frame("crop", row) for row in range(16)]
    whole = filmed.film(tmp_path / "whole.avi", pictures).read_bytes()
    part = tmp_path / "part.avi"
    part.write_bytes(whole[: len(whole) * 6 // 10])
    assert main(["track", str(part), "--out", str(tmp_path / "out"), "--size", "64"]) == 0
    told = capsys.readouterr().err
    assert "part.avi: damaged or cut short" in told
    clip = read_collection(tmp_path / "out").clips[0]
    assert 5 <= len(clip) < 16


@pytest.mark.faces
def test_clips_share_an_appearance_by_name(tmp_path):
    for name in ("may", "june"):
        pictures = [filmed.frame("crop", row) for row in range(3)]
        filmed.film(tmp_path / f"{name}.mp4", pictures)
    videos = [str(tmp_path / f"{name}.mp4") for name in ("may", "june")]
    out = tmp_path / "out"
    options = ["--size", "64", "--appearance", "summer=may,june", "--matte", "none"]
    assert main(["track", *videos, "--out", str(out), *options]) == 0
    collection = read_collection(out)
    assert collection.appearances == ["summer"]
    assert [clip.name for clip in collection.clips] == ["may", "june"]
    assert not (out / "clips" / "may" / "labels").exists()  # they need the matte


@pytest.mark.faces
def test_of_two_people_the_one_who_comes_back_is_tracked(tmp_path):
    """The other is nearer, and made up: the same person, wider."""
    pictures = []
    for row in range(10):
        mine = filmed.frame("crop", row, width=280)
        other = filmed.frame("grey", 40 - row, width=280, seed=3)
        other = other[:, (np.arange(350) / 1.25).astype(int)]
        pictures.append(np.ascontiguousarray(np.hstack([other, mine])))
    two = filmed.film(tmp_path / "two.mp4", pictures)
    alone = [filmed.frame("long", row, seed=4) for row in range(10)]
    one = filmed.film(tmp_path / "one.mp4", alone)
    report = track([two, one], tmp_path / "out", size=64, cut_background=False)
    assert report.warnings == []
    clip = read_collection(tmp_path / "out").clip("two")
    # the window's left edge in the video: the person's half begins at 350
    left = (
        630 / 2
        - clip.intrinsics[:, 0, 2] / clip.intrinsics[:, 0, 0] * (report.clips[0]["focal_pixels"])
    )
    assert (left > 330).all()


def test_labels_are_mostly_right_where_the_truth_is_known():
    collection = read_collection(filmed.STUDIO)
    hits = np.zeros((len(LABELS), len(LABELS)))
    parts = labels.of_triangles(collection.head)
    for clip in collection.clips:
        for row in (0, 24):
            rgba = read_rgba(collection.image_path(clip, row))
            true = read_gray(collection.labels_path(clip, row))
            found = labels.label(collection.head, parts, collection.betas, clip, row, rgba)
            np.add.at(hits, (true.ravel(), found.ravel()), 1)
    overlap = np.diag(hits) / (hits.sum(0) + hits.sum(1) - np.diag(hits)).clip(1)
    least = {"face": 0.7, "lips": 0.8, "eyes": 0.9, "mouth": 0.85, "scalp_hair": 0.65}
    least |= {"cloth": 0.75, "neck": 0.5, "background": 0.97}
    for name, value in least.items():
        assert overlap[LABELS.index(name)] > value, name
