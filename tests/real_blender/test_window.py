"""What only Blender's window shows. BLENDER_WINDOW names a Blender command that has a display."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from conftest import RealBlender
from places import ROOT, WORK

HERE = Path(__file__).parent.relative_to(ROOT)


def test_a_user_in_a_hurry(files):
    """Two hundred switches of shading, scrubbing, turning, views that come and go, other files:
    no crash, nothing on standard error, and the right picture in the end."""
    command = os.environ.get("BLENDER_WINDOW")
    if not command:
        pytest.skip("set BLENDER_WINDOW to a Blender command that opens a window")
    answer = WORK / "answer.json"
    done = RealBlender(command)(
        files / "walk.blend", "--python", HERE / "in_window.py", "--", answer, 1500, timeout=1700
    )
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "Traceback" not in said, said
    seen = json.loads((ROOT / answer).read_text())
    assert seen.get("ok"), seen.get("error", said)
    assert seen["drawn while switching"] > 50
    assert seen["first message"] == ""
    assert seen["scale"] == pytest.approx([1, 1], abs=1e-3)
    assert seen["silhouette"] > 500
    assert seen["off by more than a pixel"] == 0
    assert seen["border"] == pytest.approx([0.5, 0.5], abs=0.01)
    assert seen["solids"] == [1, 1, 1, 1, 1]
    assert seen["bent"]
    assert seen["moved"]
    assert seen["alone"] == [1, 0]
    assert seen["views at once"] >= 2
    assert seen["views of four"] >= 4
