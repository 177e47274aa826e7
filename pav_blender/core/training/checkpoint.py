"""Training that was interrupted, on disk: the avatar so far and what the optimiser knew."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import safetensors.torch
import torch

from ..config import Config
from ..errors import InputError, PavError
from ..field.avatar import read_metadata, read_tensors
from ..files import replacing
from .trainer import Status, Trainer

FORMAT = "pav-checkpoint"
_RETURNS = 3  # a training that goes astray more often than that does so whatever the batches are


def save_checkpoint(path: Path, trainer: Trainer, source: str) -> bool:
    """Writes the whole state of `trainer`; `source` says which data it was learning from.

    Of one that went astray nothing is written, and the checkpoint that is there stays: False.
    """
    if not trainer.sound():
        return False
    tensors: dict[str, torch.Tensor] = {
        f"field.{name}": value for name, value in trainer.avatar.field.state_dict().items()
    }
    for name, (m, v) in trainer.moments.items():
        tensors[f"m.{name}"], tensors[f"v.{name}"] = m, v
    tensors |= {f"seen.{name}": value for name, value in trainer.visibility.state().items()}
    tensors |= {f"drawn.{name}": value for name, value in trainer.attention.state().items()}
    refinement = None
    if trainer.refiner is not None:
        corrections, refinement = trainer.refiner.state()
        tensors |= {f"corrected.{name}": value for name, value in corrections.items()}
    tensors["generator"] = trainer.generator.get_state()
    header = {
        "format": FORMAT,
        "source": source,
        "config": trainer.config.to_json(),
        "minutes": trainer.minutes,
        "status": dataclasses.asdict(trainer.status),
        "pools": [[group, pool] for group, pool in trainer.pools.items()],
        "random": trainer.random.bit_generator.state,
        "refinement": refinement,
        "watch": trainer.watch.state(),
    }
    with replacing(path) as temporary:
        safetensors.torch.save_file(
            {k: v.contiguous() for k, v in tensors.items()},
            temporary,
            {"pav": json.dumps(header)},
        )
    return True


def go_back(path: Path, trainer: Trainer, source: str, times: int) -> None:
    """Puts a `trainer` that went astray where its last checkpoint left off, to go on with other
    batches; it is for the `times`-th time. Raises PavError where there is no way back."""
    status, skipped = trainer.status, trainer.watch.skipped
    where = f"training went astray at iteration {status.iteration} (loss {status.loss:.3g})"
    if not path.is_file():
        raise PavError(f"{where}, before there was a checkpoint: lower the learning rates")
    if times > _RETURNS:
        raise PavError(
            f"{where}, for the {times}th time: lower the learning rates, or look at the collection "
            f"with `pav check`; {path} is from before that"
        )
    trainer.visibility.spaces.clear()  # cells that were emptied since are filled again
    load_checkpoint(path, trainer, source)
    trainer.status.seconds = status.seconds
    trainer.watch.skipped = skipped
    trainer.other_batches(times)


def load_checkpoint(path: Path, trainer: Trainer, source: str) -> None:
    """Puts `trainer`, made from the same data and settings, where the checkpoint left off.

    Raises InputError where the file is damaged or was made from something else.
    """
    header = read_metadata(path)
    if header.get("format") != FORMAT:
        raise InputError(f"{path}: a damaged checkpoint; remove it to begin anew")
    if header.get("config") != trainer.config.to_json():
        raise InputError(f"{path}: made with other settings; remove it to begin anew")
    if header.get("source") != source:
        raise InputError(f"{path}: made from another collection; remove it to begin anew")
    try:
        tensors = read_tensors(path)
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and torch.isnan(tensor).any():
                raise ValueError(name)
        state = {k[6:]: v for k, v in tensors.items() if k.startswith("field.")}
        trainer.avatar.field.load_state_dict(state)
        for name, (m, v) in trainer.moments.items():
            put(m, tensors[f"m.{name}"])
            put(v, tensors[f"v.{name}"])
        trainer.visibility.restore(
            {name[5:]: value for name, value in tensors.items() if name.startswith("seen.")}
        )
        trainer.attention.restore(
            {name[6:]: value for name, value in tensors.items() if name.startswith("drawn.")}
        )
        trainer.generator.set_state(tensors["generator"])
        trainer.random.bit_generator.state = header["random"]
        trainer.pools = {int(group): list(pool) for group, pool in header["pools"]}
        trainer.status = Status(**header["status"])
        trainer.watch.restore(header.get("watch", {}))
        _check_status(trainer.status, trainer.config)
        if trainer.refiner is not None:
            named = {k[10:]: v for k, v in tensors.items() if k.startswith("corrected.")}
            trainer.refiner.restore(named, header["refinement"])
        trainer.check_restored()
    except (
        KeyError, IndexError, RuntimeError, ValueError, TypeError, AttributeError, OverflowError,
        InputError,
    ) as error:  # fmt: skip
        raise InputError(f"{path}: does not fit this training; remove it to begin anew") from error


def put(target: torch.Tensor, stored: torch.Tensor) -> None:
    """Copies into `target`; ValueError for another size, which copying alone would spread."""
    if target.shape != stored.shape:
        raise ValueError(f"{tuple(stored.shape)} in place of {tuple(target.shape)}")
    target.copy_(stored)


def _check_status(status: Status, config: Config) -> None:
    """ValueError, or TypeError, where training cannot have stood there."""
    counts = (
        (status.iteration, range(1 << 62)),
        (status.rays, range(1, config.rays + 1)),
        (status.pruned, range(status.iteration + 1)),
    )
    if any(type(number) is not int or number not in known for number, known in counts):
        raise ValueError("counts")
    amounts = status.seconds, status.samples_per_ray, status.filled
    if not (0 < status.step < 1 and all(0 <= amount < 1e9 for amount in amounts)):
        raise ValueError("amounts")
    if not isinstance(status.loss, float) or not isinstance(status.psnr, float):
        raise ValueError("loss")  # any number: of a batch that failed it is none
