"""`pav eval`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.progress import Progress

if TYPE_CHECKING:
    from ..core.evaluation.evaluate import Evaluation, Metric
    from ..core.evaluation.parts import Part

SUMMARY = "Measure an avatar on frames it has not seen, with the field's metrics."
EXAMPLE = "pav eval out/avatar.pav out/collection --out out/eval --check --head-psnr 27"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("avatar", type=Path, help="avatar file (.pav)")
    parser.add_argument("collection", type=Path, help="folder of the collection")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="for eval.json and sheet.png"
    )
    parser.add_argument(
        "--splits",
        default="test,view",
        help="test: frames kept out; view: cameras never filmed; train (default: test,view)",
    )
    parser.add_argument(
        "--per-appearance", type=int, metavar="N", help="frames of each appearance (default: all)"
    )
    parser.add_argument(
        "--weights",
        type=Path,
        metavar="DIR",
        help="networks' weights for LPIPS, DISTS and FID (default: torch's hub cache); "
        "nothing is downloaded",
    )
    parser.add_argument(
        "--head-psnr", type=float, metavar="DB", help="what the head of test frames should reach"
    )
    parser.add_argument("--check", action="store_true", help="end with code 1 where it does not")


def run(args: argparse.Namespace) -> int:
    from ..core.collection import read_collection
    from ..core.errors import InputError
    from ..core.evaluation.evaluate import by_appearance, evaluate, summary
    from ..core.evaluation.parts import shares
    from ..core.evaluation.report import Claim, write_proof
    from ..core.evaluation.sheet import grid
    from ..core.field.avatar import Avatar
    from ..core.images import write_rgba
    from .doctor import machine, versions

    splits = [split.strip() for split in args.splits.split(",")]
    if args.check and args.head_psnr is None:
        raise InputError("--check needs what to reach: --head-psnr DB")
    if args.head_psnr is not None and "test" not in splits:
        raise InputError(f"--head-psnr is of test frames; --splits {args.splits} has none")
    if args.out.exists() and not args.out.is_dir():
        raise InputError(f"{args.out}: not a folder; --out names one")
    avatar, collection = Avatar.load(args.avatar), read_collection(args.collection)
    started = time.monotonic()
    evaluation = evaluate(
        avatar,
        collection,
        splits=splits,
        per_appearance=args.per_appearance,
        weights=args.weights,
        keep=1,
        progress=Progress("eval", as_json=args.json_progress),
    )
    seconds = time.monotonic() - started
    measured = list(dict.fromkeys(row["split"] for row in evaluation.rows))
    if args.head_psnr is not None and "test" not in measured:
        raise InputError(f"{args.collection}: no test frames that --head-psnr could be of")
    found = {
        split: shares([row for row in evaluation.rows if row["split"] == split])
        for split in measured
    }
    for line in [*_table(evaluation, measured), *_by_label(found)]:
        print(line)
    write_rgba(args.out / "sheet.png", grid(_sheet(evaluation)))
    fields = {
        "avatar": str(args.avatar),
        "collection": str(args.collection),
        "summary": {split: summary(evaluation, split) for split in measured},
        "appearances": {split: by_appearance(evaluation, split) for split in measured},
        "absent": evaluation.absent,
        "needs": evaluation.needs,
        "left_out": evaluation.left_out,
        "parts": {split: [asdict(part) for part in found[split]] for split in measured},
        "rows": evaluation.rows,
        "seconds": round(seconds, 1),
        "versions": versions(),
        "machine": machine(),
    }
    claims = []
    if args.head_psnr is not None:
        reached = float(summary(evaluation, "test")["head_psnr"])
        claims.append(Claim.at_least("head PSNR, test frames", reached, args.head_psnr, "dB"))
    met = write_proof(args.out / "eval.json", fields, claims)
    print(f"see {args.out / 'eval.json'} and {args.out / 'sheet.png'}")
    return 0 if met or not args.check else 1


def _table(evaluation: Evaluation, splits: list[str]) -> list[str]:
    """A Markdown table a split: its appearances, all together; then what is missing, and why."""
    from ..core.evaluation.evaluate import FIGURES, METRICS, by_appearance, summary

    shown = [m for m in (*METRICS, *FIGURES) if m.key not in evaluation.absent]
    lines = []
    for split in splits:
        heads = [f"{m.name}, {m.unit}" if m.unit else m.name for m in shown]
        lines += ["", "| " + " | ".join([split, "frames", *heads]) + " |"]
        lines.append("|" + "---|" * (len(heads) + 2))
        rows = [row["appearance"] for row in evaluation.rows if row["split"] == split]
        for name, values in by_appearance(evaluation, split).items():
            lines.append(_row(name, rows.count(name), values, shown))
        lines.append(_row("all", len(rows), summary(evaluation, split), shown))
    lines.append("")
    names = {metric.key: metric.name for metric in METRICS}
    for key, reason in evaluation.absent.items():
        lines.append(f"{names[key]}: {reason} ({evaluation.needs[key]})")
    for name in evaluation.left_out:
        lines.append(f"{name}: left out, the avatar does not wear it")
    return lines


def _by_label(found: Mapping[str, Sequence[Part]]) -> list[str]:
    """A Markdown table a split: where the person's pixels are, and their error."""
    lines = []
    for split, parts in found.items():
        if parts:
            lines += ["", f"| {split}, by label | of the person | of the error | PSNR, dB |"]
            lines.append("|---|---|---|---|")
        lines += [
            f"| {p.name} | {p.area:.1%} | {p.error:.1%} | {p.psnr:.2f} |"
            for p in parts
            if p.area >= 0.001
        ]
    return lines


def _row(name: str, frames: int, values: Mapping[str, float | str], shown: list[Metric]) -> str:
    cells = [name, str(frames)]
    for metric in shown:
        value = values.get(metric.key, "")
        if not isinstance(value, str):
            value = f"{value:.2f}" if metric.unit or metric.key == "fid" else f"{value:.4f}"
        cells.append(value)
    return "| " + " | ".join(cells) + " |"


def _sheet(evaluation: Evaluation) -> list[list[Any]]:
    """A row an appearance: truth, ours and the error map of a frame of each split."""
    from ..core.evaluation.heldout import BACKGROUND
    from ..core.evaluation.metrics import over
    from ..core.evaluation.sheet import error_map

    rows: dict[str, list[Any]] = {}
    for score in evaluation.scores:
        truth, ours = over(score.frame.rgba / 255, BACKGROUND), over(score.rendered, BACKGROUND)
        rows.setdefault(score.appearance, []).extend([truth, ours, error_map(ours, truth)])
    return list(rows.values())
