"""An avatar measured on frames of a collection, and `pav eval`."""

import contextlib
import dataclasses
import io
import json
import math
import shutil

import numpy as np
import pytest

from pav_blender.cli import main
from pav_blender.core.collection import LABELS, Collection, read_collection
from pav_blender.core.errors import InputError
from pav_blender.core.evaluation import learned, parts
from pav_blender.core.evaluation.evaluate import (
    KEYS,
    METRICS,
    Evaluation,
    by_appearance,
    evaluate,
    summary,
)
from pav_blender.core.evaluation.heldout import head_mask
from pav_blender.core.evaluation.metrics import LARGEST_PSNR, over, psnr, ssim
from pav_blender.core.images import read_rgba, write_gray

PLAIN = ("psnr", "head_psnr", "ssim")


def changed(collection: Collection, **appearances) -> Collection:
    """The collection with clips' fields replaced: changed(toy, plain={"appearance": "other"})."""
    clips = [dataclasses.replace(c, **appearances.get(c.name, {})) for c in collection.clips]
    return dataclasses.replace(collection, clips=clips)


@pytest.fixture(scope="module")
def measured(toy, toy_avatar):
    return evaluate(toy_avatar, toy, metrics=PLAIN, keep=1)


def test_each_frame_has_a_row_of_what_its_picture_shows(toy, measured):
    assert [row["frame"] for row in measured.rows] == [
        f"{name}/{number:06d}" for name in ("plain", "bushy") for number in (6, 7)
    ]
    assert {row["split"] for row in measured.rows} == {"test"}
    assert [score.appearance for score in measured.scores] == ["plain", "bushy"]
    rows = {row["frame"]: row for row in measured.rows}
    for score in measured.scores:
        row, frame = rows[score.frame.name], score.frame
        ours, truth = over(score.rendered, 1.0), over(frame.rgba / 255, 1.0)
        assert row["psnr"] == psnr(ours, truth)
        assert row["head_psnr"] == psnr(ours, truth, head_mask(frame.rgba))
        assert row["ssim"] == ssim(ours, truth)
        assert 0 <= row["fog"] < 20  # per mille: a head that is learned well
        assert 0 <= row["holes"] < 200
        assert row["appearance"] == score.appearance
    assert not measured.absent


def test_the_error_is_told_by_label():
    """Pixels and squared error of each label among the person's; the head is what no shoulder
    wears, and shares are of the person."""
    truth = np.zeros((4, 4, 3))
    ours = truth.copy()
    ours[0] = 0.1  # face
    ours[1] = 0.5  # cloth
    labels = np.zeros((4, 4), np.uint8)
    labels[0], labels[1], labels[2] = (LABELS.index(n) for n in ("face", "cloth", "neck"))
    person = labels > 0
    person[0, 0] = False
    found = parts.measured(ours, truth, person, labels)
    assert found == {
        "face": [3, pytest.approx(0.03)],
        "neck": [4, 0.0],
        "cloth": [4, pytest.approx(1.0)],
    }
    rows = [{"parts": found}, {"psnr": 1.0}, {"parts": {"face": [1, 0.97]}}]
    face, neck, cloth, head = parts.shares(rows)
    assert (face.name, face.area, face.error) == ("face", 4 / 12, pytest.approx(0.5))
    assert face.psnr == pytest.approx(10 * np.log10(4 / 1.0))
    assert (neck.psnr, neck.error) == (LARGEST_PSNR, 0.0)
    assert (cloth.area, cloth.psnr) == (4 / 12, pytest.approx(10 * np.log10(4)))
    assert (head.name, head.area, head.psnr) == (parts.HEAD, face.area, face.psnr)
    assert parts.shares(rows[1:2]) == []


def test_labels_of_a_collection_are_measured_and_wrong_ones_refused(
    toy_path, toy_avatar_path, tmp_path
):
    copy = tmp_path / "labelled"
    shutil.copytree(toy_path, copy)
    toy = read_collection(copy)
    labels = np.full((64, 64), LABELS.index("face"), np.uint8)
    labels[40:] = LABELS.index("cloth")
    for clip in toy.clips:
        for row in clip.indices("test"):
            write_gray(toy.labels_path(clip, int(row)), labels)
    words = ["eval", toy_avatar_path, copy, "--per-appearance", 1, "--out"]
    printed, _ = pav(*words, tmp_path / "out")
    found = json.loads((tmp_path / "out" / "eval.json").read_text())
    face, cloth, head = found["parts"]["test"]
    assert [face["name"], cloth["name"], head["name"]] == ["face", "cloth", parts.HEAD]
    assert face["area"] + cloth["area"] == pytest.approx(1)
    whole = face["area"] * 10 ** (-face["psnr"] / 10) + cloth["area"] * 10 ** (-cloth["psnr"] / 10)
    assert face["error"] == pytest.approx(face["area"] * 10 ** (-face["psnr"] / 10) / whole)
    assert f"| {parts.HEAD} | {face['area']:.1%} |" in printed

    path = toy.labels_path(toy.clips[0], int(toy.clips[0].indices("test")[0]))
    write_gray(path, labels[:32])
    _, said = pav(*words, tmp_path / "bad", code=2)
    assert "not labels of a 64x64 picture" in said


def test_means_are_over_appearances_means():
    rows = [
        {"frame": str(i), "appearance": name, "split": split, "psnr": value, "fog": 1.0}
        for i, (name, split, value) in enumerate(
            [("a", "test", 10.0), ("a", "test", 20.0), ("a", "test", 30.0), ("b", "test", 40.0),
             ("b", "view", 5.0), ("b", "test", math.nan)]
        )
    ]  # fmt: skip
    evaluation = Evaluation(rows, {"lpips": "weights absent"}, [], metrics=("psnr", "lpips"))
    found = summary(evaluation, "test")
    assert found == {"psnr": 30.0, "lpips": "weights absent", "fog": 1.0}
    assert by_appearance(evaluation, "test")["a"]["psnr"] == 20
    assert summary(evaluation, "view")["psnr"] == 5
    assert summary(evaluation)["psnr"] == pytest.approx((20 + 22.5) / 2)


def test_appearances_are_matched_by_name(toy, toy_avatar, measured):
    turned = dataclasses.replace(toy, clips=toy.clips[::-1])
    other = evaluate(toy_avatar, turned, metrics=PLAIN)
    assert sorted(other.rows, key=lambda r: r["frame"]) == sorted(
        measured.rows, key=lambda r: r["frame"]
    )
    assert other.scores == []
    more = changed(toy, plain={"appearance": "another"})
    part = evaluate(toy_avatar, more, metrics=("psnr",))
    assert part.left_out == ["another"]
    assert [row["psnr"] for row in part.rows] == [row["psnr"] for row in measured.rows[2:]]
    assert set(part.rows[0]) == {"frame", "appearance", "split", "psnr", "fog", "holes"}
    with pytest.raises(InputError, match="the avatar has plain, bushy"):
        evaluate(toy_avatar, more, appearances=["another"])


def test_splits_are_told_apart(toy, toy_avatar):
    split = np.array(["train"] * 4 + ["view"] * 2 + ["test"] * 2)
    both = evaluate(
        toy_avatar,
        changed(toy, bushy={"split": split}),
        splits=("test", "view"),
        appearances=["bushy"],
        per_appearance=1,
        metrics=("psnr",),
        keep=3,
    )
    assert [(row["frame"], row["split"]) for row in both.rows] == [
        ("bushy/000006", "test"),
        ("bushy/000004", "view"),
    ]
    assert [score.frame.name for score in both.scores] == ["bushy/000006", "bushy/000004"]
    for row in both.rows:
        assert summary(both, row["split"])["psnr"] == row["psnr"]


def test_what_is_missing_is_said(toy, toy_avatar, tmp_path, monkeypatch):
    def no_package(folder):
        raise learned.Absent("package absent", "pip install it")

    def no_weights(folder):
        assert folder == tmp_path
        raise learned.Absent("weights absent", "bring them")

    monkeypatch.setattr(learned, "inception", no_weights)
    from pav_blender.core.evaluation import evaluate as module

    monkeypatch.setitem(module._COMPARED, "lpips", no_package)
    monkeypatch.setitem(module._COMPARED, "dists", no_weights)
    found = evaluate(
        toy_avatar,
        toy,
        metrics=("lpips", "dists", "fid"),
        per_appearance=1,
        weights=tmp_path,
    )
    assert found.absent == {
        "lpips": "package absent",
        "dists": "weights absent",
        "fid": "weights absent",
    }
    assert found.needs["lpips"] == "pip install it"
    assert summary(found) | found.absent == summary(found)
    assert not set(found.rows[0]) & {"lpips", "dists", "fid", "psnr"}


def test_networks_see_both_pictures_and_fid_all_frames(toy, toy_avatar, monkeypatch):
    """Stand-ins for the networks: what they are given is what is tested."""
    from pav_blender.core.evaluation import evaluate as module

    monkeypatch.setitem(
        module._COMPARED, "lpips", lambda folder: lambda a, b: float(np.abs(a - b).mean())
    )
    monkeypatch.setattr(learned, "inception", lambda folder: lambda p: p.mean((0, 1)))
    found = evaluate(toy_avatar, toy, metrics=("lpips", "fid"), keep=9)
    for row, score in zip(found.rows, found.scores, strict=True):
        ours, truth = over(score.rendered, 1.0), over(score.frame.rgba / 255, 1.0)
        assert row["lpips"] == pytest.approx(np.abs(ours - truth).mean())
        assert "fid" not in row
    assert 0 < summary(found)["fid"] < 0.1
    alone = evaluate(toy_avatar, toy, metrics=("fid",), appearances=["plain"], per_appearance=1)
    assert summary(alone)["fid"] == "too few frames"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"metrics": ("psrn",)}, "unknown metric 'psrn': one of psnr"),
        ({"splits": ("tset",)}, "unknown split 'tset': one of train, test, view"),
        ({"splits": ("view",)}, "no frames of view"),
        ({"appearances": ["bald"]}, "unknown appearance 'bald'"),
        ({"per_appearance": 0}, "per_appearance 0"),
    ],
)
def test_wrong_names_are_refused(options, said, toy, toy_avatar):
    with pytest.raises(InputError, match=said):
        evaluate(toy_avatar, toy, **options)


def test_pictures_too_small_for_metrics_are_refused(toy, toy_avatar):
    with pytest.raises(InputError, match="clip plain is 16x12 pixels"):
        evaluate(toy_avatar, changed(toy, plain={"width": 16, "height": 12}))


def pav(*words, code=0):
    """Runs a verb in this process; what it printed, and its error line."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        assert main([str(word) for word in words]) == code, err.getvalue()
    lines = [line for line in err.getvalue().splitlines() if line.startswith("pav")]
    assert len(lines) == (code == 2), err.getvalue()
    return out.getvalue(), "".join(lines)


def test_pav_eval_writes_figures_and_a_sheet(toy_path, toy_avatar_path, tmp_path):
    words = ["eval", toy_avatar_path, toy_path, "--out", tmp_path / "out", "--per-appearance", 1]
    printed, _ = pav(*words)
    found = json.loads((tmp_path / "out" / "eval.json").read_text())
    assert [row["frame"] for row in found["rows"]] == ["plain/000006", "bushy/000006"]
    assert set(found["summary"]) == {"test"}  # no view frames in it
    assert set(found["summary"]["test"]) == {*KEYS, "fog", "holes"}
    assert set(found["appearances"]["test"]) == {"plain", "bushy"}
    assert found["claims"] == []
    assert found["versions"]["torch"]
    assert found["machine"]["threads"] >= 1
    head = found["summary"]["test"]["head_psnr"]
    row = next(line for line in printed.splitlines() if line.startswith("| all "))
    assert f"| {head:.2f} |" in row
    for metric in METRICS:
        if metric.key in found["absent"]:
            assert f"{metric.name}: {found['absent'][metric.key]} (" in printed
    # two rows of truth, ours and the error map, 64 pixels each
    assert read_rgba(tmp_path / "out" / "sheet.png").shape == (2 * 68 + 4, 3 * 68 + 4, 4)

    printed, _ = pav(*words, "--head-psnr", head - 0.1, "--check")
    assert "met" in printed
    assert "NOT MET" not in printed
    printed, _ = pav(*words, "--head-psnr", head + 0.1, "--check", code=1)
    assert "NOT MET" in printed
    assert json.loads((tmp_path / "out" / "eval.json").read_text())["claims"][0]["met"] is False
    pav(*words, "--head-psnr", head + 0.1)


def test_pav_eval_refuses_wrong_input_in_a_line(toy_path, toy_avatar_path, tmp_path):
    out = tmp_path / "out"

    def refused(*words, avatar=toy_avatar_path, collection=toy_path):
        _, line = pav("eval", avatar, collection, "--out", out, *words, code=2)
        assert not out.exists()
        return line

    assert "no such avatar file" in refused(avatar=tmp_path / "none.pav")
    assert "none" in refused(collection=tmp_path / "none")
    assert "unknown split 'tset'" in refused("--splits", "tset")
    assert "no frames of view" in refused("--splits", "view")
    assert "--head-psnr" in refused("--check")
    assert "--head-psnr" in refused("--head-psnr", 20, "--splits", "train")
    assert "no such folder" in refused("--weights", tmp_path / "none")
    assert "at least 1" in refused("--per-appearance", 0)
    broken = tmp_path / "broken"
    shutil.copytree(toy_path, broken)
    gone = broken / "clips" / "bushy" / "images" / "000006.png"
    gone.write_bytes(b"no picture")
    assert str(gone) in refused(collection=broken)
    gone.unlink()
    assert str(gone) in refused(collection=broken)
    (tmp_path / "file").write_text("")
    words = ["eval", toy_avatar_path, toy_path, "--out", tmp_path / "file"]
    assert "not a folder" in pav(*words, code=2)[1]


def test_another_head_is_refused(toy_path, toy_avatar):
    collection = read_collection(toy_path)
    other = dataclasses.replace(toy_avatar, head_fingerprint="another", head_name="other")
    with pytest.raises(InputError, match="trained on 'other'"):
        evaluate(other, collection)
