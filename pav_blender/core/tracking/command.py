"""`pav track VIDEO... --out COLLECTION`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ..errors import Cancelled
from ..progress import Progress
from .sift import ranges
from .track import track
from .write import ShouldStop

HELP = "videos or picture folders of one person -> a collection: landmarks, head fit, crop, matte"
EXAMPLE = "pav track 2019.mp4 2023a.mp4 2023b/ --out me --appearance beard=2023a,2023b"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the verb's arguments to its parser."""
    parser.add_argument(
        "videos",
        nargs="+",
        type=Path,
        metavar="VIDEO",
        help="clips of one person: video files, or folders of pictures in natural order",
    )
    parser.add_argument("--out", required=True, type=Path, help="the collection folder to write")
    parser.add_argument("--size", type=int, default=256, help="side of the pictures (256)")
    parser.add_argument("--every", type=int, default=1, help="look at every N-th frame (1)")
    parser.add_argument(
        "--max-frames",
        type=int,
        default=500,
        help="frames a clip at most, as different in turn and expression as can be (500)",
    )
    parser.add_argument(
        "--appearance",
        action="append",
        metavar="NAME=CLIP,CLIP",
        help="what the person looks like in these clips (named as their files are); or just a "
        "name, once a video in their order (default: an appearance a video)",
    )
    parser.add_argument("--head", default="builtin", help="builtin, or a head file")
    parser.add_argument(
        "--landmark-model",
        type=Path,
        metavar="FILE.task",
        help="MediaPipe's face landmarker: adds expression scores; needed with mediapipe 1.x",
    )
    parser.add_argument(
        "--matte",
        choices=("segment", "none"),
        default="segment",
        help="cut the person out, or keep the pictures opaque",
    )
    parser.add_argument(
        "--cuts",
        choices=("split", "keep"),
        default="split",
        help="split a video where it was cut, each shot becoming a clip, or take it as one",
    )
    parser.add_argument(
        "--fit",
        choices=("photo", "landmarks"),
        default="photo",
        help="follow the skin between the landmarks too, or the landmarks alone (sooner)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an older collection")


def run(args: argparse.Namespace, should_stop: ShouldStop | None = None) -> int:
    """Runs the verb and prints one line a clip. Raises what `track` raises; returns 0."""
    try:
        report = track(
            args.videos,
            args.out,
            size=args.size,
            max_frames=args.max_frames,
            every=args.every,
            appearances=args.appearance,
            head=args.head,
            model=args.landmark_model,
            cut_background=args.matte == "segment",
            cuts=args.cuts == "split",
            photo=args.fit == "photo",
            overwrite=args.overwrite,
            progress=Progress("track", as_json=getattr(args, "json_progress", False)),
            should_stop=should_stop,
        )
    except KeyboardInterrupt as stop:
        raise Cancelled("tracking stopped; the same command goes on from here") from stop
    for line in report.warnings:
        print(f"warning: {line}", file=sys.stderr)
    for clip in report.clips:
        print(
            f"{clip['name']}: {clip['frames']} frames, landmarks within "
            f"{clip['error_percent']:.2f} % of the eye distance"
            + (f"; {clip['not_chosen']} more of use" if clip["not_chosen"] else "")
        )
        for reason, numbers in clip["left_out"].items():
            print(f"  left out, {reason}: {ranges(numbers, args.every)}")
    for shot in report.skipped:
        print(f"{shot['video']}: frames {shot['first']}-{shot['last']} left out, {shot['reason']}")
    print(f"wrote {report.path}")
    return 0
