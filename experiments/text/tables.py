"""Tables as text, for a terminal and in Markdown."""

from __future__ import annotations

import io
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich import box
from rich.console import Console, RenderableType
from rich.table import Table

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.atomic import atomic_write

UNLIMITED = 100_000
"""Characters a line where a table is not to be wrapped."""


def terminal_width(elsewhere: int = 120) -> int:
    """Characters that a line of a table may have: the terminal's, or `elsewhere` where the output goes there."""
    return shutil.get_terminal_size((elsewhere, 24)).columns if sys.stdout.isatty() else elsewhere


def ruled_table(title: str, columns: Sequence[str], n_text: int = 1, rows: Iterable[Sequence[str]] = ()) -> Table:
    """A table with a title and a line under its head; all but the first `n_text` columns are aligned right."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for k, name in enumerate(columns):
        table.add_column(name, justify="left" if k < n_text else "right")
    for row in rows:
        table.add_row(*row)
    return table


class Section(NamedTuple):
    """A part of a report, for a terminal and a page: title, table and note; the first `n_text` columns are text.

    `looks`: classes of columns on a page by their heads, as in the template `parts.html`. `parts`: what follows on a
    page alone: texts, names with texts, tables as sections, and groups of charts.
    """

    title: str
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    n_text: int = 1
    note: str = ""
    looks: Mapping[str, str] = {}
    parts: Sequence[Any] = ()

    @property
    def classes(self) -> list[str]:
        """The classes of the columns on a page."""
        return [self.looks.get(name, "text" if 0 < k < self.n_text else "") for k, name in enumerate(self.head)]


def sections_text(sections: Sequence[Section], elsewhere: int, *lines: str) -> str:
    """The tables with rows and their notes, and more lines, for a terminal, or `elsewhere` characters wide."""
    parts: list[RenderableType] = []
    for one in sections:
        if one.rows:
            gap = [""] if parts and isinstance(parts[-1], str) else []
            parts += [*gap, ruled_table(one.title, one.head, one.n_text, one.rows), *([one.note] if one.note else [])]
    return rendered(terminal_width(elsewhere), *parts, *filter(None, lines))


def compact_table(title: str, labels: Sequence[str], numbers: Sequence[str]) -> Table:
    """A table with little space between its many columns: `labels`, aligned left, may be wrapped, `numbers` not."""
    table = Table(
        title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0),
        pad_edge=False, collapse_padding=True,
    )  # fmt: skip
    for name in labels:
        table.add_column(name, overflow="fold")
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows as lines with two spaces between columns, without a frame."""
    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0), pad_edge=False)
    for row in rows:
        table.add_row(*row)
    return rendered(UNLIMITED, table).rstrip("\n")


def markdown(rows: Sequence[Sequence[str]], numbers: Iterable[int] = ()) -> str:
    """Rows as a table in Markdown, the first one its head; columns `numbers` are aligned right."""
    right = set(numbers)
    rule = ["---:" if k in right else "---" for k in range(len(rows[0]))]
    return "".join(f"| {' | '.join(row)} |\n" for row in (rows[0], rule, *rows[1:]))


def replace_tables(page: Path, name: str, text: str) -> None:
    """Replace what a page has between the marks of the tables of this name."""
    begin, end = f"<!-- tables of {name} -->", "<!-- end of the tables -->"
    before, _, rest = page.read_text("utf-8").partition(begin)
    new = f"{before}{begin}\n\n{text}\n{end}{rest.partition(end)[2]}"
    atomic_write(page, lambda path: path.write_text(new, "utf-8"))


def require_page(page: Path) -> None:
    """Raises UnusableInput for a page that is none: before hours are spent on its tables."""
    if not page.is_file():
        raise UnusableInput(f"{page}: no such page; expected one with the marks of tables, as docs/performance.md")


def width_of(table: Table) -> int:
    """Characters a line of the table without wrapping."""
    return Console(width=UNLIMITED, markup=False, emoji=False).measure(table).maximum


def rendered(width: int, *parts: RenderableType) -> str:
    """Tables and lines as text of at most `width` characters a line, without trailing blanks."""
    page = io.StringIO()
    console = Console(file=page, width=width, highlight=False, markup=False, emoji=False)
    for part in parts:
        if isinstance(part, Table) and part.title:
            # The title of a narrow table may be wider than the table.
            console.print(part.title)
            part.title = None
        console.print(part)
    return "\n".join(line.rstrip() for line in page.getvalue().splitlines()) + "\n"
