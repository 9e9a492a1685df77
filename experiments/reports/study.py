"""A study's report: one HTML file with everything in it, for a desk, a phone and paper."""

from __future__ import annotations

import base64
import re
import shlex
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from experiments.monte_carlo.expectations import Conclusion, ExpectedResult
from experiments.monte_carlo.results import Results
from experiments.plots.study import SHOWN_CELLS, Drawing, distribution_charts, figure_chart
from experiments.reports.html_page import document, section
from experiments.reports.wording import Unit, heading, units_of, with_interval
from trackers.recordings.atomic import atomic_write

REPORT = "report.html"
KINDS = {".svg": "image/svg+xml", ".png": "image/png"}
LINE = 132
"""The most characters of a line of a table whose intervals stand beside their values; of longer ones, under them."""

EXTRA = """
table.wide td:first-child { min-width: 8rem; }
table.wide th { min-width: 4.6rem; }
table.wide td { white-space: normal; }
td.text, th.text, td.long, th.long { text-align: left; }
td.judged.no { color: var(--warn); font-weight: 700; }
.interval { display: inline-block; color: var(--soft); font-weight: 400; white-space: nowrap; }
table.under .interval { display: block; font-size: .9em; }
.pictures { display: flex; flex-wrap: wrap; gap: 1.6rem 2rem; }
.pictures figure { max-width: min(46rem, 100%); }
.pictures img { width: auto; max-width: 100%; }
@media screen and (max-width: 720px) {
  td.long { grid-column: 1 / -1; }
  td:empty { display: none; }
}
@media not all and (max-width: 720px) {
  table.under :is(th, td):not(:first-child, .long) { padding-inline: .4rem; }
}
"""


def write_page(
    folder: Path,
    results: Results,
    claims: Sequence[ExpectedResult | Conclusion],
    drawn: Sequence[str],
    command: Sequence[str],
) -> Path:
    """The report's path, written whole or not at all. `drawn`: pictures in the folder that go into it."""
    text = page(results, claims, [folder / name for name in drawn], command)
    return atomic_write(folder / REPORT, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def page(
    results: Results, claims: Sequence[ExpectedResult | Conclusion], pictures: Sequence[Path], command: Sequence[str]
) -> str:
    """The report as HTML."""
    study = results.study
    # Not between numbers: "figures-6-7" are Figures 6-7.
    title = re.sub(r"-(?!\d)|(?<!\d)-", " ", study.name).capitalize()
    parts = [_claims(claims), _conclusions(claims), _own(pictures), _charts(results), _figures(results)]
    parts += [_differences(results), _asked(results, command)]
    return document("study", title, f'<p class="verdict">{escape(study.about)}</p>', "".join(parts), EXTRA)


def table(head: Sequence[str], rows: Sequence[Sequence[str]], kinds: Sequence[str] = ()) -> str:
    """A table whose first column names the rows; `kinds`: a class for the cells of each column.

    `text` is that of names, `long` that of sentences, `judged` that of yes and no, where a no is to be seen.
    """
    kinds = kinds or [""] * len(head)
    top = "".join(f'<th class="{kind}">{escape(h)}</th>' for h, kind in zip(head, kinds, strict=True))
    body = "".join(
        "<tr>"
        + "".join(
            f'<td class="{kind} no" data-label="{escape(h)}">no</td>'
            if (kind, text) == ("judged", "no")
            else f'<td class="{kind}" data-label="{escape(h)}">{_wrapping(text)}</td>'
            for h, kind, text in zip(head, kinds, row, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    line = sum(max(map(len, column)) + 3 for column in zip(*rows, strict=True))
    kind = "wide under" if line > LINE else "wide"
    return f'<div class="scroll"><table class="{kind}"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _wrapping(text: str) -> str:
    """A cell's text, with minus signs, in which an interval is kept whole and may go under its value."""
    text = re.sub(r"(?<![\w.-])-(?=\d)", "\u2212", text)
    return re.sub(r"^(\S+) (\(\S+ … \S+\))$", r'\1 <span class="interval">\2</span>', escape(text))


def _claims(claims: Sequence[ExpectedResult | Conclusion]) -> str:
    own = [c for c in claims if isinstance(c, ExpectedResult)]
    rows = []
    for c in own:
        reached = "" if c.reached is None else "yes" if c.reached else "no"
        kind = "fitted" if c.fitted else "predicted"
        rows.append(
            [c.quantity, f"{c.printed:g}\u00a0{c.unit}", with_interval(c.ours, Unit(c.unit, 1.0)), f"{c.ratio:.2f}", kind,
             reached, c.note]
        )  # fmt: skip
    judged = [c for c in own if c.reached is not None]
    asked = " or ".join(f"{100 * width:g} %" for width in sorted({c.within for c in judged if c.within is not None}))
    lead = (
        f"{sum(bool(c.reached) for c in judged)} of {len(judged)} within {asked} of what is printed. " if judged else ""
    ) + "Fitted: the printed number was used to choose what the paper does not print; predicted: it was not."
    head = ["figure", "printed", "ours (95 % interval)", "ours / printed", "kind", "reached", "remark"]
    kinds = ["", "", "after", "", "", "judged", "long"]
    shown = len(head) if any(c.note for c in own) else len(head) - 1
    content = table(head[:shown], [row[:shown] for row in rows], kinds[:shown]) if rows else ""
    return section("printed", "What is printed, and what came out", lead, content)


def _conclusions(claims: Sequence[ExpectedResult | Conclusion]) -> str:
    rows = [[c.statement, "yes" if c.holds else "no", c.evidence] for c in claims if isinstance(c, Conclusion)]
    content = table(["conclusion", "holds", "evidence"], rows, ["", "judged", "long"]) if rows else ""
    return section("conclusions", "Conclusions", "", content)


def _own(pictures: Sequence[Path]) -> str:
    parts = []
    for path in pictures:
        data = base64.b64encode(path.read_bytes()).decode()
        name = path.stem.replace("-", " ").replace("_", " ")
        image = f'<img alt="{escape(name)}" src="data:{KINDS[path.suffix]};base64,{data}">'
        parts.append(f"<figure>{image}<figcaption>{escape(path.name)}</figcaption></figure>")
    content = f'<div class="pictures">{"".join(parts)}</div>' if parts else ""
    return section("pictures", "Pictures", "", content)


def _figures(results: Results) -> str:
    study = results.study
    head, columns = ["world", "tracker"], []
    shown = results.main_metrics()
    units = units_of({f: [v.value for v in found.values()] for f, found in shown.items()})
    for figure, found in shown.items():
        unit = units[figure]
        head.append(heading(figure) + (f",\u00a0{unit.name}" if unit.name else ""))
        columns.append({k: with_interval(v, unit) for k, v in found.items()})
    rows = [[c.label, t, *(column[c.index, t] for column in columns)] for c in study.conditions for t in study.trackers]
    counts = sorted(set(results.runs.values()))
    runs = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    lead = f"{runs} trajectories per row, the same for all trackers. In brackets 95 % intervals by resampling them."
    if any(f.startswith("bound") for f in study.metrics):
        lead += " The bound is by the tracker's own noise levels, over the second half of the rows."
    return section("figures", "Figures", lead, table(head, rows, ["", "text", *[""] * len(columns)]))


def _differences(results: Results) -> str:
    study = results.study
    names = list(study.trackers)
    figures = [f for f in study.metrics if f not in ("bound_m", "bound_3d_m", "us_per_row")]
    if len(names) < 2 or not figures:
        return ""
    head, columns = ["world", "tracker"], []
    pairs = [(c, t) for c in study.conditions for t in names[1:]]
    for figure in figures:
        found = [results.compared(_ratio, figure, c, t, names[0]) for c, t in pairs]
        if not any(np.isfinite(v.value) for v in found):
            continue
        head.append(heading(figure))
        columns.append([with_interval(v, Unit("", 1.0)) for v in found])
    rows = [[c.label, t, *(column[k] for column in columns)] for k, (c, t) in enumerate(pairs)]
    lead = (
        f"Every figure over that of “{names[0]}”: paired, so that what both have in common does not widen the interval."
    )
    return section(
        "differences", "Beside the first tracker", lead, table(head, rows, ["", "text", *[""] * len(columns)])
    )


def _ratio(a: Any, b: Any) -> Any:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.divide(a, b)


def _charts(results: Results) -> str:
    found = results.main_metrics()
    units = units_of({f: [v.value for v in values.values()] for f, values in found.items()})
    names = [f for f in results.study.metrics if f != "us_per_row"][:4]
    drawings = [x for f in names if (x := figure_chart(results, f, found[f], units[f])) is not None]
    more = len(results.study.conditions) - SHOWN_CELLS
    lead = "Bands and bars are the 95 % intervals." + (
        f" Distributions of the first {SHOWN_CELLS} of {len(results.study.conditions)} cells." if more > 0 else ""
    )
    lengths = next((unit for figure, unit in units.items() if figure.endswith("_m")), None)
    return section("charts", "Charts", lead, _abreast(drawings) + _abreast(distribution_charts(results, lengths)))


def _abreast(drawings: Sequence[Drawing]) -> str:
    images = "".join(f'<figure><img alt="{escape(x.says)}" src="{x.source}"></figure>' for x in drawings)
    return f'<div class="charts">{images}</div>' if images else ""


def _asked(results: Results, command: Sequence[str]) -> str:
    study = results.study
    rows = [
        ("Worlds", "; ".join(study.worlds)),
        ("Trackers", "; ".join(study.trackers)),
        ("Grid", "; ".join(f"{k}: {', '.join(map(str, v))}" for k, v in study.grid.items()) or "none"),
        ("Runs", f"{study.runs} per cell, seed {study.seed}, in chunks of {study.chunk}"),
    ]
    listed = "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows)
    words = ["trackwright", *command[1:]]
    again = f"<dt>Again</dt><dd><code>{escape(shlex.join(words))}</code></dd>"
    return section("asked", "What was run", "", f"<dl>{listed}{again}</dl>")
