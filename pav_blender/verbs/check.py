"""`pav check`."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..core.progress import Progress

SUMMARY = "Validate a collection, say what it holds, and show how well it was tracked."
EXAMPLE = "pav check out/me --out out/me.png --plot out/me.svg --video out/me.mp4"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("collection", type=Path, help="folder of the collection")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE.png",
        help="sheet to write: pictures with mesh (green), landmarks (yellow), matte edge (pink)",
    )
    parser.add_argument(
        "--video", type=Path, metavar="FILE.mp4", help="the same of every frame, as a video"
    )
    parser.add_argument(
        "--plot", type=Path, metavar="FILE.svg", help="every frame's landmark error (svg, png)"
    )


def run(args: argparse.Namespace) -> int:
    from ..core.collection import read_collection
    from ..core.errors import InputError
    from ..core.evaluation import review
    from ..core.evaluation.check import check

    collection = read_collection(args.collection)
    findings = check(collection, progress=Progress("check", as_json=args.json_progress))
    print(f"{args.collection}: head {collection.head_name}, {len(collection.betas)} coefficients")
    for row in findings.summary:
        print("  " + "  ".join(f"{key} {value}" for key, value in row.items()))
    found = [review.landmark_errors(collection, clip) for clip in collection.clips]
    errors = [one for one in found if one is not None]
    for one in errors:
        print(
            f"  {one.clip.name}: landmarks within {one.median:.2f} % of the eye distance (median); "
            f"worst in frame {one.worst}, {one.percent.max():.2f} %"
        )
    for name, reason, frames in review.left_out(collection):
        print(f"  {name}: left out, {reason}: {frames}")
    # what is wrong with pictures is told first: nothing can be drawn without them
    if findings.problems:
        first, *others = findings.problems
        for problem in others:
            print(f"  also: {problem}")
        raise InputError(first)
    if args.plot and not errors:
        raise InputError(f"{args.collection}: no landmarks were kept in it, so nothing to --plot")
    if args.out:
        review.write_overlays(collection, args.out)
        print(f"overlay: {args.out}")
    if args.plot:
        review.plot_errors(errors, args.plot)
        print(f"plot: {args.plot}")
    if args.video:
        tell = Progress("video", as_json=args.json_progress)
        review.write_video(collection, args.video, progress=tell)
        print(f"video: {args.video}")
    print("no problems found")
    return 0
