"""What a real Blender evaluates and draws, against the core in the same process."""

from __future__ import annotations

import json

from places import ROOT, WORK

HERE = "tests/real_blender"


def test_blender_and_the_core_agree(blender, files):
    answer = WORK / "inside.json"
    (ROOT / answer).unlink(missing_ok=True)
    done = blender(
        "-b", files / "walk.blend", "--python-exit-code", "3", "--python", f"{HERE}/inside.py",
        "--", answer,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((ROOT / answer).read_text())
    for picture in ("alone", "chosen", "blend", "region"):
        assert found[picture] <= 1.01, (picture, found)
    assert found["region_from_alone"] > 20, found  # or nothing was compared
    assert found["depth"] < 1e-3, found
    assert found["rig"] < 5e-5, found
    assert abs(found["recorded"] - 0.75) < 1e-6, found
    for line, words in zip(
        found["refusals"], ("no such avatar file", "nowhere.csv", "not found in"), strict=True
    ):
        assert words in line, found
