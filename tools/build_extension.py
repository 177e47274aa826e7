"""Builds the Blender extension and validates it: `python tools/build_extension.py`.

Uses Blender's own packer: from the bpy wheel if this Python has one, else from a Blender binary
(`--blender COMMAND`, or $BLENDER). The archive lands in out/ under its final name only when it is
valid.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

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
        for arguments in (
            ["build", "--source-dir", _here(source), "--output-filepath", _here(temporary)],
            ["validate", _here(temporary)],
        ):
            done = subprocess.run([*command, *arguments], capture_output=True, text=True)
            if done.returncode != 0:
                raise SystemExit(f"{arguments[0]} failed:\n{done.stdout}{done.stderr}".rstrip())
        os.replace(temporary, archive)
    finally:
        temporary.unlink(missing_ok=True)
    return archive


def _here(path: Path) -> str:
    """Relative to the working folder: a wrapper may run Blender where that has another path."""
    return os.path.relpath(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "out")
    parser.add_argument("--blender", help="command of a Blender to build with")
    args = parser.parse_args()
    archive = build(args.out, args.blender)
    print(f"{archive} ({archive.stat().st_size / 1e6:.1f} MB)")


if __name__ == "__main__":
    main()
