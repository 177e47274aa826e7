"""Training asked for in a panel: what was asked, kept beside the avatar until it is done, and the
processes that do it."""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.files import write_text
from ..core.reading import read_json
from ..core.training.places import checkpoint_path, read_curve
from . import packages, requirements
from .pipeline import Phase, Pipeline
from .process import Fields, Process

FORMAT = "pav-training 1"
TRACK, TRAIN = "Track", "Train"
_TRACK_MINUTES = 4.0  # a clip, by the way: what the progress bar takes it for
_DEFAULT_MINUTES = 20.0


@dataclass(frozen=True)
class Wanted:
    """What to train. clips: videos and the appearance each shows; without any, `collection` is
    what to learn from. minutes 0: by the number of iterations. options: of `pav train`."""

    output: Path
    clips: tuple[tuple[Path, str], ...] = ()
    collection: Path | None = None
    minutes: float = 0.0
    options: str = ""
    track_again: bool = False

    def __post_init__(self) -> None:
        if self.output.suffix != ".pav":
            raise InputError(f"{self.output}: an avatar file ends in .pav")
        if not self.clips and self.collection is None:
            raise InputError("add videos, or choose the folder of a tracked collection")
        for path, name in self.clips:
            if not path.exists():
                raise InputError(f"{path}: no such video")
            if not name.strip() or "=" in name:
                raise InputError(f"{path.name}: name its appearance, without '='; not {name!r}")

    @property
    def learned(self) -> Path:
        """The collection to learn from: that of the clips is written beside the avatar."""
        if self.clips or self.collection is None:
            return self.output.with_suffix(".collection")
        return self.collection

    @property
    def note(self) -> Path:
        return note_of(self.output)

    @property
    def preview(self) -> Path:
        return preview_of(self.output)

    @property
    def checkpoint(self) -> Path:
        return checkpoint_path(self.output)


def note_of(output: Path) -> Path:
    """Where the note of an unfinished training lies: beside the avatar."""
    return output.with_name(f"{output.name}.job.json")


def preview_of(output: Path) -> Path:
    """The folder of the pictures that show how a training goes."""
    return output.with_name(f"{output.name}.preview")


def write_note(wanted: Wanted) -> None:
    content = dataclasses.asdict(wanted) | {
        "format": FORMAT,
        "output": str(wanted.output),
        "collection": None if wanted.collection is None else str(wanted.collection),
        "clips": [[str(path), name] for path, name in wanted.clips],
    }
    write_text(wanted.note, json.dumps(content, indent=1) + "\n")


def read_note(output: Path) -> Wanted:
    """What an unfinished training of `output` was to do. InputError for a note that does not say.

    Paths are taken from where the note lies now: the folder may have moved with its avatar.
    """
    path = note_of(output)
    try:
        content = read_json(path)
        if content["format"] != FORMAT:
            raise ValueError(content["format"])
        collection = content["collection"]
        clips = tuple((Path(str(video)), str(name)) for video, name in content["clips"])
        values: dict[str, Any] = {
            "collection": None if collection is None else Path(str(collection)),
            "minutes": float(content["minutes"]),
            "options": str(content["options"]),
        }
    except (InputError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: not the note of a training; discard it") from error
    return Wanted(output, clips, **values)


def unfinished(output: Path) -> bool:
    """Whether a training of `output` was begun and never ended, and no job is at it."""
    try:
        begun = note_of(output).stat().st_mtime
    except OSError:
        return False
    try:
        written = output.stat().st_mtime
    except OSError:
        return True
    # the avatar is the last to be written: only the note is left then
    return checkpoint_path(output).exists() or written < begun


def discard(output: Path) -> None:
    """Removes what an unfinished training left; videos, collections and avatars stay."""
    for path in (note_of(output), checkpoint_path(output)):
        path.unlink(missing_ok=True)
    shutil.rmtree(preview_of(output), ignore_errors=True)


@dataclass
class Watch:
    """What is known of the training that runs, or ran last: for the panel."""

    wanted: Wanted
    pipeline: Pipeline | None = None
    # rows of `core.training.places.COLUMNS`
    curve: list[tuple[float, ...]] = field(default_factory=list)

    def listen(self, said: Fields) -> None:
        if said.get("task") != "train" or "psnr" not in said:
            return
        row = (said.get("iteration"), said.get("seconds"), said.get("loss"), said.get("psnr"))
        if all(isinstance(value, int | float) for value in row):
            while self.curve and self.curve[-1][0] >= float(said["iteration"]):
                self.curve.pop()  # what a crash lost is learned again
            self.curve.append(tuple(float(value) for value in row if value is not None))
        if len(self.curve) > 2000:
            del self.curve[::2]


_watch: list[Watch] = []


def watched() -> Watch | None:
    return _watch[-1] if _watch else None


def start(wanted: Wanted, *, resume: bool = False) -> Pipeline:
    """Starts the processes. PavError, one line, for what is missing or in the way."""
    if not packages.chosen_python():  # another Python says itself what it lacks
        requirements.check()
        if wanted.clips:
            requirements.check(requirements.TRACKING)
    if not resume and unfinished(wanted.output):
        raise InputError(f"{wanted.output}: an unfinished training is there; resume or discard it")
    tracks = bool(wanted.clips) and not tracked(wanted)
    if not resume:
        discard(wanted.output)
        write_note(wanted)
    watch = Watch(wanted, curve=read_curve(wanted.preview))
    _watch[:] = [watch]
    phases = [Phase(TRAIN, wanted.minutes or _DEFAULT_MINUTES, _train(wanted, watch))]
    if tracks:
        weight = _TRACK_MINUTES * len(wanted.clips)
        arguments = track_arguments(wanted)
        phases.insert(0, Phase(TRACK, weight, lambda: Process(arguments)))
    watch.pipeline = Pipeline(phases, finish=lambda: note_of(wanted.output).unlink(missing_ok=True))
    return watch.pipeline


def tracked(wanted: Wanted) -> bool:
    """Whether the clips' collection is there already, from these clips as they are now.

    InputError where something else lies in its place: it is never replaced without being asked.
    """
    folder = wanted.learned
    if wanted.track_again or not folder.exists():
        return False
    try:
        made = (folder / "collection.json").stat().st_mtime
        content = read_json(folder / "collection.json")
        looks = {clip["name"]: clip["appearance"] for clip in content["clips"]}
        tracking = content["extra"]["tracking"]
        videos = {clip["video"] for clip in tracking["clips"] + tracking["skipped"]}
        pairs = {(clip["video"], looks[clip["name"]]) for clip in tracking["clips"]}
    except (InputError, OSError, KeyError, TypeError):
        videos, pairs, made = set(), set(), 0.0
    same = {(path.name, name.strip()) for path, name in wanted.clips}
    newer = any(path.stat().st_mtime > made for path, _ in wanted.clips)
    if newer or videos != {path.name for path, _ in wanted.clips} or not pairs <= same:
        raise InputError(
            f"{folder}: holds other clips than these; tick Track Again to replace it, or write "
            "the avatar under another name"
        )
    return True


def track_arguments(wanted: Wanted) -> list[str]:
    arguments = ["track", *(str(path) for path, _ in wanted.clips)]
    for _, name in wanted.clips:
        arguments += ["--appearance", name.strip()]
    arguments += ["--out", str(wanted.learned), "--json-progress"]
    return arguments + (["--overwrite"] if wanted.track_again else [])


def _train(wanted: Wanted, watch: Watch) -> Callable[[], Process]:
    return lambda: Process(train_arguments(wanted), listen=watch.listen)


def train_arguments(wanted: Wanted) -> list[str]:
    """Of `pav train`; it goes on from a checkpoint where there is one."""
    arguments = ["train", str(wanted.learned), "--out", str(wanted.output), "--json-progress"]
    arguments += ["--preview", str(wanted.preview)]
    if wanted.minutes > 0:
        arguments += ["--minutes", f"{wanted.minutes:g}"]
    if wanted.checkpoint.exists():
        arguments.append("--resume")
    try:
        return arguments + shlex.split(wanted.options, posix=os.name != "nt")
    except ValueError as error:
        raise InputError(f"options {wanted.options!r}: {error}") from error
