"""`pav bench accuracy`: how wrong pictures, gradients and files are, each against a bound.

Bounds stand in the modules, each with where it comes from.
"""

from __future__ import annotations

from typing import Any

from ...core.evaluation.report import Claim
from ...core.progress import Report
from ..measure import Options, a_frame, plot, show, subject
from . import approximations, determinism, gradients, quadrature, rounding, steps, storage


def run(options: Options, progress: Report | None = None) -> tuple[dict[str, Any], list[Claim]]:
    """Measures; prints a table a question; writes accuracy*.svg."""
    avatar, collection = subject(options, progress)
    frame = a_frame(collection)
    fields: dict[str, Any] = {}
    claims: list[Claim] = []

    def keep(name: str, title: str, found: tuple[Any, list[Claim]]) -> None:
        rows, claimed = found
        fields[name] = rows
        claims.extend(claimed)
        print(f"\n{title}", flush=True)
        for table in rows.values() if isinstance(rows, dict) else (rows,):
            show({k: v for k, v in row.items() if k != "errors"} for row in table)

    keep("media", "Media whose integral is known: error against step", quadrature.measure())
    keep("steps", "Pictures: error against step and time", steps.measure(avatar, frame))
    found = approximations.measure(avatar, frame, options.repeats)
    keep("approximations", "Each approximation switched on alone", found)
    keep("rounding", "Pieces of a sample in float32", rounding.measure(avatar, frame))
    keep("gradients", "Gradients, float32 against float64", gradients.measure(avatar, frame))
    found = determinism.measure(avatar, frame, collection)
    keep("determinism", "Run twice", found)
    keep("storage", "Files", storage.measure(avatar, collection))
    order = steps.fitted(fields["steps"])
    print(f"\norder of pictures, 2 mm and finer: {order:.2f}")
    fields["picture_order"] = order
    _plots(options, fields)
    return fields, claims


def _plots(options: Options, fields: dict[str, Any]) -> None:
    name = "accuracy{}.svg".format
    error = "root mean square error, of 1"
    media, pictures = fields["media"], fields["steps"]
    plot(
        options.out / name(""),
        lambda axes: steps.draw(axes, pictures, "us_a_ray"),
        "Pictures: error against time",
        "microseconds a ray",
        error,
    )
    plot(
        options.out / name("_step"),
        lambda axes: steps.draw(axes, pictures, "step_mm"),
        "Pictures: error against step",
        "millimetres",
        error,
    )
    plot(
        options.out / name("_media"),
        lambda axes: quadrature.draw(axes, media),
        "A medium of linear density: error against step, by the place of the sample",
        "millimetres",
        "largest error, of 1",
    )
