"""FLAME's files: read as their makers wrote them, and told apart from what is not one."""

import contextlib
import pickle
import struct
from pathlib import Path

import formats_fixtures as formats
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from test_import_hostile import Run

from pav_blender.core import pickles, preferences
from pav_blender.core.errors import InputError
from pav_blender.core.head import builtin_head, load_head, oracle, remember_head, write_head
from pav_blender.core.head.flame import EYELIDS, find_flame, read_flame, version_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """FLAME 2020 in the older form, with everything that may lie beside it."""
    root = tmp_path_factory.mktemp("flame")
    formats.write_model(root / "generic_model.pkl", chumpy=True)
    formats.write_companions(root)
    faces = np.arange(0, 9000, 90)[:100]
    np.savez(
        root / "mediapipe_landmark_embedding.npz",
        lmk_face_idx=faces,
        lmk_b_coords=np.full((100, 3), 1 / 3),
        landmark_indices=np.arange(0, 400, 4),
    )
    return root


@pytest.fixture(scope="module")
def head(folder):
    return read_flame(folder)


@pytest.fixture(autouse=True)
def config(tmp_path, monkeypatch):
    monkeypatch.setenv("PAV_CONFIG", str(tmp_path / "config"))


def test_everything_in_the_model_is_read(head):
    arrays = formats.flame().arrays
    assert head.name == "FLAME 2020"
    assert version_of(head) == "2020"
    np.testing.assert_array_equal(head.template, arrays["v_template"].astype(np.float32))
    np.testing.assert_array_equal(head.triangles, arrays["f"])
    assert head.shape_basis.shape == (300, 5023, 3)
    assert head.expression_basis.shape == (102, 5023, 3)
    assert head.expression_names[-2:] == EYELIDS
    np.testing.assert_allclose(head.shape_basis[17], arrays["shapedirs"][:, :, 17], atol=1e-7)
    np.testing.assert_allclose(head.expression_basis[5], arrays["shapedirs"][:, :, 305], atol=1e-7)
    np.testing.assert_allclose(head.pose_basis[30], arrays["posedirs"][:, :, 30], atol=1e-7)
    np.testing.assert_allclose(head.joints(np.zeros(1)), arrays["J"], atol=1e-6)
    assert head.joint_names == ("root", "neck", "jaw", "left_eye", "right_eye")
    assert head.joint_parents.tolist() == [-1, 0, 1, 1, 1]


def test_what_lies_beside_the_model_is_read(head):
    model = formats.flame()
    corners = head.uvs[head.uv_triangles]
    np.testing.assert_allclose(corners, model.uvs[model.uv_faces], atol=1e-5)
    for name in ("face", "lips", "neck", "scalp", "eyeballs"):
        assert head.regions[name].any(), name
    assert set(model.masks["lips"]) <= set(np.flatnonzero(head.regions["lips"]))
    assert set(model.masks["lips"]) <= set(np.flatnonzero(head.regions["face"]))
    np.testing.assert_allclose(head.expression_basis[100], model.eyelids[0], atol=1e-7)


def test_landmarks_are_those_given_and_the_rest_near_the_surface(head):
    assert len(head.landmark_triangles) == 478
    points = head.landmarks(head.template)
    centres = head.template[head.triangles[np.arange(0, 9000, 90)[:100]]].mean(1)
    np.testing.assert_allclose(points[np.arange(0, 400, 4)], centres, atol=1e-6)
    assert (head.landmark_barycentrics >= 0).all()


def test_a_model_alone_has_what_training_needs(tmp_path):
    head = read_flame(formats.write_model(tmp_path / "flame2023.pkl"))
    assert version_of(head) == "2023"
    assert head.expression_basis.shape[0] == 100
    assert 500 < head.regions["face"].sum() < 4000
    assert head.uvs.min() >= 0
    assert head.uvs.max() <= 1
    truth = np.isin(np.arange(5023), formats.flame().masks["face"])
    assert (head.regions["face"] & truth).sum() > 0.8 * truth.sum()


def test_posing_is_flames_own(head):
    """Against this test suite's own skinning, whose joints follow the expression."""
    act = formats.take(3)
    pose = np.concatenate([act.root, act.neck, act.jaw, act.eyes.reshape(-1, 6)], 1)
    pose = pose.reshape(-1, 5, 3)
    shift = np.array([0.1, -0.2, 0.3])
    posed = head.pose(act.shape, act.expression, pose, np.tile(shift, (len(pose), 1))).numpy()
    truth = [
        formats.posed(act.shape, act.expression[f], act.turns(f), shift) for f in range(len(pose))
    ]
    assert np.abs(posed - truth).max() < 2e-6
    twin = oracle.pose(head, act.shape, act.expression[1], pose[1], shift)
    assert np.abs(twin - truth[1]).max() < 2e-6


def test_a_converted_npz_is_the_same_head(tmp_path, head):
    arrays = {k: v for k, v in formats.flame().arrays.items() if k != "J"}
    np.savez(tmp_path / "FLAME2020.npz", **arrays)
    again = read_flame(tmp_path / "FLAME2020.npz")
    np.testing.assert_array_equal(again.template, head.template)
    arrays["J_regressor"] = np.array(sparse.csc_matrix(arrays["J_regressor"]), dtype=object)
    np.savez(tmp_path / "objects.npz", **arrays)
    with pytest.raises(InputError, match="toarray"):
        read_flame(tmp_path / "objects.npz")


def test_wrong_files_are_told_apart(tmp_path):
    path = tmp_path / "generic_model.pkl"
    model = formats.write_model(tmp_path / "whole.pkl").read_bytes()
    smpl = {**formats.flame().arrays, "v_template": np.zeros((6890, 3))}
    cases = {
        b"": "an empty file",
        b"<!DOCTYPE html><html><body>Please sign in</body></html>": "login page",
        b"\n <HTML>": "login page",
        b"version https://git-lfs.github.com/spec/v1\noid sha256:1": "git lfs pull",
        model[: len(model) // 2]: "cut short at",
        model[:-1]: "cut short at",
        pickle.dumps(smpl, protocol=2): r"SMPL \(6890 vertices\), not FLAME",
        pickle.dumps(formats.flame().masks, protocol=2): "the masks of FLAME",
        pickle.dumps([1, 2], protocol=2): "something else",
        b"\x89PNG\r\n\x1a\n": "not a readable pickle|refused",
    }
    for content, words in cases.items():
        path.write_bytes(content)
        with pytest.raises(InputError, match=words) as caught:
            read_flame(path)
        assert "generic_model.pkl" in str(caught.value)
    with pytest.raises(InputError, match=r"flame\.is\.tue\.mpg\.de"):
        find_flame(tmp_path / "nothing.pkl")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="name the model file"):
        find_flame(tmp_path / "empty")


def test_a_zip_is_told_and_what_is_in_it(tmp_path):
    import zipfile

    with zipfile.ZipFile(tmp_path / "FLAME2020.pkl", "w") as archive:
        archive.writestr("generic_model.pkl", b"x")
    with pytest.raises(InputError, match=r"a zip archive; unpack it and name generic_model\.pkl"):
        read_flame(tmp_path / "FLAME2020.pkl")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shapedirs": np.zeros((5023, 3, 100))}, "shapedirs has shape"),
        ({"f": np.full((10, 3), 6000)}, "out of range"),
        ({"weights": np.full((5023, 5), np.nan)}, "not finite"),
        ({"weights": np.full((5023, 5), 0.5)}, "skinning_weights"),
        ({"posedirs": "none"}, "posedirs|malformed"),
    ],
)
def test_malformed_models_are_told(changes, words, tmp_path):
    path = formats.write_model(tmp_path / "generic_model.pkl", **changes)
    with pytest.raises(InputError, match=words):
        read_flame(path)


def test_a_file_whose_name_is_silent_needs_a_word(tmp_path):
    path = formats.write_model(tmp_path / "head.pkl")
    with pytest.raises(InputError, match="--flame-version"):
        read_flame(path)
    assert read_flame(find_flame(path, "2023 Open")).name == "FLAME 2023 Open"
    with pytest.raises(InputError, match="one of 2020"):
        find_flame(path, "2021")


def test_heads_are_remembered_by_fingerprint(tmp_path, folder, head):
    with pytest.raises(InputError, match="pav import --head FILE"):
        load_head("FLAME 2020", head.fingerprint)
    remember_head(folder)
    assert set(preferences.read("heads")) == {head.fingerprint}
    assert load_head("FLAME 2020", head.fingerprint).fingerprint == head.fingerprint
    # the eyelids that were beside the model then belong to it: without them it is another head
    moved = tmp_path / "moved"
    moved.mkdir()
    path = formats.write_model(moved / "generic_model.pkl")
    other = remember_head(path)
    assert other.fingerprint != head.fingerprint
    assert len(preferences.read("heads")) == 2
    path.unlink()
    with pytest.raises(InputError, match="no longer there"):
        load_head("FLAME 2020", other.fingerprint)
    formats.write_model(path, seed=1)
    with pytest.raises(InputError, match="files were changed"):
        load_head("FLAME 2020", other.fingerprint)


def test_damaged_preferences_are_no_preferences(tmp_path):
    assert preferences.read("heads") == {}
    preferences.folder().mkdir()
    (preferences.folder() / "preferences.json").write_text("{broken")
    assert preferences.read("heads") == {}
    preferences.write("other", {"a": 1})
    preferences.write("heads", {"b": "c"})
    assert preferences.read("other") == {"a": 1}
    own = tmp_path / "mine.npz"
    write_head(own, builtin_head(), step=1e-5)
    head = remember_head(own)
    assert load_head("mine", head.fingerprint).name == "builtin"


@pytest.mark.parametrize(
    ("platform", "variables", "place"),
    [
        ("linux", {"XDG_CONFIG_HOME": "/x"}, "/x/pav_blender"),
        ("linux", {}, "/home/me/.config/pav_blender"),
        ("darwin", {}, "/home/me/Library/Application Support/pav_blender"),
        ("win32", {"APPDATA": "/roaming"}, "/roaming/pav_blender"),
        ("linux", {"PAV_CONFIG": "/mine"}, "/mine"),
    ],
)
def test_where_preferences_lie(platform, variables, place, monkeypatch):
    for name in ("PAV_CONFIG", "XDG_CONFIG_HOME", "APPDATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(preferences.sys, "platform", platform)
    monkeypatch.setattr(preferences.Path, "home", lambda: Path("/home/me"))
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert preferences.folder() == Path(place)


def test_an_offset_belongs_to_the_person_not_to_the_model(head):
    offset = np.full((5023, 3), 0.01)
    person = head.with_offset(offset)
    assert person.fingerprint == head.fingerprint
    np.testing.assert_allclose(person.template, head.template + np.float32(0.01), atol=1e-7)
    still = np.zeros((1, 102)), np.zeros((1, 5, 3)), np.zeros((1, 3))
    a = person.pose(np.zeros(3), *still)
    b = head.pose(np.zeros(3), *still, offset=offset[None])
    assert float((a - b).abs().max()) < 1e-6
    with pytest.raises(InputError, match="an offset of shape"):
        head.with_offset(offset[:3])


# ---- pickles


def test_hostile_pickles_are_refused_and_nothing_runs(tmp_path):
    path = tmp_path / "generic_model.pkl"
    mark = tmp_path / "ran"
    for protocol in range(5):
        path.write_bytes(pickle.dumps({"v_template": Run(f"touch {mark}")}, protocol=protocol))
        with pytest.raises(InputError, match=r"refused to unpickle.*system"):
            read_flame(path)
    by_hand = {
        b"cbuiltins\neval\n(S'1'\ntR.": "builtins.eval",
        b"c__builtin__\nexec\n(S'1'\ntR.": "exec",
        b"cnumpy.f2py.capi_maps\ngetinit\n.": "numpy.f2py",
        b"cnumpy\nload\n(S'x'\ntR.": "numpy.load",
        b"ctorch\nload\n.": "torch.load",
        b"cnumpy\nndarray.tofile\n.": "not allowed",
        b"cscipy.sparse.csc\nnp.os.system\n.": "not allowed",
        b"ccopy_reg\n_reconstructor\n(cbuiltins\nlist\nNNtR.": "not allowed",
        b"c_codecs\nencode\n(S'a'\nS'rot13'\ntR.": "not allowed",
        b"\x80\x02Kac__main__\nx\n.": "not allowed",
    }
    for content, words in by_hand.items():
        with pytest.raises(InputError, match=words):
            pickles.loads(content, "x.pkl")
    assert not mark.exists()


def test_arrays_that_claim_too_much_are_refused():
    def array(shape, kind, data):
        made = pickle.dumps(np.zeros(3), protocol=2)
        assert b"f8" in made
        state = (1, shape, kind, False, data)
        head = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(K\x00tU\x01btR"
        return b"\x80\x02" + head + pickle.dumps(state, protocol=2)[2:-1] + b"b."

    with pytest.raises(InputError, match=r"not allowed|incomplete|size"):
        pickles.loads(array((10**9,), "f8", b"\0" * 8), "x.pkl")
    good = pickle.dumps(np.arange(6, dtype=">i2").reshape(2, 3, order="F"), protocol=2)
    np.testing.assert_array_equal(pickles.loads(good, "x"), np.arange(6).reshape(2, 3, order="F"))
    shrunk = good.replace(struct.pack("<BB", 0x4B, 3), struct.pack("<BB", 0x4B, 9), 1)
    with pytest.raises(InputError):
        pickles.loads(shrunk, "x")


@pytest.mark.parametrize("protocol", range(6))
def test_plain_contents_come_back(protocol):
    content = {
        "a": np.arange(6, dtype=np.float32).reshape(2, 3),
        "b": [1, 2.5, "text", None, True, (np.int64(4), b"bytes")],
        "c": np.array(["x", "yy"]),
        "d": np.float64(0.5),
    }
    back = pickles.loads(pickle.dumps(content, protocol=protocol), "x")
    np.testing.assert_array_equal(back["a"], content["a"])
    assert back["b"] == content["b"]
    assert list(back["c"]) == ["x", "yy"]
    assert back["d"] == 0.5
    matrix = sparse.random(5, 7, 0.3, "csr", random_state=1)
    back = pickles.loads(pickle.dumps(matrix, protocol=protocol), "x")
    np.testing.assert_array_equal(back.toarray(), matrix.toarray())


SEED = pickle.dumps({"a": np.arange(4.0), "b": sparse.eye(3, format="csc"), "c": [1]}, protocol=2)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damaged_pickles_only_ever_raise_input_errors(data):
    content = bytearray(SEED)
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(content)))
    with contextlib.suppress(InputError):
        pickles.loads(bytes(content[:cut]) if data.draw(st.booleans()) else bytes(content), "x")
