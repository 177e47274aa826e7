"""The verbs as a user runs them: a process, its exit code, its one line on standard error."""

import contextlib
import io
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from pav_blender.cli import VERBS, main
from pav_blender.core.images import read_rgba


def pav(*words, code=0):
    done = subprocess.run(
        [sys.executable, "-m", "pav_blender", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


def refused(*words):
    """Exit code 2 and one line; returns the line. In this process: a new one takes two seconds."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        assert main([str(word) for word in words]) == 2
    lines = [line for line in said.getvalue().splitlines() if line.startswith("pav")]
    assert len(lines) == 1, said.getvalue()
    return lines[0]


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself(verb, capsys):
    assert main([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert "example:" in text
    assert f"pav {verb}" in text


def test_the_list_of_verbs_and_unknown_ones(capsys):
    assert main(["--help"]) == 0
    assert all(verb in capsys.readouterr().out for verb in ["train"])
    assert main(["trian"]) == 2
    assert main([]) == 2
    assert main(["train", "--out"]) == 2


def test_blas_keeps_to_one_thread_unless_told_otherwise():
    code = (
        "import sys, pav_blender.cli as cli; assert 'numpy' not in sys.modules;"
        "cli.main(['doctor', '--help']); import numpy, os; print(os.environ[sys.argv[1]])"
    )
    name = "OPENBLAS_NUM_THREADS"
    others = {key: value for key, value in os.environ.items() if key != name}
    for given, expected in (({}, "1"), ({name: "3"}, "3")):
        done = subprocess.run(
            [sys.executable, "-c", code, name], env=others | given, capture_output=True, text=True
        )
        assert done.stdout.split()[-1:] == [expected], done.stderr


def test_info_and_doctor(toy_avatar_path):
    assert '"plain"' in pav("info", toy_avatar_path).stdout
    assert '"torch"' in pav("doctor").stdout


def test_check_prints_a_summary_and_draws_an_overlay(toy_path, tmp_path):
    done = pav("check", toy_path, "--out", tmp_path / "o.png")
    assert "no problems" in done.stdout
    assert read_rgba(tmp_path / "o.png").shape[0] > 100


def test_render_writes_what_it_names(toy_avatar_path, toy_path, tmp_path):
    out = tmp_path / "{appearance}" / "####.png"
    track = f"{toy_path}:plain"
    done = pav(
        "render", toy_avatar_path, "--track", track, "--appearance", "all",
        "--frames", "2-3", "--size", "40", "--out", out,
    )  # fmt: skip
    assert "4 pictures" in done.stdout
    for name in ("plain", "bushy"):
        assert [p.name for p in sorted((tmp_path / name).iterdir())] == ["0002.png", "0003.png"]
    a, b = (read_rgba(tmp_path / name / "0002.png") for name in ("plain", "bushy"))
    assert a.shape == (40, 40, 4)
    assert np.abs(a.astype(int) - b).max() > 30


def test_depth_goes_to_exr(toy_avatar_path, toy_path, tmp_path):
    pav(
        "render", toy_avatar_path, "--track", f"{toy_path}:plain", "--appearance", "plain",
        "--frames", "1", "--depth", "--out", tmp_path / "d.exr",
    )  # fmt: skip
    assert (tmp_path / "d.exr").stat().st_size > 1000


def test_wrong_input_is_one_line_and_nothing_is_written(toy_avatar_path, toy_path, tmp_path):
    text = tmp_path / "text.pav"
    text.write_text("this is no avatar\n" * 50)
    out = tmp_path / "out" / "####.png"
    track = f"{toy_path}:plain"

    def rendering(avatar, *rest, track=track, appearance="plain"):
        return refused(
            "render", avatar, "--track", track, "--appearance", appearance, "--out", out, *rest
        )

    assert "none.pav" in rendering(tmp_path / "none.pav")
    done = pav("render", text, "--track", track, "--appearance", "plain", "--out", out, code=2)
    assert "not an avatar" in done.stderr
    assert "plain, bushy" in rendering(toy_avatar_path, appearance="bald")
    assert "no clip named" in rendering(toy_avatar_path, track=f"{toy_path}:summer")
    assert "COLLECTION:CLIP" in rendering(toy_avatar_path, track="nowhere")
    assert "frames" in rendering(toy_avatar_path, "--frames", "50-60")
    assert "quality" in rendering(toy_avatar_path, "--quality", "best")
    assert not out.parent.exists()
    assert "no such collection" in refused("check", tmp_path / "none")
    assert "ends in .pav" in refused("train", toy_path, "--out", tmp_path / "a.png")
    assert "--minutes" in refused("train", toy_path, "--out", tmp_path / "a.pav", "--minutes", "-1")
    assert "--threads" in refused("info", toy_avatar_path, "--threads", "0")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["text.pav"]


def test_one_broken_picture_stops_check_and_train_by_name(toy_path, tmp_path):
    copy = shutil.copytree(toy_path, tmp_path / "copy")
    broken = copy / "clips" / "bushy" / "images" / "000004.png"
    broken.write_bytes(broken.read_bytes()[:100])
    assert "000004.png" in refused("check", copy)
    assert "000004.png" in refused("train", copy, "--out", tmp_path / "a.pav")
    assert sorted(os.listdir(tmp_path)) == ["copy"]
