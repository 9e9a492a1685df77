"""HTML pages from the templates of `pages/templates`, each one self-contained file, and the data inside them."""

from __future__ import annotations

import base64
import json
import re
import shlex
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from trackwright.experiments.text.tables import Section
from trackwright.trackers.recordings.atomic import atomic_write

if TYPE_CHECKING:
    from jinja2 import Environment


def page(template: str, **content: Any) -> str:
    """The page of a template; all text is escaped."""
    return _environment().get_template(template).render(**content)


def report_page(
    kind: str,
    title: str,
    summary: Sequence[str],
    sections: Sequence[Section],
    commands: Sequence[str],
    foot: str = "",
    warnings: Sequence[str] = (),
) -> str:
    """A report: a `summary` in paragraphs, warnings, sections, without those that are empty, and commands as typed."""
    shown = [section for section in sections if section.rows or any(section.parts)]
    moving = any(isinstance(part, list) and part for section in shown for part in section.parts)
    told = {"summary": [*filter(None, summary)], "warnings": warnings, "commands": commands, "foot": foot}
    return page("report.html", kind=kind, title=title, sections=shown, moving=moving, **told)


def typed(command: Sequence[str]) -> str:
    """The arguments of a program, the first one its path, as a user types them."""
    return shlex.join(["trackwright", *command[1:]])


def write_page(path: Path | str, text: str) -> Path:
    """Writes the page whole or not at all; returns the path. Raises UnusableInput where it can't be written."""
    return atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _cell(text: str) -> str | Markup:
    """A table cell's text with true minus signs; its interval is kept on one line, and markup as it is."""
    if isinstance(text, Markup):
        return text
    text = re.sub(r"(?<![\w.-])-(?=\d)", "\u2212", text)
    match = re.fullmatch(r"(\S+) (\(\S+ … \S+\))", text)
    return text if match is None else Markup('{} <span class="interval">{}</span>').format(*match.groups())


def _environment() -> Environment:
    # It takes a while to import, which a run without a page need not wait for.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("trackwright.experiments.pages"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    made.filters["cell"] = _cell
    made.filters["json"] = lambda content: Markup(script_json(content))
    made.globals["plotting_script"] = _plotting_script
    return made


def _plotting_script() -> Markup:
    """The source of plotly.js in the installed package `plotly`, which takes half a second to import and is not."""
    spec = find_spec("plotly")
    assert spec is not None
    assert spec.origin is not None
    return Markup((Path(spec.origin).parent / "package_data" / "plotly.min.js").read_text(encoding="utf-8"))


def packed(values: np.ndarray, kind: str = "f4") -> dict[str, str]:
    """An array (n,) as plotly.js takes typed arrays: its kind, as `f4`, and its bytes in base64."""
    with np.errstate(over="ignore", invalid="ignore"):
        array = np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<"))
    return {"dtype": kind, "bdata": base64.b64encode(array.tobytes()).decode("ascii")}


def script_json(content: Any) -> str:
    """The content as JSON for a `<script type="application/json">`, which a `</script>` in a text does not end."""
    return json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False).replace("<", "\\u003c")


def drawn_tracks(worst_first: list[int], most: int) -> list[int]:
    """The numbers of the tracks that are drawn, ascending: all, or evenly over the ranks from the worst to the best."""
    if len(worst_first) <= most:
        return sorted(worst_first)
    return sorted({worst_first[k] for k in np.linspace(0, len(worst_first) - 1, most).round().astype(int)})


def drawn_rows(lengths: np.ndarray, weight: np.ndarray, most: int) -> np.ndarray:
    """The rows that are drawn, ascending: all, or the first, the last and those with the largest weight of each block.

    Blocks of equal length; `lengths` (g,): rows of each track; `weight` (n,): the size of the error, NaN as zero. About
    `most` rows, two of each block at least.
    """
    n = int(lengths.sum())
    if n <= most:
        return np.arange(n)
    size = -(-2 * n // max(most - 2 * len(lengths), 2))
    first = np.cumsum(lengths) - lengths
    within = np.arange(n) - np.repeat(first, lengths)
    begins = np.flatnonzero(within % size == 0)
    block = np.repeat(np.arange(len(begins)), np.diff(np.append(begins, n)))
    order = np.lexsort((-np.nan_to_num(weight), block))
    return np.unique(np.concatenate([begins, order[begins], first + lengths - 1]))
