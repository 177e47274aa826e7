"""Tests on the bpy wheel: settings in a temporary folder, a fresh scene a test, a hard exit.

The 4.5 wheel hangs at exit while a class is registered, so pytest's status is kept and the
process ended with it.
"""

from __future__ import annotations

import atexit
import os
import shutil
import sys
import tempfile

import pytest

_resources = tempfile.mkdtemp(prefix="pav-blender-test-")
atexit.register(shutil.rmtree, _resources, ignore_errors=True)
os.environ.setdefault("BLENDER_USER_RESOURCES", _resources)

_status: list[int] = []


def pytest_sessionfinish(session, exitstatus):
    _status[:] = [int(exitstatus)]


@pytest.hookimpl(trylast=True)
def pytest_unconfigure(config):
    if "bpy" not in sys.modules:
        return
    sys.stdout.flush()
    sys.stderr.flush()
    shutil.rmtree(_resources, ignore_errors=True)
    os._exit(_status[0] if _status else 1)


@pytest.fixture(scope="session")
def registered():
    """The add-on registered from the working tree, for the whole session."""
    pytest.importorskip("bpy")
    import pav_blender

    pav_blender.register()
    yield
    pav_blender.unregister()


@pytest.fixture
def scene(registered):
    """An empty scene with the add-on registered."""
    import bpy

    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    return bpy.context.scene


@pytest.fixture(scope="module")
def files(registered, tmp_path_factory):
    """A folder with the avatar small.pav and the collection "collection"."""
    import small

    folder = tmp_path_factory.mktemp("files")
    small.write_avatar(folder / "small.pav")
    small.write_collection(folder / "collection")
    return folder


@pytest.fixture
def here(files, tmp_path):
    """A folder with an avatar of its own."""
    shutil.copy(files / "small.pav", tmp_path / "small.pav")
    return tmp_path
