"""Training from the panel's operators where there is no window."""

from __future__ import annotations

from places import ROOT, WORK
from toy import make_toy

from pav_blender.core.training.places import PICTURE, checkpoint_path, read_curve

TRAIN = """
import sys, threading, time
from pathlib import Path
import bpy
from bl_ext.user_default.pav_blender.bridge import jobs, training

collection, output = (Path(word).resolve() for word in sys.argv[sys.argv.index("--") + 1:])
settings = bpy.context.scene.pav.training
settings.source, settings.collection = "COLLECTION", str(collection)
settings.output, settings.minutes = str(output), 0
settings.options = "--iterations 40 --checkpoint-every 0"

def cancel_when_begun():
    while not output.with_suffix(".checkpoint").exists():
        time.sleep(0.02)
    jobs.cancel()

threading.Thread(target=cancel_when_begun, daemon=True).start()
try:
    bpy.ops.pav.train()
except RuntimeError as error:
    assert "training was stopped" in str(error), error
else:
    raise AssertionError("was not cancelled")
assert training.unfinished(output) and not output.exists()
settings.options = ""
training.watched().curve.clear()
assert bpy.ops.pav.resume_training() == {"FINISHED"}
assert not training.unfinished(output)
assert training.watched().curve[-1][0] == 40
assert bpy.ops.pav.add_head(filepath=str(output)) == {"FINISHED"}
assert bpy.context.object.pav.appearance == "plain"
print("trained without a window")
"""


def test_a_training_that_was_cancelled_goes_on_without_a_window(blender):
    make_toy(ROOT / WORK / "toy", frames=4, size=32)
    script, output = WORK / "train.py", WORK / "trained.pav"
    (ROOT / script).write_text(TRAIN)
    arguments = ("--python", script, "--", WORK / "toy", output)
    done = blender("-b", "--python-exit-code", "3", *arguments)
    assert "trained without a window" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0
    assert (ROOT / output).is_file()
    assert not checkpoint_path(ROOT / output).exists()
    preview = ROOT / WORK / "trained.pav.preview"
    assert (preview / PICTURE).is_file()
    assert read_curve(preview)[-1][0] == 40
