"""How many threads to use."""

from __future__ import annotations

import os


def threads() -> int:
    """`PAV_THREADS` if it is a positive number, else as many as the CPUs we may run on."""
    wanted = os.environ.get("PAV_THREADS", "")
    if wanted.isdigit() and int(wanted) > 0:
        return int(wanted)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
