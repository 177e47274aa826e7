"""Folders of other programs as collections: the same vertices at the same pixels."""

import formats_fixtures as formats
import numpy as np
import pytest

from pav_blender.core.collection import LABELS, read_collection
from pav_blender.core.collection.importers import detect, normalise, read_sources, write_person
from pav_blender.core.errors import InputError
from pav_blender.core.evaluation.check import check
from pav_blender.core.head.library import remember_head
from pav_blender.core.images import read_gray, read_rgba
from pav_blender.core.training.frames import camera_of


@pytest.fixture(autouse=True)
def config(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("PAV_CONFIG", str(tmp_path_factory.mktemp("config")))


def imported(sources, head, out, models, **options):
    """The collection that sources become, read back from disk."""
    person = normalise(read_sources(sources), head, **options)
    write_person(person, out)
    for version in ("2020", "2023"):
        if head.name == f"FLAME {version}":
            remember_head(models / version)
    return read_collection(out)


def misses(collection, clip, truth):
    """The farthest that any vertex lies from where the tool's own camera shows it, pixels."""
    worst = 0.0
    for row, number in enumerate(clip.frame_id):
        vertices = collection.posed(clip, np.array([row]))[0]
        pixels, depth = camera_of(clip, row).project(vertices)
        assert (depth > 0).all()
        worst = max(worst, float(np.abs(pixels - truth[int(number)]).max()))
    return worst


FORMATS = {
    "insta": (formats.write_insta, {}, "2020"),
    "insta without its canonical mesh": (formats.write_insta, {"canonical": False}, "2020"),
    "metrical": (formats.write_metrical, {}, "2020"),
    "metrical with a matte": (formats.write_metrical, {"matte": True}, "2020"),
    "metrical without meshes": (formats.write_metrical, {"meshes": False}, "2020"),
    "flashavatar": (formats.write_flashavatar, {}, "2020"),
    "vhap": (formats.write_vhap, {}, "2023"),
    "vhap with moving offsets": (formats.write_vhap, {"dynamic": True}, "2023"),
    "vhap-track": (formats.write_vhap_track, {}, "2023"),
    "imavatar": (formats.write_imavatar, {}, "2020"),
    "imavatar of pixels": (formats.write_imavatar, {"pixels_512": True}, "2020"),
}


@pytest.mark.parametrize("name", FORMATS)
def test_vertices_are_seen_where_the_tool_saw_them(name, tmp_path, heads, models, make):
    write, options, version = FORMATS[name]
    act = make(write, tmp_path / "source", **options)
    assert detect(tmp_path / "source") == name.split()[0]
    collection = imported([f"me={tmp_path / 'source'}"], heads[version], tmp_path / "c", models)
    clip = collection.clip("me")
    assert len(clip) == formats.FRAMES
    assert misses(collection, clip, act.truth) < 0.1
    assert not clip.pose[:, 0].any()
    assert not clip.translation.any()
    found = check(collection)
    assert found.problems == []
    assert found.summary[0]["face_in_matte"] > 0.95


def read_one(path, head, out, models, **options):
    collection = imported([f"me={path}"], head, out, models, **options)
    return collection, collection.clip("me")


def test_parameters_come_through(tmp_path, heads, models, make):
    """What a mesh alone holds is found again; what is written down is kept."""
    act = make(formats.write_insta, tmp_path / "insta")
    collection, clip = read_one(tmp_path / "insta", heads["2020"], tmp_path / "c", models)
    shape = heads["2020"].shaped(act.shape.astype(np.float32))
    own = heads["2020"].shaped(collection.betas)
    assert np.linalg.norm(own - shape, axis=1).max() < 1e-4
    np.testing.assert_allclose(clip.pose[:, 2], act.jaw, atol=0.02)
    np.testing.assert_allclose(clip.expression[:, :100], act.expression, atol=1e-6)
    assert np.abs(clip.expression[:, 100:] - act.lids).max() < 0.2

    act = make(formats.write_imavatar, tmp_path / "imavatar")
    collection, clip = read_one(tmp_path / "imavatar", heads["2020"], tmp_path / "d", models)
    np.testing.assert_allclose(collection.betas, act.shape, atol=1e-6)
    np.testing.assert_allclose(clip.pose[:, 1], act.neck, atol=1e-6)
    np.testing.assert_allclose(clip.pose[:, 3:], act.eyes, atol=1e-6)
    assert clip.vertices is None
    assert list(clip.frame_id) == [1, 2, 3, 4, 5, 6]


def test_eyes_in_the_other_order_are_told_by_the_meshes(tmp_path, heads, models, monkeypatch):
    made = formats.metrical_frame

    def swapped(act, frame):
        content, vertices, world = made(act, frame)
        eyes = content["flame"]["eyes"]
        content["flame"]["eyes"] = np.concatenate([eyes[:, 6:], eyes[:, :6]], 1)
        return content, vertices, world

    monkeypatch.setattr(formats, "metrical_frame", swapped)
    act = formats.write_metrical(tmp_path / "source")
    _, clip = read_one(tmp_path / "source", heads["2020"], tmp_path / "c", models)
    np.testing.assert_allclose(clip.pose[:, 3:], act.eyes, atol=1e-5)


def test_pictures_mattes_and_labels(tmp_path, heads, models, make):
    make(formats.write_vhap, tmp_path / "vhap")
    collection, clip = read_one(tmp_path / "vhap", heads["2023"], tmp_path / "c", models)
    truth = read_gray(tmp_path / "vhap/fg_masks/00002_00.png")
    rgba = read_rgba(collection.image_path(clip, 2))
    np.testing.assert_array_equal(rgba[..., 3], truth)
    # VHAP lays pictures on white; a soft edge keeps the skin's colour, not white's
    soft = (truth > 60) & (truth < 200)
    assert soft.sum() > 30
    laid = read_rgba(tmp_path / "vhap/images/00002_00.png")
    assert rgba[soft][:, 2].mean() < laid[soft][:, 2].mean() - 30
    assert abs(rgba[soft][:, 2].mean() - rgba[truth == 255][:, 2].mean()) < 25

    make(formats.write_insta, tmp_path / "insta")
    collection, clip = read_one(tmp_path / "insta", heads["2020"], tmp_path / "d", models)
    labels = read_gray(collection.labels_path(clip, 1))
    alpha = read_rgba(collection.image_path(clip, 1))[..., 3]
    assert (labels[alpha == 0] == LABELS.index("background")).all()
    assert {LABELS[i] for i in np.unique(labels)} == {"background", "face", "scalp_hair"}

    make(formats.write_imavatar, tmp_path / "im")
    collection, clip = read_one(tmp_path / "im", heads["2020"], tmp_path / "e", models)
    labels = read_gray(collection.labels_path(clip, 1))
    assert {LABELS[i] for i in np.unique(labels)} == {"background", "face", "scalp_hair"}


def test_several_sources_are_appearances_of_one_person(tmp_path, heads, models, make):
    make(formats.write_insta, tmp_path / "a", seed=1)
    act = make(formats.write_imavatar, tmp_path / "b", seed=2)
    sources = [f"young={tmp_path / 'a'}", f"old={tmp_path / 'b'}"]
    mean = imported(sources, heads["2020"], tmp_path / "c", models)
    assert mean.appearances == ["young", "old"]
    first = imported(sources[::-1], heads["2020"], tmp_path / "d", models, shapes="first")
    np.testing.assert_allclose(first.betas, act.shape, atol=1e-6)
    assert np.abs(mean.betas - first.betas).max() > 0.1
    assert misses(first, first.clip("old"), act.truth) < 0.1
    with pytest.raises(InputError, match="two clips are called 'x'"):
        imported([f"x={tmp_path / 'a'}", f"x={tmp_path / 'b'}"], heads["2020"], tmp_path, models)
    with pytest.raises(InputError, match="mean, first"):
        imported(sources, heads["2020"], tmp_path / "e", models, shapes="median")


def test_combined_sequences_and_cameras_are_told_apart(tmp_path, heads, models, make):
    acts = formats.write_combined(tmp_path)
    collection = imported([f"me={tmp_path / 'UNION'}"], heads["2023"], tmp_path / "c", models)
    assert [clip.name for clip in collection.clips] == ["EMO-1", "SEN-2"]
    assert collection.appearances == ["me"]
    for name, split in (("EMO-1", "train"), ("SEN-2", "test")):
        clip = collection.clip(name)
        assert set(clip.split) == {split}
        assert list(clip.frame_id) == list(range(formats.FRAMES))
    own = imported([f"me={tmp_path / 'SEN-2'}"], heads["2023"], tmp_path / "d", models)
    assert misses(own, own.clip("me"), acts["SEN-2"].truth) < 0.1

    act = make(formats.write_vhap, tmp_path / "rig", cameras=2)
    rig = imported([str(tmp_path / "rig")], heads["2023"], tmp_path / "e", models)
    assert [clip.name for clip in rig.clips] == ["rig_cam0", "rig_cam1"]
    assert list(rig.clip("rig_cam0").split) == ["train"] * 4 + ["test"] * 2
    assert list(rig.clip("rig_cam1").split) == ["view"] * 4 + ["test"] * 2
    side = {frame: act.truth[1000 + frame] for frame in range(formats.FRAMES)}
    assert misses(rig, rig.clip("rig_cam1"), side) < 0.1


def test_held_out_frames(tmp_path, heads, models, make):
    make(formats.write_insta, tmp_path / "split")
    _, clip = read_one(tmp_path / "split", heads["2020"], tmp_path / "a", models)
    assert list(clip.split) == ["train"] * 4 + ["test"] * 2
    make(formats.write_insta, tmp_path / "whole", split=False)
    _, clip = read_one(tmp_path / "whole", heads["2020"], tmp_path / "b", models)
    assert list(clip.split) == ["train"] * 5 + ["test"]
    _, clip = read_one(tmp_path / "whole", heads["2020"], tmp_path / "c", models, hold_out=3)
    assert list(clip.split) == ["train"] * 3 + ["test"] * 3
    with pytest.raises(InputError, match="leaves none"):
        read_one(tmp_path / "whole", heads["2020"], tmp_path / "d", models, hold_out=6)
    parsed = read_sources([str(tmp_path / "whole")])
    assert parsed[0].habit == 350


def test_the_flame_of_a_track_is_checked(tmp_path, heads, make):
    make(formats.write_imavatar, tmp_path / "old")
    make(formats.write_vhap, tmp_path / "new")
    for name, version, other in (("old", "2020", "2023"), ("new", "2023", "2020")):
        parsed = read_sources([str(tmp_path / name)])
        with pytest.raises(InputError, match=f"tracked with FLAME {version}"):
            normalise(parsed, heads[other])
        normalise(parsed, heads[other], tracked_with=other)
        normalise(parsed, heads[version])
        with pytest.raises(InputError, match="one of 2020, 2023"):
            normalise(parsed, heads[version], tracked_with="2021")
    from pav_blender.core.head import builtin_head

    with pytest.raises(InputError, match="is not FLAME"):
        normalise(parsed, builtin_head())


def test_nerface_is_refused_with_what_it_lacks(tmp_path):
    formats.write_nerface(tmp_path / "n")
    assert detect(tmp_path / "n") == "nerface"
    with pytest.raises(InputError, match="no mesh and no identity"):
        read_sources([str(tmp_path / "n")])
    with pytest.raises(InputError, match="not a folder of"):
        detect(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        detect(tmp_path / "nothing")
