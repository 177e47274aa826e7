"""`pav track VIDEO... --out COLLECTION`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ..progress import Progress
from .track import ShouldStop, track

HELP = "videos of one person -> a collection: landmarks, head fit, crop, matte"
EXAMPLE = "pav track morning.mp4 evening.mp4 --out me --appearance plain --appearance glasses"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the verb's arguments to its parser."""
    parser.add_argument("videos", nargs="+", type=Path, metavar="VIDEO", help="clips of one person")
    parser.add_argument("--out", required=True, type=Path, help="the collection folder to write")
    parser.add_argument("--size", type=int, default=256, help="side of the pictures (256)")
    parser.add_argument("--every", type=int, default=1, help="use every N-th frame (1)")
    parser.add_argument(
        "--max-frames", type=int, default=1000, help="frames a video at most (1000)"
    )
    parser.add_argument(
        "--appearance",
        action="append",
        metavar="NAME",
        help="what the person looks like in a video, once a video in their order; videos may share "
        "one (default: the file names)",
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
    parser.add_argument("--overwrite", action="store_true", help="replace an older collection")


def run(args: argparse.Namespace, should_stop: ShouldStop | None = None) -> int:
    """Runs the verb and prints one line a clip. Raises what `track` raises; returns 0."""
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
        overwrite=args.overwrite,
        progress=Progress("track", as_json=getattr(args, "json_progress", False)),
        should_stop=should_stop,
    )
    for line in report.warnings:
        print(f"warning: {line}", file=sys.stderr)
    for clip in report.clips:
        print(
            f"{clip['name']}: {clip['frames']} frames, landmarks within "
            f"{clip['error_percent']:.2f} % of the eye distance"
            + (f"; left out {_ranges(clip['left_out'])}" if clip["left_out"] else "")
        )
    print(f"wrote {report.path}")
    return 0


def _ranges(numbers: list[int]) -> str:
    """[1, 2, 3, 7] -> '1-3, 7'."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in parts)
