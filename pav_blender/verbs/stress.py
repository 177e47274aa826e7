"""`pav stress`: hostile scenes, what must hold in each, and what was seen."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..core.progress import Progress

SUMMARY = "Render hostile scenes: what must hold in each, and what was seen."
EXAMPLE = "pav stress --out out/stress --check"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("out/stress"), help="folder of results")
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="scenes whose names hold one of these"
    )
    parser.add_argument("--check", action="store_true", help="exit 1 where something did not hold")


def run(args: argparse.Namespace) -> int:
    from ..benchmarks.stress.run import run as run_scenes
    from ..core.evaluation.report import write_proof
    from .doctor import machine, versions

    args.out.mkdir(parents=True, exist_ok=True)
    progress = Progress("stress", as_json=args.json_progress)
    fields, claims = run_scenes(args.out, args.only, progress)
    fields |= {"versions": versions(), "machine": machine()}
    path = args.out / "stress.json"
    met = write_proof(path, fields, claims)
    for row in fields["scenes"]:
        if row["failed"]:
            print(f"{row['scene']} failed: {row['failed']}")
    print(f"see {path}")
    return 0 if met or not args.check else 1
