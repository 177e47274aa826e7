"""`python -m ...child FOLDER NAME ...`: runs scenes and prints a line of JSON after each."""

from __future__ import annotations

import dataclasses
import json
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from ...core.errors import PavError
from ..peak import peak_bytes
from . import SCENES
from .scene import Given


def row_of(name: str, given: Given) -> dict[str, Any]:
    """What was seen in a scene; `failed`: an error that it ended in."""
    scene, started = SCENES[name], time.perf_counter()
    row: dict[str, Any] = {"scene": name, "failed": None, "claims": [], "seen": {}}
    row["what"] = " ".join((scene.run.__doc__ or "").split())
    try:
        found = scene.run(given)
        row["claims"] = [dataclasses.asdict(claim) for claim in found.claims]
        row["seen"] = found.raw
    except PavError as error:
        row["failed"] = str(error)
    except Exception:  # whatever it is belongs into the table
        row["failed"] = traceback.format_exc(limit=-3)
    row["seconds"] = round(time.perf_counter() - started, 2)
    return row


def main(folder: Path, names: list[str]) -> None:
    given = Given(folder)
    for name in names:
        row = row_of(name, given) | {"peak_gb": round(peak_bytes() / 1e9, 2)}
        print(json.dumps(row, default=float), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
