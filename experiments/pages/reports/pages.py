"""HTML pages from the templates of `pages/templates`: each one self-contained file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from trackwright.experiments.pages.reports.packing import plotting_script
from trackwright.experiments.text.wording import duration, number
from trackwright.trackers.core.errors import listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.recordings.atomic import atomic_write

CHART = '<img src="data:image/svg+xml;base64,'
"""How an image of a chart begins in a page."""

WIDE = 132
"""Characters a line of a table from which intervals are put below their values instead of beside them."""


def page(template: str, **content: Any) -> str:
    """The page of a template; all text is escaped. Its charts can be zoomed and moved, and show their numbers."""
    environment = _environment()
    text = environment.get_template(template).render(**content)
    if CHART not in text:
        return text
    scripts = environment.get_template("moving.html").render()
    before, end, after = text.rpartition("</body>")
    return before + scripts + end + after


def write_page(path: Path | str, text: str) -> Path:
    """Writes the page whole or not at all; returns the path. Raises UnusableInput where it can't be written."""
    return atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _cell(text: str) -> str | Markup:
    """A table cell's text with true minus signs; its interval is kept on one line."""
    text = re.sub(r"(?<![\w.-])-(?=\d)", "\u2212", text)
    match = re.fullmatch(r"(\S+) (\(\S+ … \S+\))", text)
    return text if match is None else Markup('{} <span class="interval">{}</span>').format(*match.groups())


def _is_wide(rows: Sequence[Sequence[str]]) -> bool:
    return sum(max(map(len, column)) + 3 for column in zip(*rows, strict=True)) > WIDE


def _thousands(count: int) -> str:
    return f"{count:,}".replace(",", "\u202f")


def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("trackwright.experiments.pages"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    made.filters |= {"cell": _cell, "is_wide": _is_wide, "thousands": _thousands, "number": number, "listed": listed,
                     "counted": counted, "duration": duration}  # fmt: skip
    made.globals["plotting_script"] = lambda: Markup(plotting_script())
    return made
