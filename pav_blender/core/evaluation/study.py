"""Training and measuring the methods of a table, each once: what is there already is kept."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..collection import Collection
from ..errors import Cancelled, InputError
from ..field.avatar import Avatar, read_header
from ..files import write_text
from ..images import write_rgba
from ..progress import Report
from ..reading import digest, read_json
from ..training.people import People, read_people
from ..training.places import checkpoint_path
from ..training.train import fingerprint, train
from .evaluate import Evaluation, absent, evaluate, merged, summary
from .heldout import Score
from .methods import Method

# what is measured: held-out frames, cameras that no clip used, another performance
SETS = ("test", "view", "novel")


@dataclass(frozen=True, eq=False)
class Study:
    """What all methods of a table share. novel: another performance of the same person in the same
    appearances, all of it unseen; other: another person's clips, for methods that learn two;
    weights: where perceptual metrics find theirs."""

    collection: Collection
    out: Path
    iterations: int
    novel: Collection | None = None
    other: Collection | None = None
    per_appearance: int | None = None
    weights: Path | None = None

    @property
    def sets(self) -> tuple[str, ...]:
        """Those of SETS that there are pictures of."""
        splits = {split for clip in self.collection.clips for split in clip.split.tolist()}
        return tuple(s for s in SETS if s in splits or (s == "novel" and self.novel is not None))


@dataclass(eq=False)
class Result:
    """One training of a method, all its networks together: seconds, parameters and bytes are
    their sums; measures: each set's metrics (`evaluate.summary`); examples: by appearance, the
    frame that `example_path` shows."""

    method: Method
    seed: int
    seconds: float
    parameters: int
    bytes: int
    measures: dict[str, dict[str, float | str]]
    examples: dict[str, str]


def result(
    study: Study,
    method: Method,
    seed: int,
    *,
    progress: Report | None = None,
    measuring: Report | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> Result:
    """Trains what is missing and measures what was not measured; both are kept in `study.out`, so
    that an interrupted study goes on where it was. Raises Cancelled, InputError."""
    paths = _train(study, method, seed, progress, should_stop)
    known = study.out / f"{method.key}-{seed}.json"
    trained = [read_header(path)["record"] for path in paths]
    source = {
        "trained": [digest(path) for path in paths],
        "novel": fingerprint(study.novel) if study.novel else None,
        "per_appearance": study.per_appearance,
    }

    def measured(done: float, **fields: Any) -> None:
        if should_stop is not None and should_stop():
            raise Cancelled(f"stopped; what was measured is in {study.out}")
        if measuring:
            measuring(done, **fields)

    stored: dict[str, Any] = read_json(known) if known.is_file() else {}
    words = absent(study.weights)
    if stored.get("source") != source:
        stored = {"source": source, "sets": {}}
    missing = [name for name in study.sets if not _is_measured(stored["sets"].get(name), words)]
    if missing:
        avatars = [Avatar.load(path) for path in paths]
        stored["parameters"] = sum(
            p.numel() for avatar in avatars for p in avatar.field.parameters()
        )
        for name in missing:
            evaluation = _measure(study, avatars, name, measured)
            stored["sets"][name] = {"summary": summary(evaluation), "rows": evaluation.rows}
            if name == "test":
                stored["examples"] = _keep_examples(study, method, seed, evaluation.scores)
            write_text(known, json.dumps(stored, indent=1) + "\n")
    return Result(
        method,
        seed,
        sum(record["seconds"] for record in trained),
        stored["parameters"],
        sum(path.stat().st_size for path in paths),
        {name: stored["sets"][name]["summary"] | words for name in study.sets},
        stored["examples"],
    )


def example_path(study: Study, method: Method, seed: int, appearance: str) -> Path:
    """The picture of one held-out frame of an appearance."""
    return study.out / "examples" / f"{method.key}-{seed}" / f"{appearance}.png"


def _train(
    study: Study,
    method: Method,
    seed: int,
    progress: Report | None,
    should_stop: Callable[[], bool] | None,
) -> list[Path]:
    """The files of a method's networks."""
    config = replace(method.config, seed=seed, iterations=study.iterations)
    parts: dict[str, Collection | People] = {f"{method.key}-{seed}": study.collection}
    if method.two_people:
        if study.other is None:
            raise InputError(f"method {method.key!r} needs another person's clips")
        both = read_people({"person": study.collection, "other": study.other})
        parts = {f"{method.key}-{seed}": both}
    if method.per_clip:
        parts = {
            f"{method.key}-{seed}-{name}": study.collection.only(name)
            for name in study.collection.appearances
        }
    paths = []
    for number, (name, part) in enumerate(parts.items()):
        path = study.out / f"{name}.pav"
        paths.append(path)
        if _is_trained(path, part, config.to_json()):
            continue

        def report(done: float, *, at: int = number, **fields: Any) -> None:
            if progress:
                progress((at + done) / len(parts), **fields)

        train(
            part,
            path,
            config,
            resume=checkpoint_path(path).is_file(),
            progress=report,
            should_stop=should_stop,
        )
    return paths


def _is_trained(path: Path, part: Collection | People, config: dict[str, Any]) -> bool:
    if not path.is_file():
        return False
    header = read_header(path)
    return header["config"] == config and header["record"].get("collection") == fingerprint(part)


def _measure(study: Study, avatars: list[Avatar], name: str, progress: Report | None) -> Evaluation:
    """All networks' measures of a set, as if one had made them."""
    collection, splits = study.collection, [name]
    if name == "novel":
        assert study.novel is not None
        collection, splits = study.novel, ["train", "test"]
    parts = [
        evaluate(
            avatar,
            collection,
            splits=splits,
            per_appearance=study.per_appearance,
            weights=study.weights,
            keep=1,
            progress=progress,
        )
        for avatar in avatars
    ]
    return merged(parts)


def _keep_examples(study: Study, method: Method, seed: int, scores: list[Score]) -> dict[str, str]:
    """Writes one picture an appearance; returns whose they are: frames by appearance."""
    names = study.collection.appearances
    for score in scores:
        appearance = names[score.frame.appearance]
        write_rgba(example_path(study, method, seed, appearance), score.rendered)
    return {names[score.frame.appearance]: score.frame.name for score in scores}


def _is_measured(stored: dict[str, Any] | None, words: dict[str, str]) -> bool:
    """Whether a set has a number for each metric but those that cannot be measured now."""
    return stored is not None and not any(
        isinstance(value, str) and key not in words for key, value in stored["summary"].items()
    )
