"""`pav bench studio`: how exact the studio's own pictures are.

Cycles takes few samples a pixel and takes their noise away; what is left differs from the picture
that many samples converge to. No avatar can agree with noise, so this bounds every PSNR that is
measured on studio pictures.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import numpy as np

from ..core.evaluation.heldout import BACKGROUND, head_mask
from ..core.evaluation.metrics import over, psnr
from ..core.evaluation.report import Claim
from ..core.head import builtin_head
from ..core.progress import Report
from .measure import Options, plot, show

_LOOKS, _FRAMES, _SIZE = 3, 60, 256
_SAMPLES = (16, 64)  # as `pav studio` takes by default, and `--samples 64`
_CONVERGED = 512
_TARGET = 32.0  # what avatars are meant to reach on these pictures


def run(options: Options, progress: Report | None) -> tuple[dict[str, Any], list[Claim]]:
    """Films one held-out pose of each look several times over; writes studio.svg."""
    rows = []
    for done, row in enumerate(_measured()):
        rows.append(row)
        if progress:
            progress((done + 1) / (_LOOKS * len(_SAMPLES)), look=row["look"])
    show(rows)
    plot(
        options.out / "studio.svg",
        lambda axes: _lines(axes, rows),
        f"Studio pictures against {_CONVERGED} samples a pixel",
        "seconds a picture",
        "PSNR over the head, dB",
    )
    usual = [row["head_psnr"] for row in rows if row["samples"] == _SAMPLES[0]]
    claim = Claim.at_least(
        "studio pictures to converged ones, over the head", float(np.mean(usual)), _TARGET, "dB"
    )
    return {"converged_samples": _CONVERGED, "rows": rows}, [claim]


def _measured() -> Iterator[dict[str, Any]]:
    # Blender is there or not: only this benchmark and the studio need it
    from ..studio.appearances import APPEARANCES
    from ..studio.identity import identity
    from ..studio.person import build_person
    from ..studio.render import filming, plan

    head = builtin_head()
    person = build_person(head, identity(head, 0))
    for look in APPEARANCES[:_LOOKS]:
        shots = [s for s in plan(person, look, _FRAMES, _SIZE, (0, 0)) if s.split == "test"]
        shot = shots[len(shots) // 2]
        with filming(person, look, _SIZE, 0) as take:
            truth = take(shot, _CONVERGED).rgba
            for samples in _SAMPLES:
                started = time.perf_counter()
                rgba = take(shot, samples).rgba
                seconds = time.perf_counter() - started
                shown, wanted = over(rgba / 255, BACKGROUND), over(truth / 255, BACKGROUND)
                yield {
                    "look": look.name,
                    "samples": samples,
                    "seconds": seconds,
                    "head_psnr": psnr(shown, wanted, head_mask(truth)),
                    "psnr": psnr(shown, wanted),
                }


def _lines(axes: Any, rows: list[dict[str, Any]]) -> None:
    for look in dict.fromkeys(row["look"] for row in rows):
        own = [row for row in rows if row["look"] == look]
        seconds, decibels = ([row[key] for row in own] for key in ("seconds", "head_psnr"))
        axes.plot(seconds, decibels, "o-", label=look)
    axes.legend()
