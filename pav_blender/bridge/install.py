"""Putting PyTorch, and what else Blender's Python lacks, into the extension's own folder by pip."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..child import PIP
from ..core.errors import PavError
from . import packages
from .pipeline import Phase, Pipeline
from .process import Fields, Process

TORCH_INDEX = "https://download.pytorch.org/whl"


@dataclass(frozen=True)
class Build:
    """A build of PyTorch: what pip is asked for, from which index ("" for pip's own), and about how
    many MB come over the network and are taken on disk."""

    torch: str
    index: str
    megabytes: int
    on_disk: int


# sizes: of the wheels for Linux with what they need; Windows' and macOS' are smaller
CPU = Build("torch==2.13.0", f"{TORCH_INDEX}/cpu", 200, 800)
CUDA = Build("torch>=2.7", f"{TORCH_INDEX}/cu128", 3000, 6500)
BUILDS = {"CPU": CPU, "CUDA": CUDA}

# with these versions the project is tested (requirements/wheels.txt); without what they need in
# turn: that is numpy, which Blender has
OTHERS = {
    "numba": ("numba==0.68.1", "llvmlite==0.50.0"),
    "safetensors": ("safetensors==0.8.0",),
    "scipy": ("scipy==1.17.1",),
}
_OTHERS_MB, _TRACKING_MB = 400, 900
NEW = "packages"
_LOOK_EVERY_S = 1.0


def lacking() -> list[str]:
    """Which of OTHERS this Python lacks but for the extension's own folder."""
    from importlib.machinery import PathFinder

    own = str(packages.own_folder())
    elsewhere = [entry for entry in sys.path if entry != own]
    return [name for name in OTHERS if PathFinder.find_spec(name, elsewhere) is None]


def pip_variables() -> dict[str, str]:
    """What lets Blender's Python run pip: nothing, or where the pip lies that Pythons carry packed.

    PavError where there is neither (Linux distributions leave it out).
    """
    if importlib.util.find_spec("pip") is not None:
        return {}
    bundled = importlib.util.find_spec("ensurepip")
    folder = Path(bundled.origin).parent / "_bundled" if bundled and bundled.origin else None
    found = sorted(folder.glob("pip-*.whl")) if folder else []
    if not found:
        raise PavError(
            f"{sys.executable} has no pip: install it (your distribution's python3-pip), or name "
            "an environment that has PyTorch in the preferences"
        )
    return {PIP: str(found[-1])}


def command(target: Path, wanted: Sequence[str], source: Sequence[str]) -> list[str]:
    """Arguments of pip that put wheels (never anything to be built) into `target`."""
    return [
        "pip",
        "install",
        "--target",
        str(target),
        "--only-binary=:all:",
        "--no-input",
        "--no-compile",
        "--no-cache-dir",
        "--disable-pip-version-check",
        "--progress-bar=off",
        *source,
        *wanted,
    ]


def start(
    build: Build,
    *,
    tracking: bool = False,
    source: Sequence[str] | None = None,
    torch: Sequence[str] | None = None,
) -> Pipeline:
    """Installs a build of PyTorch, what else is lacking, and with `tracking` what reads videos.

    It works in a folder beside the final one, which is replaced when all is there. source: options
    of pip for where packages come from, torch: what to ask it for, instead of the build's own.
    Raises PavError where there is no pip or the folder cannot be written.
    """
    final = packages.own_folder()
    variables = pip_variables()
    try:
        final.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{final.name}.partial-", dir=final.parent))
        (work / "tmp").mkdir()
    except OSError as error:
        raise PavError(f"{final.parent}: cannot write there: {error.strerror}") from error

    def phase(label: str, megabytes: int, wanted: Sequence[str], options: Sequence[str]) -> Phase:
        arguments = command(work / NEW, wanted, options)
        return Phase(label, megabytes, lambda: _pip(arguments, variables, work, megabytes))

    of_torch = list(source) if source is not None else ["--index-url", build.index]
    of_others = list(source) if source is not None else []
    total = build.megabytes + build.on_disk
    phases = [phase("PyTorch", total, torch or [build.torch], of_torch)]
    others = [name for package in lacking() for name in OTHERS[package]]
    if others:
        phases.append(phase("Others", _OTHERS_MB, others, ["--no-deps", *of_others]))
    if tracking:
        phases.append(phase("Tracking", _TRACKING_MB, tracking_packages(), of_others))
    return Pipeline(
        phases,
        finish=lambda: _take_place(work, final),
        abandon=lambda: shutil.rmtree(work, ignore_errors=True),
    )


def tracking_packages() -> list[str]:
    """What reads videos, in the versions that this project is tested with on this Python."""
    if sys.version_info < (3, 13):
        return ["av==18.1.0", "mediapipe==0.10.21"]
    return ["av==19.0.2", "mediapipe==1.2.2"]


def remove() -> None:
    """Removes what was installed. PavError where it is in use."""
    folder = packages.own_folder()
    if folder.exists():
        _put_aside(folder)
    packages.activate()


def _pip(arguments: list[str], variables: dict[str, str], work: Path, megabytes: float) -> Process:
    """pip tells little while it loads: how far it is is read off the folder it fills."""
    before = _size(work)
    looked = [0.0]

    def measure() -> float:
        now = time.monotonic()
        if now - looked[0] < _LOOK_EVERY_S:
            return 0.0
        looked[0] = now
        return min(0.99, (_size(work) - before) / (megabytes * 1e6))

    places = {name: str(work / "tmp") for name in ("TMPDIR", "TMP", "TEMP")}
    return Process(
        arguments,
        merged=True,
        understand=_understand,
        measure=measure,
        python=sys.executable,
        variables=variables | places,
        message="Asking the index",
    )


def _size(folder: Path) -> int:
    total = 0
    for root, _folders, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(root, name)).st_size
            except OSError:  # gone meanwhile
                continue
    return total


def _understand(line: str) -> Fields | None:
    """What a line of pip's tells a user; None for others, of which the last is kept."""
    said = re.match(r"\s*(Collecting|Downloading|Processing|Using cached) (\S+)", line)
    if said:
        name = re.split(r"[/\\]", said[2])[-1]
        wheel = re.match(r"([A-Za-z0-9_.]+?)-(\d[^-]*)-.*\.whl", name)
        return {"message": f"{said[1]} {f'{wheel[1]} {wheel[2]}' if wheel else said[2]}"}
    if line.startswith("Installing collected packages"):
        return {"message": "Unpacking"}
    return None


def _take_place(work: Path, final: Path) -> None:
    """The new folder takes the old one's place."""
    try:
        if final.exists():
            _put_aside(final)
        os.replace(work / NEW, final)
    except OSError as error:
        raise PavError(f"{final}: cannot be written ({error.strerror})") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    packages.activate()


def _put_aside(folder: Path) -> None:
    """Removes a folder; where a part is in use (Windows) it stays aside until the next time."""
    for left in folder.parent.glob(f".{folder.name}.old-*"):
        shutil.rmtree(left, ignore_errors=True)
    aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.old-", dir=folder.parent))
    try:
        os.replace(folder, aside / folder.name)
    except OSError as error:
        aside.rmdir()
        raise PavError(
            f"{folder}: in use ({error.strerror}); restart Blender and try again first thing"
        ) from error
    shutil.rmtree(aside, ignore_errors=True)
