"""A real Blender, named by the environment variable BLENDER (a command line), with the extension
installed from a freshly built archive.

Everything lies under out/test-real-blender and is named relative to the repository, for the
command may run Blender where the repository has another path.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import sys

import pytest
from places import ROOT, WORK

sys.path.insert(0, str(ROOT / "tests" / "blender"))


class RealBlender:
    """Runs the command with arguments from the repository's root."""

    def __init__(self, command: str) -> None:
        self.command = shlex.split(command)

    def __call__(self, *arguments: object, timeout: float = 600) -> subprocess.CompletedProcess:
        # settings of its own: the user's Blender stays as it is
        environment = {**os.environ, "BLENDER_USER_RESOURCES": str(WORK / "resources")}
        environment["PAV_CACHE"] = str(WORK.with_name("real-blender-cache"))  # compile once
        command = [*self.command, *map(str, arguments)]
        child = subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            out, err = child.communicate(timeout=timeout)
        finally:
            if child.poll() is None:  # a wrapper's children go with it
                os.killpg(child.pid, signal.SIGKILL)
        return subprocess.CompletedProcess(command, child.returncode, out, err)


@pytest.fixture(scope="session")
def bare_blender():
    command = os.environ.get("BLENDER")
    if not command:
        pytest.skip("set BLENDER to a Blender command to run these tests")
    shutil.rmtree(ROOT / WORK, ignore_errors=True)
    (ROOT / WORK / "resources").mkdir(parents=True)
    return RealBlender(command)


@pytest.fixture(scope="session")
def blender(bare_blender):
    """With the extension built, validated, installed and enabled."""
    archive = WORK / "pav_blender.zip"
    for arguments in (
        ("build", "--source-dir", "pav_blender", "--output-filepath", archive),
        ("validate", archive),
        ("install-file", "-r", "user_default", "-e", archive),
    ):
        done = bare_blender("--command", "extension", *arguments)
        assert done.returncode == 0, done.stdout + done.stderr
    return bare_blender


@pytest.fixture(scope="session")
def files(blender):
    """A tiny avatar, a tiny collection, and the scene that `pav scene` makes of them."""
    import small

    small.write_avatar(ROOT / WORK / "small.pav")
    small.write_collection(ROOT / WORK / "collection")
    done = blender(
        "--command",
        "pav",
        "scene",
        WORK / "small.pav",
        "--track",
        f"{WORK / 'collection'}:walk",
        "--out",
        WORK / "walk.blend",
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return WORK
