"""Tables of means and spreads, as Markdown and LaTeX."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Column:
    """higher_is_better None: neither is."""

    key: str
    title: str
    higher_is_better: bool | None
    digits: int = 2


@dataclass(frozen=True)
class Cell:
    """Values of several runs, or a word where there are none."""

    values: tuple[float, ...] = ()
    word: str = ""

    @property
    def mean(self) -> float:
        return float(np.mean(self.values)) if self.values else math.nan

    @property
    def spread(self) -> float:
        """Standard deviation of one run; nan for a single one."""
        return float(np.std(self.values, ddof=1)) if len(self.values) > 1 else math.nan

    def text(self, digits: int, plus_minus: str) -> str:
        if not self.values:
            return self.word
        spread = "" if math.isnan(self.spread) else f"{plus_minus}{self.spread:.{digits}f}"
        return f"{self.mean:.{digits}f}{spread}"


@dataclass
class Table:
    """rows: (title, cells by the columns' keys); sections: row number -> line above it."""

    name: str
    caption: str
    columns: Sequence[Column]
    rows: list[tuple[str, dict[str, Cell]]] = field(default_factory=list)
    sections: dict[int, str] = field(default_factory=dict)

    def best(self, column: Column) -> set[int]:
        """Rows that are best of their section, where the table shows no other."""
        found: set[int] = set()
        starts = sorted({0, *self.sections, len(self.rows)})
        for first, last in itertools.pairwise(starts):
            if column.higher_is_better is None or last - first < 2:
                continue
            shown = {}
            for row in range(first, last):
                mean = self.rows[row][1][column.key].mean
                if not math.isnan(mean):
                    shown[row] = round(mean, column.digits)
            if shown:
                best = (max if column.higher_is_better else min)(shown.values())
                found |= {row for row, value in shown.items() if value == best}
        return found


def markdown(table: Table) -> str:
    """GitHub's Markdown; the best of each column in bold."""
    lines = [f"| | {' | '.join(_title(c, ('↑', '↓')) for c in table.columns)} |"]
    lines.append("|---" * (len(table.columns) + 1) + "|")
    best = {column.key: table.best(column) for column in table.columns}
    for number, (title, cells) in enumerate(table.rows):
        if number in table.sections:
            lines.append(f"| **{table.sections[number]}** {'| ' * len(table.columns)}|")
        texts = []
        for column in table.columns:
            text = cells[column.key].text(column.digits, " ± ")
            texts.append(f"**{text}**" if number in best[column.key] else text)
        lines.append(f"| {title} | {' | '.join(texts)} |")
    return f"{table.caption}\n\n" + "\n".join(lines) + "\n"


def latex(table: Table) -> str:
    """A `table` environment; needs the booktabs package."""
    arrows = (r"\;$\uparrow$", r"\;$\downarrow$")
    columns = table.columns
    lines = [
        r"\begin{table}[t]",
        r"  \centering",
        rf"  \begin{{tabular}}{{l{'c' * len(columns)}}}",
        r"    \toprule",
        "    & " + " & ".join(_title(c, arrows) for c in columns) + r" \\",
        r"    \midrule",
    ]
    best = {column.key: table.best(column) for column in columns}
    for number, (title, cells) in enumerate(table.rows):
        if number in table.sections:
            above = [r"    \midrule"] if number else []
            section = rf"    \multicolumn{{{len(columns) + 1}}}{{c}}{{{table.sections[number]}}} \\"
            lines += [*above, section, r"    \midrule"]
        texts = []
        for column in columns:
            text = cells[column.key].text(column.digits, r"\,$\pm$\,")
            texts.append(rf"\textbf{{{text}}}" if number in best[column.key] else text)
        lines.append(f"    {title} & " + " & ".join(texts) + r" \\")
    lines += [
        r"    \bottomrule",
        r"  \end{tabular}",
        rf"  \caption{{{table.caption}}}",
        rf"  \label{{tab:{table.name}}}",
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"


def _title(column: Column, arrows: tuple[str, str]) -> str:
    if column.higher_is_better is None:
        return column.title
    return f"{column.title} {arrows[0 if column.higher_is_better else 1]}".replace(" \\", "\\")
