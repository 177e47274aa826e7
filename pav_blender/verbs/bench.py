"""`pav bench`: what things cost, and how right they are."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

from ..core.errors import InputError
from ..core.progress import Progress
from ..studio import DEFAULT_COLLECTION

SUMMARY = "Measure speed against error on a studio avatar; tables, plots and claims."
EXAMPLE = "pav bench render --out out/bench --check"

NAMES = (
    "render",
    "accuracy",
    "train",
    "kernels",
    "scale",
    "memory",
    "devices",
    "matte",
    "studio",
    "track",
    "viewport",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", choices=NAMES, help="what to measure")
    parser.add_argument("--out", type=Path, default=Path("out/bench"), help="folder of the results")
    parser.add_argument("--collection", type=Path, help="another collection than the built-in one")
    parser.add_argument("--repeats", type=int, default=3, help="of which the least time counts")
    parser.add_argument(
        "--minutes",
        type=float,
        default=8.0,
        help="of the paper's preset in `train`, of each training in `devices`",
    )
    parser.add_argument(
        "--landmark-model", type=Path, metavar="FILE.task", help="`track`: as for pav track"
    )
    parser.add_argument("--check", action="store_true", help="exit 1 where a claim is not met")


def run(args: argparse.Namespace) -> int:
    from ..benchmarks.measure import Options
    from ..core.evaluation.report import write_proof
    from .doctor import machine, versions

    if args.repeats < 1 or not args.minutes > 0:
        raise InputError("--repeats takes 1 or more, --minutes more than 0")
    args.out.mkdir(parents=True, exist_ok=True)
    options = Options(
        args.out,
        args.collection or DEFAULT_COLLECTION,
        args.repeats,
        args.minutes,
        landmark_model=args.landmark_model,
    )
    module = importlib.import_module(f"...benchmarks.{args.name}", __name__)
    fields, claims = module.run(options, Progress(args.name, as_json=args.json_progress))
    fields |= {"versions": versions(), "machine": machine()}
    path = args.out / f"{args.name}.json"
    met = write_proof(path, fields, claims)
    print(f"see {path} and {path.with_suffix('.svg')}")
    return 0 if met or not args.check else 1
