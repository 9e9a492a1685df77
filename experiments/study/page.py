"""A study's report: one HTML file with everything in it, for a desk, a phone and paper."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from experiments.html_page import document, section
from experiments.study.charts import SHOWN_CELLS, distribution_chart, figure_chart
from experiments.study.claims import Claim, Conclusion
from experiments.study.results import Results
from experiments.study.wording import Unit, heading, units_of, with_interval
from experiments.writing import atomic_write

REPORT = "report.html"
KINDS = {".svg": "image/svg+xml", ".png": "image/png"}
EXTRA = """
table.wide td:first-child { min-width: 11rem; }
td.no { color: var(--warn); font-weight: 700; }
td.text, th.text { text-align: left; white-space: normal; }
figure.own { grid-column: 1 / -1; max-width: 46rem; }
table.wide th { min-width: 5.2rem; }
"""


def write_page(
    folder: Path, results: Results, claims: Sequence[Claim | Conclusion], drawn: Sequence[str], command: Sequence[str]
) -> Path:
    """The report's path, written whole or not at all. `drawn`: pictures in the folder that go into it."""
    text = page(results, claims, [folder / name for name in drawn], command)
    return atomic_write(folder / REPORT, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def page(
    results: Results, claims: Sequence[Claim | Conclusion], pictures: Sequence[Path], command: Sequence[str]
) -> str:
    """The report as HTML."""
    study = results.study
    title = study.name.replace("-", " ").capitalize()
    parts = [_claims(claims), _conclusions(claims), _own(pictures), _figures(results), _differences(results)]
    parts += [_charts(results), _asked(results, command)]
    return document("study", title, f'<p class="verdict">{escape(study.about)}</p>', "".join(parts), EXTRA)


def table(head: Sequence[str], rows: Sequence[Sequence[str]], kinds: Sequence[str] = ()) -> str:
    """A table whose first column names the rows; `kinds`: a class for the cells of each column."""
    kinds = kinds or [""] * len(head)
    top = "".join(f'<th class="{kind}">{escape(h)}</th>' for h, kind in zip(head, kinds, strict=True))
    body = "".join(
        "<tr>"
        + "".join(
            f'<td class="{kind}" data-label="{escape(h)}">{escape(text)}</td>'
            for h, kind, text in zip(head, kinds, row, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table class="wide"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _claims(claims: Sequence[Claim | Conclusion]) -> str:
    own = [c for c in claims if isinstance(c, Claim)]
    rows = []
    for c in own:
        reached = "" if c.reached is None else "yes" if c.reached else "no"
        kind = "fitted" if c.fitted else "predicted"
        rows.append(
            [c.figure, f"{c.printed:g} {c.unit}", with_interval(c.ours, Unit(c.unit, 1.0)), f"{c.ratio:.2f}", kind,
             reached, c.note]
        )  # fmt: skip
    judged = [c for c in own if c.reached is not None]
    lead = (
        f"{sum(bool(c.reached) for c in judged)} of {len(judged)} within what was asked. Fitted: the printed number "
        "was used to choose what the paper does not print; predicted: it was not."
    )
    head = ["figure", "printed", "ours (95 % interval)", "ratio", "", "reached", "remark"]
    content = table(head, rows, ["", "", "after", "", "", "", "text"]) if rows else ""
    return section("printed", "What is printed, and what came out", lead, content)


def _conclusions(claims: Sequence[Claim | Conclusion]) -> str:
    rows = [[c.says, "yes" if c.holds else "no", c.evidence] for c in claims if isinstance(c, Conclusion)]
    content = table(["conclusion", "holds", "evidence"], rows, ["", "", "text"]) if rows else ""
    return section("conclusions", "Conclusions", "", content)


def _own(pictures: Sequence[Path]) -> str:
    parts = []
    for path in pictures:
        data = base64.b64encode(path.read_bytes()).decode()
        name = path.stem.replace("-", " ").replace("_", " ")
        image = f'<img alt="{escape(name)}" src="data:{KINDS[path.suffix]};base64,{data}">'
        parts.append(f'<figure class="own">{image}<figcaption>{escape(name)}</figcaption></figure>')
    content = f'<div class="charts">{"".join(parts)}</div>' if parts else ""
    return section("pictures", "Pictures", "", content)


def _figures(results: Results) -> str:
    study = results.study
    head, columns = ["world", "tracker"], []
    shown = results.shown()
    units = units_of({f: [v.value for v in found.values()] for f, found in shown.items()})
    for figure, found in shown.items():
        unit = units[figure]
        head.append(heading(figure) + (f", {unit.name}" if unit.name else ""))
        columns.append({k: with_interval(v, unit) for k, v in found.items()})
    rows = [[c.label, t, *(column[c.index, t] for column in columns)] for c in study.cells for t in study.trackers]
    counts = sorted(set(results.runs.values()))
    runs = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    lead = f"{runs} trajectories per row, the same for all trackers. In brackets 95 % intervals by resampling them."
    if any(f.startswith("bound") for f in study.figures):
        lead += " The bound is by the tracker's own noise levels, over the second half of the rows."
    return section("figures", "Figures", lead, table(head, rows, ["", "text", *[""] * len(columns)]))


def _differences(results: Results) -> str:
    study = results.study
    names = list(study.trackers)
    figures = [f for f in study.figures if f not in ("bound_m", "bound_3d_m", "us_per_row")]
    if len(names) < 2 or not figures:
        return ""
    head, columns = ["world", "tracker"], []
    pairs = [(c, t) for c in study.cells for t in names[1:]]
    for figure in figures:
        found = [results.compared(_ratio, figure, c, t, names[0]) for c, t in pairs]
        head.append(heading(figure))
        columns.append([with_interval(v, Unit("", 1.0)) for v in found])
    rows = [[c.label, t, *(column[k] for column in columns)] for k, (c, t) in enumerate(pairs)]
    lead = (
        f"Every figure over that of {names[0]}: paired, so that what both have in common does not widen the interval."
    )
    return section(
        "differences", "Beside the first tracker", lead, table(head, rows, ["", "text", *[""] * len(columns)])
    )


def _ratio(a: Any, b: Any) -> Any:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.divide(a, b)


def _charts(results: Results) -> str:
    drawings = [figure_chart(results, f) for f in results.study.figures[:4] if f != "us_per_row"]
    drawings = [x for x in drawings if x is not None]
    drawings += [distribution_chart(results, c) for c in results.study.cells[:SHOWN_CELLS]]
    images = "".join(f'<figure><img alt="" src="{source}"></figure>' for source in drawings)
    more = len(results.study.cells) - SHOWN_CELLS
    lead = "Bands and bars are the 95 % intervals." + (
        f" Distributions of {more} more cells: results.json." if more > 0 else ""
    )
    return section("charts", "Drawn", lead, f'<div class="charts">{images}</div>')


def _asked(results: Results, command: Sequence[str]) -> str:
    study = results.study
    rows = [
        ("Worlds", ", ".join(study.worlds)),
        ("Trackers", ", ".join(study.trackers)),
        ("Grid", "; ".join(f"{k}: {', '.join(map(str, v))}" for k, v in study.grid.items()) or "none"),
        ("Runs", f"{study.runs} per cell, seed {study.seed}, in chunks of {study.chunk}"),
    ]
    listed = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows)
    words = ["trackwright", *command[1:]]
    again = f"<dt>Again</dt><dd><code>{escape(shlex.join(words))}</code></dd>"
    return section("asked", "What was run", "", f"<dl>{listed}{again}</dl>")
