"""Tables as CSV files, and the lines that put the paper's figure beside ours."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

Cell: TypeAlias = str | int | float | None


@dataclass(frozen=True)
class Table:
    """A table. name: of its CSV file, without the ending; columns: names with units; rows: as many cells each."""

    name: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[Cell, ...]]

    def write(self, folder: Path) -> None:
        """Write it as CSV; a number that does not exist is empty."""
        with (folder / f"{self.name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(self.columns)
            for row in self.rows:
                writer.writerow(f"{cell:.6g}" if isinstance(cell, float) else cell for cell in row)

    def markdown(self) -> str:
        """The table in Markdown, numbers with three digits."""
        return markdown_table(self.columns, [[_shown(cell) for cell in row] for row in self.rows])


@dataclass(frozen=True)
class Comparison:
    """One figure of the paper beside ours. holds: whether ours is as the paper's or better; None where neither."""

    what: str
    paper: str
    ours: str
    holds: bool | None = None

    @property
    def verdict(self) -> str:
        """One word for the table."""
        return {True: "yes", False: "**no**", None: ""}[self.holds]


@dataclass(frozen=True)
class Section:
    """A part of the report. text: Markdown; figures: (file name, caption)."""

    title: str
    text: str
    comparisons: Sequence[Comparison] = ()
    tables: Sequence[Table] = ()
    shown: Sequence[Table] = ()
    figures: Sequence[tuple[str, str]] = field(default=())


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _shown(cell: Cell) -> str:
    if cell is None:
        return ""
    return f"{cell:.3g}" if isinstance(cell, float) else str(cell)
