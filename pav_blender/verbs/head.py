"""`pav head`."""

from __future__ import annotations

import argparse
from pathlib import Path

SUMMARY = "Make a head file out of a Blender mesh with shape keys, and its armature."
EXAMPLE = "pav head character.blend --object Face --joint jaw=DEF-jaw --out out/face.npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "blend", type=Path, nargs="?", help="the .blend (default: the one that Blender has open)"
    )
    parser.add_argument(
        "--object", metavar="NAME", help="the mesh (default: the only one with shape keys)"
    )
    parser.add_argument("--out", type=Path, required=True, help="head file to write (.npz)")
    parser.add_argument(
        "--joint",
        action="append",
        default=[],
        metavar="NAME=BONE",
        help="call a bone root, neck, jaw, left_eye or right_eye; may be repeated",
    )
    parser.add_argument(
        "--region",
        action="append",
        default=[],
        metavar="NAME=GROUP",
        help="a vertex group as a region, besides those called region.NAME; may be repeated",
    )


def run(args: argparse.Namespace) -> int:
    from ..bridge.heads import head_from_object, open_object
    from ..core.errors import InputError
    from ..core.head import write_head

    if args.out.suffix != ".npz":
        raise InputError(f"--out {args.out}: a head file ends in .npz")
    joints, regions = _pairs("--joint", args.joint), _pairs("--region", args.region)
    found = open_object(args.blend, args.object)
    head = head_from_object(found, joints=joints, regions=regions)
    write_head(args.out, head)
    print(f"{args.out}: {head.name}, {head.vertex_count} vertices, {len(head.triangles)} triangles")
    print(f"  expressions: {', '.join(head.expression_names) or 'none'}")
    print(f"  joints: {', '.join(head.joint_names)}")
    print(f"  regions: {', '.join(head.regions) or 'none'}")
    print(f"  fingerprint: {head.fingerprint}")
    for name, use in _USES.items():
        if name not in head.joint_names and name not in head.regions:
            print(f"  no {name}: {use}")
    return 0


_USES = {
    "jaw": "the canonical mouth stays closed",
    "face": "training takes no depth from the mesh, and beards may reach as far as hair",
}


def _pairs(option: str, texts: list[str]) -> dict[str, str]:
    from ..core.errors import InputError

    pairs = {}
    for text in texts:
        ours, separator, theirs = text.partition("=")
        if not (ours and separator and theirs):
            raise InputError(f"{option} {text!r}: write OURS=THEIRS")
        pairs[ours] = theirs
    return pairs
