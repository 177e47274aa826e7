"""Two implementations of one interface: `reference` (plain torch, any device) and `cpu` (numba).

Both folders hold the same file names (`MODULES`) with the same functions. Code that computes asks
for one of them and never names it:

>>> from pav_blender.core.kernels import select
>>> kernels = select("cpu")
>>> kernels.nearest.nearest  # doctest: +SKIP
"""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from types import ModuleType
from typing import Any

_plain = False

MODULES = (
    *("frames", "nearest", "encoding", "mlp", "marching", "bricks", "picking", "optimiser"),
    *("solids", "sparing"),
)


def select(device: Any = "cpu", *, reference: bool = False) -> ModuleType:
    """The kernels for a device, as a module whose attributes are the names in `MODULES`.

    `device` is what torch accepts ("cpu", "cuda:0", a `torch.device`). Everything but the CPU runs
    the reference; `reference=True` asks for it on the CPU too. numba is imported only when the
    compiled kernels are chosen, and each submodule only when it is first touched.
    """
    compiled = str(device).split(":")[0] == "cpu" and not (reference or _plain)
    return importlib.import_module(f"{__name__}.{'cpu' if compiled else 'reference'}")


@contextlib.contextmanager
def plain_torch() -> Iterator[None]:
    """Within it every choice is the reference: for measuring what the compiled kernels are worth.

    What was made outside for the compiled kernels (a posed mesh) does not fit.
    """
    global _plain
    _plain = True
    try:
        yield
    finally:
        _plain = False
