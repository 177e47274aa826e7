"""The most memory that this process ever held; imports nothing that would hold some itself."""

from __future__ import annotations

import sys
from pathlib import Path


def peak_bytes() -> int:
    """Bytes of this process alone, without what its parent held before it began."""
    import resource  # not on Windows

    # Linux counts what the parent held before the process began as the child's own in `getrusage`
    status = Path("/proc/self/status")
    if status.is_file():
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines())
        return int(lines["VmHWM"].split()[0]) * 1024
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most * (1 if sys.platform == "darwin" else 1024)
