"""Installing packages into the extension's folder, by the real pip and a wheel made here."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("bpy")

import bpy
from layouts import drawn

from pav_blender.bridge import install, jobs, packages
from pav_blender.core.errors import PavError

NAME = "pav_pretend"


def write_wheel(folder: Path, version: str = "1.0", body: str = "answer = 42\n") -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / f"{NAME}-{version}-py3-none-any.whl"
    about = f"{NAME}-{version}.dist-info"
    files = {
        f"{NAME}/__init__.py": body,
        f"{about}/METADATA": f"Metadata-Version: 2.1\nName: {NAME}\nVersion: {version}\n",
        f"{about}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    listed = "".join(f"{name},,\n" for name in (*files, f"{about}/RECORD"))
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in (files | {f"{about}/RECORD": listed}).items():
            archive.writestr(name, text)
    return path


@pytest.fixture
def own(scene, tmp_path, monkeypatch):
    """The extension's folder for packages, in a place of this test's."""
    folder = tmp_path / "user" / "packages"
    monkeypatch.setattr(packages, "own_folder", lambda: folder)
    yield folder
    packages.deactivate()
    sys.modules.pop(NAME, None)


@pytest.fixture
def source(tmp_path):
    return ["--no-index", "--find-links", str(write_wheel(tmp_path / "wheels").parent)]


def run(work, seconds=60.0):
    end = time.monotonic() + seconds
    while not work.step():
        work.wait()
        assert time.monotonic() < end, "pip did not end"
    return work.error


def test_installs_and_can_be_imported_at_once(own, source):
    work = install.start(install.CPU, source=source, torch=[NAME])
    assert run(work) == ""
    assert work.fraction == 1.0
    assert [path.name for path in own.parent.iterdir()] == [own.name]
    assert packages.added() == [str(own)]
    assert sys.path[-1] == str(own)  # what Blender has itself comes first
    assert importlib.import_module(NAME).answer == 42


def test_a_second_installation_takes_the_place_of_the_first(own, source, tmp_path):
    assert run(install.start(install.CPU, source=source, torch=[NAME])) == ""
    write_wheel(tmp_path / "wheels", "2.0", "answer = 43\n")
    assert run(install.start(install.CPU, source=source, torch=[NAME])) == ""
    assert [path.name for path in own.parent.iterdir()] == [own.name]
    assert [path.name for path in own.glob("*.dist-info")] == [f"{NAME}-2.0.dist-info"]
    install.remove()
    assert not own.exists()
    assert packages.added() == []


def test_a_failure_leaves_nothing_and_says_why(own, source):
    work = install.start(install.CPU, source=source, torch=["no-such-package-of-pav"])
    assert "No matching distribution found for no-such-package-of-pav" in run(work)
    assert list(own.parent.iterdir()) == []
    assert packages.added() == []


def test_cancelling_leaves_nothing(own, source):
    work = install.start(install.CPU, source=source, torch=[NAME])
    assert list(own.parent.iterdir()) != []
    work.stop()
    assert run(work) == "Cancelled"
    assert list(own.parent.iterdir()) == []


def test_the_pip_that_python_carries_will_do(own, source, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        install.importlib.util, "find_spec", lambda name: None if name == "pip" else find(name)
    )
    variables = install.pip_variables()
    assert variables["PAV_PIP"].endswith(".whl")
    assert run(install.start(install.CPU, source=source, torch=[NAME])) == ""
    assert (own / NAME).is_dir()
    monkeypatch.setattr(install.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(PavError, match="has no pip"):
        install.start(install.CPU, source=source, torch=[NAME])


def test_without_online_access_nothing_is_fetched(own):
    assert not bpy.app.online_access
    with pytest.raises(RuntimeError, match="online access is off"):
        bpy.ops.pav.install_torch()
    assert not own.parent.exists()


def test_what_pip_says_becomes_a_message():
    for line, message in (
        ("Collecting torch==2.13.0", "Collecting torch==2.13.0"),
        (
            "  Downloading https://a.b/whl/torch-2.13.0%2Bcpu-cp311-cp311-linux_x86_64.whl (1 MB)",
            "Downloading torch 2.13.0%2Bcpu",
        ),
        ("Installing collected packages: torch", "Unpacking"),
    ):
        assert install._understand(line) == {"message": message}
    assert install._understand("ERROR: no space left") is None


def test_the_pins_are_those_of_the_requirements(request):
    text = (request.config.rootpath / "requirements" / "py311.txt").read_text()
    pins = set(text.split())
    for pin in (install.CPU.torch, *(pins[0] for pins in install.OTHERS.values())):
        assert pin in pins, pin
    assert set(install.tracking_packages()) <= pins or sys.version_info >= (3, 13)
    wheels = (request.config.rootpath / "requirements" / "wheels.txt").read_text()
    for names in install.OTHERS.values():
        for pin in names:
            assert f"{pin} " in wheels, pin
            name, _, version = pin.partition("==")  # they fit together: these tests run on them
            assert importlib.metadata.version(name) == version


BLOCKED = """
import sys
for name in ("torch", "numba", "safetensors", "scipy"):
    sys.modules[name] = None
sys.path.insert(0, sys.argv[1])
import bpy, pav_blender
pav_blender.register()
import layouts
from pav_blender.ui import avatar, motion, output, preferences, training
for panel in (avatar.PAV_PT_avatar, training.PAV_PT_train, output.PAV_PT_render):
    texts = layouts.drawn(panel).texts
    assert "Missing: torch, numba, safetensors, scipy" in texts, texts
    assert "preferences.addon_show" in texts, texts
assert bpy.ops.pav.add_rig() == {"FINISHED"}
head = bpy.context.object
assert len(head.data.shape_keys.key_blocks) > 50 and head.parent.type == "ARMATURE"
head.data.shape_keys.key_blocks["jawOpen"].value = 1.0
bpy.ops.pav.save_head(filepath="mine.npz")
assert bpy.ops.pav.add_rig(filepath="mine.npz") == {"FINISHED"}
assert bpy.context.object.name == "mine"
for wrong, said in (("nowhere.npz", "no such head"), (sys.argv[2], "damaged, or not an .npz")):
    try:
        bpy.ops.pav.add_rig(filepath=wrong)
    except RuntimeError as error:
        assert said in str(error), error
    else:
        raise AssertionError(wrong)
layouts.drawn(avatar.PAV_PT_avatar)
scene = bpy.context.scene
scene.render.engine = "PAV"
scene.pav.training.source, scene.pav.training.collection = "COLLECTION", "/tmp"
scene.pav.training.output = "/tmp/never.pav"
head.pav.avatar = "/tmp/some.pav"
assert head.pav.appearance == ""
for operator in (bpy.ops.render.render, bpy.ops.pav.train, bpy.ops.pav.add_head):
    try:
        operator()
    except RuntimeError as error:
        assert "lacks torch, numba, safetensors, scipy" in str(error), error
    else:
        raise AssertionError(operator)
pav_blender.unregister()
assert not [n for n in ("torch", "numba") if sys.modules.get(n)]
print("rigs without torch", flush=True)
"""


def test_without_torch_heads_are_rigged_and_the_rest_explains_itself(tmp_path, request):
    root = request.config.rootpath
    environment = {**os.environ, "PYTHONPATH": str(root)}
    environment["BLENDER_USER_RESOURCES"] = str(tmp_path / "resources")
    (tmp_path / "resources").mkdir()
    damaged = tmp_path / "damaged.npz"
    damaged.write_bytes(b"PK not a head")
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED, str(Path(__file__).parent), str(damaged)],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert "rigs without torch" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0


def test_the_preferences_show_the_job(scene):
    jobs._jobs.clear()
    from pav_blender.ui.preferences import PavPreferences

    texts = drawn(PavPreferences, environment="", python="").texts
    assert any(text.startswith("torch 2.") for text in texts)
    assert {"pav.install_torch", "pav.check_environment", "environment"} <= set(texts)
