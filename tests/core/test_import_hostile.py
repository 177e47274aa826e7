"""Hostile and damaged folders of other programs: refused or skipped by name, nothing run."""

import os
from pathlib import Path

import formats_fixtures as formats
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.collection.importers import detect, normalise, read_sources, write_person
from pav_blender.core.collection.importers.meshes import read_vertices
from pav_blender.core.errors import InputError
from pav_blender.core.pickles import read_torch


def first_path(key, value):
    def change(content):
        content["frames"][0][key] = value

    return change


@pytest.mark.parametrize(
    ("write", "file", "key"),
    [
        (formats.write_insta, "transforms.json", "file_path"),
        (formats.write_insta, "transforms.json", "mesh_path"),
        (formats.write_insta, "transforms.json", "exp_path"),
        (formats.write_insta, "transforms.json", "seg_mask_path"),
        (formats.write_vhap, "transforms.json", "file_path"),
        (formats.write_vhap, "transforms.json", "flame_param_path"),
        (formats.write_vhap, "transforms.json", "fg_mask_path"),
        (formats.write_imavatar, "flame_params.json", "file_path"),
    ],
)
@pytest.mark.parametrize(
    "value", ["../../etc/passwd", "/etc/passwd", "C:\\x.png", "a\0b", "\ud800"]
)
def test_paths_that_leave_the_source_are_refused(write, file, key, value, tmp_path, make):
    source = tmp_path / "outer" / "source"
    make(write, source)
    formats.rewrite_json(source / file, first_path(key, value))
    with pytest.raises(InputError, match=r"leads out|absolute path|not a file's name") as caught:
        read_sources([str(source)])
    assert "root:" not in str(caught.value)


def test_a_neighbour_is_read_for_vhap_only(tmp_path, make):
    make(formats.write_insta, tmp_path / "a")
    make(formats.write_insta, tmp_path / "b")
    formats.rewrite_json(
        tmp_path / "a/transforms.json", first_path("file_path", "../b/images/00000.png")
    )
    with pytest.raises(InputError, match="leads out"):
        read_sources([str(tmp_path / "a")])


def test_links_out_of_the_source_are_refused(tmp_path, make):
    secret = tmp_path / "secret.png"
    make(formats.write_insta, tmp_path / "in/source")
    picture = tmp_path / "in/source/images/00003.png"
    picture.rename(secret)
    picture.symlink_to(secret)
    with pytest.raises(InputError, match="leads out"):
        read_sources([str(tmp_path / "in/source")])
    make(formats.write_metrical, tmp_path / "in/metrical")
    frame = tmp_path / "in/metrical/checkpoint/00002.frame"
    frame.rename(tmp_path / "00002.frame")
    frame.symlink_to(tmp_path / "00002.frame")
    with pytest.raises(InputError, match="leads out"):
        read_sources([str(tmp_path / "in/metrical")])


class Run:
    """What a hostile pickle asks for."""

    def __init__(self, command):
        self.command = command

    def __reduce__(self):
        return os.system, (self.command,)


def test_a_hostile_checkpoint_is_not_run(tmp_path, make):
    make(formats.write_metrical, tmp_path / "m")
    evil = {"flame": Run(f"touch {tmp_path / 'ran'}")}
    formats.save_frame(tmp_path / "m/checkpoint/00001.frame", evil)
    with pytest.raises(InputError, match=r"00001\.frame: refused to unpickle.*system"):
        read_sources([str(tmp_path / "m")])
    assert not (tmp_path / "ran").exists()


def test_a_pickled_npz_is_refused(tmp_path, make):
    make(formats.write_vhap, tmp_path / "v")
    evil = np.array([Run(f"touch {tmp_path / 'ran'}")], dtype=object)
    np.savez(tmp_path / "v/flame_param/00001.npz", shape=evil)
    with pytest.raises(InputError, match=r"00001\.npz: .*it holds pickled objects"):
        read_sources([str(tmp_path / "v")])
    assert not (tmp_path / "ran").exists()


def lose_a_picture(source: Path):
    pictures = [p for p in source.rglob("*.png") if p.parent.name in ("images", "imgs", "input",
                                                                      "image")]  # fmt: skip
    sorted(pictures)[2].unlink()


@pytest.mark.parametrize(
    "write",
    [
        formats.write_insta,
        formats.write_metrical,
        formats.write_flashavatar,
        formats.write_vhap,
        formats.write_vhap_track,
        formats.write_imavatar,
    ],
)
def test_missing_pictures_are_skipped_by_name(write, tmp_path, make):
    make(write, tmp_path / "s")
    lose_a_picture(tmp_path / "s")
    (clip,) = read_sources([str(tmp_path / "s")])
    assert len(clip) == formats.FRAMES - 1
    assert len(clip.skipped) == 1
    assert "picture" in clip.skipped[0]
    assert any(digit in clip.skipped[0] for digit in "23")


@pytest.mark.parametrize(
    "changes",
    [
        {"rotation": np.float32(1)},
        {"timestep_id": np.array("00000")},
        {"dynamic_offset": np.float32(0)},
        {"focal_length": np.zeros(0, np.float32)},
    ],
)
def test_arrays_of_a_vhap_track_without_a_length_are_refused(changes, tmp_path, make):
    make(formats.write_vhap_track, tmp_path / "s")
    path = tmp_path / "s/run/tracked_flame_params_30.npz"
    with np.load(path) as stored:
        content = dict(stored)
    np.savez(path, **(content | changes))
    with pytest.raises(InputError, match=r"differ in their number|focal_length is 0") as caught:
        read_sources([str(tmp_path / "s")])
    assert str(path) in str(caught.value)


def test_values_that_are_not_finite_are_skipped_by_frame(tmp_path, make):
    make(formats.write_vhap, tmp_path / "v")
    with np.load(tmp_path / "v/flame_param/00003.npz") as stored:
        content = dict(stored)
    content["jaw_pose"][0, 1] = np.nan
    np.savez(tmp_path / "v/flame_param/00003.npz", **content)
    (clip,) = read_sources([str(tmp_path / "v")])
    assert list(clip.frame_id) == [0, 1, 2, 4, 5]
    assert clip.skipped == ["frame 3: pose is not finite"]

    make(formats.write_insta, tmp_path / "i")
    formats.rewrite_json(
        tmp_path / "i/transforms.json",
        lambda c: c["frames"][0]["transform_matrix"][0].__setitem__(3, float("nan")),
    )
    (clip,) = read_sources([str(tmp_path / "i")])
    assert len(clip) == 5
    assert "camera_to_world is not finite" in clip.skipped[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(frames={}), "not a list of frames"),
        (lambda c: c["frames"][0].update(transform_matrix=[[1, 2]]), "shape"),
        (lambda c: c["frames"][0].update(transform_matrix=np.diag([2, 2, 2, 1]).tolist()),
         "not a rotation"),
        (lambda c: c["frames"][0].update(transform_matrix=np.diag([1, 1, -1, 1]).tolist()),
         "not a rotation"),
        (lambda c: c.update(fl_x="wide"), "fl_x"),
    ],
)  # fmt: skip
def test_malformed_descriptions_are_told(change, words, tmp_path, make):
    make(formats.write_insta, tmp_path / "i")
    formats.rewrite_json(tmp_path / "i/transforms.json", change)
    with pytest.raises(InputError, match=words):
        read_sources([str(tmp_path / "i")], "insta")


def test_another_mesh_is_told(tmp_path, make):
    make(formats.write_insta, tmp_path / "i")
    mesh = tmp_path / "i/meshes/00001.obj"
    mesh.write_text(mesh.read_text().replace("v ", "# ", 5))
    with pytest.raises(InputError, match=r"00001\.obj: 5018 vertices; FLAME has 5023"):
        read_sources([str(tmp_path / "i")])


@pytest.mark.parametrize("part", [0.0, 0.3, 0.98])
def test_truncated_checkpoints_are_told(part, tmp_path, make):
    make(formats.write_metrical, tmp_path / "m", frames=2)
    frame = tmp_path / "m/checkpoint/00001.frame"
    whole = frame.read_bytes()
    frame.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(InputError, match=r"00001\.frame"):
        read_sources([str(tmp_path / "m")])


def test_nothing_is_left_where_a_picture_does_not_fit(tmp_path, heads, make):
    make(formats.write_vhap, tmp_path / "v")
    (tmp_path / "v/fg_masks/00004_00.png").write_bytes(b"not a picture")
    person = normalise(read_sources([str(tmp_path / "v")]), heads["2023"])
    with pytest.raises(InputError, match=r"00004_00\.png"):
        write_person(person, tmp_path / "out" / "c")
    assert list((tmp_path / "out").iterdir()) == []


def test_frames_without_the_matte_that_others_have_are_skipped(tmp_path, make):
    make(formats.write_vhap, tmp_path / "v")
    (tmp_path / "v/fg_masks/00002_00.png").unlink()
    (clip,) = read_sources([str(tmp_path / "v")])
    assert clip.skipped == ["frame 2: its matte is missing"]
    assert len(clip) == formats.FRAMES - 1


def test_a_description_that_is_a_link_is_not_read(tmp_path, make):
    make(formats.write_insta, tmp_path / "in/source")
    for name in ("transforms", "transforms_train", "transforms_test", "transforms_val"):
        description = tmp_path / f"in/source/{name}.json"
        description.rename(tmp_path / description.name)
        description.symlink_to(tmp_path / description.name)
    with pytest.raises(InputError, match="not a folder of"):
        detect(tmp_path / "in/source")
    with pytest.raises(InputError, match="leads out"):
        read_sources([str(tmp_path / "in/source")], "insta")


def test_numbers_beyond_all_measure_are_told(tmp_path, make):
    make(formats.write_imavatar, tmp_path / "huge")
    make(formats.write_imavatar, tmp_path / "large")
    file = "flame_params.json"
    formats.rewrite_json(tmp_path / "huge" / file, first_path("pose", [10**400] * 15))
    with pytest.raises(InputError, match="pose: not numbers"):
        read_sources([str(tmp_path / "huge")])
    formats.rewrite_json(tmp_path / "large" / file, first_path("expression", [1e30] * 50))
    (clip,) = read_sources([str(tmp_path / "large")])
    assert clip.skipped == ["frame 1: expression is not finite"]


def test_meshes_in_another_unit_are_refused(tmp_path, heads, make):
    make(formats.write_metrical, tmp_path / "m")
    parsed = read_sources([str(tmp_path / "m")])
    parsed[0].vertices *= 1000
    with pytest.raises(InputError, match="another head, another unit"):
        normalise(parsed, heads["2020"])


def test_checkpoints_of_torch_itself(tmp_path):
    act = formats.take()
    content, _, _ = formats.metrical_frame(act, 1)
    torch.save(content, tmp_path / "a.frame")
    back = read_torch(tmp_path / "a.frame")
    np.testing.assert_array_equal(back["flame"]["exp"], content["flame"]["exp"])
    assert back["frame_id"] == "00001"
    torch.save({"flame": torch.zeros(3)}, tmp_path / "b.frame")
    with pytest.raises(InputError, match=r"b\.frame: refused to unpickle"):
        read_torch(tmp_path / "b.frame")


MESHES = (
    (".obj", formats.obj_text(np.zeros((3, 3))).encode()[:80]),
    (".ply", formats.ply_bytes(np.zeros((3, 3)))[:400]),
)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_meshes_only_ever_raise_input_errors(tmp_path_factory, data):
    ending, whole = data.draw(st.sampled_from(MESHES))
    content = bytearray(whole)
    for _ in range(data.draw(st.integers(0, 5))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / f"mesh{ending}"
    path.write_bytes(bytes(content[: data.draw(st.integers(0, len(content)))]))
    with pytest.raises(InputError, match="mesh"):
        read_vertices(path)
