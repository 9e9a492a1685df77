"""The page of `track`: estimates that move over the floor plan, with linked charts, in one HTML file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from markupsafe import Markup

from trackwright.experiments.pages.reports.pages import (
    TYPES,
    drawn_rows,
    drawn_tracks,
    packed,
    page,
    rounded,
    script_json,
    write_page,
)
from trackwright.experiments.pages.reports.residuals import page_residuals
from trackwright.experiments.pages.scored_tracks import Component, ScoredRecording, ScoredTracks
from trackwright.experiments.text.wording import SCALES, shown_metric
from trackwright.trackers.core.data.seconds import time_label
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.metrics import METRICS
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.tuning.diagnostics import nis_quantile

PAGE = "report.html"
"""File in the output folder of `trackwright track`."""

SCRIPTS = ("data", "formats", "colours", "plan", "polar", "overlay", "series", "charts", "playback", "main")
"""The page's own scripts, in the order in which they need each other."""

MOST_ROWS, MOST_TRACKS, MOST_POINTS, MOST_EVENTS = 25_000, 300, 12_000, 1_000
"""The most estimates, tracks, residuals and events of a page, over all its recordings."""

MOST_RECORDINGS = 60
"""The most recordings of a page; the terminal's table has all."""

MOST_LISTED = 40
"""The most tracks in the table: those with the largest errors."""


def write_track_page(path: Path, runs: Sequence[Mapping[str, Any]], command: str, kind: str = "track") -> None:
    """Writes the page, whole or not at all. `runs`: from `run_data`, one for each tracker; `kind`: who wrote it."""
    write_page(path, track_page(runs, command, kind))


def track_page(runs: Sequence[Mapping[str, Any]], command: str = "", kind: str = "track") -> str:
    """The text of the page; arguments as of `write_track_page`."""
    names = list(dict.fromkeys(recording["name"] for run in runs for recording in run["recordings"]))
    return page(
        "track.html",
        title=", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else ""),
        kind=kind,
        tracker=runs[0]["tracker"],
        data=Markup(script_json({"runs": runs, "command": command, "columns": _columns()})),
        scripts=SCRIPTS,
    )


def run_data(
    tracks: ScoredTracks,
    events: pl.DataFrame,
    evaluation: Evaluation | None,
    tracker: str,
    name: str = "",
    of: int = 1,
    figures: bool = False,
) -> dict[str, Any]:
    """Everything that the page shows of one tracker, within limits on rows, tracks and residuals of all together.

    `evaluation`: None without truth. `tracker`: what it is; `name`: its name where the page has `of` trackers, more
    than one. `figures`: whether there are figures in files, whose choice of recordings the page names.
    """
    shown = tracks.recordings[:MOST_RECORDINGS]
    total = of * max(sum(len(recording.times) for recording in shown), 1)
    recordings = []
    for recording in shown:
        share = len(recording.times) / total
        of_recording = events.filter(pl.col("recording") == recording.folder.name)
        limits = (max(int(share * most), least) for most, least in
                  ((MOST_ROWS, 200), (MOST_TRACKS, 3), (MOST_POINTS, 100)))  # fmt: skip
        recordings.append(recording_data(recording, of_recording, *limits))
    return {
        "name": name,
        "tracker": tracker,
        "recordings": recordings,
        "recordingCount": len(tracks.recordings),
        "metrics": [] if evaluation is None else _metrics(evaluation),
        "statements": [] if evaluation is None else evaluation.statements,
        "figures": tracks.drawn_words if figures else "",
    }


HEADED = {"m": "m", "m²": "m²", "rad": "°", "s": "s"}
"""The units in headings of columns, by those in which metrics are stored."""


def _columns() -> list[dict[str, Any]]:
    """The columns of the table of metrics."""
    columns = []
    for metric in METRICS.values():
        if metric.page:
            unit, (factor, digits) = HEADED.get(metric.unit, ""), SCALES.get(metric.unit, (1.0, 3))
            words = metric.short.replace("\n/", "/").replace("\n", " ")
            title = f"{words}, {unit}" if unit else words
            columns.append({"key": metric.name, "title": title, "factor": factor, "digits": digits})
    return columns


def _metrics(evaluation: Evaluation) -> list[dict[str, Any]]:
    """The main metrics of each recording and of the tracks with the largest errors, without those that have no data.

    Errors in 3-D of a height that is given, not estimated, are left out.
    """

    def size(metrics: Mapping[str, Any]) -> float:
        return metrics.get("rmse_m") or metrics.get("rmse_direction_rad") or 0.0

    def known(metrics: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
        for column in _columns():
            value = shown_metric(metrics, column["key"])
            if value is not None:
                yield column["key"], rounded(value)

    worst = sorted(evaluation.tracks, key=size, reverse=True)[:MOST_LISTED]
    return [
        {key: metrics[key] for key in ("recording", "tag", "station") if metrics.get(key) is not None}
        | dict(known(metrics))
        for metrics in (*evaluation.recordings, *worst)
    ]


FAR_M = 500.0
"""Distance from the origin, m, from which the page holds positions relative to another one."""

CELLS = 30
"""The most cells along the longer side of the map of errors."""

STATUSES = ("ok", "waiting", "lost", "restarted", "non-finite")


def recording_data(
    recording: ScoredRecording, events: pl.DataFrame, most_rows: int, most_tracks: int, most_points: int
) -> dict[str, Any]:
    """The recording as the page's scripts read it; lengths in m relative to `origin`, times in s after `start`.

    `events`: of this recording. The rest: limits on the rows, tracks and residuals that are drawn.
    """
    # matplotlib takes a third of a second to import, which a run without a page need not wait for.
    from trackwright.experiments.pages.charts.figures import page_charts

    starts, rows, times = recording.starts, recording.rows, recording.times
    lengths = np.diff(starts)
    chosen = drawn_tracks(recording.worst_first(), most_tracks)
    kept_lengths = lengths[chosen]
    of_chosen = np.concatenate([np.arange(starts[k], starts[k + 1]) for k in chosen] or [np.zeros(0, int)])
    drawn = drawn_rows(kept_lengths, recording.miss[of_chosen], most_rows) if len(of_chosen) else of_chosen
    first = np.searchsorted(drawn, np.concatenate([[0], np.cumsum(kept_lengths)]))
    index = of_chosen[drawn]
    start = float(np.min(times, initial=np.inf)) if len(times) else 0.0
    zero = recording.zero
    places = [np.zeros(len(rows)) if recording.angles else float_column(rows, f"{axis}_m") for axis in "xy"]
    origin = _origin(np.stack(places, axis=1))
    stations = recording.first["station"].to_list() if recording.angles else [None] * len(lengths)
    tags = recording.first["tag"].to_list()
    source, sources = _sources(recording, index)
    scale = 180 / np.pi if recording.angles else 1.0
    components = recording.components()
    return {
        "name": recording.folder.name,
        "start": start - zero,
        "end": float(np.max(times, initial=start)) - zero if len(times) else start - zero,
        "timeLabel": time_label(zero),
        "origin": origin.tolist(),
        "angles": recording.angles,
        "rows": len(rows),
        "drawn": len(index),
        "trackCount": len(lengths),
        "tracks": [
            {"tag": tags[k], "station": stations[k], "first": int(a), "end": int(b),
             "rmse": rounded(scale * float(recording.rmse[k])), "rows": int(lengths[k])}
            for k, a, b in zip(chosen, first[:-1], first[1:], strict=True)
        ],
        "axes": [
            {"name": c.name, "unit": c.unit, "value": f"v{k}", "error": f"e{k}", "sigma": f"s{k}", "bound": f"b{k}"}
            for k, c in enumerate(components)
        ],
        "columns": _packed_rows(recording, components, index, start, origin)
        | {"status": packed(_statuses(rows, index), "u1"), "source": packed(source, "u2")},
        "statuses": STATUSES,
        "sources": sources,
        "nisBand": _nis_band(rows, recording.student_t_dof),
        "events": _events(events, chosen, tags, stations, start),
        "eventCount": len(events),
        "rig": _rig(recording.folder.rig, origin),
        "bounds": _bounds(recording, start),
        "residuals": page_residuals(recording, most_points),
        "map": error_map(recording, origin),
        "charts": page_charts(recording),
    }  # fmt: skip


def _origin(positions: np.ndarray) -> np.ndarray:
    """Zero, or for positions (n, 2) far from it, whose single precision is coarse, whole metres in their middle."""
    known = positions[np.isfinite(positions).all(axis=1)]
    middle = np.floor(np.median(known, axis=0)) if len(known) else np.zeros(2)
    return middle if np.abs(middle).max() > FAR_M else np.zeros(2)


def _packed_rows(
    recording: ScoredRecording, components: list[Component], index: np.ndarray, start: float, origin: np.ndarray
) -> dict[str, dict[str, str]]:
    """Times, values, errors, standard deviations, horizontal covariance, NIS and its degrees of freedom of the rows."""
    rows = recording.rows[index]
    columns = {"t": float_column(rows, "t_s") - start}
    for k, component in enumerate(components):
        values, errors, sigmas = (values[index] for values in component[2:])
        columns |= {
            f"v{k}": values - (0.0 if recording.angles else [*origin, 0.0][k]),
            f"e{k}": errors,
            f"s{k}": sigmas,
        }
    if recording.angles:
        columns["miss"] = np.degrees(recording.miss[index])
    else:
        columns["cov"] = np.nan_to_num(float_column(rows, "cov_xy_m2"))
    dof = np.nan_to_num(float_column(rows, "nis_dof"))
    columns |= {"nis": np.where(dof > 0, float_column(rows, "nis"), np.nan), "dof": dof}
    return {name: packed(values, TYPES.get(name, "f4")) for name, values in columns.items()}


def _statuses(rows: pl.DataFrame, index: np.ndarray) -> np.ndarray:
    """The numbers in `STATUSES` of the rows' status; all `ok` in a table without."""
    if "status" not in rows.columns:
        return np.zeros(len(index), int)
    words = rows["status"].cast(pl.String).fill_null("ok").to_numpy()[index]
    return np.select([words == name for name in STATUSES], range(len(STATUSES)), 0)


def _sources(recording: ScoredRecording, index: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """The number of the anchor or station whose reading has the time of each row, and their names.

    The two last names are for several sources at one time and for none.
    """
    rows, folder = recording.rows[index], recording.folder
    if recording.angles:
        names = sorted(folder.rig.stations)
        return np.array([names.index(s) for s in rows["station"].to_list()], int), names
    readings = [
        folder.tables[table].select(pl.col("tag").cast(pl.String), "t_s", source=pl.col(column).cast(pl.String))
        for table, kind in KINDS.items()
        for column in kind.sensors
        if table in folder.tables
    ]
    if not readings:
        return np.zeros(len(rows), int), []
    at_times = pl.concat(readings).group_by("tag", "t_s").agg(
        source=pl.col("source").first(), several=pl.col("source").n_unique() > 1
    )  # fmt: skip
    joined = rows.select("tag", "t_s").join(at_times, on=["tag", "t_s"], how="left", maintain_order="left")
    names = sorted(pl.concat(readings)["source"].unique().to_list())
    words = pl.when(pl.col("several")).then(pl.lit("several")).otherwise(pl.col("source").fill_null("none"))
    order = {name: k for k, name in enumerate([*names, "several", "none"])}
    number = joined.select(words.alias("word"))["word"].replace_strict(order, return_dtype=pl.Int64).to_numpy()
    return number, list(order)


def _nis_band(rows: pl.DataFrame, student_t_dof: float | None) -> list[float] | None:
    """The central 95 % of NIS per degree of freedom of a consistent filter, at the median degrees of freedom.

    Empty where the distribution is unknown; None without NIS.
    """
    dof = float_column(rows, "nis_dof")
    dof = dof[dof > 0]
    if not len(dof):
        return None
    if student_t_dof is not None and math.isnan(student_t_dof):
        return []
    middle = float(np.median(dof))
    return [nis_quantile(p, middle, student_t_dof) / middle for p in (0.025, 0.975)]


def _events(
    events: pl.DataFrame, chosen: list[int], tags: list[str], stations: list[str | None], start: float
) -> list[dict[str, Any]]:
    """The first events of the tracks that are drawn; `track` is the number among these."""
    number = {(tags[k], stations[k]): place for place, k in enumerate(chosen)}
    shown: list[dict[str, Any]] = []
    for event in events.iter_rows(named=True):
        place = number.get((event["tag"], event.get("station")))
        if place is not None and len(shown) < MOST_EVENTS:
            shown.append(
                {"t": max(event["t_s"] - start, 0.0), "track": place, "what": event["event"], "detail": event["detail"]}
            )
    return shown


def _rig(rig: Rig, origin: np.ndarray) -> dict[str, Any]:
    """Anchors, stations with their boresight, walls and path, m, relative to the origin."""
    corner = np.append(origin, 0.0)

    def point(position: np.ndarray) -> list[float]:
        return [round(float(x), 4) for x in np.asarray(position, float) - corner]

    return {
        "anchors": [{"name": name, "at": point(position)} for name, position in rig.anchors.items()],
        "stations": [
            {"name": name, "at": point(station.position), "ahead": station.world_from_array()[:, 2].round(4).tolist()}
            for name, station in rig.stations.items()
        ],
        "walls": (rig.all_walls() - np.tile(origin, 2)).round(4).tolist(),
        "path": [] if rig.path_knots is None else (rig.path_knots - origin).round(4).tolist(),
    }


def _bounds(recording: ScoredRecording, start: float) -> dict[str, Any] | None:
    if recording.bounds is None:
        return None
    times, bounds = recording.bounds
    step = max(1, len(times) // 2000)
    columns = {f"b{k}": packed(bounds[::step, k]) for k in range(3)}
    return {"t": packed(times[::step] - start, TYPES["t"])} | columns


def error_map(recording: ScoredRecording, origin: np.ndarray) -> dict[str, Any] | None:
    """The RMSE of the horizontal position, m, in square cells of the floor by the true position; None without truth.

    `x`, `y`: the cells' middles, m, relative to the origin. `rmse`, `count`: by rows of cells; null in an empty cell.
    """
    if recording.angles:
        return None
    squares = (recording.errors[:, :2] ** 2).sum(axis=1)
    true = recording.truth[:, :2] - origin
    known = np.isfinite(squares) & np.isfinite(true).all(axis=1)
    if known.sum() < 2:
        return None
    low, high = true[known].min(axis=0), true[known].max(axis=0)
    extent = float(np.max(high - low))
    if extent < 0.05:
        return None
    cell = _round_size(extent / CELLS)
    x, y = (cell * np.arange(a, b + 2) for a, b in np.floor(np.stack([low, high], axis=1) / cell))
    across, up = true[known].T
    count, total = (np.histogram2d(up, across, bins=[y, x], weights=w)[0] for w in (None, squares[known]))
    rmse = np.sqrt(total / np.where(count > 0, count, np.nan))
    return {
        "cell": cell,
        "x": (x[:-1] + cell / 2).round(4).tolist(),
        "y": (y[:-1] + cell / 2).round(4).tolist(),
        "rmse": [[rounded(value) for value in row] for row in rmse.tolist()],
        "count": count.astype(int).tolist(),
    }


def _round_size(size: float) -> float:
    """The smallest of 1, 2 and 5 times a power of ten that is no smaller than `size`."""
    decade = 10.0 ** np.floor(np.log10(size))
    return float(next(d * decade for d in (1, 2, 5, 10) if d * decade >= size * (1 - 1e-9)))
