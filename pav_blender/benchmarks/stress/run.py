"""Runs scenes in processes of their own, so that one that ends its process is one line more."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ...core.errors import InputError
from ...core.evaluation.report import Claim
from ...core.progress import Report
from . import SCENES

MOST_GB = 3.0  # of any scene's process
_MOST_S = 300.0  # of a scene


def chosen(names: Sequence[str] | None) -> list[str]:
    """The scenes whose names hold one of `names`; all for None. InputError where one finds none."""
    if not names:
        return list(SCENES)
    for part in names:
        if not any(part in name for name in SCENES):
            raise InputError(f"--only {part!r}: no such scene; there are {', '.join(SCENES)}")
    return [name for name in SCENES if any(part in name for part in names)]


def run(
    folder: Path, names: Sequence[str] | None = None, progress: Report | None = None
) -> tuple[dict[str, Any], list[Claim]]:
    """Rows of all chosen scenes and their claims, each named after its scene."""
    wanted = chosen(names)
    rows: list[dict[str, Any]] = []
    alone = [[name] for name in wanted if SCENES[name].alone]
    for group in [[name for name in wanted if not SCENES[name].alone], *alone]:
        for row in _rows(folder, group):
            rows.append(row)
            if progress:
                progress(len(rows) / len(wanted), scene=row["scene"])
    claims = []
    for row in rows:
        claims.append(
            Claim.at_most(f"{row['scene']}: failures", int(row["failed"] is not None), 0, "")
        )
        claims += [
            Claim(**{**claim, "name": f"{row['scene']}: {claim['name']}"})
            for claim in row["claims"]
        ]
        if SCENES[row["scene"]].alone:
            claims.append(Claim.at_most(f"{row['scene']}: memory", row["peak_gb"], MOST_GB, "GB"))
    most = max((row["peak_gb"] for row in rows), default=0.0)
    claims.append(Claim.at_most("greatest memory of all", most, MOST_GB, "GB"))
    return {"scenes": rows}, claims


def _rows(folder: Path, names: list[str]) -> Iterator[dict[str, Any]]:
    """What children print; one that ends before its time fails the scene it was at, and another
    goes on after that."""
    while names:
        command = [sys.executable, "-m", f"{__package__}.child", str(folder), *names]
        path = [str(Path(__file__).parents[3]), os.environ.get("PYTHONPATH", "")]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, path))}
        child = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        assert child.stdout is not None
        watch = _watch(child)
        for line in child.stdout:
            watch.cancel()
            yield json.loads(line)
            names = names[1:]
            watch = _watch(child)
        watch.cancel()
        code = child.wait()
        if names:
            why = signal.Signals(-code).name if code < 0 else f"code {code}"
            failed = f"its process ended: {why}"
            yield {"scene": names[0], "failed": failed, "claims": [], "seen": {}, "peak_gb": 0.0}
            names = names[1:]


def _watch(child: subprocess.Popen[str]) -> threading.Timer:
    timer = threading.Timer(_MOST_S, child.kill)
    timer.daemon = True
    timer.start()
    return timer
