"""The report of a calibration: terms, errors before and after, and figures, as text and as an HTML page."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trackwright.experiments.pages.charts.calibration import Panel, floor_charts, reading_chart
from trackwright.experiments.pages.charts.style import Chart
from trackwright.experiments.pages.reports.pages import page, write_page
from trackwright.experiments.text.tables import Section
from trackwright.experiments.text.wording import MISSING, fixed
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.core.wording import counted
from trackwright.trackers.recordings.bearing_map import BearingMap
from trackwright.trackers.recordings.calibration import (
    ANGLE_TERMS,
    ANGLES,
    DETERMINED,
    OFFSET_SIGMA,
    RANGE_TERMS,
    UNCALIBRATED,
    Calibration,
    angle_terms,
    range_terms,
)
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.tuning.calibrating import systematic
from trackwright.tuning.calibration_pairs import Pairs, calibration_pairs, differs_by_distance

WIDTH = 150
SHOWN = 12
"""The most stations, or anchors, in figures."""

CURVE = 80
"""Points of a fitted curve."""

DEGREES = float(np.rad2deg(1.0))
TAG_HEAD = ("tag", "bias, m", "ahead, m", "to the left, m", "rows")
_ERRORS = ("rows", "as measured", "calibrated", "left out")
ANGLE_HEAD = ("station", "angle", "offset, rad", "gain", "cubic, rad⁻²", "cross, rad⁻¹", *_ERRORS)
RANGE_HEAD = ("anchor", "bias, m", "slope", *_ERRORS)
DIFFERENCE_HEAD = ("anchor", "bias, m", *_ERRORS)
DIFFERENCE = "range difference"
TABLES = ("stations", "anchors", "differences")
NOT_LINEAR = ", not linear"
"""What follows the name of an anchor whose errors differ by distance after the line is removed."""

NOTES = {
    "": "± standard error.",
    "(": "In brackets: not determined by these recordings, near its value before any of them.",
    NOT_LINEAR: "Not linear: the errors that the line leaves differ between distances more than between pieces of time "
    "(p < 0.001); see the figures.",
    "as measured": "As measured, calibrated: 68th percentile of the absolute error before and after.",
    "left out": "Left out: cross-validated, by a calibration on the other recordings.",
}
"""What the tables' marks mean, by the text that has to occur in them."""


class Source(NamedTuple):
    """One angle of a station, or the ranges of an anchor or its range differences to others.

    Its name, `quantity` and column of the pairs.
    """

    name: str
    quantity: str
    column: int
    pairs: Pairs

    @property
    def is_angle(self) -> bool:
        """Whether the values are angles, not ranges."""
        return self.quantity in ANGLES

    @property
    def table(self) -> int:
        """Its number in `TABLES`."""
        return 0 if self.is_angle else 1 + (self.quantity == DIFFERENCE)

    def errors(self, calibration: Calibration | None) -> np.ndarray:
        """Measured minus expected values (N,), rad or m, NaN where not measured; None: without a calibration."""
        true, k = self.pairs.true, self.column
        expected = true[:, k]
        if calibration is not None and self.is_angle:
            expected = calibration.stations.get(self.name, UNCALIBRATED).measured(true)[:, k]
        elif calibration is not None and self.quantity == DIFFERENCE:
            names, number = np.unique(self.pairs.other, return_inverse=True)
            both = np.column_stack([np.full(len(number), len(names)), number])
            expected = expected - calibration.of_differences([*names, self.name], both, np.zeros(len(number)))[0]
        elif calibration is not None and self.name in calibration.anchors:
            tags, number = np.unique(self.pairs.tag, return_inverse=True)
            biases = np.array([calibration.tags[tag].bias if tag in calibration.tags else 0.0 for tag in tags])
            expected = expected + range_terms(expected) @ calibration.anchors[self.name].coefficients + biases[number]
        return self.pairs.measured[:, k] - expected

    def bend(self, calibration: Calibration) -> str:
        """`NOT_LINEAR` where the ranges contradict the line of the calibration."""
        errors = self.errors(calibration)
        bent = differs_by_distance(self.pairs.true[:, 0], errors, self.pairs.piece, self.spread(errors))
        return NOT_LINEAR if bent else ""

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
    """The tables of a calibration by their part of the page, those with rows, and no column of dashes alone.

    `undetermined`: each source with the terms that are not determined. `by_place`: what a map of bearings brings, in
    words.
    """

    tables: dict[str, Section]
    undetermined: list[tuple[str, str]]
    sources: list[Source]
    by_place: str

    @property
    def note(self) -> str:
        """What the marks mean that occur in the tables."""
        cells = [*chain.from_iterable([section.head, *section.rows] for section in self.tables.values())]
        notes = [text for mark, text in NOTES.items() if any(mark in cell for row in cells for cell in row)]
        return " ".join([*notes, self.by_place] if self.by_place else notes)


SECTIONS = {
    "stations": Section("Stations", ANGLE_HEAD, [], 2, "", {"calibrated": "after"}),
    "anchors": Section("Anchors", RANGE_HEAD, [], 1, "", {"calibrated": "after"}),
    "differences": Section("Range differences", DIFFERENCE_HEAD, [], 1, "", {"calibrated": "after"}),
    "tags": Section("Tags: bias relative to their mean, and where their ranges end", TAG_HEAD, []),
}
"""The tables without their rows: of stations by angle, of anchors of ranges and of differences, of tags if several."""


def report_on(calibration: Calibration, folders: Sequence[RecordingFolder]) -> Report:
    """The tables of a calibration of these recordings."""
    # An anchor whose differences are to anchors with too few has no bias.
    sources = [source for source in _sources(folders) if source.table < 2 or source.name in calibration.differences]
    without = _without_each(folders)
    tables: dict[str, list[list[str]]] = {name: [] for name in SECTIONS}
    undetermined = []
    for source in sources:
        terms, covariance, determined, names = _fit(calibration, source)
        sigmas = np.sqrt(np.diag(covariance))
        cells = [_term(*values) for values in zip(terms, sigmas, determined, strict=True)]
        left_out = np.full(len(source.pairs.true), np.nan)
        for number, other in enumerate(without):
            if other is not None:
                of_recording = source.pairs.recording == number
                left_out[of_recording] = source.errors(other)[of_recording]
        measured = source.errors(None)
        spreads = [source.spread(errors) for errors in (measured, source.errors(calibration), left_out)]
        factor, unit = _shown(source.quantity)
        shown = [MISSING if np.isnan(spread) else fixed(factor * spread, 1) + unit for spread in spreads]
        heads = [source.name, source.quantity], [source.name + source.bend(calibration)], [source.name]
        head = heads[source.table]
        tables[TABLES[source.table]].append([*head, *cells, str(int(np.isfinite(measured).sum())), *shown])
        lacking = [name for name, known in zip(names, determined, strict=True) if not known]
        if lacking:
            words = f"station {source.name}, {source.quantity}", f"anchor {source.name}"
            word = (*words, f"anchor {source.name} in range differences")[source.table]
            undetermined.append((word, ", ".join(lacking)))
    tables["tags"] = [
        [name, _term(tag.bias, tag.sigma, True), *map(_offset, tag.offset, tag.offset_sigmas), str(tag.rows)]
        for name, tag in calibration.tags.items()
        if len(calibration.tags) > 1
    ]
    filled: dict[str, Section] = {}
    for part, rows in tables.items():
        section = SECTIONS[part]
        width = len(section.head) - (part in TABLES and all(row[-1] == MISSING for row in rows))
        if rows:
            filled[part] = section._replace(head=section.head[:width], rows=[row[:width] for row in rows])
    return Report(filled, undetermined, sources, _in_words(calibration.bearing_map))


def _in_words(by_place: BearingMap | None) -> str:
    """What a map of the errors of bearings brings; empty without one."""
    if by_place is None:
        return ""
    return (
        "A map of the errors of bearings over the floor is kept, of "
        f"{sum(len(visits) for visits in by_place.stations.values())} visits: visits left out are more probable by "
        f"{by_place.gain:.3f} nats each than without it. `bearings` uses it for tags of known height."
    )


def _offset(value: float, sigma: float) -> str:
    """A part of the place where the ranges of a tag end; none where the heading of its body is not known."""
    return _term(value, sigma, sigma < DETERMINED * OFFSET_SIGMA) if sigma else MISSING


def _sources(folders: Sequence[RecordingFolder]) -> Iterator[Source]:
    for table, quantities in (("bearings", ANGLES), ("ranges", ["range"]), ("tdoa", [DIFFERENCE])):
        for name, pairs in calibration_pairs(folders, KINDS[table]).items():
            for column, quantity in enumerate(quantities):
                yield Source(name, quantity, column, pairs)


def _without_each(folders: Sequence[RecordingFolder]) -> list[Calibration | None]:
    """Of each recording: the calibration on the others, None where they have too few rows."""
    calibrations: list[Calibration | None] = []
    for left_out in folders:
        try:
            calibrations.append(systematic([folder for folder in folders if folder is not left_out]))
        except UnusableInput:
            calibrations.append(None)
    return calibrations


def _fit(calibration: Calibration, source: Source) -> tuple[np.ndarray, np.ndarray, np.ndarray, Sequence[str]]:
    """Terms, covariance, whether each is determined, and their names."""
    if source.is_angle:
        station, k = calibration.stations[source.name], source.column
        return station.coefficients[k], station.covariances[k], station.determined[k], ANGLE_TERMS
    if source.quantity == DIFFERENCE:
        known, k = calibration.differences, calibration.differences.anchors.index(source.name)
        return known.biases[[k]], known.covariance[[k]][:, [k]], known.determined[[k]], RANGE_TERMS[:1]
    anchor = calibration.anchors[source.name]
    return anchor.coefficients, anchor.covariance, anchor.determined, RANGE_TERMS


def _shown(quantity: str) -> tuple[float, str]:
    """The factor and the unit with which sizes of errors are shown."""
    return (DEGREES, "°") if quantity in ANGLES else (100.0, " cm")


def _term(value: float, sigma: float, determined: bool) -> str:
    text = f"{fixed(value, 3)}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{fixed(sigma, 3)}"
    return text if determined else f"({text})"


def calibration_charts(calibration: Calibration, report: Report) -> dict[str, tuple[list[Chart], list[Chart]]]:
    """Of each table with sources, by what they are called: readings against the truth, and errors over the floor."""
    charts = {}
    for number, kind in enumerate(TABLES):
        panels = [_panel(calibration, source) for source in report.sources if source.table == number]
        panels = [panel for panel in panels if len(panel.true)][: SHOWN if number else 2 * SHOWN]
        if panels:
            charts[kind] = [reading_chart(panel, kind) for panel in panels], floor_charts(panels, kind)
    return charts


def _panel(calibration: Calibration, source: Source) -> Panel:
    pairs, column = source.pairs, source.column
    seen = np.isfinite(pairs.measured[:, column])
    true = pairs.true[seen, column]
    at = np.linspace(true.min(), true.max(), CURVE) if seen.any() else np.zeros(0)
    terms, covariance, _, _ = _fit(calibration, source)
    if source.is_angle:
        # The curve of one angle is that at the median of the other.
        angles = np.repeat(np.median(pairs.true, axis=0)[None], len(at), axis=0)
        angles[:, column] = at
        factors = angle_terms(angles, calibration.stations[source.name].spans)[:, column]
        fitted = factors @ terms
    else:
        factors = range_terms(at)[:, : len(terms)]
        fitted = at + factors @ terms
    sigma = np.sqrt(np.einsum("ki,ij,kj->k", factors, covariance, factors))
    columns = true, true + source.errors(None)[seen], true + source.errors(calibration)[seen]
    return Panel(source.name, source.quantity, source.is_angle, *columns, pairs.positions[seen, :2], at, fitted, sigma)


def write_calibration_report(
    out: Path,
    calibration: Calibration,
    report: Report,
    figures: Mapping[str, tuple[list[Chart], list[Chart]]],
    command: Sequence[str],
) -> Path:
    """Writes the page beside the file `out`, with its name and the ending .html; returns the path."""
    counts = [len({row[0] for row in report.tables[name].rows}) for name in TABLES if name in report.tables]
    text = page(
        "calibration.html",
        command,
        title=f"Calibration on {counted(len(calibration.recordings), 'recording')}",
        recordings=calibration.recordings,
        report=report,
        **report.tables,
        figures=figures,
        several=len(calibration.recordings) > 1,
        most=SHOWN if max(counts, default=0) > SHOWN else None,
        out=str(out),
    )
    return write_page(out.with_suffix(".html"), text)
