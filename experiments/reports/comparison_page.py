"""The page and the table of a comparison of two runs."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from html import escape
from pathlib import Path

from rich import box
from rich.table import Table

from experiments.cli.console import output_folder, rendered
from experiments.reports.comparison import Pair
from experiments.reports.html_page import document, section
from experiments.reports.study import EXTRA, table
from experiments.reports.wording import heading, units_of, with_interval
from trackers.recordings.atomic import atomic_write

SHOWN = (
    "rmse_m", "median_m", "p95_m", "rmse_3d_m", "p95_3d_m", "rmse_direction_rad", "nees_mean", "coverage_95",
    "nis_ratio", "lost_fraction", "diverged",
)  # fmt: skip
HEAD = ("", "figure", "first", "second", "second / first", "differ?")


def rows(found: Sequence[Pair]) -> list[list[str]]:
    """The cells of the table."""
    values: dict[str, list[float]] = {}
    for pair in found:
        values.setdefault(pair.figure, []).extend([pair.before.value, pair.after.value])
    units, made = units_of(values), []
    for pair in found:
        unit = units[pair.figure]
        name = heading(pair.figure) + (f", {unit.name}" if unit.name else "")
        differs = "" if pair.differs is None else "yes" if pair.differs else "no"
        both = (with_interval(pair.before, unit), with_interval(pair.after, unit))
        made.append([pair.whose, name, *both, f"{pair.ratio:.3f}" if math.isfinite(pair.ratio) else "–", differs])
    return made


def comparison_text(runs: Sequence[Path], found: Sequence[Pair]) -> str:
    """The figures side by side on a terminal."""
    shown = Table(title=f"first: {runs[0]}, second: {runs[1]}", title_justify="left", box=box.SIMPLE_HEAD)
    for k, name in enumerate(HEAD):
        shown.add_column(name, justify="left" if k < 2 else "right")
    for row in rows(found):
        shown.add_row(*row)
    return rendered(150, shown)


def write_comparison(path: Path, runs: Sequence[Path], found: Sequence[Pair], command: Sequence[str]) -> Path:
    """The page's path, written whole or not at all; raises UnusableInput where it can't be."""
    output_folder(path.parent)
    names = f"{runs[0]} and {runs[1]}"
    known = any(p.differs is not None for p in found)
    lead = "In brackets 95 % intervals." if known else "An evaluation of recordings has no intervals."
    content = table(HEAD, rows(found), ["", "text", "", "after", "", ""])
    again = f"<p><code>{escape(shlex.join(['trackwright', *command[1:]]))}</code></p>"
    body = section("figures", "Figures", lead, content) + section("again", "Again", "", again)
    text = document("comparison", names, "", body, EXTRA)
    return atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
