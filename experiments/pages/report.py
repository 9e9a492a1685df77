"""HTML pages from the templates of `pages/templates`, each one self-contained file."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from markupsafe import Markup

from trackwright.experiments.text.tables import Section
from trackwright.trackers.recordings.files import atomic_write

SOURCES = Path(__file__).parent / "templates"  # of styles and scripts, too, which are no templates


def report_page(
    kind: str, title: str, summary: Sequence[str], sections: Sequence[Section], commands: Sequence[str],
    warnings: Sequence[str] = (),
) -> str:  # fmt: skip
    """A report: a `summary` in paragraphs, warnings, sections, without those that are empty, and commands as typed."""
    shown = [section for section in sections if section.rows or any(section.parts)]
    moving = any(isinstance(part, list) and part for section in shown for part in section.parts)
    told = {"summary": [*filter(None, summary)], "warnings": warnings, "commands": commands}
    return page("report.html", kind=kind, title=title, sections=shown, moving=moving, **told)


def page(template: str, **content: Any) -> str:
    """The page of a template; all text is escaped."""
    # It takes a while to import, which a run without a page need not wait for.
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("trackwright.experiments.pages"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    made.filters |= {"cell": _cell, "json": _script_json}
    made.globals |= {
        "plotting_script": _plotting_script,
        "source": lambda name: Markup((SOURCES / name).read_text("utf-8")),
    }
    return made.get_template(template).render(**content)


def _cell(text: str) -> str:
    """A table cell's text with true minus signs."""
    return re.sub(r"(?<![\w.-])-(?=\d)", "\u2212", text)


def _plotting_script() -> Markup:
    """The source of plotly.js in the installed package `plotly`, which takes half a second to import and is not."""
    spec = find_spec("plotly")
    assert spec is not None
    assert spec.origin is not None
    return Markup((Path(spec.origin).parent / "package_data" / "plotly.min.js").read_text(encoding="utf-8"))


def _script_json(content: Any) -> Markup:
    """The content as JSON for a `<script type="application/json">`, which a `</script>` in a text does not end."""
    text = json.dumps(content, allow_nan=False, separators=(",", ":"), ensure_ascii=False)
    return Markup(text.replace("<", "\\u003c"))


def typed(command: Sequence[str]) -> str:
    """The arguments of a program, the first one its path, as a user types them."""
    return shlex.join(["trackwright", *command[1:]])


def write_page(path: Path | str, text: str) -> Path:
    """Writes the page whole or not at all; returns the path. Raises UnusableInput where it can't be written."""
    return atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
