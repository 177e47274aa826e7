"""Builds the Blender extension and validates it: `python tools/build_extension.py [--wheels]`.

Without --wheels: one archive for every platform, which bundles no packages. With it: one more for
each platform, which bundle numba and what else rendering needs but PyTorch.

Uses Blender's own packer: from the bpy wheel if this Python has one, else from a Blender binary
(`--blender COMMAND`, or $BLENDER). The archive lands in out/ under its final name only when it is
valid. Exit code 1 where one could not be built.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import wheels

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "pav_blender"


def packer(blender: str | None) -> list[str]:
    """The command that runs Blender's extension tool."""
    spec = importlib.util.find_spec("bpy")
    if blender is None and spec is None:
        blender = os.environ.get("BLENDER")
    if blender:
        return [*shlex.split(blender), "--command", "extension"]
    if spec is None or spec.origin is None:
        raise SystemExit("no bpy in this Python: pip install bpy, or pass --blender COMMAND")
    found = sorted(Path(spec.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))
    if not found:
        raise SystemExit(f"{Path(spec.origin).parent}: no blender_ext.py in this bpy")
    return [sys.executable, str(found[-1])]


def build(out: Path, blender: str | None = None, source: Path = SOURCE) -> Path:
    """Packs `source` into `out` (a folder) and returns the archive. SystemExit where it fails."""
    manifest = tomllib.loads((source / "blender_manifest.toml").read_text(encoding="utf-8"))
    out.mkdir(parents=True, exist_ok=True)
    archive = out / f"{manifest['id']}-{manifest['version']}.zip"
    temporary = archive.with_name(f".{archive.stem}.partial-{os.getpid()}.zip")
    command = packer(blender)
    try:
        _run(command, "build", "--source-dir", _here(source), "--output-filepath", _here(temporary))
        _run(command, "validate", _here(temporary))
        os.replace(temporary, archive)
    finally:
        temporary.unlink(missing_ok=True)
    return archive


def build_with_wheels(
    out: Path, blender: str | None = None, source: Path = SOURCE, pins: Path = wheels.PINS
) -> list[Path]:
    """Packs `source` with its wheels, an archive a platform. SystemExit where that fails."""
    found = wheels.fetch(out / "wheels", pins)
    command = packer(blender)
    built = []
    with tempfile.TemporaryDirectory(prefix=".bundle.partial-", dir=out) as folder:
        staged, packed = Path(folder) / "source", Path(folder) / "packed"
        packed.mkdir()
        shutil.copytree(source, staged, ignore=shutil.ignore_patterns("__pycache__", ".*"))
        (staged / "wheels").mkdir()
        names = {path.name: path for paths in found.values() for path in paths}
        for name, path in names.items():
            os.link(path, staged / "wheels" / name)
        target = staged / "blender_manifest.toml"
        text = target.read_text(encoding="utf-8")
        target.write_text(wheels.manifest(text, list(found), list(names)), encoding="utf-8")
        arguments = ("--source-dir", _here(staged), "--output-dir", _here(packed))
        _run(command, "build", *arguments, "--split-platforms")
        for archive in sorted(packed.glob("*.zip")):
            _run(command, "validate", _here(archive))
            built.append(out / archive.name)
            os.replace(archive, built[-1])
    if len(built) != len(found):
        raise SystemExit(f"{len(built)} archives for {len(found)} platforms")
    return built


def _run(command: list[str], verb: str, *arguments: str) -> None:
    done = subprocess.run([*command, verb, *arguments], capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"{verb} failed:\n{done.stdout}{done.stderr}".rstrip())


def _here(path: Path) -> str:
    """Relative to the working folder: a wrapper may run Blender where that has another path."""
    return os.path.relpath(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "out")
    parser.add_argument("--blender", help="command of a Blender to build with")
    parser.add_argument("--wheels", action="store_true", help="the archives with wheels too")
    args = parser.parse_args()
    _tell(build(args.out, args.blender))
    if args.wheels:
        for archive in build_with_wheels(args.out, args.blender):
            _tell(archive)


def _tell(archive: Path) -> None:
    print(f"{archive} ({archive.stat().st_size / 1e6:.1f} MB)", flush=True)


if __name__ == "__main__":
    main()
