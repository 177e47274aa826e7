"""Registering, and the archive on the wheel in a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("bpy")

ROOT = Path(__file__).resolve().parents[2]

INSTALL = """
import os, sys
import bpy
bpy.ops.extensions.package_install_files(
    filepath=sys.argv[1], repo="user_default", enable_on_install=True
)
assert not {"torch", "numba"} & set(sys.modules), "enabling imports heavy packages"
name = "bl_ext.user_default.pav_blender"
assert name in bpy.context.preferences.addons, list(bpy.context.preferences.addons)
assert hasattr(bpy.types.Object, "pav") and hasattr(bpy.ops.pav, "add_head")
bpy.context.scene.render.engine = "PAV"
from bl_ext.user_default.pav_blender.cli import main
assert main(["info", "no-such.pav"]) == 2
print("installed", flush=True)
os._exit(0)
"""

REGISTER_TWICE = """
import bpy, pav_blender
for _ in range(3):
    pav_blender.register()
    assert hasattr(bpy.types.Scene, "pav")
    assert "PAV" in bpy.types.DATA_PT_camera.COMPAT_ENGINES
    pav_blender.unregister()
    assert not hasattr(bpy.types.Scene, "pav")
    assert not hasattr(bpy.types, "PAV_PT_avatar")
    assert "PAV" not in bpy.types.DATA_PT_camera.COMPAT_ENGINES
    handlers = bpy.app.handlers
    assert not handlers.render_init and not handlers.render_cancel
print("left cleanly", flush=True)
"""


def run(tmp_path, code, *arguments, source=True):
    """Runs Python code in an empty folder; `source`: with the working tree importable."""
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(tmp_path / "resources")}
    environment["PYTHONPATH"] = str(ROOT) if source else ""
    (tmp_path / "resources").mkdir()
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_registers_and_leaves_cleanly_again_and_again(tmp_path):
    done = run(tmp_path, REGISTER_TWICE)
    assert "left cleanly" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0  # Blender hangs or crashes here if a class is left


def test_the_archive_is_valid_installs_and_enables(tmp_path):
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        from build_extension import build
    finally:
        sys.path.remove(str(ROOT / "tools"))
    archive = build(tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [archive.name]
    done = run(tmp_path, INSTALL, str(archive), source=False)
    assert "installed" in done.stdout, done.stdout + done.stderr


def test_an_invalid_manifest_leaves_no_archive(tmp_path):
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        from build_extension import build
    finally:
        sys.path.remove(str(ROOT / "tools"))
    source = tmp_path / "pav_blender"
    source.mkdir()
    manifest = (ROOT / "pav_blender" / "blender_manifest.toml").read_text()
    broken = manifest.replace('type = "add-on"', 'type = "hat"')
    (source / "blender_manifest.toml").write_text(broken)
    (source / "__init__.py").write_text("")
    with pytest.raises(SystemExit, match="build failed"):
        build(tmp_path / "out", source=source)
    assert list((tmp_path / "out").iterdir()) == []
