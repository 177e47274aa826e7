"""Training from the panel: what is asked for, its note, the job, and what happens after a crash."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("bpy")

import bpy
from hypothesis import given
from hypothesis import strategies as st
from layouts import drawn
from toy import make_toy

from pav_blender.bridge import jobs, monitor, training
from pav_blender.bridge.training import Wanted
from pav_blender.core.errors import InputError, PavError
from pav_blender.core.training.places import checkpoint_path, read_curve

ITERATIONS = 12


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    return make_toy(tmp_path_factory.mktemp("tiny") / "collection", frames=4, size=32)


@pytest.fixture
def settings(scene):
    jobs._jobs.clear()
    training._watch.clear()
    return scene.pav.training


@pytest.fixture
def asked(settings, tiny, tmp_path):
    """The panel filled in for a collection; a checkpoint after every iteration."""
    settings.source, settings.collection = "COLLECTION", str(tiny)
    settings.output, settings.minutes = str(tmp_path / "me.pav"), 0
    settings.options = f"--iterations {ITERATIONS} --checkpoint-every 0"
    return settings


def panel():
    from pav_blender.ui.training import PAV_PT_train

    return drawn(PAV_PT_train)


def video(path):
    path.write_bytes(b"not looked at")
    return path


def test_videos_are_listed_with_the_names_of_their_files(settings, tmp_path):
    files = [{"name": name} for name in ("2019.mp4", "beard.mov", "2019.mp4")]
    for _ in range(2):
        bpy.ops.pav.add_clips(directory=str(tmp_path), files=files)
    assert [clip.appearance for clip in settings.clips] == ["2019", "beard"]
    assert settings.clips[1].path == str(tmp_path / "beard.mov")
    bpy.ops.pav.remove_clip()
    assert [clip.appearance for clip in settings.clips] == ["2019"]
    assert "pav.train" in panel().texts


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"output": ""}, "choose the avatar file"),
        ({"output": "/tmp/a.obj"}, "ends in .pav"),
        ({"collection": ""}, "add videos, or choose"),
        ({"source": "VIDEOS"}, "add videos, or choose"),
        ({"collection": "/no/such"}, "no such collection"),
        ({"options": "--minutes 'x"}, "No closing quotation"),
        ({"options": "--minutes x"}, "invalid float value"),
    ],
)
def test_what_is_not_filled_in_is_told_in_one_line(asked, change, said, tmp_path):
    for name, value in change.items():
        setattr(asked, name, value)
    with pytest.raises(RuntimeError, match=said):
        bpy.ops.pav.train()
    assert not list(tmp_path.glob("*.pav"))


def test_wanted_clips_must_be_there_and_be_named(tmp_path):
    there = video(tmp_path / "a.mp4")
    with pytest.raises(InputError, match="no such video"):
        Wanted(tmp_path / "a.pav", ((tmp_path / "b.mp4", "b"),))
    for name in ("", "  ", "x=y"):
        with pytest.raises(InputError, match="name its appearance"):
            Wanted(tmp_path / "a.pav", ((there, name),))


def test_the_note_says_all_that_was_wanted(tmp_path):
    wanted = Wanted(
        tmp_path / "me.pav", ((video(tmp_path / "a.mp4"), "beard"),), None, 2.5, "--seed 3"
    )
    training.write_note(wanted)
    assert training.read_note(wanted.output) == wanted
    assert training.unfinished(wanted.output)
    training.discard(wanted.output)
    assert not training.unfinished(wanted.output)
    assert (tmp_path / "a.mp4").exists()


@given(
    st.recursive(
        st.none() | st.integers() | st.text(max_size=5),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(st.sampled_from(["format", "clips", "collection", "minutes"]), inner)
        ),
        max_leaves=8,
    )
)
def test_a_damaged_note_is_one_line(tmp_path_factory, content):
    output = tmp_path_factory.getbasetemp() / "damaged.pav"
    if isinstance(content, dict):
        content["format"] = training.FORMAT
    training.note_of(output).write_text(json.dumps(content))
    with pytest.raises(InputError, match="note of a training"):
        training.read_note(output)


def test_a_note_left_behind_by_a_finished_training_means_nothing(tmp_path):
    output = tmp_path / "me.pav"
    training.note_of(output).write_text("{}")
    output.write_bytes(b"")
    now = time.time()
    os.utime(output, (now + 5, now + 5))
    assert not training.unfinished(output)
    os.utime(output, (now - 5, now - 5))  # an older avatar that was to be replaced
    assert training.unfinished(output)


def test_videos_are_tracked_then_learned(tmp_path):
    clips = [(video(tmp_path / f"{name}.mp4"), look) for name, look in (("a", "x"), ("b", "y z"))]
    wanted = Wanted(tmp_path / "me.pav", tuple(clips), None, 3.0)
    tracking = training.track_arguments(wanted)
    assert tracking == [
        *("track", str(clips[0][0]), str(clips[1][0])),
        *("--appearance", "x", "--appearance", "y z"),
        *("--out", str(tmp_path / "me.collection"), "--json-progress"),
    ]
    learning = training.train_arguments(wanted)
    assert learning[1] == str(tmp_path / "me.collection")
    assert learning[-2:] == ["--minutes", "3"]
    from pav_blender.core.tracking.command import add_arguments
    from pav_blender.core.tracking.track import appearance_names

    parser = argparse.ArgumentParser()
    add_arguments(parser)
    found = parser.parse_args([word for word in tracking[1:] if word != "--json-progress"])
    assert appearance_names(["a", "b"], found.appearance) == ["x", "y z"]


def write_tracked(folder, *clips):
    folder.mkdir()
    content = {
        "clips": [{"name": Path(video).stem, "appearance": look} for video, look in clips],
        "extra": {
            "tracking": {
                "clips": [{"name": Path(video).stem, "video": video} for video, _ in clips],
                "skipped": [],
            }
        },
    }
    (folder / "collection.json").write_text(json.dumps(content))


def test_a_track_of_the_same_videos_is_used_again_and_no_other(tmp_path):
    clip = video(tmp_path / "a.mp4")
    os.utime(clip, (1, 1))
    wanted = Wanted(tmp_path / "me.pav", ((clip, "x"),))
    assert not training.tracked(wanted)
    write_tracked(wanted.learned, ("a.mp4", "x"))
    assert training.tracked(wanted)
    with pytest.raises(InputError, match="holds other clips"):
        training.tracked(Wanted(wanted.output, ((clip, "y"),)))
    os.utime(clip)
    os.utime(wanted.learned / "collection.json", (2, 2))
    with pytest.raises(InputError, match="holds other clips"):  # the video is newer
        training.tracked(wanted)
    again = Wanted(wanted.output, ((clip, "x"),), track_again=True)
    assert not training.tracked(again)
    assert training.track_arguments(again)[-1] == "--overwrite"


def test_trains_to_the_end_without_a_window(asked, tmp_path):
    assert bpy.ops.pav.train() == {"FINISHED"}
    output = tmp_path / "me.pav"
    assert output.is_file()
    assert not training.unfinished(output)
    assert not list(tmp_path.glob("*.json"))
    assert not checkpoint_path(output).exists()
    watch = training.watched()
    assert watch.curve[-1][0] == ITERATIONS
    assert [phase.fraction for phase in watch.pipeline.phases] == [1.0]
    pieces = monitor.pieces(watch.wanted.preview / "preview.png")
    assert len(pieces) == 4  # two appearances, filmed and learned
    assert pieces[0].std() > 0.05  # a head, not a plain grey
    layout = panel()
    assert "Wrote me.pav" in layout.texts
    assert "pav.add_head" in layout.texts
    assert layout.icons == 1 + 4
    monitor.forget()


@pytest.mark.slow
def test_two_videos_become_an_avatar_of_two_appearances(settings, tmp_path, request, monkeypatch):
    monkeypatch.syspath_prepend(str(request.config.rootpath / "tests" / "core"))
    import filmed

    for name, look in (("one", "crop"), ("two", "grey")):
        filmed.film(tmp_path / f"{name}.mp4", [filmed.frame(look, row) for row in range(12)])
    bpy.ops.pav.add_clips(directory=str(tmp_path), files=[{"name": "one.mp4"}, {"name": "two.mp4"}])
    settings.clips[1].appearance = "silver"
    settings.output, settings.minutes = str(tmp_path / "me.pav"), 0
    settings.options = "--iterations 4"
    assert bpy.ops.pav.train() == {"FINISHED"}
    assert [phase.label for phase in training.watched().pipeline.phases] == ["Track", "Train"]
    from pav_blender.bridge import avatars

    assert avatars.header(tmp_path / "me.pav")["appearances"] == ["one", "silver"]
    assert (tmp_path / "me.collection" / "collection.json").is_file()
    assert bpy.ops.pav.train() == {"FINISHED"}  # and the track is used again
    assert [phase.label for phase in training.watched().pipeline.phases] == ["Train"]


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited for too long"
        time.sleep(0.02)


BLENDER = """
import sys
import bpy, pav_blender
pav_blender.register()
settings = bpy.context.scene.pav.training
settings.source, settings.collection, settings.output = "COLLECTION", *sys.argv[1:3]
settings.minutes, settings.options = 0, sys.argv[3]
bpy.ops.pav.train()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
@pytest.mark.slow
def test_goes_on_after_blender_was_killed_and_after_the_training_was(
    asked, tmp_path, request, monkeypatch
):
    output = tmp_path / "me.pav"
    asked.options = f"--iterations {2 * ITERATIONS} --checkpoint-every 0"
    command = [sys.executable, "-c", BLENDER, asked.collection, str(output), asked.options]
    environment = {**os.environ, "PYTHONPATH": str(request.config.rootpath)}
    blender = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    until(lambda: checkpoint_path(output).is_file())
    blender.kill()
    blender.wait()
    until(lambda: not list(tmp_path.glob(".me.partial-*")), 10)  # it saves, politely stopped
    assert training.unfinished(output)
    assert not output.exists()
    assert {"pav.resume_training", "pav.discard_training"} <= set(panel().texts)
    assert "pav.train" not in panel().texts
    with pytest.raises(RuntimeError, match="resume or discard"):
        bpy.ops.pav.train()

    work = training.start(training.read_note(output), resume=True)
    watch = training.watched()
    watch.curve.clear()  # of what was known before
    until(lambda: work.step() or watch.curve)
    assert watch.curve[0][0] > 1
    os.kill(work._current._child.pid, signal.SIGKILL)
    until(work.step)
    assert "ended with code -9" in work.error
    assert training.unfinished(output)

    asked.options = ""  # the note knows
    assert bpy.ops.pav.resume_training() == {"FINISHED"}
    watch = training.watched()
    assert watch.curve[-1][0] == 2 * ITERATIONS
    assert not training.unfinished(output)
    from pav_blender.bridge import avatars

    assert avatars.header(output)["record"]["iterations"] == 2 * ITERATIONS
    rows = [row[0] for row in read_curve(watch.wanted.preview)]
    assert rows == sorted(rows)


def test_a_failure_keeps_what_was_wanted_and_says_why(asked, tmp_path):
    asked.options = "--preset no-such"
    with pytest.raises(RuntimeError, match="preset 'no-such'"):
        bpy.ops.pav.train()
    assert training.unfinished(tmp_path / "me.pav")
    assert "preset" in " ".join(panel().texts)
    assert bpy.ops.pav.discard_training() == {"FINISHED"}
    assert not training.unfinished(tmp_path / "me.pav")


def test_phases_share_the_bar_by_their_weight():
    from pav_blender.bridge.pipeline import Phase, Pipeline

    class Pretend:
        def __init__(self, fractions, error=""):
            self.left, self.fraction, self.error, self.message = fractions, 0.0, error, "at work"

        def step(self):
            self.fraction = self.left.pop(0)
            return not self.left

        def stop(self):
            self.left = [self.fraction]

        def wait(self):
            pass

    ended = []
    phases = [
        Phase("a", 1, lambda: Pretend([0.5, 1.0])),
        Phase("b", 3, lambda: Pretend([0.5, 1.0])),
    ]
    work = Pipeline(phases, finish=lambda: ended.append("well"))
    seen = []
    while not work.step():
        seen.append((work.fraction, work.message))
    assert seen == [(0.125, "1/2 at work"), (0.25, "2/2 at work"), (0.625, "2/2 at work")]
    assert (work.fraction, work.error, ended) == (1.0, "", ["well"])

    def refuse():
        raise PavError("no more room")

    work = Pipeline([Phase("a", 1, lambda: Pretend([1.0]))], finish=refuse)
    assert work.step()
    assert work.error == "no more room"
    gone = []
    stopped = Pipeline(
        [Phase("a", 1, lambda: Pretend([0.1, 0.2, 0.3])), Phase("b", 1, refuse)],
        abandon=lambda: gone.append(True),
    )
    stopped.stop()
    while not stopped.step():
        pass
    assert (stopped.error, gone) == ("Cancelled", [True])


def test_the_curve_rises_where_the_psnr_does():
    rows = [(i, i, 2.0 / (1 + i), 10.0 + i) for i in range(50)]
    picture = monitor.curve_picture(rows)
    assert picture.shape == (monitor.SIDE, monitor.SIDE, 4)
    blue = (picture[..., 2] > 0.6) & (picture[..., 0] < 0.5)
    left, right = blue[:, 5].nonzero()[0].mean(), blue[:, -5].nonzero()[0].mean()
    assert left > 150 > 40 > right
    assert monitor.curve_picture([]).std() < 0.5
