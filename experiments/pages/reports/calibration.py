"""The report of a calibration: terms, errors before and after, and charts, as text and as an HTML page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binned_statistic_2d

from trackwright.experiments.pages.charts.style import BEFORE, BLACK, BLUE, NARROW, VERMILION, Chart, Field, Line, band
from trackwright.experiments.pages.reports.pages import report_page, typed, write_page
from trackwright.experiments.text.tables import Section
from trackwright.experiments.text.wording import MISSING, fixed
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.wording import counted
from trackwright.trackers.recordings.calibration import (
    ANGLE_PRIOR,
    ANGLES,
    DETERMINED,
    OFFSET_SIGMA,
    RANGE_PRIOR,
    UNCALIBRATED,
    Calibration,
    angle_terms,
    range_terms,
)
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.tuning.calibrating import calibrate
from trackwright.tuning.calibration_pairs import Pairs, calibration_pairs

WIDTH, SHOWN = 150, 12
"""Characters of a table's line, and the most stations, or anchors, with charts."""

CURVE, POINTS, SQUARE = 80, 500, 0.5
"""Points of a fitted curve, about the most rows drawn of a source, and the side of the squares of the floor, m."""

_ERRORS = ("rows", "as measured", "calibrated", "left out")
SECTIONS = {
    "stations": Section(
        "Stations", ("station", "angle", "offset, rad", "gain", "cubic, rad⁻²", "cross, rad⁻¹", *_ERRORS), (), 2,
        "A true angle a, with the other angle b, is measured as offset + gain·a + cubic·a³ + cross·a·b."),
    "anchors": Section(
        "Anchors", ("anchor", "bias, m", "slope", *_ERRORS), (), 1,
        "A distance d is measured as d + bias + slope·d, plus the bias of the tag where there are several."),
    "tags": Section(
        "Tags", ("tag", "bias, m", "ahead, m", "to the left, m", "rows"), (), 1,
        "Bias relative to the mean of the tags, and where on the body their ranges end, from the place of the tag."),
}  # fmt: skip
"""The tables without their rows: of stations by angle, of anchors, of tags if several."""

NOTES = {
    "±": "±: standard error.",
    "(": "In brackets: not determined by these recordings, near its value before them.",
    "as measured": "As measured, calibrated: 68th percentile of the absolute error before and after.",
    "left out": "Left out: by a calibration on the other recordings.",
}
"""What the words of the tables mean."""


class Source(NamedTuple):
    """One angle of a station, or the ranges of an anchor.

    `table`: stations or anchors. `column`: of the pairs.
    """

    table: str
    name: str
    quantity: str
    column: int
    pairs: Pairs

    @property
    def is_angle(self) -> bool:
        """Whether the values are angles, not ranges."""
        return self.table == "stations"

    @property
    def measured(self) -> np.ndarray:
        """The readings (N,), rad or m, NaN where not measured."""
        return self.pairs.measured[:, self.column]

    def fit(self, calibration: Calibration) -> tuple[np.ndarray, ...]:
        """Terms, covariance, and whether each is determined."""
        if self.is_angle:
            station, k = calibration.stations[self.name], self.column
            return _with_verdict(station.coefficients[k], station.covariances[k], ANGLE_PRIOR[1])
        anchor = calibration.anchors[self.name]
        return _with_verdict(anchor.coefficients, anchor.covariance, RANGE_PRIOR[1])

    def errors(self, calibration: Calibration | None) -> np.ndarray:
        """Measured minus expected values (N,), rad or m, NaN where not measured; None: without a calibration."""
        expected = self.pairs.true[:, self.column]
        if calibration is not None and self.is_angle:
            expected = calibration.stations.get(self.name, UNCALIBRATED).measured(self.pairs.true)[:, self.column]
        elif calibration is not None and self.name in calibration.anchors:
            tags, number = np.unique(self.pairs.tag, return_inverse=True)
            biases = np.array([calibration.tags[tag].bias if tag in calibration.tags else 0.0 for tag in tags])
            expected = expected + range_terms(expected) @ calibration.anchors[self.name].coefficients + biases[number]
        return self.measured - expected

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
    """The tables of a calibration by what they are of, those with rows, and no column of dashes alone.

    `note`: what the marks in the tables mean.
    """

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
            without.append(calibrate([folder for folder in folders if folder is not apart]))
        except UnusableInput:
            without.append(None)
    for source in sources:
        terms, covariance, determined = source.fit(calibration)
        cells = [_term(*values) for values in zip(terms, np.sqrt(np.diag(covariance)), determined, strict=True)]
        left_out, of = np.full(len(source.pairs.true), np.nan), source.pairs.recording
        for number, other in enumerate(without):
            if other is not None:
                left_out[of == number] = source.errors(other)[of == number]
        measured, calibrated = source.errors(None), source.errors(calibration)
        factor, unit = (180 / np.pi, "°") if source.is_angle else (100.0, " cm")
        spreads = [factor * source.spread(errors) for errors in (measured, calibrated, left_out)]
        shown = [MISSING if np.isnan(spread) else fixed(spread, 1) + unit for spread in spreads]
        head = [source.name, *[source.quantity] * source.is_angle]
        rows[source.table].append([*head, *cells, str(int(np.isfinite(measured).sum())), *shown])
    for name, tag in calibration.tags.items() if len(calibration.tags) > 1 else ():
        # There is no place on a body whose heading is not known.
        places = (_term(*of, of[1] < DETERMINED * OFFSET_SIGMA) if of[1] else MISSING
                  for of in zip(tag.offset, tag.offset_sigmas, strict=True))  # fmt: skip
        rows["tags"].append([name, _term(tag.bias, tag.sigma, True), *places, str(tag.rows)])
    tables = {}
    for name, section in SECTIONS.items():
        width = len(section.head) - (name != "tags" and all(row[-1] == MISSING for row in rows[name]))
        if rows[name]:
            shorter = [row[:width] for row in rows[name]]
            tables[name] = section._replace(head=section.head[:width], rows=shorter, looks={"calibrated": "after"})
    words = "\n".join(cell for table in tables.values() for row in (table.head, *table.rows) for cell in row)
    note = " ".join(text for word, text in NOTES.items() if word in words)
    return Report(tables, sources, note)


def _sources(folders: Sequence[RecordingFolder]) -> Iterator[Source]:
    of = {
        "stations": ("bearings", ANGLES),
        "anchors": ("ranges", ["range"]),
    }
    for table, (kind, quantities) in of.items():
        for name, pairs in calibration_pairs(folders, KINDS[kind]).items():
            yield from (Source(table, name, quantity, k, pairs) for k, quantity in enumerate(quantities))


def _with_verdict(terms: np.ndarray, covariance: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, ...]:
    """Terms, their covariance, and whether the recordings of the fit determine each, rather than its prior."""
    return terms, covariance, np.sqrt(np.diag(covariance)) < DETERMINED * prior


def _term(value: float, sigma: float, determined: bool) -> str:
    text = f"{fixed(value, 3)}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{fixed(sigma, 3)}"
    return text if determined else f"({text})"


def calibration_charts(calibration: Calibration, report: Report) -> dict[str, tuple[list[Chart], list[Chart]]]:
    """Of each table with sources, by what they are called: readings against the truth, and errors over the floor."""
    charts = {}
    for kind in SECTIONS:
        sources = [one for one in report.sources if one.table == kind and np.isfinite(one.measured).any()]
        if shown := sources[: 2 * SHOWN if kind == "stations" else SHOWN]:
            charts[kind] = [_readings(one, calibration) for one in shown], _floor_charts(shown, calibration)
    return charts


def _readings(source: Source, calibration: Calibration) -> Chart:
    """Readings before and after calibration against true values, with the fit and its 95 % interval."""
    pairs, k = source.pairs, source.column
    seen = np.flatnonzero(np.isfinite(source.measured))
    true = pairs.true[seen, k]
    at = np.linspace(true.min(), true.max(), CURVE)
    terms, covariance, _ = source.fit(calibration)
    if source.is_angle:
        # The curve of one angle is that at the median of the other.
        angles = np.repeat(np.median(pairs.true, axis=0)[None], CURVE, axis=0)
        angles[:, k] = at
        factors = angle_terms(angles, calibration.stations[source.name].spans)[:, k]
        shown, none, factor, unit, what = true, at, 180 / np.pi, "°", "measured"
    else:
        # Errors of a few centimetres of ranges of metres are visible only by themselves.
        factors = range_terms(at)[:, : len(terms)]
        shown, none, factor, unit, what = 0 * true, 0 * at, 1.0, "m", "error of"
    fitted, half = factors @ terms, 1.96 * np.sqrt(np.einsum("ki,ij,kj->k", factors, covariance, factors))
    part = slice(None, None, -(-len(seen) // POINTS))
    measured, calibrated = (factor * (shown + source.errors(of)[seen])[part] for of in (None, calibration))
    parts = [Line(factor * true[part], measured, "as measured", BEFORE, 0.0, marker="circle", size=3)]
    parts.append(Line(factor * true[part], calibrated, "calibrated", BLUE, 0.0, marker="circle", size=3))
    parts.append(Line(factor * at, factor * none, "no error", BLACK, 0.9, "dash"))
    interval = factor * (fitted - half), factor * (fitted + half)
    parts.append(band(factor * at, *interval, "its 95 % interval", VERMILION, 0.25))
    parts.append(Line(factor * at, factor * fitted, "fit", VERMILION, 1.4))
    labels = f"true {source.quantity} ({unit})", f"{what} {source.quantity} ({unit})"
    name = f"{source.table}-{source.name}-{source.quantity}"
    return Chart(name, f"{source.name}: {source.quantity}", *labels, parts, robust=True)


def _floor_charts(sources: Sequence[Source], calibration: Calibration) -> list[Chart]:
    """Median errors after calibration over the floor, in squares, a chart for each source, all with one scale."""
    factor, unit = (180 / np.pi, "°") if sources[0].is_angle else (1.0, "m")
    errors = [factor * source.errors(calibration) for source in sources]
    places = [source.pairs.positions[np.isfinite(own), :2] for source, own in zip(sources, errors, strict=True)]
    squares = np.floor(np.concatenate(places) / SQUARE)
    edges = [SQUARE * np.arange(x.min(), x.max() + 2) for x in squares.T]
    medians = [
        binned_statistic_2d(*place.T, own[np.isfinite(own)], "median", edges).statistic
        for place, own in zip(places, errors, strict=True)
    ]
    largest = float(np.nanquantile(np.abs(np.concatenate([m.ravel() for m in medians])), 0.97)) or 1.0
    x, y = (of[:-1] + SQUARE / 2 for of in edges)
    look: dict[str, Any] = {"equal": True, "width": NARROW, "height": None}
    return [
        Chart(f"{one.table}-floor-{one.name}-{one.quantity}", f"{one.name}: {one.quantity}", "x (m)", "y (m)",
              [Field(x, y, median.T, f"median error ({unit})", "RdBu", -largest, largest)], **look)
        for one, median in zip(sources, medians, strict=True)
    ]  # fmt: skip


def write_calibration_report(out: Path, calibration: Calibration, report: Report, command: Sequence[str]) -> Path:
    """Writes the page beside the file `out`, with its name and the ending .html; returns the path."""
    recordings, tables = calibration.recordings, report.tables
    counts = {name: len({row[0] for row in table.rows}) for name, table in tables.items() if name != "tags"}
    words = {"stations": "station", "anchors": "anchor"}
    of = listed([counted(count, words[name]) for name, count in counts.items()])
    summary = f"Systematic errors of {of}, from recordings with truth: {listed(recordings, 12)}."
    if len(recordings) < 2:
        summary += " With a second recording this page would show the errors of readings that were left out."
    figures: list[str | list[Chart]] = []
    for kind, (readings, floor) in calibration_charts(calibration, report).items():
        over = (
            f"Median errors of calibrated {kind} in squares of half a metre. Errors of one sign over large parts of "
            "the floor are systematic errors that the terms do not describe."
        )
        figures += [f"Calibration of {kind}", readings, over, floor]
    most = f"Of the first {SHOWN} stations and anchors." if max(counts.values(), default=0) > SHOWN else ""
    sections = [*tables.values(), Section("Figures", note=most, parts=figures)]
    title = f"Calibration on {counted(len(recordings), 'recording')}"
    use = f"trackwright track RECORDING --calibration {out} --out out/tracks"
    text = report_page("calibration", title, [summary, report.note], sections, [use, typed(command)])
    return write_page(out.with_suffix(".html"), text)
