"""Folders of other programs as collections: the same vertices at the same pixels."""

import os
import shutil
from pathlib import Path

import formats_fixtures as formats
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pav_blender.core.collection import LABELS, read_collection
from pav_blender.core.collection.importers import detect, normalise, read_sources, write_person
from pav_blender.core.collection.importers.meshes import read_vertices
from pav_blender.core.errors import InputError
from pav_blender.core.evaluation.check import check
from pav_blender.core.head.flame import read_flame
from pav_blender.core.head.library import remember_head
from pav_blender.core.images import read_gray, read_rgba
from pav_blender.core.pickles import read_torch
from pav_blender.core.training.frames import camera_of


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Folders with FLAME 2020 (and its companions) and FLAME 2023, both of the same numbers."""
    root = tmp_path_factory.mktemp("flame")
    for version, name in (("2020", "generic_model.pkl"), ("2023", "flame2023.pkl")):
        (root / version).mkdir()
        formats.write_model(root / version / name, chumpy=version == "2020")
        formats.write_companions(root / version)
    return root


@pytest.fixture(scope="module")
def heads(models):
    return {version: read_flame(models / version) for version in ("2020", "2023")}


@pytest.fixture(scope="module")
def templates(tmp_path_factory):
    """Sources written once each: {(writer, options): (folder, take)}."""
    return {}, tmp_path_factory.mktemp("templates")


@pytest.fixture
def make(templates):
    """make(writer, folder, **options): writes a source there, or a copy of one written before."""
    known, root = templates

    def write(writer, folder, **options):
        key = (writer, *sorted(options.items()))
        if key not in known:
            place = root / str(len(known))
            known[key] = place, writer(place, **options)
        shutil.copytree(known[key][0], folder)
        return known[key][1]

    return write


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


# ---- hostile and damaged sources


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
@pytest.mark.parametrize("value", ["../../etc/passwd", "/etc/passwd", "C:\\x.png", "a\0b"])
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
    with pytest.raises(InputError, match=r"00001\.npz: damaged, or it holds pickled objects"):
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
