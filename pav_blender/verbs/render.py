"""`pav render`."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..core.progress import Progress

SUMMARY = "Render an avatar, wearing one of its appearances, along the motion of a clip."
EXAMPLE = (
    "pav render out/avatar.pav --track out/collection:grey --appearance crop --out out/####.png"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("avatar", type=Path, help="avatar file (.pav), or a scene (.blend)")
    parser.add_argument(
        "--track", metavar="COLLECTION:CLIP", help="the motion; a .blend has its own"
    )
    parser.add_argument(
        "--appearance",
        help="a name, a blend such as old=0.3,young=0.7, or all; a .blend's own if left out",
    )
    parser.add_argument(
        "--out", required=True, help="pictures: #### is the frame number, {appearance} the name"
    )
    parser.add_argument("--size", type=int, help="longer side in pixels (default: the clip's)")
    parser.add_argument("--frames", metavar="A-B", help="frame numbers, e.g. 10-20 or 5")
    parser.add_argument("--depth", action="store_true", help="write EXR with depth (.exr)")
    parser.add_argument(
        "--format", help="png8, png16 or exr (default: as --out ends, a .png of 8 bits)"
    )
    parser.add_argument("--quality", default="final", help="preview, final or reference")
    parser.add_argument(
        "--relative", action="store_true", help="move from the track's neutral, not as it is"
    )
    parser.add_argument(
        "--other-identity", action="store_true", help="yes, the track is another person's"
    )
    parser.add_argument("--device", default="cpu", help="of the networks: cpu, cuda or mps")


def run(args: argparse.Namespace) -> int:
    progress = Progress("render", as_json=args.json_progress)
    if args.avatar.suffix == ".blend":
        return _render_blend(args, progress)
    from ..core.errors import InputError
    from ..core.rendering.sequence import render_track

    if not args.track:
        raise InputError("--track is missing: COLLECTION:CLIP, the motion to render")
    if args.appearance is None:
        raise InputError("--appearance is missing: the name of one that the avatar has, or all")
    written = render_track(
        args.avatar,
        args.track,
        args.appearance,
        args.out,
        size=args.size,
        frames=args.frames,
        depth=args.depth,
        quality=args.quality,
        format=args.format,
        device=args.device,
        relative=args.relative,
        other_identity=args.other_identity,
        progress=progress,
    )
    print(f"{len(written)} pictures, the last {written[-1]}")
    return 0


def _render_blend(args: argparse.Namespace, progress: Progress) -> int:
    from ..bridge.animation import render_blend
    from ..core.errors import InputError
    from ..core.rendering.sequence import check_pattern

    taken = [name for name in ("track", "size", "frames", "depth", "format") if getattr(args, name)]
    taken += [n for n in ("relative", "other-identity") if getattr(args, n.replace("-", "_"))]
    taken += ["device"] * (args.device != "cpu")
    if taken:
        raise InputError(f"--{taken[0]} does not go with a .blend: it is set in the scene")
    check_pattern(args.out, several=True, appearances=2 if args.appearance == "all" else 1)
    written = render_blend(args.avatar, args.appearance, args.out, progress=progress)
    print(f"{len(written)} pictures, the last {written[-1]}")
    return 0
