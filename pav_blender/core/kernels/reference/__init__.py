"""Kernels in plain torch: dense, simple, on any device. The oracle of the compiled ones."""

from __future__ import annotations

import importlib
from typing import Any

from .. import MODULES


def __getattr__(name: str) -> Any:
    if name in MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
