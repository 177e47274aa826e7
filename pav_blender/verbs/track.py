"""`pav track`."""

import argparse

from ..core.stopping import StopSignal
from ..core.tracking import add_arguments
from ..core.tracking import run as track

SUMMARY = "Make a collection from videos of one person: landmarks, matte, head geometry."
EXAMPLE = "pav track a.mp4 b.mp4 --out out/collection"

__all__ = ["EXAMPLE", "SUMMARY", "add_arguments", "run"]


def run(args: argparse.Namespace) -> int:
    return track(args, StopSignal())
