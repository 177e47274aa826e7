"""Write Frames: formats, appearances, what is kept and drawn again, processes side by side."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")

import bpy
import small

from pav_blender.bridge import render, reuse, sequence
from pav_blender.bridge import scene as bridge_scene
from pav_blender.core import images
from pav_blender.core.collection import read_collection
from pav_blender.core.errors import InputError
from pav_blender.core.frame_files import look
from pav_blender.core.version import version

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def made(scene, files):
    found = bridge_scene.build_scene(
        files / "small.pav", read_collection(files / "collection"), "walk"
    )
    scene.pav.quality = "PREVIEW"
    reuse.forget()
    return found


@pytest.fixture
def drawn(monkeypatch):
    """Grows by one with each picture that is really drawn."""
    calls = []

    def counting(shot, *rest, **named):
        calls.append(shot)
        return original(shot, *rest, **named)

    original = render.draw
    monkeypatch.setattr(render, "draw", counting)
    return calls


def write(folder):
    work = sequence.begin(bpy.context.scene, folder)
    while not work.step():
        work.wait()
    assert work.error == ""
    assert work.done == work.total
    return work


def names(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def f12(path, frame):
    scene = bpy.context.scene
    scene.frame_set(frame)
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    return images.read_rgba(path)


def test_formats_and_what_frames_say_of_themselves(made, scene, tmp_path):
    import OpenImageIO as oiio

    from pav_blender.core.rendering.colour import srgb_to_linear

    for format in ("PNG8", "PNG16", "EXR"):
        scene.pav.frames.format = format
        write(tmp_path / format)
        suffix = "exr" if format == "EXR" else "png"
        assert names(tmp_path / format) == [f"{frame:06d}.{suffix}" for frame in (3, 4, 5, 6)]
        told = images.read_metadata(tmp_path / format / f"000004.{suffix}")
        assert told["pav:avatar"] == "small.pav"
        assert told["pav:appearance"] == "morning"
        assert told["pav:frame"] == "4"
        assert told["pav:version"] == version()
        assert told["pav:settings"] == f"preview, {format.lower()}"
    rendered = f12(tmp_path / "f12.png", 4).astype(int)
    eight = images.read_rgba(tmp_path / "PNG8" / "000004.png").astype(int)
    sixteen = images._read(tmp_path / "PNG16" / "000004.png", "native")
    assert sixteen.dtype == np.uint16
    assert np.abs(eight - rendered).max() <= 1
    assert np.abs(np.rint(sixteen / 257) - eight).max() <= 1
    assert len(np.unique(sixteen)) > 256  # finer than eight bits
    source = oiio.ImageInput.open(str(tmp_path / "EXR" / "000004.exr"))
    assert source.spec().channelnames == ("R", "G", "B", "A", "Z")
    pixels = source.read_image("float")
    source.close()
    linear = srgb_to_linear(sixteen[..., :3] / 65535) * (sixteen[..., 3:] / 65535)
    np.testing.assert_allclose(pixels[..., :3], linear, atol=2e-3)
    np.testing.assert_allclose(pixels[..., 3], sixteen[..., 3] / 65535, atol=1e-3)
    empty = pixels[..., 3] == 0
    assert empty.any()
    assert (pixels[..., 4][empty] == np.float32(1e10)).all()
    solid = pixels[..., 3] > 0.9
    assert 0.4 < pixels[..., 4][solid].min() < pixels[..., 4][solid].max() < 1.0


def test_all_appearances_each_in_its_folder(made, scene, tmp_path):
    scene.pav.frames.appearances = "ALL"
    scene.frame_end = 4
    work = write(tmp_path)
    assert work.total == 4
    expected = [f"{name}/{frame:06d}.png" for name in ("evening", "morning") for frame in (3, 4)]
    assert names(tmp_path) == expected
    told = images.read_metadata(tmp_path / "evening" / "000003.png")
    assert told["pav:appearance"] == "evening"
    assert made.mesh.pav.appearance == "morning"
    made.mesh.pav.appearance = "evening"
    found = images.read_rgba(tmp_path / "evening" / "000003.png").astype(int)
    assert np.abs(found - f12(tmp_path / "f12.png", 3)).max() <= 1


def test_heads_without_a_common_appearance_are_told(made, scene, files, tmp_path):
    small.write_avatar(tmp_path / "other.pav", appearances=["noon"])
    bridge_scene.build_head(tmp_path / "other.pav")
    scene.pav.frames.appearances = "ALL"
    with pytest.raises(InputError, match="no appearance in common"):
        sequence.begin(scene, tmp_path / "frames")
    assert not (tmp_path / "frames").exists()


def test_only_frames_whose_inputs_changed_are_drawn_again(made, scene, tmp_path, drawn):
    """Also after a restart, which the cleared memory stands for."""
    folder = tmp_path / "frames"
    assert write(folder).kept == 0
    assert len(drawn) == 4

    def again():
        drawn.clear()
        reuse.forget()
        return write(folder).kept, len(drawn)

    assert again() == (4, 0)
    jaw = made.mesh.data.shape_keys.key_blocks["jawOpen"]
    jaw.value = 0.6
    jaw.keyframe_insert("value", frame=5)
    assert again() == (3, 1)
    scene.render.resolution_percentage = 50
    assert again() == (0, 4)
    made.mesh.pav.appearance = "evening"
    assert again() == (0, 4)
    layer = made.mesh.pav.layers.add()
    layer.appearance, layer.weight = "morning", 0.5
    assert again() == (0, 4)
    assert images.read_metadata(folder / "000003.png")["pav:appearance"] == "evening + morning 0.5"
    layer.weight = 0.25
    assert again() == (0, 4)
    scene.pav.frames.format = "PNG16"
    assert again() == (0, 4)
    made.mesh.name = "renamed"  # no part of a picture
    assert again() == (4, 0)


def test_the_avatars_content_counts_and_not_its_place(made, scene, files, tmp_path, drawn):
    path = tmp_path / "a" / "own.pav"
    path.parent.mkdir()
    shutil.copy(files / "small.pav", path)
    made.mesh.pav.avatar = str(path)
    write(tmp_path / "frames")
    (tmp_path / "b").mkdir()
    moved = path.rename(tmp_path / "b" / "own.pav")
    made.mesh.pav.avatar = str(moved)
    assert write(tmp_path / "frames").kept == 4
    small.write_avatar(moved, seed=7)
    assert write(tmp_path / "frames").kept == 0


def test_a_foreign_picture_is_not_taken_for_a_frame(made, scene, tmp_path):
    scene.frame_end = 3
    images.write_rgba(tmp_path / "000003.png", np.zeros((40, 48, 4), np.uint8))
    assert write(tmp_path).kept == 0
    assert images.read_rgba(tmp_path / "000003.png").max() > 200


def test_f12_reuses_pictures_of_frames_where_nothing_moved(made, scene, tmp_path, drawn):
    for owner in (made.mesh.data.shape_keys, made.armature, made.camera, made.camera.data):
        owner.animation_data_clear()
    scene.render.filepath = str(tmp_path) + "/"
    bpy.ops.render.render(animation=True)
    assert len(drawn) == 1
    pictures = [images.read_rgba(tmp_path / f"{frame:04d}.png") for frame in (3, 4, 5, 6)]
    assert pictures[0][..., 3].max() == 255
    for picture in pictures[1:]:
        np.testing.assert_array_equal(picture, pictures[0])
    assert write(tmp_path / "frames").kept == 0
    assert len(drawn) <= 2  # the operator's frames too, whose camera may differ in a last digit

    drawn.clear()
    made.camera.location.x += 0.05
    moved = f12(tmp_path / "moved.png", 3)
    assert len(drawn) == 1
    assert (moved != pictures[0]).any()
    made.camera.location.x -= 0.05
    np.testing.assert_array_equal(f12(tmp_path / "back.png", 3), pictures[0])
    assert len(drawn) == 1


def test_kept_pictures_are_bounded_and_read_only(made, scene, drawn, monkeypatch):
    shots = [sequence.read_frame(scene.name, frame) for frame in (3, 4, 5)]
    one = reuse.draw(shots[0])
    with pytest.raises(ValueError, match="read-only"):
        one.combined[0, 0, 0] = 1
    monkeypatch.setattr(reuse, "LIMIT", 2 * sum(map(np.size, reuse._arrays(one))) * 4)
    for shot in (shots[1], shots[0], shots[2]):  # the first was used last but one
        reuse.draw(shot)
    assert len(drawn) == 3
    reuse.draw(shots[0])
    assert len(drawn) == 3
    reuse.draw(shots[1])
    assert len(drawn) == 4


def test_stereo_is_refused(made, scene, tmp_path):
    scene.render.use_multiview = True
    scene.render.filepath = str(tmp_path) + "/"
    with pytest.raises(RuntimeError, match="switch stereoscopy off"):
        bpy.ops.render.render(animation=True)
    assert names(tmp_path) == []


CHILD = """
import os, sys
import bpy
import pav_blender
pav_blender.register()
blend, out, first, last, how = sys.argv[1:]
bpy.ops.wm.open_mainfile(filepath=blend)
scene = bpy.context.scene
scene.frame_start, scene.frame_end = int(first), int(last)
scene.render.filepath = out
code = 0
try:
    if how == "frames":
        bpy.ops.pav.write_sequence()
    elif how == "animation":
        bpy.ops.render.render(animation=True)
    else:
        import signal
        from pav_blender.core import images
        original = images._save
        def killed(path, *rest):
            if path.name == "000005.png":
                images_open = images.replacing(path)
                temporary = images_open.__enter__()
                temporary.write_bytes(b"half")
                os.kill(os.getpid(), signal.SIGKILL)
            original(path, *rest)
        images._save = killed
        bpy.ops.pav.write_sequence()
except RuntimeError as error:
    print(error, file=sys.stderr)
    code = 1
sys.stdout.flush()
sys.stderr.flush()
os._exit(code)
"""


def child(files, out, first, last, how):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    words = [files / "walk.blend", f"{out}/", first, last, how]
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, *map(str, words)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture
def blend(made, scene, files):
    scene.render.filepath = ""
    bpy.ops.wm.save_as_mainfile(filepath=str(files / "walk.blend"), copy=True)
    return files / "walk.blend"


@pytest.mark.parametrize("how", ["frames", "animation"])
def test_two_processes_render_ranges_of_one_file_at_once(blend, files, tmp_path, how):
    both = [child(files, tmp_path, *span, how) for span in ((3, 4), (5, 6))]
    for process in both:
        _, said = process.communicate(timeout=180)
        assert process.returncode == 0, said
    digits = 6 if how == "frames" else 4
    assert names(tmp_path) == [f"{frame:0{digits}d}.png" for frame in (3, 4, 5, 6)]
    scene = bpy.context.scene
    scene.pav.quality = "PREVIEW"
    for frame in (3, 6):
        found = images.read_rgba(tmp_path / f"{frame:0{digits}d}.png").astype(int)
        expected = f12(tmp_path / "f12" / "f.png", frame)
        assert np.abs(found - expected).max() <= 1


def test_a_killed_process_leaves_whole_frames_and_a_resume_completes_them(blend, files, tmp_path):
    process = child(files, tmp_path, 3, 6, "killed")
    process.communicate(timeout=180)
    assert process.returncode == -signal.SIGKILL
    found = look(tmp_path)
    assert [path.name for path in found.whole] == ["000003.png", "000004.png"]
    assert found.damaged == {}
    assert len(found.left) == 1
    work = write(tmp_path)
    assert (work.kept, work.done) == (2, 4)
