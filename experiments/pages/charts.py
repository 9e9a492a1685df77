"""The charts of scored estimates, each one function: for a notebook, a file and a page."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.pages.chart import (
    GREY,
    LINES,
    TRUTH,
    Chart,
    Line,
    band,
    broken_at_gaps,
    path,
    write_charts,
)
from trackwright.experiments.pages.scored_tracks import ScoredRecording, ScoredTracks, drawn_of
from trackwright.experiments.text.tables import SHOWN, length_unit
from trackwright.trackers.core.data.consistency import chi_square_probability, chi_square_quantile, nis_band
from trackwright.trackers.core.errors import UnusableInput, time_label
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.rows import covariances, main_size
from trackwright.trackers.recordings.columns import TagRows, float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Measured
from trackwright.trackers.recordings.tracks_table import is_bearing

Runs = ScoredRecording | pl.DataFrame | Mapping[str, ScoredRecording | pl.DataFrame]
"""Scored estimates of a recording or of several, or those of several runs by name."""

MARKED, LEVELS = (50.0, 90.0, 95.0), {level: str(level) for level in (0, 25, 50, 75, 90, 100)}
"""Percentiles named in the distribution of errors, and ticks of levels and shares, %."""

ELLIPSES, LARGE = 24, 3.0
"""The most ellipses of a floor plan, and the size in medians of those that are not drawn, as of a start."""

WINDOW, WINDOWS = 20, 120  # the fewest rows of a mean of NEES or NIS over time, and the most means

WIDE: dict[str, Any] = {"width": 8.0, "height": 2.6}


def floor_plan(scored: ScoredRecording, tags: Sequence[str] = ()) -> Chart:
    """The estimated paths over the floor, m, with some reported 95 % ellipses, truth and installation.

    `tags`: those drawn, at most six; by default all, or of more the worst, the median and the best. Outliers don't set
    the scale; a note names their number. Raises UnusableInput for bearings, and for an unknown tag.
    """
    if scored.angles:
        raise UnusableInput("floor_plan: found bearings; expected estimates of positions")
    names = [str(tag) for tag in scored.first["tag"]]
    order = sorted(range(len(names)), key=lambda k: natural(names[k]))
    shown = tags[: len(LINES)] or [names[order[k]] for k in drawn_of(scored.rmse[order], len(LINES))]
    parts, truths, around, drawn = list[Line](), list[Line](), [np.zeros((0, 2))], [np.zeros((0, 2))]
    for tag, colour in zip(shown, LINES, strict=False):
        rows = scored.rows_of(track_number(scored, tag))
        places, table = scored.columns("x_m", "y_m")[rows], scored.rows[rows]
        there = np.isfinite(places).all(axis=1)
        _, whole = broken_at_gaps(scored.times[rows][there], places[there])
        centres, covs = _some_covariances(places, table, min(ELLIPSES // len(shown), ELLIPSES // 2))
        name = f"tag {tag}" if tag else "estimates"
        parts += [path(whole, name, colour, 1.1), path(ellipses(centres, covs), "", colour, 0.8)]
        true, known = scored.columns("true_x_m", "true_y_m")[rows], scored.miss[rows] >= 0
        _, true = broken_at_gaps(scored.times[rows][known], true[known])
        truths += [path(true, "" if truths else "truth", TRUTH, 3.0)] if len(true) else []
        drawn.append(places[there])
        around += [true, np.quantile(places[there], (0.01, 0.99), axis=0, method="nearest") if there.any() else true]
    chart = plan("floor-plan", "Floor plan", [*truths, *parts], np.concatenate(around), scored.folder.rig)
    low, high = np.transpose([chart.xlim, chart.ylim])
    outside = int(((np.concatenate(drawn) < low) | (np.concatenate(drawn) > high)).any(axis=1).sum())
    notes = [f"{len(shown)} of {len(names)} tags are shown."] if len(names) > len(shown) else []
    notes += [f"{outside} of {sum(map(len, drawn))} estimates lie outside the axes."] if outside else []
    return replace(chart, note=" ".join(notes))


def plan(name: str, title: str, parts: Sequence[Line], around: np.ndarray, rig: Rig) -> Chart:
    """Lines over the floor with the installation; the axes hold the points `around` (n, 2) and the installation."""
    walls = rig.all_walls().reshape(-1, 2, 2)
    points = np.concatenate([around, np.reshape(rig.places(), (-1, 3))[:, :2], walls.reshape(-1, 2)])
    points = points[np.isfinite(points).all(axis=1)] if np.isfinite(points).any() else np.zeros((1, 2))
    low, high = points.min(axis=0), points.max(axis=0)
    size = float(np.max(high - low))
    # The millimetres of noise of a tag at rest shall not fill the plan.
    (left, bottom), (right, top) = low - max(0.08 * size, 0.25), high + max(0.08 * size, 0.25)
    broken = np.pad(walls, ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2)
    rig_lines = [path(broken, "", GREY, 2.0)]
    stations = {name: station.position for name, station in rig.stations.items()}
    for kind, marker, places in (("anchor", "triangle-up", rig.anchors), ("station", "square", stations)):
        if places:
            at = np.array([place[:2] for place in places.values()])
            rig_lines.append(path(at, kind, GREY, 0.0, marker=marker, size=7, text=[*places]))
    height = 7.9 * float(np.clip((top - bottom) / (right - left), 0.3, 1.5)) + 1.1
    look: dict[str, Any] = {"equal": True, "width": 8.5, "height": height}
    return Chart(name, title, "x (m)", "y (m)", [*parts, *rig_lines], (left, right), (bottom, top), **look)


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts names with their numbers: 2 before 10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]


def _some_covariances(places: np.ndarray, rows: pl.DataFrame, count: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `count` of the places with proper covariances (k, 2, 2), evenly over the rows, and these."""
    covs = covariances(rows)[:, :2, :2]
    proper = np.isfinite(places).all(axis=1) & np.isfinite(covs).all(axis=(1, 2)) & (covs[:, 0, 0] > 0)
    major = np.linalg.eigvalsh(np.where(proper[:, None, None], covs, np.eye(2)))[:, 1]
    some = np.flatnonzero(proper & (major <= LARGE**2 * (np.median(major[proper]) if proper.any() else 0.0)))
    some = some[np.unique((np.arange(count) + 0.5) * len(some) / count).astype(int)] if len(some) else some
    return places[some], covs[some]


def ellipses(centres: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """The 95 % ellipses (n, 2) as one line with NaN between them."""
    squares, vectors = np.linalg.eigh(covs)
    turn = np.append(np.linspace(0, 2 * np.pi, 37), np.nan)
    half_axes = vectors * np.sqrt(chi_square_quantile(0.95, 2) * np.maximum(squares, 0))[:, None, :]
    return (np.swapaxes(half_axes @ np.stack([np.cos(turn), np.sin(turn)]), 1, 2) + centres[:, None]).reshape(-1, 2)


def track_number(scored: ScoredRecording, tag: str | None) -> int:
    """The number of the track of a tag; of none the one with the largest RMSE."""
    tags = [str(name) for name in scored.first["tag"]]
    matches = [k for k in scored.worst_first() if tag in (None, tags[k])]
    if not matches:
        raise UnusableInput(f"plot: no estimate of tag '{tag}'; tags: {', '.join(sorted({*tags}, key=natural))}")
    return matches[0]


def error_over_time(scored: ScoredRecording, tag: str | None = None) -> Chart:
    """The horizontal error of a tag, by default the worst, over time with its standard deviation, or of an angle."""
    rows = scored.rows_of(track_number(scored, tag))
    factor, name = (180 / np.pi, "angle to the truth (°)") if scored.angles else (1.0, "horizontal error (m)")
    error, parts = factor * scored.miss[rows], list[Line]()
    top = float(np.nanquantile(error, 0.995, method="nearest")) if np.isfinite(error).any() else 0.0
    if not scored.angles:
        sigma = np.hypot(*scored.columns("std_x_m", "std_y_m")[rows].T)
        at, wide = broken_at_gaps(scored.times[rows] - scored.zero, sigma)
        parts = [band(at, 0.0, wide, "reported standard deviation")]
        # A wide band, as of a start, does not flatten the error.
        top = max(top, float(np.nan_to_num(min(3 * np.nanmedian(sigma), np.nanmax(sigma)))))
    at, shown = broken_at_gaps(scored.times[rows] - scored.zero, error)
    parts.append(Line(at, shown, "error", width=0.9))
    note = f"Tag {scored.rows['tag'][int(rows.start)]}, the largest RMSE of {len(scored.rmse)}."
    note = note if tag is None and len(scored.rmse) > 1 else ""
    labels = "error-over-time", "Error over time", time_label(scored.zero), name
    return Chart(*labels, parts, ylim=(0, 1.1 * top or None), note=note, **WIDE)


def _tables(runs: Runs) -> dict[str, pl.DataFrame]:
    """The scored rows of runs by name."""
    named = runs if isinstance(runs, Mapping) else {"": runs}
    return {name: run.rows if isinstance(run, ScoredRecording) else run for name, run in named.items()}


def _by_shape(runs: Runs, flat: str, spatial: str) -> dict[str, tuple[np.ndarray, int]]:
    """A column of each run (n,), without NaN, and its degrees of freedom; of one run also the one in space, if any."""
    tables, several = _tables(runs), isinstance(runs, Mapping)
    bearing = is_bearing(next(iter(tables.values())))
    words = "" if several else "both angles" if bearing else "horizontal"
    found = {name or words: (float_column(rows, flat), 2) for name, rows in tables.items()}
    if not several and not bearing and tables[""]["nees_3d"].is_finite().any():
        found["3-D"] = float_column(tables[""], spatial), 3
    return {name: (of[np.isfinite(of)], dof) for name, (of, dof) in found.items() if np.isfinite(of).any()}


def error_cdf(scored: Runs) -> Chart:
    """The distribution function of the errors, horizontal and 3-D or of angles; of several runs by name, a curve each.

    The axis ends at the second largest of the runs' 99th percentiles, or at the largest 95th if that is more.
    """
    tables = _tables(scored)
    first = next(iter(tables.values()))
    errors = _by_shape(scored, main_size(first), "size_3d_m")
    p95, p99 = (sorted(float(np.quantile(e, share)) for e, _ in errors.values()) for share in (0.95, 0.99))
    end = 1.05 * max([p95[-1], p99[-2:][0]] if errors else [1.0])
    unit, parts = SHOWN["rad"] if is_bearing(first) else length_unit(end / 2), list[Line]()
    for k, (name, (values, _)) in enumerate(errors.items()):
        shares = np.linspace(0, 100, min(len(values), 201))
        marked = ", ".join(
            f"p{p:.0f} {v:.3g}" for p, v in zip(MARKED, unit.factor * np.percentile(values, MARKED), strict=True)
        )
        words = f"RMSE {unit.factor * np.sqrt(np.mean(values**2)):.3g}" if isinstance(scored, Mapping) else marked
        beyond = 100 * np.mean(values > end)
        label = f"{name}: {words} {unit.name}" + (f", {beyond:.1f} % beyond" if beyond >= 1.05 else "")
        parts.append(Line(unit.factor * np.percentile(values, shares), shares, label, LINES[k % len(LINES)]))
    what = "angle to the truth" if is_bearing(first) else "error" if len(errors) > 1 else "horizontal error"
    ends: dict[str, Any] = {"xlim": (0, unit.factor * end), "ylim": (0, 101), "yticks": LEVELS, "width": 6.4}
    labels = f"{what} ({unit.name})", "share of estimates (%)"
    return Chart("error-cdf", "Distribution of errors", *labels, parts, **ends)


def coverage(scored: Runs) -> Chart:
    """The observed share of the truth inside the reported ellipses against their level: the diagonal is correct.

    Of several runs by name a curve each; of one run those of ellipses and ellipsoids.
    """
    at, parts = np.linspace(0, 100, 201), [Line([0, 100], [0, 100], "correct covariances", GREY, 1.0, "dash")]
    for k, (name, (nees, dof)) in enumerate(_by_shape(scored, "nees", "nees_3d").items()):
        inside = 100 * np.searchsorted(np.sort(chi_square_probability(nees, dof)), at / 100, side="right") / len(nees)
        label = f"{name}: {inside[190]:.0f} % inside 95 %"
        parts.append(Line(at, inside, label, LINES[k % len(LINES)]))
    ends: dict[str, Any] = {"xlim": (0, 100.8), "ylim": (0, 100.8), "xticks": LEVELS, "yticks": LEVELS, "equal": True}
    return Chart("coverage", "Truth inside the reported ellipses", "level of the reported ellipse (%)",
                 "truth inside (% of rows)", parts, **ends, width=4.7, height=4.6)  # fmt: skip


def nees_over_time(scored: ScoredRecording) -> Chart:
    """The mean of the NEES per degree of freedom over time, with its band: 1 for correct covariances."""
    return _consistency(scored, "NEES", np.full(len(scored.rows), 2.0), "slow", None)


def nis_over_time(scored: ScoredRecording) -> Chart:
    """The mean of the NIS per degree of freedom over time, with its band where its distribution is known."""
    return _consistency(scored, "NIS", float_column(scored.rows, "nis_dof"), "slow_nis", scored.student_t_dof)


def _consistency(scored: ScoredRecording, name: str, dof: np.ndarray, slow: str, nu: float | None) -> Chart:
    """Means of NEES or NIS over the rows of all tracks in windows of time; `slow`: rows with the information of one."""
    values, of_one = (float_column(scored.rows, column) for column in (name.lower(), slow))
    known = np.flatnonzero(np.isfinite(values) & (dof > 0))
    order, parts, note = known[np.argsort(scored.times[known], kind="stable")], list[Line](), ""
    if len(order):
        windows = np.array_split(order, int(np.clip(len(order) // WINDOW, 1, WINDOWS)))
        total, freedom = (np.array([x[rows].sum() for rows in windows]) for x in (values, dof))
        at = np.array([scored.times[rows].mean() for rows in windows]) - scored.zero
        if nu is None or np.isfinite(nu):
            several = of_one[order][np.isfinite(of_one[order])]
            one = float(np.clip(several.mean(), 1.0, len(windows[0]))) if len(several) else 1.0
            parts.append(band(at, *nis_band(freedom / one, nu), "95 % band, rows as correlated as these"))
        mean = Line(at, total / freedom, f"mean of {len(windows[0])} rows", marker="circle", size=3)
        parts += [Line([at[0], at[-1]], [1.0, 1.0], "", GREY, 0.8), mean]
        note = f"Mean {total.sum() / freedom.sum():.2f}, 1 expected."
    labels = f"{name.lower()}-over-time", f"{name} over time", time_label(scored.zero), f"{name} / dof"
    return Chart(*labels, parts, log="y", note=note, **WIDE)


def plot_tracks(out: Path, tracks: ScoredTracks, kind: str = "png") -> list[str]:
    """Writes the charts of recordings `tracks.drawn`, and of all errors, into a folder, as png or pdf; their names."""
    figures = list[Chart]()
    for k in tracks.drawn:
        scored, name = tracks.recordings[k], tracks.folders[k].name
        charts = [] if scored.angles else [floor_plan(scored)]
        charts += [error_over_time(scored), nees_over_time(scored)] if np.isfinite(scored.miss).any() else []
        charts.append(nis_over_time(scored))
        suffix = "" if len(tracks.folders) == 1 else f"-{name}"
        figures += [replace(one, name=one.name + suffix, title=f"{one.title}, {name}") for one in charts if one.parts]
    if tracks.rows["why"].is_null().any():
        figures += [error_cdf(tracks.rows), coverage(tracks.rows)]
    return write_charts(out, figures, kind)


class Residuals(NamedTuple):
    """The residuals (n,) of one column of readings about the estimates or, of bearings, about the truth.

    `source`, `tag` (n,): numbers of the anchor or station among `sources`, and of the tag. `times` (n,): s.
    """

    name: str
    unit: str
    sources: list[str]
    source: np.ndarray
    tag: np.ndarray
    times: np.ndarray
    values: np.ndarray


def residuals(recording: ScoredRecording) -> tuple[list[str], list[Residuals]]:
    """The tags of the readings, and the residuals of each column that has any."""
    folder, tags, found = recording.folder, list[str](), list[Residuals]()
    for table, kind in KINDS.items():
        if table not in folder.tables or not kind.averaged:
            continue
        rows = folder.rows(table)
        tags += [tag for tag in rows.tags if tag not in tags]
        tag = rows.of_each(np.array([tags.index(tag) for tag in rows.tags]))
        measured = kind.measured(folder.rig, rows).usable
        measured = measured._replace(values=_without_systematic_errors(folder, measured, rows))
        source = measured.sensors.number[:, 0] if kind.sensors else np.zeros(len(rows.times), int)
        at = folder.paths.at(rows.tags, rows.starts, rows.times)[0] if recording.angles else _estimated(recording, rows)
        for column, values in zip(measured.columns, kind.shown[1] * measured.errors(at).T, strict=True):
            if np.isfinite(values).any():
                name, unit = column.rpartition("_")[0].replace("_", " "), kind.shown[0].strip()
                of = list(measured.ids) or [kind.name], source, tag, rows.times, values
                found.append(Residuals("fix, " * kind.position + name, unit, *of))
    return tags, found


def _estimated(recording: ScoredRecording, rows: TagRows) -> np.ndarray:
    """The estimated positions (N, 3), m, at the times of the readings, between rows of estimates; else NaN."""
    estimated = np.full((len(rows.times), 3), np.nan)
    of_tags = {tag: k for k, tag in enumerate(recording.first["tag"])}
    positions = recording.columns("x_m", "y_m", "z_m")
    for k, tag in ((k, tag) for k, tag in enumerate(rows.tags) if tag in of_tags):
        part, own = recording.rows_of(of_tags[tag]), slice(rows.starts[k], rows.starts[k + 1])
        known = np.isfinite(positions[part, :2]).all(axis=1)
        for axis in range(3) if known.any() else ():
            values = recording.times[part][known], positions[part][known, axis]
            estimated[own, axis] = np.interp(rows.times[own], *values, np.nan, np.nan)
    return estimated


def _without_systematic_errors(folder: RecordingFolder, measured: Measured, rows: TagRows) -> np.ndarray:
    """The readings (N, m), NaN where one is missing, without what the calibration says of their anchors or stations."""
    values, of, known = measured.values, measured.kind.calibrated, folder.calibration
    if known is None or of is None:
        return values
    number = measured.sensors.number
    if of == "stations":
        return known.of_bearings(measured.ids, number[:, 0], values)[1]
    if of == "differences":
        return known.of_differences(measured.ids, number, values[:, 0])[0][:, None]
    tag = rows.of_each(np.arange(len(rows.tags)))
    return known.of_ranges(measured.ids, number[:, 0], rows.tags, tag, values[:, 0])[0][:, None]
