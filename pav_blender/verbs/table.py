"""`pav table`: the paper's tables, reproduced."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.progress import Progress
from ..core.stopping import StopSignal

SUMMARY = (
    "Reproduce a table of the paper, or of our own choices: trains, measures, writes the table."
)
EXAMPLE = "pav table ablation --out out/table --check"

NAMES = ("ablation", "choices", "comparison", "efficiency")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", choices=NAMES, help="which table")
    parser.add_argument(
        "--out", type=Path, default=Path("out/table"), help="folder of trainings and results"
    )
    parser.add_argument(
        "--collection",
        type=Path,
        help="clips of one person; without it the studio films five appearances into OUT/studio5",
    )
    parser.add_argument(
        "--novel",
        type=Path,
        help="another performance in the same appearances (`pav studio --performance 1`); "
        "filmed into OUT/studio5_novel beside the studio's own clips",
    )
    parser.add_argument(
        "--identities",
        type=Path,
        metavar="COLLECTION",
        help="`comparison`: another person's clips, for a row of both in one network",
    )
    parser.add_argument("--iterations", type=int, default=3000, help="of each network (3000)")
    parser.add_argument("--seeds", type=int, default=3, help="trainings of each method (3)")
    parser.add_argument("--per-appearance", type=int, help="at most so many pictures of each set")
    parser.add_argument("--weights", type=Path, help="folder of the perceptual metrics' weights")
    parser.add_argument(
        "--only", metavar="METHOD,...", help="train and measure these, and draw no table"
    )
    parser.add_argument("--check", action="store_true", help="exit 1 where a claim is not met")


def run(args: argparse.Namespace) -> int:
    from ..core.evaluation.methods import METHODS, method
    from ..core.evaluation.paper_tables import TABLES
    from ..core.evaluation.study import result

    if args.iterations < 1 or args.seeds < 1:
        raise InputError("--iterations and --seeds take 1 or more")
    wanted = TABLES[args.name]
    keys = wanted.needs
    if args.identities is not None and args.name == "comparison":
        keys = (*keys, "ours_two")
    if args.only:
        keys = tuple(method(key).key for key in args.only.split(","))
    study, stop = _study(args), StopSignal()
    results: dict[str, list[Any]] = {}
    # seeds outside: a table that was interrupted has something of every method
    for seed in range(args.seeds):
        for one in (m for m in METHODS if m.key in keys):
            name = f"{one.key}-{seed}"
            found = result(
                study,
                one,
                seed,
                progress=Progress(f"train {name}", as_json=args.json_progress),
                measuring=Progress(f"measure {name}", as_json=args.json_progress),
                should_stop=stop,
            )
            results.setdefault(one.key, []).append(found)
            psnr = found.measures["test"]["psnr"]
            print(f"{name}: {found.seconds:.0f} s, {psnr:.2f} dB held-out", flush=True)
    if args.only:
        return 0
    return _write(args, study, results)


def _study(args: argparse.Namespace) -> Any:
    from ..core.collection import read_collection
    from ..core.evaluation.study import Study

    args.out.mkdir(parents=True, exist_ok=True)
    collection, novel = args.collection, args.novel
    if collection is None:
        collection = _filmed(args, "studio5", frames=60)
        novel = novel or _filmed(args, "studio5_novel", frames=12, performance=1, views=())
    return Study(
        read_collection(collection),
        args.out / str(args.iterations),
        args.iterations,
        None if novel is None else read_collection(novel),
        None if args.identities is None else read_collection(args.identities),
        args.per_appearance,
        args.weights,
    )


def _filmed(args: argparse.Namespace, name: str, **options: Any) -> Path:
    from ..studio import render_collection

    path: Path = args.out / name
    if not path.exists():
        print(f"{path}: filming five appearances", flush=True)
        render_collection(
            path,
            appearances=5,
            truth="light",
            progress=Progress(f"film {name}", as_json=args.json_progress),
            **options,
        )
    return path


def _write(args: argparse.Namespace, study: Any, results: dict[str, list[Any]]) -> int:
    from ..core.evaluation.figure import draw_figure
    from ..core.evaluation.methods import METHODS
    from ..core.evaluation.paper_tables import TABLES
    from ..core.evaluation.report import write_proof
    from ..core.evaluation.tables import latex, markdown
    from ..core.files import write_text
    from .doctor import machine, versions

    frames = sum(len(clip.indices("train")) for clip in study.collection.clips)
    caption = (
        f"{TABLES[args.name].caption}, {len(study.collection.appearances)} appearances, {frames} "
        f"training frames, {args.iterations} iterations a network, {args.seeds} "
        f"{'seeds' if args.seeds > 1 else 'seed'}"
    )
    tables, claims = TABLES[args.name].build(results, caption)
    text = "\n".join(markdown(table) for table in tables)
    write_text(args.out / f"{args.name}.md", text)
    write_text(args.out / f"{args.name}.tex", "\n".join(latex(table) for table in tables))
    methods = [m for m in METHODS if m.key in results]
    examples = results[methods[0].key][0].examples
    draw_figure(study, methods, 0, examples, args.out / f"{args.name}.png")
    print(text)
    fields = {
        "caption": caption,
        "results": {
            key: [{k: v for k, v in vars(found).items() if k != "method"} for found in runs]
            for key, runs in results.items()
        },
        "configs": {m.key: dataclasses.asdict(m.config) for m in methods},
        "versions": versions(),
        "machine": machine(),
    }
    met = write_proof(args.out / f"{args.name}.json", fields, claims)
    print(f"see {args.out / args.name}.md, .tex, .json and .png")
    return 0 if met or not args.check else 1
