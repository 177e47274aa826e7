"""The paper's three tables out of results, and one of our own choices: which rows, which columns,
what must come out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from .evaluate import METRICS
from .methods import CHOICES, METHODS
from .report import Claim
from .study import Result
from .tables import Cell, Column, Table

Results = dict[str, list[Result]]  # a method's key -> a result for each seed

_DIGITS = {"ssim": 4, "st_lpips": 4, "lpips": 4, "dists": 4}
_QUALITY = tuple(
    Column(
        m.key,
        f"{m.name} ({m.unit})" if m.unit else m.name,
        m.higher_is_better,
        _DIGITS.get(m.key, 2),
    )
    for m in METRICS
)
_TITLES = {m.key: m.title for m in METHODS}
_SETS = {
    "test": "held-out frames",
    "view": "cameras that no clip used",
    "novel": "another performance",
}
_ABLATION = ("insta", "no_lnf", "no_offset", "surface", "full", "ours")
_UNIFIED = ("insta", "full", "ours", "ours_two")
_CHOICES = ("ours", *(m.key for m in CHOICES))
_SEPARATE = ("insta_clips", "full", "ours")


@dataclass(frozen=True)
class PaperTable:
    """needs: the methods of its rows; build: results -> tables and claims."""

    caption: str
    needs: tuple[str, ...]
    build: Callable[[Results, str], tuple[list[Table], list[Claim]]]


def quality(name: str, caption: str, results: Results, keys: tuple[str, ...], of: str) -> Table:
    """A row a method, a column a metric."""
    table = Table(name, caption, _QUALITY)
    for key in keys:
        if key in results:
            table.rows.append((_TITLES[key], _cells(results[key], of)))
    return table


def _cells(results: list[Result], of: str) -> dict[str, Cell]:
    return {column.key: _cell([r.measures[of][column.key] for r in results]) for column in _QUALITY}


def _cell(values: list[float | str]) -> Cell:
    numbers = tuple(v for v in values if not isinstance(v, str) and math.isfinite(v))
    words = [v for v in values if isinstance(v, str)]
    return Cell(numbers, words[0] if words else "none")


def _mean(results: Results, key: str, of: str, metric: str) -> float:
    return _cells(results[key], of)[metric].mean


def _above(results: Results, better: str, worse: str, of: str = "test") -> float:
    return _mean(results, better, of, "psnr") - _mean(results, worse, of, "psnr")


def _ablation(results: Results, caption: str) -> tuple[list[Table], list[Claim]]:
    sets = next(iter(results.values()))[0].measures
    tables = [
        quality(f"ablation_{of}", f"{caption}: {_SETS[of]}", results, _ABLATION, of) for of in sets
    ]
    claims = []
    for worse, least in (("insta", 4.0), ("no_lnf", 0.7), ("no_offset", 0.7)):
        gain = _above(results, "full", worse)
        claims.append(Claim.at_least(f"full above {_TITLES[worse]}", gain, least, "dB"))
    for column in _QUALITY:
        ours, full = (_mean(results, key, "test", column.key) for key in ("ours", "full"))
        if math.isfinite(ours) and math.isfinite(full):
            gain = ours - full if column.higher_is_better else full - ours
            name = f"ours better than full: {column.title}"
            claims.append(Claim.at_least(name, gain, 0.0, ""))
    head = _mean(results, "ours", "test", "head_psnr")
    claims.append(Claim.at_least("ours: head PSNR, held-out", head, 32.0, "dB"))
    return tables, claims


def _choices(results: Results, caption: str) -> tuple[list[Table], list[Claim]]:
    """What each choice of ours gives, on poses that no training saw."""
    sets = [of for of in ("test", "novel") if of in results["ours"][0].measures]
    tables = [
        quality(f"choices_{of}", f"{caption}: {_SETS[of]}", results, _CHOICES, of) for of in sets
    ]
    claims = [
        Claim.at_least(f"ours above {_TITLES[key]}", _above(results, "ours", key), 0.0, "dB")
        for key in _CHOICES[1:]
    ]
    return tables, claims


def _comparison(results: Results, caption: str) -> tuple[list[Table], list[Claim]]:
    table = quality("comparison", caption, results, _UNIFIED, "test")
    table.sections[0] = "(a) one network for all clips, held-out frames"
    claims = [
        Claim.at_least("ours above INSTA, unified", _above(results, "ours", "insta"), 4.0, "dB")
    ]
    for of in ("test", "novel"):
        if of not in results["insta_clips"][0].measures:
            continue
        table.sections[len(table.rows)] = f"(b) against a network a clip, {_SETS[of]}"
        table.rows += quality("", "", results, _SEPARATE, of).rows
        gain = _above(results, "ours", "insta_clips", of)
        claims.append(
            Claim.at_least(f"ours above five INSTA models, {_SETS[of]}", gain, -0.3, "dB")
        )
    return [table], claims


def _efficiency(results: Results, caption: str) -> tuple[list[Table], list[Claim]]:
    of = "novel" if "novel" in results["ours"][0].measures else "test"
    shown = [c for c in _QUALITY if c.key in ("psnr", "st_lpips", "fid")]
    columns = (
        Column("minutes", "training (min)", False),
        Column("parameters", "parameters (M)", False),
        Column("megabytes", "file (MB)", False, 1),
        *shown,
    )
    table = Table("efficiency", f"{caption}; quality on {_SETS[of]}", columns)
    for key in _SEPARATE:
        runs = results[key]
        cells = {
            "minutes": Cell(tuple(r.seconds / 60 for r in runs)),
            "parameters": Cell(tuple(r.parameters / 1e6 for r in runs)),
            "megabytes": Cell(tuple(r.bytes / 1e6 for r in runs)),
            **_cells(runs, of),
        }
        table.rows.append((_TITLES[key], cells))
    cells_of = {key: row[1] for key, row in zip(_SEPARATE, table.rows, strict=True)}

    def part(key: str) -> float:
        return cells_of["ours"][key].mean / cells_of["insta_clips"][key].mean

    claims = [
        Claim.at_most(
            "ours: training time of that of a network a clip", part("minutes"), 1 / 3, ""
        ),
        Claim.at_most("ours: size of that of a network a clip", part("megabytes"), 1 / 3, ""),
        Claim.at_most("ours: file", cells_of["ours"]["megabytes"].mean, 60.0, "MB"),
    ]
    return [table], claims


TABLES = {
    "ablation": PaperTable("Ablation", _ABLATION, _ablation),
    "comparison": PaperTable("Comparison", ("insta", "insta_clips", "full", "ours"), _comparison),
    "choices": PaperTable("Choices", _CHOICES, _choices),
    "efficiency": PaperTable("Efficiency", _SEPARATE, _efficiency),
}
