"""The wheels that the extension bundles: pinned in requirements/wheels.txt, fetched once by pip."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PINS = ROOT / "requirements" / "wheels.txt"
PYTHONS = ("3.11", "3.13")
# Blender's name of a platform -> pip's names of what runs there
PLATFORMS = {
    "linux-x64": tuple(f"manylinux{v}_x86_64" for v in ("_2_28", "_2_27", "_2_17", "2014")),
    "windows-x64": ("win_amd64",),
    "macos-arm64": ("macosx_12_0_arm64",),
}


def fetch(folder: Path, pins: Path = PINS) -> dict[str, list[Path]]:
    """The wheels of each platform, from `folder` where they are there already, each with its hash
    checked. SystemExit, one line, where pip does not get one."""
    found = {}
    edition = hashlib.sha256(pins.read_bytes()).hexdigest()[:12]  # of other pins nothing is taken
    for platform, names in PLATFORMS.items():
        here = folder / edition / platform
        here.mkdir(parents=True, exist_ok=True)
        for python in PYTHONS:
            _download(here, names, python, pins)
        found[platform] = sorted(here.glob("*.whl"))
    return found


def _download(folder: Path, names: tuple[str, ...], python: str, pins: Path) -> None:
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
    command += ["--only-binary=:all:", "--no-deps", "--require-hashes", "--python-version", python]
    for name in names:
        command += ["--platform", name]
    # what was fetched before is found in the folder, and its hash is checked again
    command += ["--find-links", str(folder), "--dest", str(folder), "--requirement", str(pins)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        wrong = [line for line in done.stderr.splitlines() if line.startswith("ERROR: ")]
        said = wrong[-1][7:] if wrong else done.stderr.strip()[-300:]
        raise SystemExit(
            f"the wheels for {folder.name}, Python {python}, could not be fetched: {said}\n"
            "the zip without wheels is built; where a package index can be reached, run this again"
        )


def manifest(text: str, platforms: list[str], wheels: list[str]) -> str:
    """A manifest's text with what it bundles, before its first table."""
    listed = ",\n".join(f'  "./wheels/{name}"' for name in sorted(wheels))
    names = ", ".join(f'"{name}"' for name in platforms)
    addition = f"platforms = [{names}]\nwheels = [\n{listed},\n]\n\n"
    head, bracket, tail = text.partition("\n[")
    return f"{head.rstrip()}\n{addition}{bracket.lstrip()}{tail}" if bracket else text + addition
