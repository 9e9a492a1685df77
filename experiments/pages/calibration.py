"""Reports of a calibration, terms and errors before and after, and of a survey, anchors over the walks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trackwright.experiments.pages.chart import BLACK, BLUE, GREY, PALE, Chart, Line, path
from trackwright.experiments.pages.charts import ellipses, plan
from trackwright.experiments.pages.report import report_page, typed, write_page
from trackwright.experiments.text.tables import MISSING, Section, fixed
from trackwright.trackers.core.errors import UnusableInput, counted, listed
from trackwright.trackers.recordings.calibration import (
    ANGLE_PRIOR,
    ANGLES,
    DETERMINED,
    RANGE_PRIOR,
    UNCALIBRATED,
    Calibration,
    range_terms,
)
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.tuning.calibrating import Pairs, calibration_pairs, systematic
from trackwright.tuning.survey import Survey

WIDTH, SHOWN, POINTS = 150, 24, 500
"""Characters of a table's line, the most charts, and about the most rows drawn in each."""

_ERRORS = ("rows", "as measured", "calibrated", "left out")
SECTIONS = {
    "stations": Section(
        "Stations", ("station", "angle", "offset, rad", "gain", "cubic, rad⁻²", "cross, rad⁻¹", *_ERRORS), (), 2,
        "A true angle a, with the other angle b, is measured as offset + gain·a + cubic·a³ + cross·a·b."),
    "anchors": Section("Anchors", ("anchor", "bias, m", "slope", *_ERRORS), (), 1,
        "A distance d is measured as d + bias + slope·d, plus the bias of the tag where there are several."),
    "tags": Section("Tags", ("tag", "bias, m", "rows"), (), 1, "Bias relative to the mean of the tags."),
}  # fmt: skip
"""The tables without their rows: of stations by angle, of anchors, of tags if several."""

NOTE = (
    "±: standard error; in brackets: not determined, near its value before. Errors: 68th percentile as measured, "
    "calibrated, and by a calibration on the other recordings (left out)."
)


class Source(NamedTuple):
    """One angle of a station, or the ranges of an anchor; `column`: of the pairs."""

    table: str
    name: str
    quantity: str
    column: int
    pairs: Pairs

    @property
    def unit(self) -> tuple[float, str]:
        """The factor to the unit in tables, and its name."""
        return (180 / np.pi, "°") if self.table == "stations" else (100.0, " cm")

    def fit(self, calibration: Calibration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Terms, their standard deviations, and whether the recordings determine each, rather than the prior."""
        if self.table == "stations":
            station, k, prior = calibration.stations[self.name], self.column, ANGLE_PRIOR[1]
            terms, covariance = station.coefficients[k], station.covariances[k]
        else:
            anchor, prior = calibration.anchors[self.name], RANGE_PRIOR[1]
            terms, covariance = anchor.coefficients, anchor.covariance
        sigmas = np.sqrt(np.diag(covariance))
        return terms, sigmas, sigmas < DETERMINED * prior

    def errors(self, calibration: Calibration | None) -> np.ndarray:
        """Measured minus expected values (N,), rad or m, NaN where not measured; None: without a calibration."""
        expected = self.pairs.true[:, self.column]
        if calibration is not None and self.table == "stations":
            expected = calibration.stations.get(self.name, UNCALIBRATED).measured(self.pairs.true)[:, self.column]
        elif calibration is not None and self.name in calibration.anchors:
            tags, number = np.unique(self.pairs.tag, return_inverse=True)
            biases = np.array([calibration.tags[tag].bias if tag in calibration.tags else 0.0 for tag in tags])
            expected = expected + range_terms(expected) @ calibration.anchors[self.name].coefficients + biases[number]
        return self.pairs.measured[:, self.column] - expected

    def spread(self, errors: np.ndarray) -> float:
        """The 68th percentile of the sizes of errors (N,), each recording with the same weight; NaN without any."""
        seen = np.flatnonzero(np.isfinite(errors))
        if not len(seen):
            return np.nan
        seen = seen[np.argsort(np.abs(errors[seen]))]
        recording = self.pairs.recording[seen]
        shares = np.cumsum(1.0 / np.bincount(recording)[recording])
        return float(np.abs(errors[seen])[np.searchsorted(shares, 0.6827 * shares[-1])])


class Report(NamedTuple):
    """The tables with rows of a calibration by what they are of; `note`: what the marks in them mean."""

    tables: dict[str, Section]
    sources: list[Source]
    note: str


def report_on(calibration: Calibration, folders: Sequence[RecordingFolder]) -> Report:
    """The tables of a calibration of these recordings."""
    sources = [*_sources(folders)]
    rows: dict[str, list[list[str]]] = {name: [] for name in SECTIONS}
    without = list[Calibration | None]()
    for apart in folders:
        try:
            without.append(systematic([folder for folder in folders if folder is not apart]))
        except UnusableInput:
            without.append(None)
    for source in sources:
        cells = [_term(*values) for values in zip(*source.fit(calibration), strict=True)]
        left_out, of = np.full(len(source.pairs.true), np.nan), source.pairs.recording
        for number, other in enumerate(without):
            if other is not None:
                left_out[of == number] = source.errors(other)[of == number]
        measured, (factor, unit) = source.errors(None), source.unit
        spreads = (source.spread(errors) for errors in (measured, source.errors(calibration), left_out))
        shown = [MISSING if np.isnan(spread) else fixed(factor * spread, 1) + unit for spread in spreads]
        head = [source.name, *[source.quantity] * (source.table == "stations")]
        rows[source.table].append([*head, *cells, str(int(np.isfinite(measured).sum())), *shown])
    several = calibration.tags if len(calibration.tags) > 1 else {}
    rows["tags"] = [[name, _term(tag.bias, tag.sigma, True), str(tag.rows)] for name, tag in several.items()]
    tables = {name: one._replace(rows=rows[name]) for name, one in SECTIONS.items() if rows[name]}
    visits = sum(map(len, calibration.bearing_map.values()))
    kept = f" A map over the floor of what is left of bearings is kept, of {visits} visits." if visits else ""
    return Report(tables, sources, NOTE + kept)


def _sources(folders: Sequence[RecordingFolder]) -> Iterator[Source]:
    of = {"stations": ("bearings", ANGLES), "anchors": ("ranges", ["range"])}
    for table, (kind, quantities) in of.items():
        for name, pairs in calibration_pairs(folders, KINDS[kind]).items():
            yield from (Source(table, name, quantity, k, pairs) for k, quantity in enumerate(quantities))


def _term(value: float, sigma: float, determined: bool) -> str:
    text = f"{fixed(value, 3)}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{fixed(sigma, 3)}"
    return text if determined else f"({text})"


def errors_chart(source: Source, calibration: Calibration) -> Chart:
    """Errors of the readings before and after calibration against the true value."""
    factor, unit = source.unit
    true = (factor if unit == "°" else 1.0) * source.pairs.true[:, source.column]
    every, wild = slice(None, None, -(-len(true) // POINTS)), 0.0
    parts = [Line([np.min(true), np.max(true)], [0, 0], "", BLACK, 0.9, "dash")]
    for name, colour, of in (("as measured", PALE, None), ("calibrated", BLUE, calibration)):
        errors = factor * source.errors(of)
        wild = max(wild, 1.2 * float(np.nanquantile(np.abs(errors), 0.99, method="higher")))
        parts.append(Line(true[every], errors[every], name, colour, 0.0, marker="circle", size=3))
    labels = f"true {source.quantity} ({'°' if unit == '°' else 'm'})", f"error ({unit.strip()})"
    return Chart("errors", f"{source.name}: {source.quantity}", *labels, parts, ylim=(-wild, wild))


def write_calibration_report(out: Path, calibration: Calibration, report: Report, command: Sequence[str]) -> Path:
    """Writes the page beside the file `out`, with its name and the ending .html; returns the path."""
    recordings, shown = calibration.recordings, [one for one in report.sources if np.isfinite(one.errors(None)).any()]
    charts = [errors_chart(one, calibration) for one in shown[:SHOWN]]
    summary = f"Systematic errors of {listed([*report.tables])}, from recordings with truth: {listed(recordings, 12)}."
    sections = [*report.tables.values(), Section(f"Errors, {len(charts)} of {len(shown)}", parts=[charts])]
    title = f"Calibration on {counted(len(recordings), 'recording')}"
    use = f"trackwright track RECORDING --calibration {out} --out out/tracks"
    text = report_page("calibration", title, [summary, report.note], sections, [use, typed(command)])
    return write_page(out.with_suffix(".html"), text)


def write_survey_page(out: Path, survey: Survey, command: Sequence[str]) -> Path:
    """Writes the page beside the file `out`, with its name; returns its path."""
    drawn = np.flatnonzero(survey.half_widths[:, :2].max(axis=1) < 2.0).tolist()
    places, covs = survey.positions[drawn, :2], np.reshape([survey.block(k)[:2, :2] for k in drawn], (-1, 2, 2))
    walks = [path(walk, "" if k else "walk", GREY, 1.1) for k, walk in enumerate(survey.paths)]
    found = path(ellipses(places, covs), "95 % ellipse", BLUE)
    around = np.concatenate([walk[:, :2] for walk in survey.paths])
    chart = plan("survey", "Anchors with 95 % ellipses over the walks", [*walks, found], around, survey.rig)
    table = Section("Anchors", survey.head, survey.rows(), 1, survey.reading, [[chart]])
    notes = [f"{note[0].upper()}{note[1:]}." for note in survey.notes]
    text = report_page("survey", f"Survey of {survey.rig.name}", notes, [table], [typed(command)])
    return write_page(out.with_suffix(".html"), text)
