"""`pav import` as a user runs it, and what comes of it: an avatar that looks like the subject."""

import dataclasses
import json
from types import SimpleNamespace

import formats_fixtures as formats
import numpy as np
import pytest
import torch
from test_cli import pav, refused

from pav_blender.cli import main
from pav_blender.core.collection import read_collection
from pav_blender.core.evaluation.metrics import over, psnr
from pav_blender.core.field.avatar import Avatar
from pav_blender.core.images import read_rgba
from pav_blender.core.rendering.sequence import posed_avatar


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """FLAME 2020 and 2023 with their companions, and a source of every format."""
    root = tmp_path_factory.mktemp("sources")
    for version, name in (("2020", "generic_model.pkl"), ("2023", "flame2023.pkl")):
        (root / version).mkdir()
        # other numbers than 2020's would be another person's head to the fixtures' own posing
        formats.write_model(root / version / name, chumpy=version == "2020")
        formats.write_companions(root / version, eyelids=version == "2020")
    formats.write_insta(root / "insta")
    formats.write_metrical(root / "metrical", matte=True)
    formats.write_flashavatar(root / "flash")
    formats.write_imavatar(root / "imavatar")
    formats.write_combined(root)
    formats.write_vhap_track(root / "track")
    formats.write_nerface(root / "nerface")
    return root


@pytest.fixture(autouse=True)
def config(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("PAV_CONFIG", str(tmp_path_factory.getbasetemp() / "config"))


OLD = ("insta", "metrical", "flash", "imavatar")
NEW = ("UNION", "track")


@pytest.fixture(scope="module")
def collections(place, tmp_path_factory):
    made = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PAV_CONFIG", str(tmp_path_factory.getbasetemp() / "config"))
        for version, sources in (("2020", OLD), ("2023", NEW)):
            out = place / f"out{version}"
            sources = [f"{name.lower()}={place / name}" for name in sources]
            words = ["import", *sources, "--head", str(place / version), "--out", str(out)]
            assert main(words) == 0
            made[version] = out
    return made


def test_a_dry_run_says_everything_and_writes_nothing(place, tmp_path, capsys):
    before = sorted(p for p in place.rglob("*") if "out20" not in str(p))
    words = ["import", f"me={place / 'insta'}", str(place / "metrical"), "--dry-run"]
    words += ["--head", str(place / "2020"), "--out", str(tmp_path / "c")]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "FLAME 2020, 102 expressions" in said
    assert "me (INSTA): appearance me, 6 frames of 96x80 (4 train, 2 test)" in said
    assert "metrical (metrical-tracker): appearance metrical, 6 frames" in said
    assert "lost: depth maps" in said
    assert "nothing was written" in said
    assert list(tmp_path.iterdir()) == []
    assert sorted(p for p in place.rglob("*") if "out20" not in str(p)) == before


def test_what_was_imported_passes_the_check_and_its_overlay_shows_it(collections, tmp_path, capsys):
    for version, names in (("2020", OLD), ("2023", NEW)):
        path = collections[version]
        assert main(["check", str(path), "--out", str(tmp_path / f"{version}.png")]) == 0
        assert "no problems found" in capsys.readouterr().out
        collection = read_collection(path)
        assert collection.appearances == [name.lower() for name in names]
        sheet = read_rgba(tmp_path / f"{version}.png")
        assert (sheet[..., 1].astype(int) - sheet[..., 0] > 40).mean() > 0.01
    described = json.loads((path / "collection.json").read_text())
    assert described["head"]["name"] == "FLAME 2023"
    assert len(described["head"]["fingerprint"]) == 64
    assert described["head"]["offset"] is True
    assert not any(path.rglob("*.pkl"))


def test_a_head_that_is_known_need_not_be_named(place, collections, capsys):
    for source, name in (("insta", "FLAME 2020"), ("track", "FLAME 2023")):
        assert main(["import", str(place / source), "--dry-run"]) == 0
        assert f"head: {name}" in capsys.readouterr().out


def test_a_collection_does_not_hold_the_head(collections, tmp_path, monkeypatch):
    """Elsewhere the head has to be made known first."""
    path = collections["2020"]
    monkeypatch.setenv("PAV_CONFIG", str(tmp_path / "other"))
    line = refused("check", path)
    assert "collection.json: the head 'FLAME 2020'" in line
    assert "pav import --head FILE" in line
    done = pav("import", "--head", path.parent / "2020" / "generic_model.pkl")
    assert "remembered" in done.stdout
    read_collection(path)


def test_wrong_input_is_one_line(place, tmp_path, capsys):
    def told(*words):
        assert main(["import", *map(str, words)]) == 2
        lines = capsys.readouterr().err.splitlines()
        (line,) = [line for line in lines if line.startswith("pav")]
        return line

    out = tmp_path / "c"
    insta, head = place / "insta", place / "2020"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PAV_CONFIG", str(tmp_path / "nobody"))
        assert "--head is missing: FLAME 2020's model" in told(insta, "--out", out)
    assert "--out is missing" in told(insta, "--head", head)
    assert "no such folder" in told(tmp_path / "x", "--head", head, "--out", out)
    assert "FLAME 2020 with --head" in told(insta, "--head", place / "2023", "--out", out)
    assert "is not FLAME" in told(insta, "--head", "builtin", "--out", out)
    assert "no mesh" in told(place / "nerface", "--head", head, "--out", out)
    assert "--format 'x'" in told(insta, "--head", head, "--out", out, "--format", "x")
    assert "--hold-out -1" in told(insta, "--head", head, "--out", out, "--hold-out", "-1")
    (tmp_path / "login.pkl").write_text("<!DOCTYPE html><title>Sign in</title>")
    assert "login page" in told("--head", tmp_path / "login.pkl")
    assert not out.exists()
    assert "exists already" in told(insta, "--head", head, "--out", place / "insta")


def test_a_track_moves_its_own_avatar_as_it_was_tracked(collections):
    """With an offset of the person's own, and with meshes beyond the parameters."""
    for version, name in (("2023", "track"), ("2020", "insta")):
        collection = read_collection(collections[version])
        clip = collection.clip(name)
        rows = np.arange(len(clip))
        if name == "insta":
            bent = collection.posed(clip, rows)
            clip = dataclasses.replace(clip, vertices=bent + 2e-3 * np.sin(300 * bent))
        avatar = SimpleNamespace(betas=collection.betas, head_offset=collection.head_offset)
        moved = posed_avatar(avatar, collection, clip, rows)
        assert np.abs(moved - collection.posed(clip, rows)).max() < 1e-5
        stranger = SimpleNamespace(betas=np.zeros(3, np.float32), head_offset=None)
        other = posed_avatar(stranger, collection, clip, rows)
        assert np.abs(other - moved).max() > 1e-3
    assert read_collection(collections["2023"]).head_offset is not None


def test_an_avatar_keeps_the_offset_and_the_fingerprint_not_the_model(collections, small_config,
                                                                      tmp_path):  # fmt: skip
    from pav_blender.core.training.prepare import load_training_frames, new_avatar

    collection = read_collection(collections["2023"])
    torch.manual_seed(0)
    made = new_avatar(collection, load_training_frames(collection), small_config)
    made.save(tmp_path / "a.pav")
    back = Avatar.load(tmp_path / "a.pav")
    np.testing.assert_array_equal(back.head_offset, collection.head_offset)
    assert back.head_fingerprint == collection.head.fingerprint
    assert (tmp_path / "a.pav").stat().st_size < 20e6
    basis = collection.head.shape_basis[3, :50].tobytes()
    assert basis not in (tmp_path / "a.pav").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("version", ["2020", "2023"])
def test_the_avatar_of_an_import_looks_like_the_subject(version, collections, tmp_path):
    """import -> train -> render, every format of that FLAME as an appearance."""
    path = collections[version]
    pav("train", path, "--out", tmp_path / "a.pav", "--iterations", "150")
    collection = read_collection(path)
    clip = collection.clips[0]
    pav(
        "render", tmp_path / "a.pav", "--track", f"{path}:{clip.name}", "--appearance", "all",
        "--frames", clip.frame_id[1], "--out", tmp_path / "{appearance}/####.png",
    )  # fmt: skip
    truth = read_rgba(collection.image_path(clip, 1)).astype(np.float32) / 255
    for name in collection.appearances:
        (picture,) = (tmp_path / name).iterdir()
        shown = read_rgba(picture).astype(np.float32) / 255
        # every fixture shows the same painted head, so that all appearances must look like it
        assert psnr(over(shown, 0.5), over(truth, 0.5)) > 22, name
