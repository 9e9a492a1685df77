"""Scored rows: estimates with the truth at their times, errors and consistency. All metrics are views of this table."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise

import numpy as np
import polars as pl

from trackwright.trackers.core.data.consistency import eliminated, upper_entries
from trackwright.trackers.core.data.seconds import span
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.wording import counted
from trackwright.trackers.evaluation.judge import correlation_times, energy_scores
from trackwright.trackers.recordings.columns import QUATERNION, TruePaths, TruthStatus, float_column, require_columns
from trackwright.trackers.recordings.tracks_table import HEADING, NO_ESTIMATE, is_bearing, track_keys

Stations = Mapping[str, Mapping[str, Station]]
"""By recording, its stations by id."""

WHY = {TruthStatus.NO_ESTIMATE: "no estimate", TruthStatus.NO_TRUTH: "no truth", TruthStatus.HOLE: "hole"}
SKIPPED = "not the last"
"""Why a row is not scored, in the column `why`: the status of its truth, or a later row of its interval."""

AXES = ("x_m", "y_m", "z_m")
ANGLES = ("azimuth_rad", "elevation_rad")


def scored_rows(
    tracks: pl.DataFrame,
    truths: Mapping[str, pl.DataFrame],
    stations: Stations | None = None,
    every: float | None = None,
) -> pl.DataFrame:
    """The estimates, sorted by recording, tag, station and time, with these columns; null where they are not known.

    `track`: number of the track. `why`: null in scored rows. `true_x_m` …: the truth, linearly interpolated; there is
    none outside its span, nor in a hole (see `TruePaths`). `error_x_m` …, m, or `error_azimuth_rad` …: estimate less
    truth. `size_m` …: size of the error by kind (`metrics.ERROR_KINDS`). `nees` of the horizontal position or of both
    angles, infinite for a singular covariance, with `density` (log density of the truth, nats), `energy` (energy
    score, m) and `slow` (rows with the information of one); the same in space with the ending `_3d`. `slow_nis`.
    `step_s`: until the next row; `lost`; `losses`: times lost.

    `tracks`: the columns of tracks.parquet. `truths`: by recording, a table of t_s, tag, x_m, y_m and optionally z_m.
    `stations`: required for scored bearings. `every`: s, score only the last estimate in each interval of that length.
    Raises UnusableInput for a missing column or station.
    """
    keys, values = track_keys(tracks), ANGLES if is_bearing(tracks) else AXES[:2]
    require_columns(tracks, [*keys, "t_s", *values], "the tracks")
    rows = tracks.with_columns(pl.col(keys).cast(pl.String)).sort([*keys, "t_s"], maintain_order=True)
    rows = rows.with_columns(track=pl.struct(keys).rle_id())
    times, track = float_column(rows, "t_s"), rows["track"].to_numpy().astype(int)
    usable = np.isfinite([times, *(float_column(rows, name) for name in values)]).all(axis=0)
    if "status" in rows.columns:
        usable &= ~rows["status"].is_in(NO_ESTIMATE).fill_null(False).to_numpy()
    starts = np.searchsorted(track, np.arange(track.max(initial=-1) + 2))
    paths = _paths(truths)
    names = _path_names(rows[starts[:-1]])
    truth, status = paths.at(names, starts, np.where(usable, times, np.nan))
    status = np.where(usable, status, TruthStatus.NO_ESTIMATE)
    scored = last_of_intervals(times, status == TruthStatus.SCORED, every, track)
    why = pl.Series("why", status).replace_strict(WHY, default=None, return_dtype=pl.String)
    why = why.zip_with(pl.Series(scored | (status != TruthStatus.SCORED)), pl.Series([SKIPPED]))
    columns = {f"true_{axis}": x for axis, x in zip(AXES, truth.T, strict=True)}
    if is_bearing(rows):
        columns |= _bearings(rows, truth, scored, track, starts, stations or {})
    else:
        if HEADING in rows.columns:
            headings = paths.headings_at(names, starts, np.where(usable, times, np.nan))
            turned = float_column(rows, HEADING) - headings
            columns["size_heading_rad"] = np.where(scored, np.abs(wrapped(turned)), np.nan)
        columns = _positions(rows, truth, scored, track) | columns
    columns |= _innovations(rows, track) | _lost(rows, times, track)
    return rows.with_columns(why, *(pl.Series(name, x, nan_to_null=True) for name, x in columns.items()))


def is_scored(rows: pl.DataFrame) -> np.ndarray:
    """Mask (n,) of the rows with both an estimate and a truth."""
    return rows["why"].is_null().to_numpy()


def _path_names(table: pl.DataFrame) -> list[str]:
    """A name for the path of each row: of its recording and tag."""
    return table.select(pl.concat_str(pl.col("recording", "tag").cast(pl.String), separator="\0")).to_series().to_list()


def _paths(truths: Mapping[str, pl.DataFrame]) -> TruePaths:
    """The true paths of all recordings."""
    tables = []
    for name, truth in truths.items():
        require_columns(truth, ["t_s", "tag", *AXES[:2]], f"the truth of recording '{name}'")
        known = pl.col("t_s", *(c for c in (*AXES, *QUATERNION) if c in truth.columns)).cast(pl.Float64)
        tag = pl.concat_str(pl.lit(name), pl.col("tag").cast(pl.String), separator="\0").alias("tag")
        tables.append(truth.select(tag, known))
    return TruePaths.of_table(pl.concat(tables, how="diagonal"), "all") if tables else TruePaths()


def last_of_intervals(times: np.ndarray, scored: np.ndarray, every: float | None, track: np.ndarray) -> np.ndarray:
    """The mask (n,) of the scored rows that are the last of their `track` (n,) in an interval of `every` seconds.

    All of them without `every`.
    """
    if every is None:
        return scored
    rows = np.flatnonzero(scored)
    # 0.3 s belongs to the interval that starts there although 0.3 / 0.1 is 2.9999999999999996.
    interval = np.floor(times[rows] / every + 1e-6)
    later = np.append((np.diff(interval) == 0) & (np.diff(track[rows]) == 0), False)
    return np.isin(np.arange(len(scored)), rows[~later[: len(rows)]])


def wrapped(angles: np.ndarray) -> np.ndarray:
    """Angles, rad, in (−π, π]."""
    turned: np.ndarray = np.pi - (np.pi - angles) % (2 * np.pi)
    return turned


def position_sizes(errors: np.ndarray) -> dict[str, np.ndarray]:
    """The sizes (…) of errors (…, 3), m, by kind, the main one first; NaN of rows without one."""
    flat, height = np.hypot(errors[..., 0], errors[..., 1]), errors[..., 2]
    # If all heights are known, both errors are the same numbers.
    return {"m": flat, "3d_m": np.sqrt(flat * flat + height**2) if height.any() else flat}


def bearing_sizes(estimates: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The errors (…, 2) of azimuth and elevation, rad, and their sizes (…) by kind, the main one first.

    In the plane of an array each azimuth is ± 90°, so that the errors of both angles are unknown.
    """
    errors, plane = estimates - truth, in_plane(estimates[..., 0])
    errors[..., 0] = wrapped(errors[..., 0])
    (x, y, z), (p, q, r) = _direction(estimates), _direction(truth)
    cross = np.sqrt((y * r - z * q) ** 2 + (z * p - x * r) ** 2 + (x * q - y * p) ** 2)
    # arctan2 of sine and cosine: the arc cosine alone is zero below 1e-8 rad.
    angles = {kind: np.where(plane, np.nan, np.abs(errors[..., k])) for k, kind in enumerate(ANGLES)}
    return errors, {"direction_rad": np.arctan2(cross, x * p + z * r + y * q)} | angles


def in_plane(azimuth: np.ndarray) -> np.ndarray:
    """Which directions with these azimuths (n,), rad, lie in the plane of a flat array, where each azimuth is ± 90°."""
    lying: np.ndarray = np.abs(np.abs(azimuth) - np.pi / 2) < 1e-9
    return lying


def _direction(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The components of the unit vectors of angles (…, 2)."""
    azimuth, elevation = angles[..., 0], angles[..., 1]
    flat = np.cos(elevation)
    return np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat


def covariances(rows: pl.DataFrame) -> np.ndarray:
    """Reported position covariances (n, 3, 3), m²; covariances missing in the table are zero."""
    entries = np.empty((3, 3, len(rows)))
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        if i == j:
            # A negative standard deviation is no variance.
            entries[i, i] = (std := float_column(rows, f"std_{AXES[i]}")) * np.abs(std)
        else:
            cov = np.nan_to_num(float_column(rows, f"cov_{'xyz'[i]}{'xyz'[j]}_m2"))
            entries[i, j] = entries[j, i] = cov
    return np.moveaxis(entries, -1, 0)


def _positions(rows: pl.DataFrame, truth: np.ndarray, scored: np.ndarray, track: np.ndarray) -> dict[str, np.ndarray]:
    """Errors, sizes and consistency of positions."""
    estimates = np.stack([float_column(rows, axis) for axis in AXES], axis=1)
    errors = np.where(scored[:, None], estimates - truth, np.nan)
    P, cov = covariances(rows), float_column(rows, "cov_xy_m2")
    # A covariance that other rows have is missing here.
    reported = [P[:, 0, 0], P[:, 1, 1], *([cov] if np.nan_to_num(cov).any() else [])]
    # A known height has no standard deviation in any row of its track.
    free = np.bincount(track, np.nan_to_num(float_column(rows, "std_z_m")) != 0)[track] > 0
    columns = {f"error_{axis}": error for axis, error in zip(AXES, errors.T, strict=True)}
    columns |= {f"size_{kind}": size for kind, size in position_sizes(errors).items()}
    columns |= _consistency(errors[:, :2], P[:, :2, :2], reported, track)
    return columns | _consistency(errors, P, [*reported, np.where(free, P[:, 2, 2], np.nan)], track, "_3d")


def _bearings(
    rows: pl.DataFrame, truth: np.ndarray, scored: np.ndarray, track: np.ndarray, starts: np.ndarray, stations: Stations
) -> dict[str, np.ndarray]:
    """Errors, sizes and consistency of azimuth and elevation, against the true direction from the station."""
    true = np.full((len(rows), 2), np.nan)
    first = rows[starts[:-1]]
    for (a, b), recording, ident in zip(pairwise(starts), first["recording"], first["station"], strict=True):
        part, known = a + np.flatnonzero(scored[a:b]), stations.get(recording, {})
        if len(part) and ident not in known:
            raise UnusableInput(
                f"the tracks of recording '{recording}': station '{ident}' is not in its rig; found "
                f"{', '.join(known) or 'no stations'}; give the recording that was tracked"
            )
        if len(part):
            true[part] = known[ident].angles(truth[part])
    errors, sizes = bearing_sizes(np.stack([float_column(rows, angle) for angle in ANGLES], axis=1), true)
    P = np.zeros((len(rows), 2, 2))
    for k, angle in enumerate(ANGLES):
        P[:, k, k] = (std := float_column(rows, f"std_{angle}")) * np.abs(std)
    columns = {f"error_{angle}": error for angle, error in zip(ANGLES, errors.T, strict=True)}
    columns |= {f"size_{kind}": size for kind, size in sizes.items()}
    return columns | _consistency(errors, P, [P[:, 0, 0], P[:, 1, 1]], track, energy=False)


def _consistency(
    errors: np.ndarray, P: np.ndarray, reported: list[np.ndarray], track: np.ndarray, space: str = "",
    energy: bool = True,
) -> dict[str, np.ndarray]:  # fmt: skip
    """NEES (n,) of errors (n, d) and what goes with it; `reported`: covariances without which there is none."""
    parts, variances = np.stack(eliminated(errors, upper_entries(P)), axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        nees = (parts**2 / variances).sum(axis=0)
    there = np.isfinite([*errors.T, *reported]).all(axis=0)
    nees = np.where(there, np.where(np.isfinite(nees), nees, np.inf), np.nan)
    known = np.isfinite(nees)
    values = {
        "density": -0.5 * (nees + np.log(2 * np.pi * variances).sum(axis=0))[known],
        "slow": _lasting((parts / np.sqrt(variances)).T[known], track[known], 2),
    }
    if energy:
        values["energy"] = energy_scores(errors[known], P[known])
    columns = {f"nees{space}": nees}
    for name, x in values.items():
        columns[name + space] = np.full(len(nees), np.nan)
        columns[name + space][known] = x
    return columns


def _lasting(values: np.ndarray, track: np.ndarray, power: int) -> np.ndarray:
    """`correlation_times` of values (n, d) of tracks, for each row."""
    return correlation_times(values, np.searchsorted(track, np.arange(track.max(initial=-1) + 2)), power)[track]


def _innovations(rows: pl.DataFrame, track: np.ndarray) -> dict[str, np.ndarray]:
    """NIS, its degrees of freedom and the rows with the information of one; none of rows without a measurement."""
    nis, dof = float_column(rows, "nis"), float_column(rows, "nis_dof")
    known = np.isfinite(nis) & (dof > 0)
    total, freedom = (np.bincount(track[known], x[known], track.max(initial=-1) + 1) for x in (nis, dof))
    slow = np.full(len(rows), np.nan)
    about = nis[known] - (total[track[known]] / freedom[track[known]]) * dof[known]
    slow[known] = _lasting(about[:, None], track[known], 1)
    return {"nis": nis, "nis_dof": dof, "slow_nis": slow}


def _lost(rows: pl.DataFrame, times: np.ndarray, track: np.ndarray) -> dict[str, np.ndarray]:
    """Seconds until the next row, whether the track is lost, and how often it was: the status holds until then.

    A loss ends where the track starts again, or with the rows.
    """
    status = rows["status"].cast(pl.String).fill_null("ok") if "status" in rows.columns else pl.Series(["ok"])
    lost, restarted = ((status == word).to_numpy() & np.isfinite(times) for word in ("lost", "restarted"))
    later = np.append((np.diff(track) == 0) & np.isfinite(times[1:]), False)[: len(times)]
    steps = np.where(later, np.diff(times, append=np.nan), 0.0)
    return {"step_s": steps, "lost": lost, "losses": (lost & ~later) + restarted.astype(int)}


def refuse_without_overlap(rows: pl.DataFrame, truths: Mapping[str, pl.DataFrame]) -> None:
    """Raises UnusableInput, with the spans and tags of both, where no row is scored."""
    if is_scored(rows).any():
        return
    known = rows.filter(pl.col("why") != "no estimate")
    expected = "expected estimates inside the span of a truth of the same recording and tag"
    if known.is_empty():
        raise UnusableInput(
            f"the tracks: none of {counted(len(rows), 'row')} holds an estimate (waiting, non-finite or empty); "
            f"{expected}; run `trackwright check` on the recording"
        )
    common = sorted(set(rows["recording"]) & set(truths))
    if not common:
        raise UnusableInput(
            f"the tracks are of recording {_names(rows['recording'])}, the truth is of {_names(truths)}; {expected}; "
            "give the recordings that were tracked"
        )
    truth = truths[common[0]]
    raise UnusableInput(
        f"no estimate lies inside a truth: estimates {_span(known)} of tags {_names(rows['tag'])}, "
        f"truth of '{common[0]}' {_span(truth)} of tags {_names(truth['tag'])}; "
        f"{expected}; compare time bases and tag ids"
    )


def _span(table: pl.DataFrame) -> str:
    times = float_column(table, "t_s")
    return f"from {span(times.min(), times.max())}" if len(times) else "at no time"


def _names(names: Iterable[object]) -> str:
    return listed(sorted({str(name) for name in names})) or "none"
