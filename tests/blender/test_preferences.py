"""Where packages and the Python for jobs come from, as the preferences say."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys

import pytest

pytest.importorskip("bpy")

import bpy
from layouts import drawn

from pav_blender.bridge import environment, jobs, packages, process, requirements
from pav_blender.bridge.process import Process

HERE = f"{sys.version_info[0]}.{sys.version_info[1]}"


@pytest.fixture
def chosen(scene, tmp_path, monkeypatch):
    """The add-on's preferences, and an empty folder of its own."""
    monkeypatch.setattr(packages, "own_folder", lambda: tmp_path / "own")
    addon = bpy.context.preferences.addons.new()
    addon.module = packages.ROOT
    jobs._jobs.clear()
    yield addon.preferences
    bpy.context.preferences.addons.remove(addon)
    packages.activate()
    environment.forget()


def make_environment(folder, version=HERE, windows=False):
    inside = "Lib/site-packages" if windows else f"lib/python{version}/site-packages"
    site = folder / inside
    (site / "pav_brought").mkdir(parents=True)
    (site / "pav_brought" / "__init__.py").write_text("answer = 42\n")
    (folder / "pyvenv.cfg").write_text(f"home = /usr/bin\nversion = {version}.4\n")
    return site


@pytest.mark.parametrize("windows", [False, True])
def test_an_environment_is_searched_last(chosen, tmp_path, windows):
    site = make_environment(tmp_path / "venv", windows=windows)
    before = list(sys.path)
    (site / "numpy").mkdir()
    (site / "numpy" / "__init__.py").write_text("raise ImportError('the wrong numpy')")
    chosen.environment = str(tmp_path / "venv")
    assert sys.path == [*before, str(site)]
    assert importlib.util.find_spec("pav_brought") is not None
    assert str(site) not in importlib.util.find_spec("numpy").origin
    chosen.environment = ""
    assert sys.path == before


def test_site_packages_may_be_named_themselves(chosen, tmp_path):
    site = make_environment(tmp_path / "venv")
    chosen.environment = str(site)
    assert packages.added() == [str(site)]


def test_an_environment_for_another_python_is_refused_in_one_line(chosen, tmp_path):
    make_environment(tmp_path / "posix", "3.9")
    make_environment(tmp_path / "windows", "3.9", windows=True)
    bare = tmp_path / "bare" / "torch"
    bare.mkdir(parents=True)
    (bare / "_C.cpython-39-x86_64-linux-gnu.so").write_bytes(b"")
    for name in ("posix", "windows", "bare"):
        chosen.environment = str(tmp_path / name)
        said = packages.problem(packages.chosen_environment())
        assert said == f"{tmp_path / name}: made for Python 3.9; this Blender's is {HERE}"
        assert packages.added() == []
    chosen.environment = str(tmp_path / "nowhere")
    assert "no environment" in packages.problem(packages.chosen_environment())
    from pav_blender.ui.preferences import PavPreferences

    drawn_texts = drawn(PavPreferences, environment="", python="").texts
    assert any("no environment and no folder" in text for text in drawn_texts)


def run(work):
    while not work.step():
        work.wait()
    return work.error


def test_a_job_finds_the_environment_too_and_last(chosen, tmp_path):
    site = make_environment(tmp_path / "venv")
    (site / "safetensors").mkdir()
    (site / "safetensors" / "__init__.py").write_text("raise SystemExit('the wrong one')")
    chosen.environment = str(tmp_path / "venv")
    variables = process.environment(sys.executable)
    assert variables["PAV_PACKAGES"] == str(site)
    assert str(site) not in variables["PYTHONPATH"].split(os.pathsep)
    assert bpy.ops.pav.check_environment() == {"FINISHED"}
    found = environment.found()
    assert found["missing"] == []
    assert found["versions"]["torch"] == requirements.version("torch")
    assert "cpu" in found["devices"]
    from pav_blender.ui.preferences import PavPreferences

    texts = drawn(PavPreferences, environment="", python="").texts
    assert any(text.startswith("Devices: cpu") for text in texts)


@pytest.fixture(scope="session")
def bare_python(tmp_path_factory):
    """A Python without any of the packages."""
    folder = tmp_path_factory.mktemp("bare") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def test_jobs_run_in_the_python_that_was_chosen(chosen, bare_python, tmp_path):
    chosen.python = str(bare_python)
    assert process.interpreter() == str(bare_python)
    bpy.ops.pav.check_environment()
    found = environment.found()
    assert set(found["missing"]) >= {"torch", "numba"}
    assert found["devices"] == []
    assert "pip install numpy torch numba" in environment.next_step("")
    settings = bpy.context.scene.pav.training
    settings.source, settings.collection = "COLLECTION", str(tmp_path)
    settings.output = str(tmp_path / "me.pav")
    with pytest.raises(RuntimeError, match=r"No module named|is missing"):
        bpy.ops.pav.train()


def test_a_python_that_is_none_is_told(chosen, tmp_path):
    chosen.python = str(tmp_path / "no-python")
    with pytest.raises(RuntimeError, match="cannot be started"):
        bpy.ops.pav.check_environment()
    from pav_blender.ui.preferences import PavPreferences

    texts = drawn(PavPreferences, environment="", python="").texts
    assert any(text.endswith("not a program") for text in texts)


def test_outside_a_preference_blenders_own_python_runs(scene):
    assert packages.chosen_python() == ""
    assert process.interpreter() == sys.executable
    work = Process(["doctor", "--json"], merged=True)
    assert run(work) == ""
