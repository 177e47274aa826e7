"""`pav bake`."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..core.progress import Progress

SUMMARY = "Bake a textured mesh of an avatar at rest, and say how far it is from the field."
EXAMPLE = "pav bake out/avatar.pav --appearance crop --out out/crop.glb"

# the mesh against the field, mean of the views; a hard outline before white costs hair the most
_SCORES = {
    "head_psnr": ("head PSNR, outline and all", 16.0),
    "inside_psnr": ("PSNR where both show the head", 24.0),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("avatar", type=Path, help="avatar file (.pav)")
    parser.add_argument("--out", type=Path, required=True, help="binary glTF to write (.glb)")
    parser.add_argument("--appearance", help="a name (default: the avatar's first)")
    parser.add_argument("--texture", type=int, default=2048, help="pixels a side (default 2048)")
    parser.add_argument("--triangles", type=int, default=50_000, help="about so many (50000)")
    parser.add_argument("--check", action="store_true", help="exit 1 where the claim is not met")


def run(args: argparse.Namespace) -> int:
    from ..core.baking import bake, compare, write_glb
    from ..core.baking.bake import neutral_scene
    from ..core.errors import InputError
    from ..core.evaluation.metrics import over
    from ..core.evaluation.report import Claim, write_proof
    from ..core.evaluation.sheet import error_map, grid
    from ..core.field.avatar import Avatar
    from ..core.images import write_rgba

    if args.out.suffix != ".glb":
        raise InputError(f"--out {args.out}: a baked mesh ends in .glb")
    if not args.out.resolve().parent.is_dir():
        raise InputError(f"--out {args.out}: no such folder")
    avatar = Avatar.load(args.avatar)
    appearance = args.appearance or avatar.appearances[0]
    avatar.appearance_index(appearance)
    progress = Progress("bake", as_json=args.json_progress)
    try:
        scene = neutral_scene(avatar, appearance)
    except InputError as error:
        raise InputError(f"{args.avatar}: {error}") from error
    baked = bake(scene, texture=args.texture, triangles=args.triangles, progress=progress)
    found = compare(scene, baked, progress=Progress("compare", as_json=args.json_progress))
    write_glb(args.out, baked, appearance)
    rows = [[over(v.field, 1), over(v.mesh, 1)] for v in found]
    columns = [[*pair, error_map(pair[1], pair[0])] for pair in rows]
    write_rgba(
        args.out.with_suffix(".png"), grid([list(row) for row in zip(*columns, strict=True)])
    )
    fields = {
        "avatar": str(args.avatar),
        "appearance": appearance,
        "vertices": len(baked.vertices),
        "triangles": len(baked.triangles),
        "texture": args.texture,
        "megabytes": round(args.out.stat().st_size / 1e6, 2),
        "views": [
            {name: round(getattr(view, name), 2) for name in ("yaw", "pitch", *_SCORES)}
            for view in found
        ],
    }
    for view in fields["views"]:
        print("  ".join(f"{key} {value}" for key, value in view.items()))
    claims = [
        Claim.at_least(text, sum(getattr(v, name) for v in found) / len(found), target, "dB")
        for name, (text, target) in _SCORES.items()
    ]
    met = write_proof(args.out.with_suffix(".json"), fields, claims)
    print(f"{args.out}: {len(baked.triangles)} triangles; see {args.out.with_suffix('.png')}")
    return 0 if met or not args.check else 1
