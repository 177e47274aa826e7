"""`pav train`."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from ..core.progress import Progress
from ..core.stopping import StopSignal

SUMMARY = "Train an avatar on the training frames of a collection."
EXAMPLE = "pav train out/collection --out out/avatar.pav --minutes 5"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("collection", type=Path, nargs="?", help="folder of the collection")
    parser.add_argument(
        "--identities",
        nargs="+",
        metavar="NAME=FOLDER",
        help="instead: two people or more, a collection each, for one avatar of them all (NAME: "
        "the folder's own if left out); their appearances are called NAME/LOOK",
    )
    parser.add_argument("--out", type=Path, required=True, help="avatar file to write (.pav)")
    parser.add_argument("--minutes", type=float, help="plan for this long")
    parser.add_argument("--iterations", type=int, help="or for so many iterations (15000)")
    parser.add_argument("--preset", default="default", help="default, or paper: its own settings")
    parser.add_argument("--device", default="cpu", help="of the networks: cpu, cuda or mps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--refine-poses",
        action="store_true",
        help="correct pose and expressions of each frame a little while learning; of a clip only "
        "where that helps frames kept out",
    )
    parser.add_argument(
        "--refined-collection",
        type=Path,
        metavar="DIR",
        help="write the collection with its track corrected (needs --refine-poses)",
    )
    parser.add_argument(
        "--preview",
        type=Path,
        metavar="DIR",
        help="show how it is going: preview.png (filmed above, avatar below) and curve.json there",
    )
    parser.add_argument(
        "--checkpoint-every",
        type=float,
        default=30.0,
        metavar="SECONDS",
        help="what an interrupted training loses at most (30)",
    )
    parser.add_argument("--resume", action="store_true", help="go on from the last checkpoint")


def run(args: argparse.Namespace) -> int:
    from ..core.config import Config
    from ..core.devices import device_of
    from ..core.errors import InputError
    from ..core.training.people import parse_people, read_people
    from ..core.training.train import train

    if (args.collection is None) == (args.identities is None):
        raise InputError(
            "a collection is needed, or --identities with a collection of each of several people"
        )
    changes = {"seed": args.seed, "refine_poses": args.refine_poses}
    if args.iterations is not None:
        changes["iterations"] = args.iterations
    config = dataclasses.replace(Config.preset(args.preset), **changes)
    avatar = train(
        read_people(parse_people(args.identities)) if args.identities else args.collection,
        args.out,
        config,
        minutes=args.minutes,
        resume=args.resume,
        refined=args.refined_collection,
        preview=args.preview,
        checkpoint_every=args.checkpoint_every,
        device=device_of(args.device),
        progress=Progress("train", as_json=args.json_progress),
        loading=Progress("read", as_json=args.json_progress),
        refining=Progress("refine", as_json=args.json_progress),
        should_stop=StopSignal(),
    )
    record = avatar.record
    for name, clip in record.get("refinement", {}).items():
        print(f"{name}: {_refinement(clip)}")
    if args.refined_collection is not None:
        print(f"{args.refined_collection}: the collection with its track corrected")
    print(
        f"{args.out}: {len(avatar.appearances)} appearances ({', '.join(avatar.appearances)}), "
        f"{record['iterations']} iterations in {record['seconds']:.0f} s, "
        f"{record['batch_psnr']:.1f} dB on training rays"
    )
    if "preview_seconds" in record:
        share = record["preview_seconds"] / max(record["seconds"], 1e-9)
        print(f"  pictures of how it was going: {record['preview_seconds']:.1f} s, {share:.1%}")
    return 0


def _refinement(clip: dict[str, Any]) -> str:
    """What came of correcting a clip's track, as one line."""
    if clip["psnr_tracked"] is None:
        return "track not corrected: too few frames, or too short a training, to tell"
    gains = f"{clip['psnr_tracked']:.2f} dB as tracked, {clip['psnr_pose']:.2f} with pose corrected"
    if clip["psnr_expression"] is not None:
        gains += f", {clip['psnr_expression']:.2f} with expressions too"
    if clip["kept"] == "off":
        return f"track not corrected, since that did not help frames kept out: {gains}"
    size = ""
    if clip["frames"]:
        size = (
            f"; {clip['frames']} frames by {clip['degrees']:.2f} degrees and "
            f"{clip['millimetres']:.2f} mm in the mean"
        )
    return f"{clip['kept']} corrected{size}; frames kept out: {gains}"
