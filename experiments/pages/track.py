"""The page of `track`: estimates that move over the floor plan, with linked charts, in one HTML file."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from trackwright.experiments.pages.chart import numbers
from trackwright.experiments.pages.charts import coverage, error_cdf, residuals
from trackwright.experiments.pages.report import page
from trackwright.experiments.pages.scored_tracks import ScoredRecording, ScoredTracks
from trackwright.experiments.text.tables import Section, cells, length_unit, shown_metric, title_of
from trackwright.trackers.core.data.consistency import nis_quantile
from trackwright.trackers.core.errors import time_label
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.evaluate import Evaluation
from trackwright.trackers.evaluation.metrics import METRICS
from trackwright.trackers.recordings.columns import float_column

PAGE = "report.html"  # file in the output folder of `trackwright track`

SCRIPTS = ("data", "formats", "plan", "polar", "overlay", "series", "playback", "main")
"""The page's own scripts, in the order in which they need each other."""

MOST_ROWS, MOST_TRACKS, MOST_POINTS, MOST_EVENTS = 25_000, 300, 12_000, 1_000
"""The most estimates, tracks, residuals and events of a page, over all its recordings."""

MOST_RECORDINGS, MOST_LISTED = 60, 40
"""The most recordings of a page, and the most tracks in its table: those with the largest errors."""

FAR_M = 500.0  # distance from the origin, m, from which the page holds positions relative to another one

STATUSES = ("ok", "waiting", "lost", "restarted", "non-finite")
TYPES = {"t": "f8", "tag": "u2", "source": "u2", "status": "u1"}
"""Types of columns that are no `f4`, in which times after a jump of the clock would run together."""


def track_page(runs: Sequence[Mapping[str, Any]], command: str = "") -> str:
    """The text of the page. `runs`: from `run_data`, one for each tracker."""
    names = list(dict.fromkeys(recording["name"] for run in runs for recording in run["recordings"]))
    title = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    told = {"title": title, "kind": "track", "tracker": runs[0]["tracker"], "command": command}
    return page("track.html", **told, metrics=_metrics(runs), data={"runs": runs}, scripts=SCRIPTS, moving=True)


def run_data(
    tracks: ScoredTracks, evaluation: Evaluation | None, tracker: str, name: str = "", of: int = 1
) -> dict[str, Any]:
    """Everything that the page shows of one tracker, within limits on rows, tracks and residuals of all together.

    `evaluation`: None without truth. `tracker`: what it is; `name`: its name where the page has `of` trackers.
    """
    shown, listed, recordings = tracks.recordings[:MOST_RECORDINGS], list[Mapping[str, Any]](), []
    total = of * max(sum(len(recording.times) for recording in shown), 1)
    if evaluation is not None:
        size = "rmse_direction_rad" if evaluation.bearing else "rmse_m"
        worst = sorted(evaluation.tracks, key=lambda metrics: -(metrics.get(size) or 0.0))[:MOST_LISTED]
        listed = [*evaluation.recordings, *worst * (len(evaluation.tracks) > len(evaluation.recordings))]
    for recording in shown:
        share = len(recording.times) / total
        limits = (MOST_ROWS, 200), (MOST_TRACKS, 3), (MOST_POINTS, 100)
        most = (max(int(share * most), least) for most, least in limits)
        recordings.append(recording_data(recording, *most))
    columns = [metric.name for metric in METRICS.values() if metric.page]
    metrics = [
        {key: metrics.get(key) for key in ("recording", "tag", "station", "nees_3d_ratio")}  # null: no 3-D
        | {key: x for key in columns if (x := shown_metric(metrics, key)) is not None and math.isfinite(x)}
        for metrics in listed
    ]
    statements = [] if evaluation is None else evaluation.statements
    return {"name": name, "tracker": tracker, "recordings": recordings, "recordingCount": len(tracks.recordings),
            "metrics": metrics, "statements": statements}  # fmt: skip


def _metrics(runs: Sequence[Mapping[str, Any]]) -> Section:
    """The table of all runs, of recordings first."""
    lines = [{**one, "tracker": run["name"]} for run in runs for one in run["metrics"]]
    keys = [(line["recording"], line["tag"], line["station"]) for line in lines]
    order = {key: k for k, key in enumerate(dict.fromkeys(sorted(keys, key=lambda key: key[1] is not None)))}
    lines = [lines[k] for k in sorted(range(len(lines)), key=lambda k: order[keys[k]])]
    labels = [name for name in ("recording", "tag", "station", "tracker") if any(line[name] for line in lines)]
    columns = [metric for metric in METRICS.values() if metric.page and any(metric.name in line for line in lines)]
    unit = length_unit(min((line["rmse_m"] for line in lines if "rmse_m" in line), default=math.nan))
    rows = [[*(line[name] or "" for name in labels), *cells(line, columns, unit)] for line in lines]
    head = [*labels, *(title_of(metric).replace("\n", " ") for metric in columns)]
    note = f"Lengths in {unit.name}, angles in degrees: each recording, and the tracks with the largest errors."
    return Section("Metrics", head, rows, len(labels), note)


def recording_data(recording: ScoredRecording, most_rows: int, most_tracks: int, most_points: int) -> dict[str, Any]:
    """The recording as the page's scripts read it; lengths in m relative to `origin`, times in s after `start`.

    Limits are on the rows, tracks and residuals that are drawn. Events are the losses of tracks.
    """
    starts, times, folder, angles = recording.starts, recording.times, recording.folder, recording.angles
    chosen, lengths = drawn_tracks(recording.worst_first(), most_tracks), np.diff(starts)
    of_chosen = np.concatenate([np.arange(starts[k], starts[k + 1]) for k in chosen] or [np.zeros(0, int)])
    drawn = drawn_rows(lengths[chosen], recording.miss[of_chosen], most_rows) if len(of_chosen) else of_chosen
    first = np.searchsorted(drawn, np.concatenate([[0], np.cumsum(lengths[chosen])]))
    start, end = (float(times.min()), float(times.max())) if len(times) else (0.0, 0.0)
    # Positions far from zero, whose single precision is coarse, are relative to whole metres in their middle.
    places = np.zeros((1, 2)) if angles else recording.columns("x_m", "y_m")
    middle = np.floor(np.nanmedian(places, axis=0)) if np.isfinite(places).any() else np.zeros(2)
    origin = middle if np.abs(middle).max() > FAR_M else np.zeros(2)
    keys = [(one["tag"], one.get("station")) for one in recording.first.iter_rows(named=True)]
    rmse = recording.rmse * (180 / np.pi if angles else 1.0)
    tracks = [
        {"tag": keys[k][0], "station": keys[k][1], "first": int(a), "end": int(b), "rmse": numbers(rmse[[k]])[0]}
        for k, a, b in zip(chosen, first[:-1], first[1:], strict=True)
    ]
    number = {keys[k]: place for place, k in enumerate(chosen)}
    lost = recording.rows.filter(pl.col("losses") > 0)
    happened = [
        {"t": max(event["t_s"] - start, 0.0), "track": track, "what": event["status"]}
        for event in lost.iter_rows(named=True)
        if (track := number.get((event["tag"], event.get("station")))) is not None
    ]
    columns = _columns(recording, of_chosen[drawn], start, origin)
    tags, found = residuals(recording)
    every = max(1, -(-sum(len(one.times) for one in found) // most_points))
    channels = [
        {"name": one.name, "unit": one.unit, "sources": one.sources, "points": _packed(
            {"t": one.times - start, "tag": one.tag, "source": one.source, "value": one.values}, every)}
        for one in found
    ]  # fmt: skip
    axes = [
        {"name": c.name, "unit": c.unit, "value": f"v{k}", "error": f"e{k}", "sigma": f"s{k}"}
        for k, c in enumerate(recording.components())
    ]
    charts = [error_cdf(recording)] if np.isfinite(recording.miss).any() else []
    charts += [coverage(recording)] if np.isfinite(float_column(recording.rows, "nees")).any() else []
    return {
        "name": folder.name, "start": start - recording.zero, "end": end - recording.zero,
        "timeLabel": time_label(recording.zero), "origin": origin.tolist(), "angles": angles, "rows": len(times),
        "drawn": len(drawn), "trackCount": len(lengths), "tracks": tracks, "axes": axes, "columns": _packed(columns),
        "statuses": STATUSES, "nisBand": _nis_band(recording), "events": happened[:MOST_EVENTS],
        "eventCount": len(lost), "rig": _rig(folder.rig, origin),
        "residuals": {"tags": tags, "every": every, "channels": channels}, "charts": [one.plotly() for one in charts],
    }  # fmt: skip


def drawn_tracks(worst_first: list[int], most: int) -> list[int]:
    """The numbers of the tracks that are drawn, ascending: all, or evenly over the ranks from the worst to the best."""
    if len(worst_first) <= most:
        return sorted(worst_first)
    return sorted({worst_first[k] for k in np.linspace(0, len(worst_first) - 1, most).round().astype(int)})


def drawn_rows(lengths: np.ndarray, weight: np.ndarray, most: int) -> np.ndarray:
    """The rows that are drawn, ascending: all, or about `most`, the first and that of the largest weight of each block.

    `lengths` (g,): rows of each track, whose last are drawn, too; `weight` (n,): the size of the error.
    """
    n = int(lengths.sum())
    if n <= most:
        return np.arange(n)
    size = -(-2 * n // max(most - 2 * len(lengths), 2))
    track, ends = np.repeat(np.arange(len(lengths)), lengths), np.cumsum(lengths)
    block = (np.arange(n) - (ends - lengths)[track]) // size
    rows = pl.DataFrame({"row": np.arange(n), "track": track, "block": block, "weight": np.nan_to_num(weight)})
    row = pl.col("row")
    kept = rows.group_by("track", "block").agg(first=row.first(), peak=row.get(pl.col("weight").arg_max()))
    return np.unique(np.concatenate([kept["first"], kept["peak"], ends - 1]))


def packed(values: np.ndarray, kind: str = "f4") -> dict[str, str]:
    """An array (n,) as plotly.js takes typed arrays: its kind, as `f4`, and its bytes in base64."""
    with np.errstate(over="ignore", invalid="ignore"):
        array = np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<"))
    return {"dtype": kind, "bdata": base64.b64encode(array.tobytes()).decode("ascii")}


def _packed(columns: Mapping[str, np.ndarray], every: int = 1) -> dict[str, dict[str, str]]:
    return {name: packed(values[::every], TYPES.get(name, "f4")) for name, values in columns.items()}


def _columns(recording: ScoredRecording, index: np.ndarray, start: float, origin: np.ndarray) -> dict[str, np.ndarray]:
    """Times, values, errors, standard deviations, horizontal covariance, NIS, its degrees of freedom, and status."""
    rows, shifts = recording.rows[index], [0.0] * 3 if recording.angles else [*origin, 0.0]
    columns = {"t": float_column(rows, "t_s") - start}
    for k, component in enumerate(recording.components()):
        values, errors, sigmas = (values[index] for values in component[2:])
        columns |= {f"v{k}": values - shifts[k], f"e{k}": errors, f"s{k}": sigmas}
    if recording.angles:
        columns["miss"] = np.degrees(recording.miss[index])
    else:
        columns["cov"] = np.nan_to_num(float_column(rows, "cov_xy_m2"))
    dof = np.nan_to_num(float_column(rows, "nis_dof"))
    words = rows["status"].cast(pl.String).to_list() if "status" in rows.columns else ["ok"] * len(rows)
    status = np.array([STATUSES.index(word) if word in STATUSES else 0 for word in words], int)
    return columns | {"nis": np.where(dof > 0, float_column(rows, "nis"), np.nan), "dof": dof, "status": status}


def _nis_band(recording: ScoredRecording) -> list[float] | None:
    """The central 95 % of NIS per degree of freedom of a consistent filter, at the median degrees of freedom.

    Empty where the distribution is unknown; None without NIS.
    """
    dof, nu = float_column(recording.rows, "nis_dof"), recording.student_t_dof
    if not (dof > 0).any():
        return None
    middle = float(np.median(dof[dof > 0]))
    unknown = nu is not None and math.isnan(nu)
    return [] if unknown else [nis_quantile(p, middle, nu) / middle for p in (0.025, 0.975)]


def _rig(rig: Rig, origin: np.ndarray) -> dict[str, Any]:
    """Anchors, stations, walls and path, m, relative to the origin."""
    shift, path = np.append(origin, 0.0), np.zeros((0, 2)) if rig.path_knots is None else rig.path_knots - origin
    anchors, stations = (
        [{"name": name, "at": (np.asarray(at) - shift).round(4).tolist()} for name, at in places.items()]
        for places in (rig.anchors, {name: one.position for name, one in rig.stations.items()})
    )
    walls = (rig.all_walls() - np.tile(origin, 2)).round(4).tolist()
    return {"anchors": anchors, "stations": stations, "walls": walls, "path": path.round(4).tolist()}
