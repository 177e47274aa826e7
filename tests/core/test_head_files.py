"""Head files: round trips, and what is wrong with malformed ones."""

import os

import numpy as np
import pytest
from test_head_pose import SMALL

from pav_blender.core.errors import InputError
from pav_blender.core.head import builtin_head, load_head, read_head, write_head


def test_round_trip_keeps_everything(tmp_path):
    path = tmp_path / "head.npz"
    write_head(path, SMALL)
    back = read_head(path)
    for field in ("template", "triangles", "shape_basis", "pose_basis", "landmark_barycentrics"):
        np.testing.assert_array_equal(getattr(back, field), getattr(SMALL, field))
    assert back.expression_names == SMALL.expression_names
    assert back.origin == SMALL.origin
    np.testing.assert_array_equal(back.regions["face"], SMALL.regions["face"])
    assert back.fingerprint == SMALL.fingerprint
    assert [p.name for p in tmp_path.iterdir()] == ["head.npz"]


def test_quantised_bases_are_near_and_stable(tmp_path):
    path = tmp_path / "head.npz"
    write_head(path, SMALL, step=2e-6)
    once = read_head(path)
    assert np.abs(once.shape_basis - SMALL.shape_basis).max() <= 1.01e-6
    write_head(path, once, step=2e-6)
    assert read_head(path).fingerprint == once.fingerprint


def test_step_too_small_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match="too far"):
        write_head(tmp_path / "head.npz", SMALL, step=1e-9)
    assert list(tmp_path.iterdir()) == []


def test_failed_write_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "head.npz"
    write_head(path, SMALL)
    before = path.read_bytes()

    def full(*_, **__):
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(OSError, match="space"):
        write_head(path, SMALL)
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.skipif(os.name != "posix", reason="modes of posix files")
def test_written_file_has_the_mode_of_any_new_file(tmp_path):
    write_head(tmp_path / "head.npz", SMALL)
    (tmp_path / "plain").touch()
    modes = {path.name: path.stat().st_mode for path in tmp_path.iterdir()}
    assert modes["head.npz"] == modes["plain"]


def test_load_head_by_name_or_path(tmp_path):
    path = tmp_path / "mine.npz"
    write_head(path, SMALL)
    assert load_head(path).name == "small"
    assert load_head("builtin") is builtin_head()


def rewritten(path, **changes):
    write_head(path, SMALL)
    with np.load(path) as file:
        content = dict(file)
    for name, value in changes.items():
        if value is None:
            del content[name]
        else:
            content[name] = value
    np.savez(path, **content)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"format": np.array("other")}, "not a head file"),
        ({"version": np.array(99)}, "version 99"),
        ({"triangles": None}, "lacks triangles"),
        ({"template": np.full((12, 3), np.inf, np.float32)}, "finite"),
        ({"template": np.array(["x"])}, "not numbers"),
        ({"expression_names": np.array(["a"])}, "expression_basis"),
        ({"region/face": np.zeros(3, bool)}, "face"),
        ({"region/face": np.full(12, "x")}, "face holds <U1, not yes or no"),
        ({"joints_follow_expression": np.array("x")}, "not yes or no"),
        ({"triangles": SMALL.triangles + 0.5}, "not whole numbers"),
        ({"triangles": SMALL.triangles + 2**40}, "outside"),
    ],
)
def test_malformed_head_files_are_named(tmp_path, changes, word):
    path = tmp_path / "bad.npz"
    rewritten(path, **changes)
    with pytest.raises(InputError, match=word) as caught:
        read_head(path)
    assert "bad.npz" in str(caught.value)


def test_missing_truncated_foreign_and_pickled_files(tmp_path):
    with pytest.raises(InputError, match="no such"):
        read_head(tmp_path / "nothing.npz")
    path = tmp_path / "head.npz"
    write_head(path, SMALL)
    whole = path.read_bytes()
    for content in (b"", b"hello", whole[: len(whole) // 2], whole[:-200] + bytes(200)):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"head\.npz"):
            read_head(path)
    np.savez(path, format=np.array([{"not": "plain"}], dtype=object))
    with pytest.raises(InputError, match="holds pickled objects"):
        read_head(path)
