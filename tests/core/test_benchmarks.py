"""What `pav bench` measures with: the plain oracle, the clock, the plots, the claims."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pav_blender.benchmarks import kernels as kernels_bench
from pav_blender.benchmarks import memory, scale
from pav_blender.benchmarks.measure import Options, a_frame, best, collection_of, plot
from pav_blender.benchmarks.plain import dense
from pav_blender.benchmarks.render import SKIPS, _front, _picture, _skips
from pav_blender.core.collection import read_collection
from pav_blender.core.errors import InputError, PavError
from pav_blender.core.evaluation.metrics import over, psnr
from pav_blender.core.rendering.render import RenderSettings
from pav_blender.core.training.prepare import load_training_frames


@pytest.mark.slow  # a minute; `pav bench accuracy` says the same of a trained avatar
def test_the_reference_preset_is_what_plain_torch_gives(toy, toy_avatar):
    frame = a_frame(toy)
    inside = np.flatnonzero(frame.rgba[..., 3].reshape(-1) > 127)
    pixels = np.random.default_rng(0).choice(inside, 12, replace=False)
    shown = _picture(toy_avatar, frame, frame.camera.width, RenderSettings.preset("reference"))
    ours = over(shown.rgba, 1.0).reshape(-1, 3)[pixels]
    assert ours.std() > 0.05
    assert psnr(ours, dense(toy_avatar, frame, pixels)) > 45


def test_every_skip_costs_less_than_it_hides(toy, toy_avatar):
    frame = a_frame(toy)
    dense = RenderSettings(skip=False, transmittance=0.0, agreement=0.0)
    truth = _picture(toy_avatar, frame, 64, dense)
    rows = _skips(toy_avatar, frame, 64, truth, 1)
    assert len(rows) == len(SKIPS) + 1
    final, *without = rows
    assert final["psnr"] > 45
    assert all(row["evaluations"] >= 0.999 * final["evaluations"] for row in without)
    assert max(row["evaluations"] for row in without) > 1.2 * final["evaluations"]


def test_the_clock_takes_the_least_in_turns():
    order = []
    seconds = best({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3)
    assert order == ["a", "b"] * 4
    assert 0 < seconds["a"] < 1


def test_the_front_holds_what_nothing_beats():
    points = [{"seconds": s, "psnr": p} for s, p in ((1, 40), (2, 50), (3, 45), (4, 60))]
    assert [p["seconds"] for p in _front(points)] == [1, 2, 4]


def test_an_exponent_is_the_slope_of_the_logarithms():
    assert scale._exponent({"10": 3.0, "100": 30.0, "1000": 300.0}) == pytest.approx(1)
    assert scale._exponent({"1": 2.0, "4": 4.0}) == pytest.approx(0.5)


def test_a_plot_is_the_same_file_for_the_same_figures(tmp_path):
    for name in ("a.svg", "b.svg"):
        plot(tmp_path / name, lambda axes: axes.plot([1, 2], [3, 4]), "title", "x", "y")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert "title" in (tmp_path / "a.svg").read_text()


def test_kernels_are_measured_and_the_subject_kept(toy, tmp_path, capsys):
    options = Options(tmp_path, toy.path, repeats=1, iterations=3)
    fields, claims = kernels_bench.run(options)
    made = (tmp_path / "subject.pav").stat().st_mtime_ns
    assert {row["kernel"] for row in fields["kernels"]} >= {"hash encoding", "nearest triangle"}
    assert len(claims) == len(fields["kernels"])
    assert all(row["ns"] > 0 and row["floor_ns"] > 0 for row in fields["kernels"])
    assert "hash encoding" in capsys.readouterr().out
    assert (tmp_path / "kernels.svg").stat().st_size > 1000
    kernels_bench.run(options)
    assert (tmp_path / "subject.pav").stat().st_mtime_ns == made


def test_no_collection_is_told(tmp_path):
    with pytest.raises(InputError, match="no such collection"):
        collection_of(Options(tmp_path, tmp_path / "none"))


def test_compiling_is_announced_once(tmp_path):
    code = "from pav_blender.core.kernels import select; select('cpu').optimiser"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}

    def said() -> str:
        command = [sys.executable, "-c", code]
        root = Path(__file__).parents[2]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=root)
        assert done.returncode == 0, done.stderr
        return done.stderr

    assert said().count("compiling kernels") == 1
    (tmp_path / "kernel.nbi").touch()
    assert "compiling" not in said()


def test_the_enlarged_collection_is_as_long_and_large_as_it_says(toy, tmp_path, monkeypatch):
    for name, value in {"_CLIPS": 3, "_FRAMES": 15, "_SIZE": 96}.items():
        monkeypatch.setattr(memory, name, value)
    memory._enlarged(toy, tmp_path / "large", None)
    large = read_collection(tmp_path / "large")
    frames = load_training_frames(large)
    assert len(frames) == 45
    assert {f.rgba.shape for f in frames} == {(96, 96, 4)}
    assert len(large.appearances) == 3
    first = frames[0]
    again = next(f for f in frames[1:] if f.appearance == 0 and (f.rgba == first.rgba).all())
    np.testing.assert_array_equal(again.vertices, first.vertices)  # the same frame, over again
    small = load_training_frames(toy)[0]
    pixels, _ = first.camera.project(small.vertices)
    np.testing.assert_allclose(pixels / 96, small.camera.project(small.vertices)[0] / 64, atol=1e-4)
    assert (first.rgba[..., 3] > 0).mean() == pytest.approx(
        (small.rgba[..., 3] > 0).mean(), abs=0.02
    )


def test_memory_is_that_of_the_process(tmp_path):
    hungry = f"held = bytearray({300 * 1000**2})\n{memory._PEAK}"
    found = memory._measured("hungry", hungry)["peak_gb"]
    assert 0.3 <= found < 0.6
    with pytest.raises(PavError, match="broken: ZeroDivisionError"):
        memory._measured("broken", "1 / 0")


@pytest.mark.faces
def test_mattes_are_measured_against_the_truth(tmp_path, monkeypatch, capsys):
    pytest.importorskip("mediapipe", reason="the optional mediapipe is not installed")
    from pav_blender.benchmarks import matte

    monkeypatch.setattr(matte, "_FRAMES", 1)
    fields, claims = matte.run(Options(tmp_path), None)
    of = {row["matte"]: row for row in fields["mattes"]}
    assert 0 < of[matte.OURS]["alpha"] < of["pose"]["alpha"]
    assert [claim.met for claim in claims[:2]] == [True, True]
    assert "guided filter" in capsys.readouterr().out
    assert (tmp_path / "matte.svg").is_file()

    truth = np.zeros((64, 64, 4), np.float32)
    truth[16:48, 16:48] = [0.8, 0.5, 0.3, 1]
    assert matte._errors(truth, truth) == {"alpha": 0, "halo": 0}
    # an edge of the background's colour is a halo, an alpha that is too small is both
    wide = truth.copy()
    wide[14:50, 14:50, 3] = 1
    both = matte._errors(wide, truth)
    assert both["alpha"] > 0.1
    stained = truth.copy()
    stained[16:18, 16:48, :3] = 1
    assert matte._errors(stained, truth)["alpha"] == 0
    assert matte._errors(stained, truth)["halo"] > 0.005
