"""Who may use the processor: what the user waits for goes before what refines a picture."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

changed = threading.Condition()
_before = 0


def wanted() -> bool:
    """True while something goes before; what refines a picture should stop then."""
    return _before > 0


@contextlib.contextmanager
def first() -> Iterator[None]:
    """The block goes before all refining, which waits until it is over."""
    global _before
    with changed:
        _before += 1
    try:
        yield
    finally:
        with changed:
            _before -= 1
            changed.notify_all()
