"""The page itself: one HTML file with everything in it, which needs nothing from anywhere else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

from experiments.plots import filter_charts, optimiser_charts
from experiments.reports.advice import IdentifiabilityIssue, is_better, is_worse, judged, number, percent
from experiments.reports.html_page import document, section
from experiments.reports.tuning_data import Score, TunedNumber, TuningEvidence
from trackers.recordings.atomic import atomic_write

REPORT = "report.html"
CLASS_AFTER = ' class="after"'
COLUMNS = ("before", "after", "95 % interval", "determined?")


def write_report(path: Path | str, evidence: TuningEvidence) -> Path:
    """The path, at which the report now stands, whole or not at all; raises UnusableInput where it can't be written."""
    text = page(evidence)
    return atomic_write(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def page(evidence: TuningEvidence) -> str:
    """The report as HTML."""
    judgement = judged(evidence)
    title = f"{evidence.tracker}, tuned on {_counted(len(evidence.training), 'recording')}"
    sections = "".join(
        section(*parts)
        for parts in (_asked(evidence), _numbers(evidence), _scores(evidence), _descents(evidence),
                      _consistency(evidence), _errors(evidence), _again(evidence))
        if parts is not None
    )  # fmt: skip
    return document("tuning report", title, _verdict(judgement), f"{sections}\n{_footer(evidence)}")


def _verdict(judgement: IdentifiabilityIssue) -> str:
    kind = "verdict" if judgement.good else "verdict beware"
    items = "".join(f"<li>{escape(w)}</li>" for w in judgement.warnings)
    listed = f'\n<ul class="warnings">{items}</ul>' if items else ""
    return f'<p class="{kind}"><b>{judgement.word}</b> {escape(judgement.verdict)}</p>{listed}'


Part = tuple[str, str, str, str]
"""A section's id, heading, sentence under it and content; the sentence is plain text, the content HTML."""


def _asked(e: TuningEvidence) -> Part:
    held_out = _listed(e.held_out) if e.held_out else "none: nothing here shows how the result does elsewhere"
    rows = [
        ("Command", f"<code>{_words(e.command)}</code>"),
        ("Tracker", f"<b>{escape(e.tracker)}</b>: {escape(e.tracker_about)}"),
        ("Made small", escape(e.objective_about)),
        ("Tuned on", escape(_listed(e.training))),
        ("Held out", escape(held_out)),
        ("Effort", f"{e.filter_runs:,} trajectories filtered in {_duration(e.seconds)}".replace(",", "\u202f")),
    ]
    listed = "".join(f"<dt>{title}</dt><dd>{text}</dd>" for title, text in rows)
    notes = "".join(f'<p class="under">{escape(note)}</p>' for note in e.notes)
    return "asked", "What was asked", "", f"<dl>{listed}</dl>{notes}"


def _numbers(e: TuningEvidence) -> Part:
    sure = any(n.determined is not None for n in e.numbers)
    head = "".join(f"<th>{t}</th>" for t in ("", *COLUMNS))
    rows = "".join(_number_row(n) for n in e.numbers)
    lead = (
        "An interval that spans a factor of ten, or a number that is not determined, says that these recordings hold "
        "too little about it."
        if sure
        else "No intervals: they take a likelihood, or the scatter of twenty trajectories, and a fit that came to rest "
        "where its objective is least."
    )
    return "numbers", "The numbers", lead, _table("numbers", head, rows)


def _number_row(n: TunedNumber) -> str:
    interval = "–" if math.isnan(n.low) else f"{number(n.low)} … {number(n.high)}"
    words = {True: "yes", False: '<span class="worse">no</span>', None: "–"}
    unit = "" if n.unit == "1" else f' <span class="unit">{escape(n.unit)}</span>'
    cells = [number(n.before), f"{number(n.after)}{unit}", interval, words[n.determined]]
    row = _cells(cells, COLUMNS)
    return f"<tr><td><code>{escape(n.name)}</code></td>{row}</tr>"


def _scores(e: TuningEvidence) -> Part:
    held = bool(e.held_out)
    where = ("tuned on", "held out") if held else ("tuned on",)
    groups = "".join(f'<th class="group" colspan="3">{w}</th>' for w in where)
    head = f'<th rowspan="2"></th>{groups}</tr><tr>' + "<th>before</th><th>after</th><th>change</th>" * len(where)
    rows = "".join(_score_row(s, e.objective, held) for s in e.scores)
    lead = (
        "Every figure, whichever was made small: a filter can be made sharp by lying about its covariances, "
        "and it shows here."
    )
    return "scores", "Before and after", lead, _table("scores", head, rows)


def _score_row(s: Score, goal: str, held: bool) -> str:
    unit = "" if s.unit == "1" else f", {s.unit}"
    aim = "should be " + number(s.target) if s.target is not None else "less is better"
    pairs = (s.training, s.held_out) if held else (s.training,)
    cells = "".join(
        _cells((number(pair[0]), number(pair[1]), _changed(s, pair)), (f"{where}: before", "after", "change"))
        for pair, where in zip(pairs, ("tuned on", "held out"), strict=False)
    )
    kind = ' class="goal"' if s.key == goal else ""
    made = " · made small" if s.key == goal else ""
    return f'<tr{kind}><td>{escape(s.title + unit)}<span class="small">{aim}{made}</span></td>{cells}</tr>'


def _changed(s: Score, pair: tuple[float, float]) -> str:
    """The change as a difference or in per cent where that means something, and a word where it matters."""
    if not all(map(math.isfinite, pair)):
        return "–"
    if pair[0] == pair[1]:
        return "same"
    change = ""
    if s.unit == "nats":  # the zero of a log-density is nowhere in particular
        change = ("+" if pair[1] >= pair[0] else "") + number(pair[1] - pair[0])
    elif s.unit != "1":  # and a distance between distributions is near zero if all is well
        change = percent(pair)
    if is_worse(s, pair):
        return f'<span class="worse">{f"{change} worse".strip()}</span>'
    if is_better(s, pair):
        return f'<span class="better">{change or "better"}</span>'
    return change or "same"


def _descents(e: TuningEvidence) -> Part | None:
    if not e.descents:
        return None
    many = len(e.descents) > 1
    starts = f"from {len(e.descents)} starts" if many else "from one start"
    drawings = [_figure(optimiser_charts.objective_chart(e), f"The objective at every step, {starts}.", "Objective")]
    if e.landscape is not None:
        names = " and ".join(e.numbers[k].name for k in e.landscape.axes)
        shape = "Contours of the objective" if len(e.landscape.axes) == 2 else "The objective"
        caption = f"{shape} over {names}, with the steps of the gradient drawn in; all else stays as tuned."
        drawings.append(_figure(optimiser_charts.landscape_chart(e, e.landscape), caption, f"Objective over {names}"))
    ways = [_figure(optimiser_charts.number_chart(e, k), "", n.name) for k, n in enumerate(e.numbers)]
    lead = "Starts that end in one place agree on the optimum." if many else ""
    if e.held_out:
        lead += " The point taken is the one that was best on the held-out recordings."
    return "descent", "How it got there", lead.strip(), _charts(drawings) + _charts(ways, "charts three")


def _consistency(e: TuningEvidence) -> Part | None:
    if e.innovations is None or min(len(side.nis) for side in e.innovations) == 0:
        return None
    before, after = e.innovations
    lead = (
        "Where a filter tells the truth about its own uncertainty, its normalised innovation squared (NIS) has a known "
        f"distribution, χ² for normal noise, and one row's says nothing about the next. Seen on {e.judged_on}."
    )
    drawings = [
        _figure(filter_charts.density_chart(before, after),
                "A filter that is too sure of itself has more large values than the vermilion line.",
                "NIS against chi-square"),
        _figure(filter_charts.probability_chart(before, after),
                "The same as probabilities, which are level if the filter is consistent. Bars that rise to the right: "
                "reported covariances are too small; to the left: too large.", "Probabilities of NIS"),
        _figure(filter_charts.autocorrelation_chart(before, after),
                "Points above the band: errors last from row to row, which white noise in the model cannot say. "
                "Taken of NIS, turned into standard normal values, since signs of innovations are not kept.",
                "Autocorrelation of NIS"),
    ]  # fmt: skip
    return "consistency", "Does the filter believe the right things?", lead, _charts(drawings, "charts three")


def _errors(e: TuningEvidence) -> Part | None:
    known = tuple(t for t in e.errors if (t.before == t.before).any() and (t.after == t.after).any())
    if not known:
        return None
    unit = e.error_unit
    drawings = [
        _figure(filter_charts.rmse_chart(known, unit), "RMSE of every trajectory; a vermilion line is one that got "
                "worse." + ("" if len(known) <= 24 else " The 24 largest."), "RMSE of trajectories"),
        _figure(filter_charts.distribution_chart(known, unit), "All rows together.", "Distribution of errors"),
    ]  # fmt: skip
    over_time = [
        _figure(drawing, "", f"Error of {name} over time") for name, drawing in filter_charts.error_charts(known, unit)
    ]
    under = "Over time" + (
        f", the {len(over_time)} trajectories that changed most" if len(over_time) < len(known) else ""
    )
    content = f'{_charts(drawings)}<p class="under">{under}:</p>{_charts(over_time)}'
    return "errors", "Errors against truth", f"On {e.judged_on}.", content


def _again(e: TuningEvidence) -> Part:
    commands = "".join(f"<pre>{_words(c)}</pre>" for c in e.again)
    return "again", "Use it, run it again", "", commands


def _footer(e: TuningEvidence) -> str:
    parts = " · ".join(f"{escape(title)} {escape(text)}" for title, text in e.provenance)
    return f"<footer>{parts}</footer>" if parts else ""


def _cells(cells: Sequence[str], labels: Sequence[str]) -> str:
    """The cells of a row; on a phone, where there is no head, each says what it is."""
    return "".join(
        f'<td data-label="{escape(label)}"{CLASS_AFTER if label == "after" else ""}>{cell}</td>'
        for cell, label in zip(cells, labels, strict=True)
    )


def _words(command: str) -> str:
    """A command whose lines break between words and not after hyphens."""
    return " ".join(f"<span>{escape(word)}</span>" for word in command.split(" "))


def _table(kind: str, head: str, rows: str) -> str:
    return (
        f'<div class="scroll"><table class="{kind}"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'
    )


def _charts(drawings: list[str], kind: str = "charts") -> str:
    return f'<div class="{kind}">{"".join(drawings)}</div>'


def _figure(address: str, caption: str, alternative: str) -> str:
    image = f'<img src="{address}" alt="{escape(alternative)}">'
    under = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    return f"<figure>{image}{under}</figure>"


def _counted(count: int, word: str) -> str:
    return f"{count} {word}" + ("" if count == 1 else "s")


def _listed(names: tuple[str, ...]) -> str:
    shown = ", ".join(names[:12])
    return shown + (f" and {len(names) - 12} more" if len(names) > 12 else "")


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.1f} s"
    return f"{seconds / 60:.1f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
