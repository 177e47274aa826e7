"""Where a field's networks run. Rays and meshes stay with the CPU's compiled kernels everywhere."""

from __future__ import annotations

import torch

from .errors import InputError

KINDS = ("cpu", "cuda", "mps")


def device_of(name: str) -> torch.device:
    """The device of a name such as "cpu", "cuda", "cuda:1" or "mps"; InputError where torch has no
    such device here."""
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"--device {name}: one of {', '.join(KINDS)}") from error
    if device.type not in KINDS:
        raise InputError(f"--device {name}: one of {', '.join(KINDS)}")
    counts = {
        "cpu": 1,
        "cuda": torch.cuda.device_count(),
        "mps": int(torch.backends.mps.is_available()),
    }
    if (device.index or 0) >= counts[device.type]:
        raise InputError(f"--device {name}: torch finds no such device here; use --device cpu")
    return device
