"""What every benchmark shares: its subject, the clock, and plots."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.collection import Collection, read_collection
from ..core.config import Config
from ..core.errors import InputError
from ..core.evaluation.heldout import chosen_frames
from ..core.field.avatar import Avatar
from ..core.progress import Report
from ..core.training.frames import Frame
from ..core.training.train import fingerprint, train
from ..studio import DEFAULT_COLLECTION


@dataclass(frozen=True)
class Options:
    """out: folder of what is written; minutes: of the longest training, "train" only; iterations:
    of the subject's training, the same work on every machine; landmark_model: of "track"."""

    out: Path
    collection: Path = DEFAULT_COLLECTION
    repeats: int = 3
    minutes: float = 8.0
    iterations: int = 3000
    landmark_model: Path | None = None


def collection_of(options: Options) -> Collection:
    """The collection to measure on; InputError, saying how to make one, where there is none."""
    if not options.collection.is_dir():
        raise InputError(
            f"{options.collection}: no such collection; `pav studio DIR` makes one for --collection"
        )
    return read_collection(options.collection)


def subject(options: Options, progress: Report | None = None) -> tuple[Avatar, Collection]:
    """The avatar that is measured, trained into `out` unless it is there already."""
    collection = collection_of(options)
    path = options.out / "subject.pav"
    if path.is_file():
        avatar = Avatar.load(path)
        if avatar.record.get("collection") == fingerprint(collection):
            return avatar, collection
    config = dataclasses.replace(Config(), iterations=options.iterations)
    return train(collection, path, config, progress=progress), collection


def a_frame(collection: Collection) -> Frame:
    """One held-out frame: the middle one of the first appearance's."""
    frames = chosen_frames(collection, ("test",), None)
    own = [f for f in frames if f.appearance == 0]
    return own[len(own) // 2]


def best(calls: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Seconds of each call, the least of `repeats` after one that warms up; taken in turns, so that
    what else the machine does falls on all alike."""
    for call in calls.values():
        call()
    seconds = dict.fromkeys(calls, float("inf"))
    for _ in range(repeats):
        for name, call in calls.items():
            started = time.perf_counter()
            call()
            seconds[name] = min(seconds[name], time.perf_counter() - started)
    return seconds


def show(rows: Iterable[dict[str, Any]]) -> None:
    """Prints rows of the same keys as a table."""
    rows = [{k: f"{v:.4g}" if isinstance(v, float) else str(v) for k, v in r.items()} for r in rows]
    if not rows:
        return
    widths = {k: max(len(k), *(len(r[k]) for r in rows)) for k in rows[0]}
    print("  ".join(k.ljust(w) for k, w in widths.items()))
    for row in rows:
        print("  ".join(row[k].ljust(w) for k, w in widths.items()))


def plot(path: Path, draw: Callable[[Any], None], title: str, x: str, y: str) -> None:
    """An SVG file of one set of axes that `draw` fills; InputError without matplotlib."""
    try:
        import matplotlib
    except ImportError as error:
        raise InputError("plots need matplotlib: `pip install matplotlib`") from error
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    draw(axes)
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.grid(alpha=0.3)
    with matplotlib.rc_context({"svg.hashsalt": "pav"}):  # the same file for the same figures
        figure.savefig(path, metadata={"Date": None})
