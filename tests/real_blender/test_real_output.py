"""Frames of a whole Blender: killed and resumed, side by side, among other objects."""

from __future__ import annotations

import os
import signal
import subprocess
import time

import numpy as np
from places import ROOT, WORK

from pav_blender.cli import main
from pav_blender.core import images
from pav_blender.core.frame_files import damage, look

# Overwrite off and placeholders on, as a farm shares a range; larger, so that a frame takes a while
SHARED = """
import bpy
scene = bpy.context.scene
scene.render.use_overwrite, scene.render.use_placeholder = False, True
scene.render.resolution_percentage = 600
scene.frame_start, scene.frame_end = 1, 12
scene.pav.quality = "PREVIEW"
bpy.ops.wm.save_as_mainfile(filepath="{path}", copy=True)
"""


def script(files, name, text):
    path = WORK / f"{name}.py"
    (ROOT / path).write_text(text)
    return path


def start(blender, *arguments):
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(WORK / "resources")}
    return subprocess.Popen(
        [*blender.command, *map(str, arguments)],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def test_a_killed_animation_is_repaired_and_resumed_by_two_processes(blender, files):
    made = blender(
        "-b", files / "walk.blend",
        "--python", script(files, "share", SHARED.format(path=WORK / "shared.blend")),
    )  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    out = WORK / "killed"
    render = ("-b", WORK / "shared.blend", "-E", "PAV", "-o", f"{out}/####", "-a")
    killed = start(blender, *render)
    deadline = time.monotonic() + 600  # of a machine that has other work too
    while time.monotonic() < deadline and killed.poll() is None:
        there = sorted((ROOT / out).glob("*.png"))
        # a frame is finished and the next one's placeholder is laid
        if len(there) > 2 and there[-1].stat().st_size == 0:
            break
        time.sleep(0.002)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.wait()
    found = look(ROOT / out)
    assert found.whole
    assert found.damaged, "killed between two frames"
    assert main(["frames", str(ROOT / out)]) == 1
    whole = {path: path.stat().st_mtime_ns for path in found.whole}

    resumed = blender(*render)
    assert resumed.returncode == 0, resumed.stdout + resumed.stderr
    assert any(damage(path) for path in found.damaged)  # Blender takes it for done

    assert main(["frames", str(ROOT / out), "--repair"]) == 0
    both = [start(blender, *render) for _ in range(2)]
    assert [process.wait(timeout=300) for process in both] == [0, 0]
    assert main(["frames", str(ROOT / out), "--range", "1-12"]) == 0
    assert {path: path.stat().st_mtime_ns for path in whole} == whole


def test_frames_verb_inside_blender(blender, files):
    folder = WORK / "verb"
    (ROOT / folder).mkdir()
    images.write_rgba(ROOT / folder / "0001.png", np.zeros((4, 4, 4), np.uint8))
    assert blender("--command", "pav", "frames", folder).returncode == 0
    (ROOT / folder / "0002.png").touch()
    done = blender("--command", "pav", "frames", folder)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "0002.png (empty)" in done.stdout
    assert blender("--command", "pav", "frames", folder, "--repair").returncode == 0
    assert [path.name for path in (ROOT / folder).iterdir()] == ["0001.png"]


COMPOSE = """
import bpy
scene = bpy.context.scene
scene.frame_end = scene.frame_start
bpy.ops.pav.composite()
scene.cycles.samples, scene.cycles.use_denoising = 1, False
bpy.ops.wm.save_as_mainfile(filepath="{path}", copy=True)
"""


def test_a_composited_scene_without_its_avatar_ends_with_code_1(blender, files):
    folder = WORK / "composited"
    (ROOT / folder).mkdir()
    path = files / "both.blend"  # beside the avatar that it names
    made = blender(
        "-b", files / "walk.blend",
        "--python", script(files, "compose", COMPOSE.format(path=path)),
    )  # fmt: skip
    assert (ROOT / path).is_file(), made.stdout + made.stderr
    done = blender("-b", path, "-o", f"{folder}/####", "-a")
    assert done.returncode == 0, done.stdout + done.stderr
    (frame,) = (ROOT / folder).glob("*.png")
    assert images.read_rgba(frame)[..., 3].max() == 255
    frame.unlink()
    (ROOT / files / "small.pav").rename(ROOT / files / "away.pav")
    try:
        done = blender("-b", path, "-o", f"{folder}/####", "-a")
    finally:
        (ROOT / files / "away.pav").rename(ROOT / files / "small.pav")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "small.pav: no such avatar file" in done.stdout + done.stderr
    assert list((ROOT / folder).glob("*.png")) == []
    # a machine without the add-on, as docs/farm.md has it
    check = "import bpy; assert hasattr(bpy.types.Scene, 'pav'), 'no PAV'"
    guarded = ("--python-exit-code", "1", "--python-expr", check, "-o", f"{folder}/####", "-a")
    done = blender("-b", "--factory-startup", path, *guarded)
    assert done.returncode == 1, done.stdout + done.stderr
    assert list((ROOT / folder).glob("*.png")) == []
    done = blender("-b", path, *guarded)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(list((ROOT / folder).glob("*.png"))) == 1
