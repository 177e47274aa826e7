"""What `pav export` wrote, imported again: the same pixels, coefficients, splits and labels."""

import dataclasses
import json
import shutil

import formats_fixtures as formats
import numpy as np
import pytest
from flame_fixture import posed as flame_posed
from test_import import imported, misses

from pav_blender.cli import main
from pav_blender.core.collection import LABELS, read_collection
from pav_blender.core.exporting import export_insta, export_vhap
from pav_blender.core.head import builtin_head
from pav_blender.core.head.oracle import rotation_matrix
from pav_blender.core.images import read_gray, read_rgba, write_gray
from pav_blender.core.training.frames import camera_of

CLOSE = 0.1  # pixels
EXPORT = {"insta": export_insta, "vhap": export_vhap}


@pytest.fixture(autouse=True)
def config(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("PAV_CONFIG", str(tmp_path_factory.mktemp("config")))


def pixels(collection, clip):
    """Where each vertex is seen, {frame number: [V, 2]}."""
    posed = collection.posed(clip, np.arange(len(clip)))
    return {
        int(number): camera_of(clip, row).project(posed[row])[0]
        for row, number in enumerate(clip.frame_id)
    }


SOURCES = {
    "lids": (formats.write_metrical, {"meshes": False, "matte": True}, "2020"),
    "meshes": (formats.write_insta, {}, "2020"),
    "offsets": (formats.write_vhap, {"dynamic": True}, "2023"),
}


@pytest.mark.parametrize("layout", EXPORT)
@pytest.mark.parametrize("source", SOURCES)
def test_a_flame_collection_comes_back(source, layout, tmp_path, heads, models, make):
    write, options, version = SOURCES[source]
    act = make(write, tmp_path / "me", **options)
    before = imported([str(tmp_path / "me")], heads[version], tmp_path / "a", models)
    own = before.clips[0]
    EXPORT[layout](before, before.clips, tmp_path / "out")
    assert not (tmp_path / "out/head.npz").exists()  # FLAME is not handed on
    after = imported([str(tmp_path / "out/me")], heads[version], tmp_path / "b", models)
    clip = after.clips[0]
    assert misses(after, clip, act.truth) < CLOSE
    assert misses(after, clip, pixels(before, own)) < CLOSE
    np.testing.assert_array_equal(clip.frame_id, own.frame_id)
    np.testing.assert_array_equal(clip.split, own.split)
    np.testing.assert_allclose(clip.expression[:, :100], own.expression[:, :100], atol=1e-6)
    np.testing.assert_allclose(clip.expression[:, 100:], own.expression[:, 100:], atol=0.03)
    # INSTA's files have the meshes alone, of which the pose is found again
    np.testing.assert_allclose(
        clip.pose[:, 2], own.pose[:, 2], atol=1e-4 if layout == "vhap" else 0.02
    )
    for row in range(len(clip)):
        ours, theirs = (read_rgba(c.image_path(k, row)) for c, k in ((after, clip), (before, own)))
        np.testing.assert_array_equal(ours, theirs)
    if source == "meshes" and layout == "insta":
        for row in range(len(clip)):
            ours = read_gray(after.labels_path(clip, row))
            np.testing.assert_array_equal(ours, read_gray(before.labels_path(own, row)))
    if layout == "vhap":
        np.testing.assert_allclose(after.betas, before.betas, atol=1e-6)
        if before.head_offset is not None:
            np.testing.assert_allclose(after.head_offset, before.head_offset, atol=1e-7)


@pytest.mark.parametrize("source", ["lids", "offsets"])
def test_vhaps_users_pose_what_the_collection_shows(source, tmp_path, heads, models, make):
    """By FLAME's formula and what is in the files, without the meshes that only we read."""
    write, options, version = SOURCES[source]
    make(write, tmp_path / "me", **options)
    collection = imported([str(tmp_path / "me")], heads[version], tmp_path / "a", models)
    clip = collection.clips[0]
    export_vhap(collection, collection.clips, tmp_path / "out")
    for row in range(len(clip)):
        with np.load(tmp_path / f"out/me/flame_param/{row:05d}.npz") as stored:
            turns = np.concatenate(
                [stored[k].ravel() for k in ("rotation", "neck_pose", "jaw_pose", "eyes_pose")]
            )
            offset = stored["static_offset"][0] + stored["dynamic_offset"][0]
            assert offset.shape == (5143, 3)
            made = flame_posed(
                stored["shape"],
                stored["expr"][0],
                np.stack([rotation_matrix(turn) for turn in turns.reshape(5, 3)]),
                stored["translation"][0],
                offset[:5023],
            )
        truth = collection.posed(clip, np.array([row]))[0]
        assert np.abs(made - truth).max() < 2e-5  # metres


@pytest.mark.parametrize("layout", EXPORT)
@pytest.mark.parametrize("head", ["builtin", "head.npz"])
def test_a_collection_of_another_head_comes_back(layout, head, toy, toy_path, tmp_path):
    out, again = tmp_path / "out", tmp_path / "again"
    assert main(["export", str(toy_path), "--to", layout, "--out", str(out)]) == 0
    words = [str(out / clip.name) for clip in toy.clips]
    words += ["--head", str(out / head) if head != "builtin" else head, "--out", str(again)]
    assert main(["import", *words]) == 0
    after = read_collection(again)
    assert after.head.fingerprint == toy.head.fingerprint
    assert after.appearances == toy.appearances
    for own in toy.clips:
        clip = after.clip(own.name)
        assert misses(after, clip, pixels(toy, own)) < CLOSE
        np.testing.assert_allclose(clip.expression, own.expression, atol=1e-6)
        np.testing.assert_array_equal(clip.split, own.split)
        np.testing.assert_array_equal(clip.frame_id, own.frame_id)
    if layout == "vhap":
        count = len(toy.betas)
        np.testing.assert_allclose(after.betas[:count], toy.betas, atol=1e-6)
        assert all(clip.vertices is None for clip in after.clips)


def test_another_head_than_the_exported_one_is_refused(toy, toy_path, heads, models, tmp_path,
                                                       capsys):  # fmt: skip
    out = tmp_path / "out"
    assert main(["export", f"{toy_path}:plain", "--to", "insta", "--out", str(out)]) == 0
    words = ["import", str(out / "plain"), "--head", str(models / "2020"), "--dry-run"]
    assert main(words) == 2
    assert "head.npz" in capsys.readouterr().err
    # a fingerprint that is none, or meshes of another size than the head's, are told as well
    names = out / "plain/names.json"
    formats.rewrite_json(names, lambda content: content.update(fingerprint="../../x"))
    assert main(words) == 2
    assert "vertices" in capsys.readouterr().err
    formats.rewrite_json(names, lambda c: c.update(fingerprint=heads["2020"].fingerprint))
    assert main(words) == 2
    assert "vertices" in capsys.readouterr().err


def test_labels_come_back_but_for_beards(toy, tmp_path):
    clip = dataclasses.replace(toy.clip("plain"))
    rgba = [read_rgba(toy.image_path(clip, row)) for row in range(len(clip))]
    folder = tmp_path / "labels" / "clips" / "plain"
    shutil.copytree(toy.path, tmp_path / "labels")
    for row, picture in enumerate(rgba):
        labels = np.where(picture[..., 3] > 0, np.arange(picture.shape[1])[None] % len(LABELS), 0)
        write_gray(folder / f"labels/{clip.frame_id[row]:06d}.png", labels.astype(np.uint8))
    before = read_collection(tmp_path / "labels")
    export_insta(before, [before.clip("plain")], tmp_path / "out")
    assert main(["import", str(tmp_path / "out/plain"), "--head", "builtin", "--out",
                 str(tmp_path / "b")]) == 0  # fmt: skip
    after = read_collection(tmp_path / "b")
    want = read_gray(before.labels_path(before.clip("plain"), 2))
    want[want == LABELS.index("facial_hair")] = LABELS.index("face")
    np.testing.assert_array_equal(read_gray(after.labels_path(after.clips[0], 2)), want)
    assert len(np.unique(want)) > 4
    assert json.loads((tmp_path / "out/plain/names.json").read_text())["head"] == "builtin"
    assert builtin_head().fingerprint == after.head.fingerprint
