"""`pav demo`: collection, avatar, Blender scene, image sequences, report."""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError, PavError
from ..core.progress import Progress
from ..studio import DEFAULT_COLLECTION

SUMMARY = "The main job on the built-in person: clips, avatar, Blender scene, image sequences."
EXAMPLE = "pav demo --out out/demo"

HEAD_PSNR = 28.0
SWITCH_GAIN = 5.0
SECONDS = 600.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("out/demo"), help="folder of the results")
    parser.add_argument("--minutes", type=float, default=8.25, help="training time")
    parser.add_argument("--frames", type=int, default=24, help="pictures an appearance")
    parser.add_argument("--held-out", type=int, default=4, help="held-out frames an appearance")
    parser.add_argument("--collection", type=Path, help="train on this one instead")
    parser.add_argument(
        "--render-studio", action="store_true", help="render the clips anew with Cycles"
    )
    parser.add_argument("--fresh", action="store_true", help="begin anew: reuse nothing")
    parser.add_argument("--check", action="store_true", help="exit 1 where a claim is not met")


class Steps:
    """Seconds of each step; steps whose results are there already count what they took then."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.seconds: dict[str, float] = {}
        if path.is_file():
            self.seconds = _seconds(path)

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        print(f"== {name}", flush=True)
        started = time.monotonic()
        yield
        from ..core.files import write_text

        self.seconds[name] = round(time.monotonic() - started, 1)
        write_text(self._path, json.dumps(self.seconds))


def _seconds(path: Path) -> dict[str, float]:
    from ..core.reading import read_json

    stored = read_json(path)
    if not all(isinstance(value, int | float) and 0 <= value < 1e9 for value in stored.values()):
        raise InputError(f"{path}: not the seconds of a demo's steps; add --fresh to begin anew")
    return stored


def run(args: argparse.Namespace) -> int:
    if args.frames < 2 or args.held_out < 1:
        raise InputError("--frames takes 2 or more, --held-out 1 or more")
    out: Path = args.out
    if args.fresh and out.exists():
        if not (out / "steps.json").is_file() and any(out.iterdir()):
            raise InputError(f"{out}: not a demo's folder; remove it yourself or choose another")
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)
    steps = Steps(out / "steps.json")

    def bar(task: str) -> Progress:
        return Progress(task, as_json=args.json_progress)

    collection = _collection(args, steps, bar)
    avatar = _avatar(args, collection, steps, bar)
    _scene(args, collection, steps)
    return _report(args, collection, avatar, steps, bar)


def _collection(args: argparse.Namespace, steps: Steps, bar: Callable[[str], Progress]) -> Any:
    from ..core.collection import read_collection

    target = args.out / "collection"
    source = args.collection or (None if args.render_studio else DEFAULT_COLLECTION)
    if source is not None and not source.is_dir():
        if args.collection:
            raise InputError(f"{source}: no such collection folder")
        source = None
    if not target.exists():
        with steps.time("collection"):
            if source is not None:
                read_collection(source)
                partial = args.out / "collection.partial-copy"
                shutil.rmtree(partial, ignore_errors=True)
                shutil.copytree(source, partial)
                partial.rename(target)
            else:
                from ..studio import render_collection

                render_collection(target, progress=bar("studio"))
    return read_collection(target)


def _avatar(
    args: argparse.Namespace, collection: Any, steps: Steps, bar: Callable[[str], Progress]
) -> Any:
    from ..core.field.avatar import Avatar, read_header
    from ..core.training.places import checkpoint_path
    from ..core.training.train import fingerprint, train

    path = args.out / "avatar.pav"
    known = read_header(path)["record"].get("collection") if path.is_file() else None
    if known != fingerprint(collection):
        with steps.time("train"):
            train(
                collection,
                path,
                minutes=args.minutes,
                resume=checkpoint_path(path).is_file(),
                progress=bar("train"),
                loading=bar("read"),
            )
        for stale in ("avatar.blend", "frames"):
            target = args.out / stale
            shutil.rmtree(target) if target.is_dir() else target.unlink(missing_ok=True)
    return Avatar.load(path)


def _scene(args: argparse.Namespace, collection: Any, steps: Steps) -> None:
    """The .blend and, from it, an image sequence an appearance, in Blender processes of their own:
    each is what an animator's `blender -b` would do."""
    from ..core.collection import CollectionWriter
    from ..core.collection.motion import performance

    out: Path = args.out
    blend = out / "avatar.blend"
    clip = performance(collection, args.frames)
    if not blend.exists():
        with steps.time("scene"):
            motion = out / "motion"
            with CollectionWriter(
                motion,
                collection.head_name,
                collection.betas,
                fingerprint=collection.head.fingerprint,
                offset=collection.head_offset,
                overwrite=motion.exists(),
            ) as writer:
                writer.clip(clip)
            _child("scene", out / "avatar.pav", "--track", f"{motion}:{clip.name}", "--out", blend)
    wanted = [
        out / "frames" / name / f"{frame:04d}.png"
        for name in collection.appearances
        for frame in clip.frame_id
    ]
    if not all(path.is_file() for path in wanted):
        with steps.time("frames"):
            pattern = out / "frames" / "{appearance}" / "####.png"
            _child("render", blend, "--appearance", "all", "--out", pattern)


def _child(verb: str, *rest: object) -> None:
    package = __package__.partition(".verbs")[0] if __package__ else "pav_blender"
    command = [sys.executable, "-m", package, verb, *(str(part) for part in rest)]
    code = subprocess.run(command, stdin=subprocess.DEVNULL).returncode
    if code != 0:
        raise PavError(f"`pav {verb}` ended with code {code}; its message is above")


def _report(
    args: argparse.Namespace,
    collection: Any,
    avatar: Any,
    steps: Steps,
    bar: Callable[[str], Progress],
) -> int:
    from ..core.evaluation.report import (
        Claim,
        figures,
        measure,
        sheet_rows,
        write_page,
        write_proof,
    )
    from ..core.evaluation.sheet import grid
    from ..core.images import read_rgba, write_rgba
    from .doctor import machine, versions

    out: Path = args.out
    with steps.time("report"):
        measured = measure(avatar, collection, args.held_out, progress=bar("measure"))
        numbers = figures(measured)
        others: dict[str, list[np.ndarray]] = {}
        frames: dict[str, int] = {}
        for name in avatar.appearances:
            paths = sorted((out / "frames" / name).glob("*.png"))
            frames[name] = len(paths)
            picked = [paths[round(i * (len(paths) - 1) / 4)] for i in range(5)]
            others[name] = [read_rgba(path).astype("float32") / 255 for path in picked]
        write_rgba(out / "sheet.png", grid(sheet_rows(measured, others)))
    fields = {
        "appearances": avatar.appearances,
        **numbers,
        "seconds": {**steps.seconds, "total": round(sum(steps.seconds.values()), 1)},
        "frames": frames,
        "training": avatar.record,
        "config": dataclasses.asdict(avatar.config),
        "versions": versions(),
        "machine": machine(),
    }
    claims = [
        Claim.at_least("head PSNR, held-out", numbers["psnr"]["head_mean"], HEAD_PSNR, "dB"),
        *(
            Claim.at_least(
                f"{name}: own over the best other",
                numbers["psnr"]["picture"][name] - max(numbers["switch_psnr"][name].values()),
                SWITCH_GAIN,
                "dB",
            )
            for name in avatar.appearances
            if numbers["switch_psnr"][name]
        ),
        *(
            Claim.at_least(f"{name}: pictures", count, args.frames, "")
            for name, count in frames.items()
        ),
        Claim.at_most("whole run", fields["seconds"]["total"], SECONDS, "s"),
    ]
    met = write_proof(out / "report.json", fields, claims)
    shown = {k: v for k, v in fields.items() if k not in ("config", "training")}
    write_page(out / "report.html", "pav demo", shown, ["sheet.png"])
    print(f"see {out / 'report.html'} and {out / 'sheet.png'}")
    return 0 if met or not args.check else 1
