"""A head that is not MakeHuman's, all the way: .blend, head file, collection, avatar, pictures.

python tools/show_other_head.py --out out/other_head
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import bpy

from pav_blender.core.collection import read_collection
from pav_blender.core.evaluation.report import Claim, figures, measure, sheet_rows, write_proof
from pav_blender.core.evaluation.sheet import grid
from pav_blender.core.field.avatar import Avatar
from pav_blender.core.images import write_rgba
from tools.other_head import blend, shape
from tools.other_head.film import film

HEAD_PSNR = 24.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="new folder of the results")
    parser.add_argument("--minutes", type=float, default=1.5, help="training time")
    args = parser.parse_args()
    out: Path = args.out.resolve()
    out.mkdir(parents=True)
    bpy.ops.wm.read_homefile(use_factory_startup=True, use_empty=True)
    directions = blend.directions(blend.build())
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "formula.blend"))
    renames = [word for pair in shape.JOINTS.items() for word in ("--joint", "=".join(pair))]
    _pav("head", out / "formula.blend", *renames, "--out", out / "head.npz")
    film(out / "collection", out / "head.npz", directions)
    _pav("check", out / "collection")
    _pav("train", out / "collection", "--out", out / "avatar.pav", "--minutes", args.minutes)
    avatar, collection = Avatar.load(out / "avatar.pav"), read_collection(out / "collection")
    measured = measure(avatar, collection, 4)
    write_rgba(out / "sheet.png", grid(sheet_rows(measured, {})))
    numbers = figures(measured)
    claim = Claim.at_least("head PSNR, held-out", numbers["psnr"]["head_mean"], HEAD_PSNR, "dB")
    met = write_proof(out / "other_head.json", numbers, [claim])
    print(f"see {out / 'sheet.png'}")
    return 0 if met else 1


def _pav(*words: object) -> None:
    command = [sys.executable, "-m", "pav_blender", *map(str, words)]
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL)


if __name__ == "__main__":
    sys.exit(main())
