"""An avatar measured on frames of a collection with the field's metrics."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..collection import SPLITS, Clip, Collection, read_labels
from ..errors import InputError
from ..field.avatar import Avatar
from ..field.identities import own_appearances
from ..progress import Report
from ..rendering.render import RenderSettings
from ..rendering.sequence import check_head
from ..training.frames import load_frames
from . import learned, parts
from .heldout import BACKGROUND, Score, chosen_rows, head_mask, score
from .metrics import frechet, over


@dataclass(frozen=True)
class Metric:
    """key: in rows and summaries; unit: "" for a plain number."""

    name: str
    unit: str
    higher_is_better: bool
    key: str


# of whole pictures before white, except the head's PSNR: of the matte's pixels
METRICS: tuple[Metric, ...] = (
    Metric("PSNR", "dB", True, "psnr"),
    Metric("head PSNR", "dB", True, "head_psnr"),
    Metric("SSIM", "", True, "ssim"),
    Metric("ST-LPIPS", "", False, "st_lpips"),
    Metric("LPIPS", "", False, "lpips"),
    Metric("DISTS", "", False, "dists"),
    Metric("FID", "", False, "fid"),
)
KEYS = tuple(one.key for one in METRICS)
# measured of every frame beside them: opacity where it should be none, and what it lacks of one
FIGURES: tuple[Metric, ...] = (
    Metric("fog outside", "per mille", False, "fog"),
    Metric("holes inside", "per mille", False, "holes"),
)

_COMPARED: dict[str, Callable[[Path | None], learned.Compare]] = {
    "st_lpips": learned.st_lpips,
    "lpips": learned.lpips,
    "dists": learned.dists,
}


@dataclass
class Evaluation:
    """rows: a dict a frame: frame ("clip/number"), appearance, split, and a value for each metric
    that was there, FID excepted, for `fog` and `holes`, and where there are labels `parts` (see
    `parts.measured`). absent: by key, why a metric was not
    (`learned.Absent`); needs: by key, what to bring. scores: frames with their pictures, as many as
    were asked for. left_out: appearances of the collection that the avatar does not have. features:
    what FID compares, ([N, D] ours, [N, D] true), a row each of `rows`.
    """

    rows: list[dict[str, Any]]
    absent: dict[str, str]
    scores: list[Score]
    metrics: tuple[str, ...] = ()
    needs: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    features: tuple[np.ndarray, np.ndarray] | None = None


def evaluate(
    avatar: Avatar,
    collection: Collection,
    *,
    splits: Sequence[str] = ("test",),
    appearances: list[str] | None = None,
    per_appearance: int | None = None,
    settings: RenderSettings | None = None,
    metrics: Sequence[str] = KEYS,
    weights: Path | None = None,
    keep: int = 0,
    progress: Report | None = None,
) -> Evaluation:
    """Renders frames wearing their own appearance, matched by name (of several people, among those
    of the one that the collection was tracked on), and compares the pictures.

    Pictures are compared before white, the truth with its matte as alpha, as in training. What the
    avatar does not wear is left out. per_appearance: frames of each appearance and split at most,
    evenly spread; weights: a folder with networks' files (beside torch's hub cache); keep: scores
    of each appearance and split that are kept with their pictures, evenly spread. Raises
    InputError for unknown names, another head than the avatar's, and where there is no frame.
    """
    check_head(avatar, collection)
    _check_names("metric", metrics, KEYS)
    _check_names("split", splits, SPLITS)
    _check_names("appearance", appearances or [], collection.appearances)
    if per_appearance is not None and per_appearance < 1:
        raise InputError(f"per_appearance {per_appearance}: at least 1")
    own = dict(
        zip(collection.appearances, own_appearances(avatar, collection), strict=True)
    )  # what the avatar calls them
    for name in appearances or []:
        avatar.appearance_index(own[name])
    if weights is not None and not weights.is_dir():
        raise InputError(f"{weights}: no such folder; it should hold networks' weights")
    chosen = [n for n in appearances or own if own[n] in avatar.appearances]
    todo = _frames(collection, chosen, splits, per_appearance, keep)
    if not todo:
        raise InputError(
            f"{collection.path}: no frames of {' or '.join(splits)} wear what the avatar has: "
            f"{', '.join(avatar.appearances)}"
        )
    result = Evaluation([], {}, [], metrics=tuple(metrics))
    result.left_out = [n for n in own if own[n] not in avatar.appearances]
    compared, look = _load(result, weights)
    ours_seen, truth_seen = [], []
    settings = settings or RenderSettings()
    for done, (clip, row, split, kept) in enumerate(todo):
        frame = load_frames(collection, clip, np.array([row]), targets=False)[0]
        scored = score(avatar, frame, own[clip.appearance], settings)
        ours, truth = over(scored.rendered, BACKGROUND), over(frame.rgba / 255, BACKGROUND)
        values = {k: getattr(scored, k) for k in ("psnr", "head_psnr", "ssim") if k in metrics}
        values |= {key: compare(ours, truth) for key, compare in compared.items()}
        values |= {"fog": 1e3 * scored.fog, "holes": 1e3 * scored.holes}
        labels = read_labels(collection, clip, row)
        if labels is not None:
            values["parts"] = parts.measured(ours, truth, head_mask(frame.rgba), labels)
        result.rows.append(
            {"frame": frame.name, "appearance": clip.appearance, "split": split, **values}
        )
        if look is not None:
            ours_seen.append(look(ours))
            truth_seen.append(look(truth))
        if kept:
            result.scores.append(scored)
        if progress:
            progress((done + 1) / len(todo), frame=frame.name, psnr=scored.psnr)
    if look is not None:
        result.features = np.stack(ours_seen), np.stack(truth_seen)
    return result


def absent(weights: Path | None = None) -> dict[str, str]:
    """Metrics that cannot be measured here, by key, and why."""
    nothing = Evaluation([], {}, [], metrics=KEYS)
    _load(nothing, weights)
    return nothing.absent


def merged(parts: Sequence[Evaluation]) -> Evaluation:
    """Measures of several avatars, each of its own frames, as if one had made them all."""
    features = [part.features for part in parts if part.features is not None]
    worn = {row["appearance"] for part in parts for row in part.rows}
    return Evaluation(
        [row for part in parts for row in part.rows],
        parts[0].absent,
        [score for part in parts for score in part.scores],
        parts[0].metrics,
        parts[0].needs,
        [name for name in parts[0].left_out if name not in worn],
        (np.concatenate([f[0] for f in features]), np.concatenate([f[1] for f in features]))
        if features
        else None,
    )


def summary(evaluation: Evaluation, split: str | None = None) -> dict[str, float | str]:
    """Each metric's mean over its appearances' means, FID over all frames at once; where there is
    none, why. Of all rows, or of those of one split. nan where no frame has a finite value."""
    found: dict[str, float | str] = {}
    rows = [row for row in evaluation.rows if split in (None, row["split"])]
    for metric in (*METRICS, *FIGURES):
        key = metric.key
        if key in evaluation.absent:
            found[key] = evaluation.absent[key]
        elif key == "fid":
            if key in evaluation.metrics:
                found[key] = _fid(evaluation, split)
        elif any(key in row for row in rows):
            found[key] = _mean([means[key] for means in by_appearance(evaluation, split).values()])
    return found


def by_appearance(evaluation: Evaluation, split: str | None = None) -> dict[str, dict[str, float]]:
    """Means over the frames of each appearance, by name and then by key."""
    rows = [row for row in evaluation.rows if split in (None, row["split"])]
    keys = [m.key for m in (*METRICS, *FIGURES) if any(m.key in row for row in rows)]
    return {
        name: {key: _mean([row[key] for row in rows if row["appearance"] == name]) for key in keys}
        for name in dict.fromkeys(row["appearance"] for row in rows)
    }


def _mean(values: list[float]) -> float:
    finite = [value for value in values if math.isfinite(value)]
    return float(np.mean(finite)) if finite else math.nan


def _fid(evaluation: Evaluation, split: str | None) -> float | str:
    assert evaluation.features is not None
    at = [i for i, row in enumerate(evaluation.rows) if split in (None, row["split"])]
    if len(at) < 2:
        return "too few frames"
    return frechet(*(features[at] for features in evaluation.features))


def _check_names(what: str, names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise InputError(f"unknown {what} {name!r}: one of {', '.join(known)}")


def _frames(
    collection: Collection,
    appearances: Sequence[str],
    splits: Sequence[str],
    per_appearance: int | None,
    keep: int,
) -> list[tuple[Clip, int, str, bool]]:
    """Clip, row, split, and whether the score is kept."""
    found = []
    for name in appearances:
        for split in dict.fromkeys(splits):
            rows = chosen_rows(collection, name, (split,), per_appearance)
            kept = set(np.linspace(-1, len(rows), keep + 2)[1:-1].round().astype(int))
            found += [(clip, row, split, i in kept) for i, (clip, row) in enumerate(rows)]
    for clip, *_ in found:
        if min(clip.width, clip.height) < learned.SMALLEST:
            raise InputError(
                f"{collection.path}: clip {clip.name} is {clip.width}x{clip.height} pixels; "
                f"metrics are of pictures of at least {learned.SMALLEST}"
            )
    return found


def _load(
    result: Evaluation, weights: Path | None
) -> tuple[dict[str, learned.Compare], learned.Features | None]:
    """The networks that are wanted and there; what is not goes to `absent` and `needs`."""
    compared: dict[str, learned.Compare] = {}
    look = None
    for key in result.metrics:
        try:
            if key in _COMPARED:
                compared[key] = _COMPARED[key](weights)
            elif key == "fid":
                look = learned.inception(weights)
        except learned.Absent as absent:
            result.absent[key], result.needs[key] = absent.reason, absent.needs
    return compared, look
