"""A verb beside Blender: progress, cancelling, its end with its parent."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

pytest.importorskip("bpy")

from pav_blender.bridge import process
from pav_blender.bridge.process import Process

SPEAKS = """
import json, sys
print("hello", file=sys.stderr)
for part in (0.25, 1.0):
    line = {"task": "train", "fraction": part, "seconds_left": 61.0}
    print(json.dumps(line), file=sys.stderr, flush=True)
sys.exit({code})
"""

WAITS = """
import signal, sys, time
signal.signal(signal.SIGTERM, lambda *_: (print("pav: stopped", file=sys.stderr), sys.exit(1)))
import threading, os
sys.path.insert(0, {root!r})
from pav_blender import child
threading.Thread(target=child._watch, daemon=True).start()
print('{{"task": "train", "fraction": 0.1}}', file=sys.stderr, flush=True)
time.sleep(60)
"""


@pytest.fixture
def pretend(monkeypatch):
    """Makes a Process run Python code instead of a verb."""

    popen = subprocess.Popen

    def replace(code):
        monkeypatch.setattr(
            process.subprocess,
            "Popen",
            lambda _command, **rest: popen([sys.executable, "-c", code], **rest),
        )

    return replace


def run(work, seconds=20.0):
    end = time.monotonic() + seconds
    while not work.step():
        work.wait()
        assert time.monotonic() < end, "the process did not end"


def test_progress_lines_become_a_fraction_and_a_sentence(pretend):
    pretend(SPEAKS.replace("{code}", "0"))
    work = Process(["train"])
    run(work)
    assert (work.fraction, work.error) == (1.0, "")
    assert work.message == "train 100 %, 1:01 left"
    assert list(work.lines) == ["hello"]


def test_a_failure_carries_the_last_line(pretend):
    pretend(SPEAKS.replace("{code}", "3"))
    work = Process(["train"])
    run(work)
    assert work.error == "pav train ended with code 3: hello"


def wait_for_the_first_line(work):
    while work.fraction == 0:
        assert not work.step(), work.error
        time.sleep(0.02)


def test_cancelling_is_polite(pretend, request):
    pretend(WAITS.format(root=str(request.config.rootpath)))
    work = Process(["train"])
    wait_for_the_first_line(work)
    begun = time.monotonic()
    work.stop()
    run(work)
    assert time.monotonic() - begun < 10
    assert work.error == "stopped"


PARENT = """
import os, sys, time
sys.path.insert(0, {root!r})
from pav_blender.bridge import process
import subprocess
popen = subprocess.Popen
process.subprocess.Popen = lambda _command, **rest: popen([sys.executable, "-c", {child!r}], **rest)
work = process.Process(["train"])
while work.fraction == 0:
    work.step()
    time.sleep(0.02)
print(work._child.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
def test_the_child_ends_when_its_parent_is_killed(request):
    root = str(request.config.rootpath)
    code = PARENT.format(root=root, child=WAITS.format(root=root))
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    # Blender 5.2 may say something first
    child = int(next(line for line in parent.stdout if line.strip().isdigit()))
    parent.kill()
    parent.wait()
    end = time.monotonic() + 10
    while is_running(child):
        assert time.monotonic() < end, "the child outlived its parent"
        time.sleep(0.05)


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    try:  # an orphan that nobody has reaped yet is dead
        with open(f"/proc/{pid}/stat", encoding="utf-8") as stream:
            return stream.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return True


def test_the_real_verb_reports_wrong_input(scene, tmp_path):
    work = Process(["train", str(tmp_path / "nowhere"), "--out", str(tmp_path / "a.pav")])
    run(work, 60)
    assert "nowhere: no such collection folder" in work.error
