"""Files made to do harm: nothing is read, written or run beyond what they may, and in no time."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import shutil

import numpy as np
import pytest
from test_head_pose import SMALL

from pav_blender.core import pickles
from pav_blender.core.collection import read_collection
from pav_blender.core.errors import InputError
from pav_blender.core.files import check_folder_name
from pav_blender.core.frame_files import clear, look
from pav_blender.core.head import load_head, write_head
from pav_blender.core.head.flame_parts import read_eyelids
from pav_blender.core.reading import read_array, read_arrays, read_json


def test_a_small_pickle_cannot_become_a_large_one():
    nested: list = [1.0] * 10
    for _ in range(12):
        nested = [nested] * 10
    many = [np.zeros(1 << 20)] * 1000
    for content in (nested, many):
        with pytest.raises(InputError, match="more than such files do"):
            pickles.loads(pickle.dumps(content, protocol=2), "x.pkl")


@pytest.mark.parametrize(
    "content",
    [
        b"\x80\x02]r\xff\xff\xff\x7f.",  # a place in the memo that would take gigabytes
        b"\x80\x04\x8e" + (1 << 40).to_bytes(8, "little") + b"x.",
        b"\x80\x05\x96" + (1 << 40).to_bytes(8, "little") + b"x.",
        b"\x80\x04\x8d" + (1 << 40).to_bytes(8, "little") + b"x.",
    ],
)
def test_sizes_in_a_pickle_take_no_memory(content):
    import tracemalloc

    tracemalloc.start()
    with contextlib.suppress(InputError):
        pickles.loads(content, "x.pkl")
    assert tracemalloc.get_traced_memory()[1] < 8 << 20
    tracemalloc.stop()


def test_links_out_of_a_collection_are_not_followed(toy_path, tmp_path):
    root = shutil.copytree(toy_path, tmp_path / "c")
    picture = root / "clips/plain/images/000000.png"
    picture.rename(tmp_path / "mine.png")
    picture.symlink_to(tmp_path / "mine.png")
    found = read_collection(root)
    with pytest.raises(InputError, match="leads out of the collection"):
        found.image_path(found.clip("plain"), 0)
    (root / "clips/bushy").rename(tmp_path / "bushy")
    (root / "clips/bushy").symlink_to(tmp_path / "bushy")
    with pytest.raises(InputError, match="leads out of the collection"):
        read_collection(root)


@pytest.mark.parametrize("name", ["../up", "a/b", "a\\b", "C:x", "", ".", "..", "nul", "a\n", "a "])
def test_appearances_name_folders_and_no_others(name):
    with pytest.raises(InputError, match="cannot name a folder"):
        check_folder_name(name, "appearance")
    assert check_folder_name("mit Bart, älter", "appearance")


def test_numbers_of_frames_far_apart_are_told_at_once(tmp_path):
    for name in ("0001.png", "99999999999999999999.png"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="--range"):
        look(tmp_path)


@pytest.mark.skipif(os.name != "posix", reason="links and pipes of posix")
def test_what_a_link_leads_to_is_not_removed(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/photo").touch()
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames/.partial-x").symlink_to(tmp_path / "mine")
    with pytest.raises(InputError, match="cannot be removed"):
        clear(look(tmp_path / "frames"))
    assert (tmp_path / "mine/photo").exists()


@pytest.mark.skipif(os.name != "posix", reason="links and pipes of posix")
def test_a_pipe_is_no_file(tmp_path):
    os.mkfifo(tmp_path / "head.npz")
    for read in (load_head, read_arrays, read_json):
        with pytest.raises(InputError, match=r"no such head file|not a file"):
            read(tmp_path / "head.npz")


def test_a_step_of_many_numbers_cannot_multiply_a_head(tmp_path):
    path = tmp_path / "head.npz"
    write_head(path, SMALL)
    content = read_arrays(path)
    np.savez(path, **content, shape_basis_step=np.ones((100_000, 1, 1, 1), np.float32))
    with pytest.raises(InputError, match="not one number"):
        load_head(path)


@pytest.mark.parametrize("length", [300, 100_000])
def test_texts_of_any_length_are_refused_in_a_line(toy_path, tmp_path, length):
    """A name that no file can have is the name of none, and is not repeated in full."""
    root = shutil.copytree(toy_path, tmp_path / "c")
    path = root / "collection.json"
    whole = json.loads(path.read_text())
    long = "x" * length
    for change in (
        {"version": long},
        {"head": {**whole["head"], "name": long}},
        {"head": {**whole["head"], "betas": [long]}},
        {"clips": [{**whole["clips"][0], "name": long}]},
    ):
        path.write_text(json.dumps(whole | change))
        with pytest.raises(InputError) as caught:
            read_collection(root)
        assert str(caught.value).startswith(f"{path}: ")
        assert len(str(caught.value)) < 1100
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "header", ["{'shape': (3,), \x01", "{'shape': ((((", "0" * 5000, "(" * 3000]
)
def test_heads_of_arrays_that_are_no_python_are_refused(tmp_path, header):
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header.encode())
    with pytest.raises(InputError, match="damaged"):
        read_array(path)


@pytest.mark.parametrize("shape", [(3, 7, 1), (7, 1, 3), (2, 7, 3), (21,), (7, 4)])
def test_eyelids_of_another_shape_are_refused(tmp_path, shape):
    path = tmp_path / "l_eyelid.npy"
    np.save(path, np.zeros((1, 7, 3), np.float32))
    assert read_eyelids(path, 7).shape == (7, 3)
    np.save(path, np.zeros(shape, np.float32))
    with pytest.raises(InputError, match="eyelid is"):
        read_eyelids(path, 7)
