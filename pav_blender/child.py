"""`python -m pav_blender.child VERB ...`: a verb that ends when its parent does.

The parent holds the other end of standard input. When that closes (because it wants the work to
end, or was killed) the verb gets a polite signal to stop, and has a while to save what it has.
`python -m pav_blender.child pip ...` runs pip in the same way.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading
import time

GRACE_S = 30.0
PACKAGES = "PAV_PACKAGES"  # folders to look for packages in after all others
PIP = "PAV_PIP"  # a packed pip, where none is installed


def _watch() -> None:
    while os.read(0, 4096):
        pass
    main_thread = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main_thread:  # wakes it even if it sleeps
        signal.pthread_kill(main_thread, signal.SIGTERM)
    else:
        signal.raise_signal(signal.SIGTERM)
    time.sleep(GRACE_S)
    os._exit(1)


if __name__ == "__main__":
    sys.path += [entry for entry in os.environ.get(PACKAGES, "").split(os.pathsep) if entry]
    threading.Thread(target=_watch, daemon=True).start()
    if sys.argv[1:2] == ["pip"]:
        del sys.argv[0]
        sys.path[:0] = [entry for entry in [os.environ.get(PIP, "")] if entry]
        runpy.run_module("pip", run_name="__main__", alter_sys=True)
    else:
        from .cli import main

        sys.exit(main(sys.argv[1:]))
