import dataclasses
import json
import shutil

import numpy as np
import pytest
from toy import APPEARANCES

from pav_blender.core.collection import CollectionWriter, read_collection
from pav_blender.core.errors import InputError
from pav_blender.core.evaluation.check import check
from pav_blender.core.evaluation.review import write_overlays
from pav_blender.core.head import remember_head, write_head
from pav_blender.core.images import read_rgba


@pytest.fixture
def copy(toy_path, tmp_path):
    return shutil.copytree(toy_path, tmp_path / "copy")


def rewrite(path, **changes):
    """frames.npz of a clip with some arrays replaced, or left out where None."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = {k: stored[k] for k in stored.files} | changes
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})


def test_what_was_written_is_read(toy):
    assert toy.appearances == list(APPEARANCES)
    clip = toy.clip("bushy")
    assert len(clip) == 8
    assert list(clip.indices("test")) == [6, 7]
    assert toy.posed(clip, np.array([0])).shape == (1, len(toy.head.template), 3)


def test_hidden_colours_are_written_as_zero(toy):
    rgba = read_rgba(toy.image_path(toy.clips[0], 0))
    assert not rgba[rgba[..., 3] == 0].any()
    assert (rgba[..., 3] == 255).any()


def test_an_interrupted_writer_leaves_nothing(tmp_path):
    def film():
        with CollectionWriter(tmp_path / "c", "builtin", np.zeros(2)) as writer:
            writer.image("a", 0, np.zeros((4, 4, 4), np.uint8))
            raise RuntimeError("the studio broke")

    with pytest.raises(RuntimeError):
        film()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_no_collection_is_never_replaced(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "me.png").write_bytes(b"x")
    with pytest.raises(InputError, match="not a collection"):
        CollectionWriter(tmp_path / "photos", "builtin", np.zeros(2), overwrite=True)
    assert (tmp_path / "photos" / "me.png").exists()


@pytest.mark.parametrize("name", ["../up", "", "a/b", ".hidden", "x" * 65, "a\n"])
def test_names_that_leave_the_folder_are_refused(tmp_path, name):
    with (
        pytest.raises(InputError, match="clip name"),
        CollectionWriter(tmp_path / "c", "builtin", np.zeros(2)) as writer,
    ):
        writer.image(name, 0, np.zeros((4, 4, 4), np.uint8))
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pose": None}, "'pose' is missing"),
        ({"expression": np.zeros((8, 3), np.float32)}, "'expression' has shape"),
        ({"translation": np.full((8, 3), np.nan, np.float32)}, "'translation' is not finite"),
        ({"split": np.array(["train"] * 7 + ["holiday"])}, "unknown split"),
        ({"frame_id": np.zeros(8, np.int32)}, "different numbers"),
        ({"pose": np.array([object()] * 8, dtype=object)}, "damaged"),
    ],
)
def test_bad_arrays_are_named(copy, changes, words):
    path = copy / "clips" / "plain" / "frames.npz"
    rewrite(path, **changes)
    with pytest.raises(InputError, match=words) as caught:
        read_collection(copy)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"translation": np.full((8, 3), np.inf)}, "'translation' is not finite at frame 0"),
        ({"pose": np.full((8, 5, 3), 1e39)}, "'pose' is not finite"),
        ({"intrinsics": np.eye(3)}, r"'intrinsics' has shape \(3, 3\), expected \(8, 3, 3\)"),
        ({"expression": np.zeros((7, 52))}, r"expected \(8, any\)"),
        ({"frame_id": np.array([0, 1, 2, 3, 4, 5, 6, 6])}, "different numbers"),
        ({"frame_id": np.arange(8) - 1}, "different numbers"),
        ({"frame_id": np.arange(8) + 2**31}, "beyond 2147483647"),
        ({"frame_id": np.arange(8) + 0.5}, "float64, which it cannot"),
        ({"split": np.array(["train"] * 7 + ["holidays_abroad"])}, "unknown split"),
        ({"width": 0}, "picture size of 0x64"),
        ({"name": "bushy"}, "two clips have the same name"),
        ({"appearance": ".."}, "appearance"),
    ],
)
def test_what_would_not_be_read_is_not_written(toy, tmp_path, changes, words):
    def write():
        with CollectionWriter(tmp_path / "c", "builtin", toy.betas) as writer:
            writer.clip(toy.clip("bushy"))
            writer.clip(dataclasses.replace(toy.clip("plain"), **changes))

    with pytest.raises(InputError, match=words) as caught:
        write()
    assert "\n" not in str(caught.value)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("betas", "offset", "words"),
    [
        ([0.0, np.nan], None, "coefficients that are not finite"),
        ([1e39], None, "coefficients that are not finite"),
        ([0.0], np.full((9, 3), np.inf), "offset"),
        ([0.0], np.zeros(9), "offset"),
        ([0.0], None, "needs a clip"),
    ],
)
def test_a_person_that_would_not_be_read_is_not_written(tmp_path, betas, offset, words):
    with (
        pytest.raises(InputError, match=words),
        CollectionWriter(tmp_path / "c", "builtin", np.array(betas), offset=offset),
    ):
        pass
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("part", [0.0, 0.001, 0.1, 0.9])
def test_truncated_arrays_are_told(copy, part):
    path = copy / "clips" / "plain" / "frames.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(InputError, match=r"frames\.npz"):
        read_collection(copy)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.update(format="x"), "not a collection file"),
        (lambda m: m.update(version=99), "version 99"),
        (lambda m: m["clips"].clear(), "no clips"),
        (lambda m: m["clips"][0].update(name="../../etc"), "clip name"),
        (lambda m: m["clips"].append(m["clips"][0]), "same name"),
        (lambda m: m["head"].pop("betas"), "missing or malformed"),
        (lambda m: m["clips"][0].update(width=10**9), "picture size"),
    ],
)
def test_bad_descriptions_are_told(copy, change, words):
    path = copy / "collection.json"
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))
    with pytest.raises(InputError, match=words):
        read_collection(copy)


def test_check_finds_a_broken_picture_and_a_wrong_track(copy, toy, tmp_path):
    assert check(toy).problems == []
    broken = copy / "clips" / "plain" / "images" / "000003.png"
    broken.write_bytes(broken.read_bytes()[:60])
    rewrite(
        copy / "clips" / "bushy" / "frames.npz",
        translation=np.full((8, 3), 0.2, np.float32),
    )
    problems = check(read_collection(copy)).problems
    assert any("000003.png" in p for p in problems)
    assert any("bushy" in p and "do not belong together" in p for p in problems)


def test_the_overlay_shows_every_clip(toy, tmp_path):
    write_overlays(toy, tmp_path / "o.png")
    sheet = read_rgba(tmp_path / "o.png")
    assert sheet.shape[0] > 2 * 64
    assert sheet.shape[1] > 6 * 64
    green = (sheet[..., 1].astype(int) - sheet[..., 0] > 40).mean()
    assert green > 0.02


def test_what_a_tracker_left_out_is_read_with_care(toy):
    from dataclasses import replace

    from pav_blender.core.evaluation.review import left_out

    def told(tracking):
        return left_out(replace(toy, extra={"tracking": tracking}))

    clips = [{"name": "a", "left_out": {"blurred": [1, 2, 5]}}, {"name": "b", "left_out": [7]}]
    skipped = [{"video": "a.mp4", "first": 8, "last": 9, "reason": "shot too short"}]
    assert told({"clips": clips, "skipped": skipped}) == [
        ("a", "blurred", "1-2, 5"),
        ("b", "not usable", "7"),
        ("a.mp4", "shot too short", "8-9"),
    ]
    every = [{"name": "a", "every": 2, "left_out": {"blurred": [2, 4]}}]
    assert told({"clips": every}) == [("a", "blurred", "2-4")]
    for broken in (None, 3, [], {"clips": 5}, {"clips": [1], "skipped": "x"}):
        assert told(broken) == []
    assert told({"clips": [{"name": "a", "left_out": {"x": 1, "y": []}}]}) == []


def test_a_collection_and_its_head_file_may_be_moved(toy, tmp_path, monkeypatch):
    """Together, or the collection alone where the head was remembered; else one line says it."""
    monkeypatch.setenv("PAV_CONFIG", str(tmp_path / "config"))
    head = dataclasses.replace(toy.head, name="other", shape_basis=0.5 * toy.head.shape_basis)
    (tmp_path / "a").mkdir()
    write_head(tmp_path / "a/head.npz", head)
    empty = tmp_path / "elsewhere"
    empty.mkdir()
    monkeypatch.chdir(tmp_path)
    known = head.fingerprint
    with CollectionWriter("a/c", "a/head.npz", np.zeros(2), fingerprint=known) as writer:
        writer.clip(toy.clips[0])
    monkeypatch.chdir(empty)
    (tmp_path / "a").rename(tmp_path / "b")
    moved = read_collection(tmp_path / "b/c")
    assert moved.head.fingerprint == known
    assert moved.head_name == str(tmp_path / "b/head.npz")
    (tmp_path / "b/c").rename(empty / "c")
    with pytest.raises(InputError, match="pav import --head FILE"):
        read_collection(empty / "c")
    remember_head(tmp_path / "b/head.npz")
    assert read_collection(empty / "c").head.fingerprint == known
