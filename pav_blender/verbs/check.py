"""`pav check`."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..core.progress import Progress

SUMMARY = "Validate a collection, say what it holds, and lay the mesh over its pictures."
EXAMPLE = "pav check out/collection --out out/overlay.png"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("collection", type=Path, help="folder of the collection")
    parser.add_argument("--out", type=Path, help="overlay picture to write (.png)")


def run(args: argparse.Namespace) -> int:
    from ..core.collection import read_collection
    from ..core.errors import InputError
    from ..core.evaluation.check import check, write_overlays

    collection = read_collection(args.collection)
    findings = check(collection, progress=Progress("check", as_json=args.json_progress))
    print(f"{args.collection}: head {collection.head_name}, {len(collection.betas)} coefficients")
    for row in findings.summary:
        print("  " + "  ".join(f"{key} {value}" for key, value in row.items()))
    if findings.problems:
        first, *others = findings.problems
        for problem in others:
            print(f"  also: {problem}")
        raise InputError(first)
    if args.out:
        write_overlays(collection, args.out)
        print(f"overlay: {args.out}")
    print("no problems found")
    return 0
