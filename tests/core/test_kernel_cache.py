"""Where compiled kernels are kept."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pav_blender

PACKAGE = Path(pav_blender.__file__).parent
SAY = "import os, {name}.core.kernels.cpu; print(os.environ['NUMBA_CACHE_DIR'])"


def folder(name: str, **variables: str) -> str:
    """The folder that the package under a name uses."""
    done = subprocess.run(
        [sys.executable, "-c", SAY.format(name=name)],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def test_an_extension_and_its_child_do_not_share_compiled_code(tmp_path):
    """It names the modules it came from, which differ: `bl_ext...` inside Blender."""
    (tmp_path / "ext").mkdir()
    (tmp_path / "ext" / "pav_blender").symlink_to(PACKAGE)
    common = {"PAV_CACHE": str(tmp_path), "NUMBA_CACHE_DIR": "", "PAV_NUMBA_CACHE": ""}
    path = os.pathsep.join([str(tmp_path), str(PACKAGE.parent)])
    first = folder("ext.pav_blender", PYTHONPATH=path, **common)
    inherited = {"NUMBA_CACHE_DIR": first, "PAV_NUMBA_CACHE": first}
    second = folder("pav_blender", PYTHONPATH=path, **(common | inherited))
    assert first.startswith(str(tmp_path))
    assert second.startswith(str(tmp_path))
    assert first != second


def test_a_folder_that_the_user_chose_is_used(tmp_path):
    chosen = str(tmp_path / "mine")
    assert folder("pav_blender", NUMBA_CACHE_DIR=chosen) == chosen
