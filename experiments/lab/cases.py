"""Tables of results on a terminal and a page, with machine and versions."""

from __future__ import annotations

import os
import platform
import re
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from trackwright.experiments.text.tables import aligned, markdown
from trackwright.trackers.core.errors import UnusableInput

PACKAGES = (
    "trackwright", "jax", "jaxlib", "numpy", "polars", "distributed", "dynamax", "cuthbert", "filterpy", "particles",
    "gtsam", "stonesoup",
)  # fmt: skip
"""Packages whose versions are written down where they are installed."""

NUMBER = re.compile(r"(\*\*)?[-+−–]?\d|$")
"""How the cell of a column of numbers begins, bold or not."""

MARK = "\N{WORD JOINER}"
"""Stands for Markdown's mark of bold while columns are aligned; it has no width."""

Row = dict[str, Any]
"""A row of a table: values by the titles of their columns."""


def chosen(names: Sequence[str], known: Iterable[str], usual: Iterable[str] = ()) -> tuple[str, ...]:
    """The names, the `usual` or all known ones where there is none; raises UnusableInput for one that is unknown."""
    all_names = tuple(known)
    for name in names:
        if name not in all_names:
            raise UnusableInput(f"'{name}': unknown; expected some of {', '.join(all_names)}")
    return tuple(names) or tuple(usual) or all_names


def machine() -> Row:
    """The processor and its load."""
    lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines() if Path("/proc/cpuinfo").exists() else []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "load_average": os.getloadavg(),
    }


def packages() -> dict[str, str]:
    """The versions of `PACKAGES`, of those that are installed."""
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


class Table(NamedTuple):
    """Rows of one table, with a title, and a line or more below it."""

    rows: Sequence[Row]
    title: str = ""
    note: str = ""


def as_text(table: Table) -> str:
    """A table with its title and its note, for a terminal, which has bold as a page has; a pipe has none."""
    marked = [[text.replace("**", MARK) for text in row] for row in cells(table.rows)]
    lines = filter(None, [table.title, aligned(marked, numeric(table.rows)), table.note])
    bold = "\x1b[1m\\1\x1b[0m" if sys.stdout.isatty() else r"\1"
    return re.sub(f"{MARK}(.*?){MARK}", bold, "\n".join(lines).replace("**", MARK))


def as_page(heading: str, tables: Sequence[Table]) -> str:
    """The Markdown of tables below a heading, for `replace_tables`."""
    parts = [
        [f"### {t.title}" if t.title else "", markdown(cells(t.rows), numeric(t.rows)).strip(), t.note] for t in tables
    ]
    return "\n\n".join(filter(None, [heading, *(part for table in parts for part in table)])) + "\n"


def cell(value: Any) -> str:
    """A number or a text of a table; nothing for None."""
    if not isinstance(value, float):
        return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value).replace("|", "/")
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def cells(rows: Sequence[Row]) -> list[list[str]]:
    """The titles of the columns and the texts of the rows; a row may lack columns."""
    titles = list(dict.fromkeys(title for row in rows for title in row))
    return [titles, *([cell(row.get(title)) for title in titles] for row in rows)]


def numeric(rows: Sequence[Row]) -> list[int]:
    """The columns of numbers, as they are or as text."""
    return [k for k, column in enumerate(zip(*cells(rows)[1:], strict=True)) if all(map(NUMBER.match, column))]
