"""`pav frames`."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..core.frame_files import FrameFiles

SUMMARY = "Find empty, torn and missing frames in folders of pictures, and clear them for a resume."
EXAMPLE = "pav frames out/frames --range 1-250 --repair"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR", help="folder of frames")
    parser.add_argument(
        "--range", metavar="A-B", help="numbers that should be there (default: lowest to highest)"
    )
    parser.add_argument(
        "--repair",
        action="store_true",
        help="remove what is damaged, while nothing is rendering there",
    )


def run(args: argparse.Namespace) -> int:
    from ..core.frame_files import clear, look

    span = _span(args.range)
    seen = [look(folder, span) for folder in args.folders]
    for found in seen:
        _say(found, args.repair)
        if args.repair:
            clear(found)
    if args.repair:
        return 0
    # without a range nobody said that there are no gaps: a render may step over frames
    wrong = any(found.damaged or (span and found.missing) for found in seen)
    return 1 if wrong else 0


def _say(found: FrameFiles, repair: bool) -> None:
    from ..core.frame_files import ranges

    done = "removed" if repair else "damaged"
    for path, problem in found.damaged.items():
        print(f"{done}: {path} ({problem})")
    for path in found.left:
        print(f"{'removed' if repair else 'left behind'}: {path} (a killed process's)")
    whole, damaged = len(found.whole), len(found.damaged)
    print(f"{found.folder}: {whole} whole, {damaged} {done}, {len(found.missing)} missing")
    if found.missing:
        print(f"missing: {ranges(found.missing)}")


def _span(text: str | None) -> tuple[int, int] | None:
    from ..core.errors import InputError

    if text is None:
        return None
    match = re.fullmatch(r"(\d+)-(\d+)", text)
    if match is None or int(match[1]) > int(match[2]):
        raise InputError(f"--range {text}: write A-B, the first and the last frame's number")
    return int(match[1]), int(match[2])
