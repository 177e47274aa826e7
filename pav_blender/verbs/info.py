"""`pav info`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

SUMMARY = "Show what an avatar file holds, as JSON."
EXAMPLE = "pav info out/avatar.pav"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("avatar", type=Path, help="avatar file (.pav)")


def run(args: argparse.Namespace) -> int:
    from ..core.field.avatar import read_header

    header = read_header(args.avatar)
    header["megabytes"] = round(args.avatar.stat().st_size / 1e6, 2)
    print(json.dumps(header, indent=1))
    return 0
