"""Studio pictures in everybody's formats: imported, trained, rendered.

python tools/show_formats.py --out out/formats
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

from pav_blender.core.collection import Collection, read_collection
from pav_blender.core.evaluation.report import Claim, figures, measure, sheet_rows, write_proof
from pav_blender.core.evaluation.sheet import grid
from pav_blender.core.field.avatar import Avatar
from pav_blender.core.images import read_rgba, write_rgba
from pav_blender.core.training.frames import camera_of
from tools.formats import crowd, wrap

HEAD_PSNR = 16.0  # another subject's pictures come to 14.1 dB at most
SECONDS, FRAMES, SIZE = 60.0, 1500, 512
NEAR = 1.0  # pixels of 256, mean: how far vertices may lie from where the studio's camera saw them
DATA = Path(__file__).resolve().parents[1] / "data" / "studio3"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="new folder of the results")
    parser.add_argument("--minutes", type=float, default=1.0, help="training time, of each FLAME")
    parser.add_argument("--only", choices=("import",), help="only time the import of many frames")
    args = parser.parse_args()
    out: Path = args.out.resolve()
    out.mkdir(parents=True)
    os.environ["PAV_CONFIG"] = str(out / "config")  # these models are nobody's
    studio = read_collection(DATA)
    wrap.write_models(out / "models")
    for name in ("insta",) if args.only else wrap.SOURCES:
        wrap.write_source(name, studio, out / "sources" / name)
    fields: dict[str, Any] = {}
    claims: list[Claim] = []
    if not args.only:
        rows: list[list[np.ndarray]] = []
        for version in wrap.MODELS:
            part, told, shown = _person(version, studio, out, args.minutes)
            fields[f"FLAME {version}"], claims, rows = part, claims + told, rows + shown
        write_rgba(out / "sheet.png", grid(rows))
    claims.append(_many(out, fields))
    met = write_proof(out / "formats.json", fields, claims)
    if not args.only:
        print(f"see {out / 'sheet.png'}: a row a format, of a held-out frame the studio's picture, "
              "ours, their difference, and what pav render wrote of another")  # fmt: skip
    return 0 if met else 1


def _person(
    version: str, studio: Collection, out: Path, minutes: float
) -> tuple[dict, list[Claim], list[list[np.ndarray]]]:
    """The sources of a FLAME as the appearances of one person: figures, claims, pictures."""
    names = [name for name, (_, used) in wrap.SOURCES.items() if used == version]
    path, avatar_path = out / f"collection{version}", out / f"avatar{version}.pav"
    sources = [f"{name}={out / 'sources' / name}" for name in names]
    held = ("--hold-out", wrap.HELD)
    _pav("import", *sources, "--head", out / "models" / version, "--out", path, *held)
    _pav("check", path, "--out", out / f"check{version}.png")
    _pav("train", path, "--out", avatar_path, "--minutes", minutes)
    avatar, collection = Avatar.load(avatar_path), read_collection(path)
    measured = measure(avatar, collection, 2)
    numbers, others, claims = figures(measured), {}, []
    for name in names:
        clip = next(c for c in collection.clips if c.appearance == name and "test" in c.split)
        number = int(clip.frame_id[clip.indices("test")[-1]])
        picture = out / "renders" / f"{name}.png"
        _pav(
            "render", avatar_path, "--track", f"{path}:{clip.name}", "--appearance", name,
            "--frames", number, "--out", picture,
        )  # fmt: skip
        others[name] = [read_rgba(picture).astype(np.float32) / 255]
        value = numbers["psnr"]["head"][name]
        claims.append(Claim.at_least(f"{name}: head PSNR, held-out", value, HEAD_PSNR, "dB"))
        away = _away(name, studio, collection)
        claims.append(Claim.at_most(f"{name}: vertices off the studio's", away, NEAR, "px"))
    return numbers, claims, sheet_rows(measured, others)


def _away(name: str, studio: Collection, collection: Collection) -> float:
    """Mean pixels between an import's vertices and the studio's own, in the studio's pictures."""
    own = studio.clip(wrap.SOURCES[name][0])
    rows = np.concatenate([own.indices("train"), own.indices("test")])
    kept, distances, at = wrap.flame().kept, [], 0
    for clip in (c for c in collection.clips if c.appearance == name):
        for row in range(len(clip)):
            truth = camera_of(own, rows[at]).project(studio.posed(own, rows[at : at + 1])[0][kept])
            posed = collection.posed(clip, np.array([row]))[0]
            distances.append(np.abs(camera_of(clip, row).project(posed)[0] - truth[0]).mean())
            at += 1
    return float(np.mean(distances))


def _many(out: Path, fields: dict) -> Claim:
    """The time that `pav import` takes for a long clip."""
    long = out / "sources" / "long"
    crowd.lengthen(out / "sources" / "insta", long, FRAMES, SIZE)
    head = ("--head", out / "models" / "2020")
    _pav("import", *head)  # known already, as it is to a user by then
    start, before = time.monotonic(), os.times()
    _pav("import", long, *head, "--out", out / "long")
    seconds, after = time.monotonic() - start, os.times()
    worked = sum(after[2:4]) - sum(before[2:4])  # of its processes, on whatever cores
    fields["import"] = {
        "frames": FRAMES,
        "size": SIZE,
        "seconds": round(seconds, 1),
        "processor_seconds": round(worked, 1),
    }
    print(f"import: {seconds:.1f} s, {worked:.1f} s of processor time")
    shutil.rmtree(out / "long")
    return Claim.at_most(f"import of {FRAMES} frames of {SIZE} px", seconds, SECONDS, "s")


def _pav(*words: object) -> None:
    command = [sys.executable, "-m", "pav_blender", *map(str, words)]
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL)


if __name__ == "__main__":
    sys.exit(main())
