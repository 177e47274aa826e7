"""Hostile scenes: those that take little here, all of them in `make test-all`; and that the checks
see what is wrong."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest

from pav_blender import cli
from pav_blender.benchmarks.stress import SCENES, checks, run
from pav_blender.benchmarks.stress.child import row_of
from pav_blender.benchmarks.stress.scene import Found, Given
from pav_blender.benchmarks.stress.subjects import ball_of, head_of
from pav_blender.core.errors import InputError
from pav_blender.core.rendering import render as rendering

QUICK = [
    "unreferenced vertices",
    "flattened mesh",
    "mesh without a size",
    "pose far outside training",
    "units 1e-4 to 1e4",
    "vertices in other units",
    "origin 1e6 m away",
    "camera 1e7 m away",
    "empty frames",
    "one-pixel frames",
    "transmittance falls to 0",
    "densities 0 to 3e38",
    "not a number in a mesh",
    "not a number in a camera",
    "not a number in a track",
    "not a number in pictures",
]


@pytest.fixture(scope="module")
def given(tmp_path_factory, toy_path, toy_avatar_path):
    folder = tmp_path_factory.mktemp("stress")
    shutil.copy(toy_avatar_path, folder / "subject.pav")
    given = Given(folder)
    given.__dict__["head"] = head_of(folder, toy_path)  # instead of the trained one
    return given


@pytest.mark.parametrize("name", QUICK)
def test_a_scene_holds(given, name):
    row = row_of(name, given)
    assert row["failed"] is None
    assert row["claims"]
    assert [claim for claim in row["claims"] if not claim["met"]] == []
    assert row["what"]


@pytest.mark.slow
def test_every_scene_holds(tmp_path, capsys):
    assert cli.main(["stress", "--out", str(tmp_path), "--check"]) == 0
    proof = json.loads((tmp_path / "stress.json").read_text())
    assert [row["scene"] for row in proof["scenes"]] == list(SCENES)
    assert len(proof["claims"]) > 200
    assert "greatest memory of all" in capsys.readouterr().out


def test_one_scene_by_the_command_line(tmp_path, capsys):
    command = ["stress", "--out", str(tmp_path), "--only", "without a size", "--check"]
    assert cli.main(command) == 0
    proof = json.loads((tmp_path / "stress.json").read_text())
    assert [row["scene"] for row in proof["scenes"]] == ["mesh without a size"]
    assert {claim["name"].split(":")[0] for claim in proof["claims"]} == {
        "mesh without a size",
        "greatest memory of all",
    }
    assert "NOT MET" not in capsys.readouterr().out
    assert cli.main([*command[:3], "--only", "no such thing"]) == 2


def test_a_process_that_ends_fails_its_scene_and_no_other(tmp_path):
    rows = list(run._rows(tmp_path, ["no such scene", "mesh without a size"]))
    assert [row["scene"] for row in rows] == ["no such scene", "mesh without a size"]
    assert rows[0]["failed"] == "its process ended: code 1"
    assert rows[1]["failed"] is None


def test_an_error_in_a_scene_is_its_failure(given, monkeypatch):
    def wrong(given):
        raise ValueError("none such")

    scene = dataclasses.replace(SCENES["flattened mesh"], run=wrong)
    monkeypatch.setitem(SCENES, "flattened mesh", scene)
    assert "none such" in row_of("flattened mesh", given)["failed"]


@pytest.mark.parametrize(
    "change",
    [
        {"rgba": (0, 0, 0, np.nan)},
        {"rgba": (24, 24, 3, 1.001)},
        {"rgba": (24, 24, 0, -1e-6)},
        {"depth": (24, 24, np.inf)},
        {"depth": (0, 0, 1.0)},
        {"depth": (24, 24, -0.1)},
    ],
)
def test_wrong_numbers_are_seen(change):
    head = ball_of()
    picture = checks.shown(head)
    assert checks.wrong_values(picture, head.camera) == 0
    ((name, (*place, value)),) = change.items()
    getattr(picture, name)[tuple(place)] = value
    assert checks.wrong_values(picture, head.camera) > 0
    assert checks.wrong_values(picture, head.camera.resized(48, 47)) > 0


def test_a_picture_that_is_not_the_oracles_is_seen(monkeypatch):
    head, real, calls = ball_of(), rendering._by_waves, []

    def off(scene, rays, settings):
        found = real(scene, rays, settings)
        calls.append(1)
        found.colour[:, 0] += 0.05 * len(calls)  # another picture each time, too
        return found

    monkeypatch.setattr(rendering, "_by_waves", off)
    monkeypatch.setattr(rendering, "_whole", off)
    found = Found()
    checks.agrees(found, head)
    unmet = {claim.name for claim in found.claims if not claim.met}
    assert "from plain torch, worst pixel" in unmet
    assert "numbers that differ when drawn again" in unmet


def test_what_is_taken_that_should_be_refused_is_seen(given, monkeypatch):
    monkeypatch.setattr(rendering, "_check_size", lambda *a: None)
    row = row_of("mesh without a size", dataclasses.replace(given))
    assert row["failed"] or not all(claim["met"] for claim in row["claims"])


def test_names_that_find_no_scene_are_told():
    assert run.chosen(None) == list(SCENES)
    assert run.chosen(["needle", "units"]) == [n for n in SCENES if "needle" in n or "units" in n]
    with pytest.raises(InputError, match="no such scene"):
        run.chosen(["needle", "thread"])
