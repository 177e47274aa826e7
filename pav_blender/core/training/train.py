"""Training from a collection to a `.pav` file, with checkpoints, cancel and resume."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from pathlib import Path

import torch

from ..collection import Collection, read_collection
from ..config import Config
from ..errors import Cancelled, InputError
from ..field.avatar import Avatar
from ..kernels.cpu.threads import torch_alone
from ..progress import Report
from .checkpoint import go_back, load_checkpoint, save_checkpoint
from .people import People
from .places import checkpoint_path
from .prepare import load_training_frames, new_avatar
from .preview import Preview
from .refined import correct_collection, refined_writer, write_refined
from .refiner import Refiner, kept_out
from .trainer import Trainer

CHECKPOINT_SECONDS = 30.0


def train(
    collection: Collection | People | Path | str,
    out: Path | str,
    config: Config | None = None,
    *,
    minutes: float | None = None,
    resume: bool = False,
    refined: Path | str | None = None,
    preview: Path | str | None = None,
    checkpoint_every: float = CHECKPOINT_SECONDS,
    progress: Report | None = None,
    loading: Report | None = None,
    refining: Report | None = None,
    should_stop: Callable[[], bool] | None = None,
    device: torch.device | str = "cpu",
) -> Avatar:
    """Trains an avatar on the "train" frames of a collection, or of several people
    (`people.read_people`), and writes it to `out`.

    minutes: plan for this much time in the loop instead of `config.iterations`. A checkpoint is
    kept beside `out` while the work goes on, written anew every `checkpoint_every` seconds;
    `resume=True` continues from it. refined: where
    `config.refine_poses` is on, the folder for the collection with its track corrected. preview:
    a folder for pictures of how it is going (`.preview`). Raises Cancelled (the checkpoint stays)
    when `should_stop()`, InputError for bad input.

    Batches whose loss is far above the usual, or not finite, are not learned from. Where that goes
    on, or the weights are no longer finite, training goes back to its checkpoint and on from there
    with other batches; PavError where that does not help.
    """
    if not isinstance(collection, Collection | People):
        collection = read_collection(collection)
    if minutes is not None and not minutes > 0:
        raise InputError(f"--minutes {minutes}: above 0")
    out = Path(out)
    if out.suffix != ".pav":
        raise InputError(f"{out}: an avatar file ends in .pav")
    saved = checkpoint_path(out)
    if resume and not saved.is_file():
        raise InputError(f"{saved}: no checkpoint to resume from")
    config = config or Config()
    if refined is not None and not config.refine_poses:
        raise InputError(f"--refined-collection {refined}: goes with --refine-poses only")
    refining_of = _one_person(collection) if config.refine_poses else None
    if refined is not None and refining_of is not None:
        refined_writer(refining_of, refined, {})  # refuses now what it would refuse at the end
    frames = load_training_frames(collection, loading)
    source = fingerprint(collection)
    held = kept_out(refining_of, frames) if refining_of is not None else set()
    learned = [frame for frame in frames if frame.name not in held]
    avatar = new_avatar(collection, frames, config)
    trainer = Trainer(avatar, learned, minutes=minutes, device=device)
    refiner = None
    if refining_of is not None:
        refiner = trainer.refiner = Refiner(refining_of, frames, held, trainer)
    if resume:
        load_checkpoint(saved, trainer, source)
    shown = None if preview is None else Preview(preview, collection, trainer)
    last_saved, returns, lost = time.monotonic(), 0, False
    while trainer.done < 1 or not trainer.sound():
        if lost or trainer.watch.astray or trainer.done >= 1:
            returns, lost = returns + 1, False
            go_back(saved, trainer, source, returns)
            continue
        with torch_alone():
            status = trainer.iterate()
        if progress:
            progress(
                trainer.done,
                iteration=status.iteration,
                loss=round(status.loss, 4),
                psnr=round(status.psnr, 2),
                samples_per_ray=round(status.samples_per_ray, 1),
            )
        if shown is not None:
            shown(status, last=trainer.done >= 1)
        stopping = should_stop is not None and should_stop()
        if stopping or time.monotonic() - last_saved >= checkpoint_every:
            lost = not save_checkpoint(saved, trainer, source)
            if shown is not None:
                shown.keep_curve()
            last_saved = time.monotonic()
        if stopping and not saved.is_file():
            raise Cancelled("training was stopped when it had gone astray: nothing was kept")
        if stopping:
            raise Cancelled(f"training was stopped; `--resume` goes on from {saved}")
    if refined is not None and refiner is not None:
        save_checkpoint(saved, trainer, source)
        correct_collection(refiner, progress=refining, should_stop=should_stop)
        write_refined(refiner, refined)
    avatar.field.cpu()
    if refiner is not None:
        avatar.record["refinement"] = refiner.record()
    avatar.record |= {
        "iterations": trainer.status.iteration,
        "seconds": round(trainer.status.seconds, 1),
        "batch_psnr": round(trainer.status.psnr, 2),
        **({} if shown is None or resume else {"preview_seconds": round(shown.seconds, 1)}),
        "collection": source,
        **({"skipped_batches": trainer.watch.skipped} if trainer.watch.skipped else {}),
        **({"returns": returns} if returns else {}),
    }
    avatar.save(out)
    saved.unlink(missing_ok=True)
    return avatar


def _one_person(collection: Collection | People) -> Collection:
    """The collection to refine the track of; InputError for several people."""
    if isinstance(collection, People):
        raise InputError(
            "--refine-poses takes one person: first refine each one's collection by itself, with "
            "--refined-collection, then train on what that wrote"
        )
    return collection


def fingerprint(collection: Collection | People) -> str:
    """Short hash of what a training reads: tracks, splits and the pictures' names."""
    if isinstance(collection, People):
        own = ((name, fingerprint(c)) for name, c in collection.collections.items())
        return hashlib.sha256(repr([*own]).encode()).hexdigest()[:16]
    digest = hashlib.sha256(collection.head.fingerprint.encode())
    digest.update(collection.betas.tobytes())
    for clip in collection.clips:
        digest.update(f"{clip.name}/{clip.appearance}/{clip.width}x{clip.height}".encode())
        for array in (clip.expression, clip.pose, clip.translation, clip.frame_id, clip.split):
            digest.update(array.tobytes())
    return digest.hexdigest()[:16]
