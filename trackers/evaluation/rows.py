"""Scored rows: estimates with the truth at their times, errors and consistency. All metrics are views of this table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl
from jaxtyping import Float

from trackwright.trackers.core.data.consistency import eliminated, upper_entries
from trackwright.trackers.core.errors import UnusableInput, listed, span
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.recordings.columns import TruePaths, TruthStatus, float_column, require_columns
from trackwright.trackers.recordings.tracks_table import HEADING, NO_ESTIMATE, is_bearing, track_keys

Truths = Mapping[str, pl.DataFrame]  # by recording
Stations = Mapping[str, Mapping[str, Station]]  # by recording, its stations by id
WHY = {TruthStatus.NO_ESTIMATE: "no estimate", TruthStatus.NO_TRUTH: "no truth", TruthStatus.HOLE: "hole"}
"""Why a row is not scored, in the column `why`."""

AXES = ("x_m", "y_m", "z_m")
ANGLES = ("azimuth_rad", "elevation_rad")

WINDOW = 3.0  # lags up to which the autocorrelation is summed, in correlation times of the sum so far
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
TANGENTS = np.tan(np.pi / 4 * (1 + NODES))
LEAST_INSIDE = 0.01  # share of estimates inside a truth below which the clocks are not the same
CHUNK = 2_000  # rows whose energy scores are computed together: their numbers fit the processor's cache


def scored_rows(tracks: pl.DataFrame, truths: Truths, stations: Stations | None = None) -> pl.DataFrame:
    """The estimates, sorted by recording, tag, station and time, with these columns; null where they are not known.

    `track`: its number. `why`: null in scored rows. `true_x_m` …: the truth, linearly interpolated; none outside its
    span, nor in a hole (see `TruePaths`). `error_x_m` …, m, or `error_azimuth_rad` …: estimate less truth. `size_m` …:
    size of the error by kind. `along`, `way`: of positions, error times true velocity, and the velocity squared. `nees`
    of the horizontal position or of both angles, infinite for a singular covariance, with `density` (log density of the
    truth, nats), `energy` (energy score, m) and `slow` (rows with the information of one); in space with the ending
    `_3d`. `slow_nis`. `step_s`: until the next row; `lost`; `losses`: times lost.

    `tracks`: the columns of tracks.parquet. `truths`: by recording, a table of t_s, tag, x_m, y_m and optionally z_m.
    `stations`: required for scored bearings. Raises UnusableInput for a missing column or station.
    """
    keys, values = track_keys(tracks), ANGLES if is_bearing(tracks) else AXES[:2]
    require_columns(tracks, [*keys, "t_s", *values], "the tracks")
    rows = tracks.with_columns(pl.col(keys).cast(pl.String)).sort([*keys, "t_s"], maintain_order=True)
    rows = rows.with_columns(track=pl.struct(keys).rle_id())
    times, track = float_column(rows, "t_s"), rows["track"].to_numpy().astype(int)
    usable = np.isfinite([times, *(float_column(rows, name) for name in values)]).all(axis=0)
    if "status" in rows.columns:
        usable &= ~rows["status"].is_in(NO_ESTIMATE).fill_null(False).to_numpy()
    truth, headings, status = _truth(rows, truths, track, np.where(usable, times, np.nan))
    status = np.where(usable, status, TruthStatus.NO_ESTIMATE)
    scored = status == TruthStatus.SCORED
    columns = {f"true_{axis}": x for axis, x in zip(AXES, truth.T, strict=True)}
    columns |= _judged(rows, np.where(scored[:, None], truth, np.nan), stations or {}, track)
    columns |= _innovations(rows, track) | _lost(rows, times, track)
    if HEADING in rows.columns:
        turned = np.abs(wrapped(float_column(rows, HEADING) - headings))
        columns["size_heading_rad"] = np.where(scored, turned, np.nan)
    why = pl.Series("why", status).replace_strict(WHY, default=None, return_dtype=pl.String)
    return rows.with_columns(why, *(pl.Series(name, x, nan_to_null=True) for name, x in columns.items()))


def _truth(
    rows: pl.DataFrame, truths: Truths, track: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True positions (n, 3), headings (n,) and the `TruthStatus` (n,) of the rows at their times (n,)."""
    truth, headings = np.full((len(rows), 3), np.nan), np.full(len(rows), np.nan)
    status, starts = np.full(len(rows), TruthStatus.NO_TRUTH, np.uint8), _starts(track)
    first = rows[starts[:-1]]
    for name, table in truths.items():
        paths, own = TruePaths.of_table(table, name), np.flatnonzero(first["recording"] == name)
        if len(own):
            of = starts[own[0] : own[-1] + 2]
            part = slice(of[0], of[-1])
            asked = first["tag"][own].to_list(), of - of[0], times[part]
            truth[part], status[part] = paths.at(*asked)
            headings[part] = paths.headings_at(*asked)
    return truth, headings, status


def _starts(track: np.ndarray) -> np.ndarray:
    """The first row of each track by the numbers (n,) of the sorted rows' tracks, then n."""
    return np.append(np.flatnonzero(np.diff(track, prepend=track[:1] - 1)), len(track))


def wrapped(angles: Any) -> Any:
    """Angles, rad, in (−π, π]."""
    return np.pi - (np.pi - angles) % (2 * np.pi)


def main_size(rows: pl.DataFrame) -> str:
    """The column with the horizontal error, m, or of bearings with the angle to the true direction, rad."""
    return "size_direction_rad" if is_bearing(rows) else "size_m"


def position_sizes(errors: Any) -> dict[str, Any]:
    """The sizes (…) of errors (…, 3), m, by kind, the main one first; NaN of rows without one."""
    xp, height = errors.__array_namespace__(), errors[..., 2]
    flat = xp.hypot(errors[..., 0], errors[..., 1])
    # Where a height is known, both errors are the same number.
    return {"m": flat, "3d_m": xp.where(height == 0, flat, xp.sqrt(flat * flat + height**2))}


def bearing_sizes(estimates: Any, truth: Any) -> tuple[Any, dict[str, Any]]:
    """The errors (…, 2) of azimuth and elevation, rad, and their sizes (…) by kind, the main one first.

    In the plane of an array each azimuth is ± 90°, so that the errors of both angles are unknown.
    """
    xp, plane = estimates.__array_namespace__(), in_plane(estimates[..., 0])
    azimuth, elevation = (estimates - truth)[..., 0], (estimates - truth)[..., 1]
    errors = xp.stack([wrapped(azimuth), elevation], axis=-1)
    half, flat = xp.sin(errors / 2) ** 2, xp.cos(estimates[..., 1]) * xp.cos(truth[..., 1])
    angles = {kind: xp.where(plane, np.nan, xp.abs(errors[..., k])) for k, kind in enumerate(ANGLES)}
    haversine = xp.minimum(half[..., 1] + flat * half[..., 0], 1.0)
    return errors, {"direction_rad": 2 * xp.arcsin(xp.sqrt(haversine))} | angles


def in_plane(azimuth: Any) -> Any:
    """Which directions with these azimuths (n,), rad, lie in the plane of a flat array, where each azimuth is ± 90°."""
    return abs(abs(azimuth) - np.pi / 2) < 1e-9


def covariances(rows: pl.DataFrame, names: Sequence[str] = AXES) -> np.ndarray:
    """Reported covariances (n, d, d) of d columns; those missing in the table are zero."""
    entries = np.zeros((len(rows), len(names), len(names)))
    for i, name in enumerate(names):
        # A negative standard deviation is no variance.
        entries[:, i, i] = (std := float_column(rows, f"std_{name}")) * np.abs(std)
        for j in range(i):
            cov = float_column(rows, f"cov_{names[j].removesuffix('_m')}{name.removesuffix('_m')}_m2")
            entries[:, i, j] = entries[:, j, i] = np.nan_to_num(cov)
    return entries


def _directions(rows: pl.DataFrame, truth: np.ndarray, stations: Stations) -> np.ndarray:
    """The true azimuths and elevations (n, 2), rad, from the station of each row to its true place (n, 3), if known."""
    angles = np.full((len(rows), 2), np.nan)
    known = rows.with_row_index("row").filter(np.isfinite(truth).all(axis=1))
    for (recording, ident), part in known.group_by("recording", "station", maintain_order=True):
        own, at = stations.get(str(recording), {}), part["row"].to_numpy()
        if ident not in own:
            found = f"station '{ident}' is not in its rig; found {', '.join(own) or 'no stations'}"
            raise UnusableInput(f"the tracks of recording '{recording}': {found}; give the recording that was tracked")
        angles[at] = own[str(ident)].angles(truth[at])
    return angles


def _judged(rows: pl.DataFrame, truth: np.ndarray, stations: Stations, track: np.ndarray) -> dict[str, np.ndarray]:
    """Errors, sizes and consistency of positions, or of azimuth and elevation from a station."""
    bearing = is_bearing(rows)
    names = ANGLES if bearing else AXES
    estimates = np.stack([float_column(rows, name) for name in names], axis=1)
    if bearing:
        errors, sizes = bearing_sizes(estimates, _directions(rows, truth, stations))
    else:
        sizes = position_sizes(errors := estimates - truth)
    columns = {f"error_{name}": error for name, error in zip(names, errors.T, strict=True)}
    columns |= {f"size_{kind}": size for kind, size in sizes.items()}
    P, cov = covariances(rows, names), float_column(rows, "cov_xy_m2")
    # A covariance that other rows have is missing here.
    reported = [P[:, 0, 0], P[:, 1, 1], *([cov] if np.nan_to_num(cov).any() else [])]
    columns |= _consistency(errors[:, :2], P[:, :2, :2], reported, track, "", not bearing)
    if bearing:
        return columns
    # Errors along the velocity of the truth until the next row are those of a time.
    step = np.where(np.diff(track) == 0, np.diff(float_column(rows, "t_s")), np.nan)
    velocity = np.diff(truth[:, :2], axis=0) / np.where(step > 0.0, step, np.nan)[:, None]
    along, way = ((x * velocity).sum(axis=1) for x in (errors[:-1, :2], velocity))
    columns |= {"along": np.append(along, np.nan), "way": np.append(way, np.nan)}
    # A known height has no standard deviation in any row of its track.
    free = np.bincount(track, np.nan_to_num(float_column(rows, "std_z_m")) != 0)[track] > 0
    return columns | _consistency(errors, P, [*reported, np.where(free, P[:, 2, 2], np.nan)], track, "_3d")


def _consistency(
    errors: np.ndarray, P: np.ndarray, reported: list[np.ndarray], track: np.ndarray, end: str, energy: bool = True
) -> dict[str, np.ndarray]:
    """NEES (n,) of errors (n, d) and what goes with it; `reported`: covariances without which there is none."""
    parts, variances = np.stack(eliminated(errors, upper_entries(P)), axis=1)
    with np.errstate(over="ignore", invalid="ignore"):
        nees = (parts**2 / variances).sum(axis=0)
    there = np.isfinite([*errors.T, *reported]).all(axis=0)
    nees = np.where(there, np.where(np.isfinite(nees), nees, np.inf), np.nan)
    known = np.isfinite(nees)
    values = {
        "density": -0.5 * (nees + np.log(2 * np.pi * variances).sum(axis=0))[known],
        "slow": correlation_times((parts / np.sqrt(variances)).T[known], track[known]),
    }
    if energy:
        values["energy"] = energy_scores(errors[known], P[known])
    columns = {f"nees{end}": nees} | {name + end: np.full(len(nees), np.nan) for name in values}
    for name, x in values.items():
        columns[name + end][known] = x
    return columns


def _innovations(rows: pl.DataFrame, track: np.ndarray) -> dict[str, np.ndarray]:
    """NIS, its degrees of freedom and the rows with the information of one; none of rows without a measurement."""
    nis, dof = float_column(rows, "nis"), float_column(rows, "nis_dof")
    known, slow = np.isfinite(nis) & (dof > 0), np.full(len(rows), np.nan)
    total, freedom = (np.bincount(track[known], x[known], track.max(initial=-1) + 1) for x in (nis, dof))
    about = nis[known] - (total[track[known]] / freedom[track[known]]) * dof[known]
    slow[known] = correlation_times(about[:, None], track[known], 1)
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


def correlation_times(values: Float[np.ndarray, "n d"], track: np.ndarray, power: int = 2) -> Float[np.ndarray, " n"]:
    """How many rows have the information of one on the mean of squares of values of mean zero, by `track` (n,), sorted.

    One at least. The variance of a mean of squares falls with the sum of the squared autocorrelation (Bartlett 1946;
    window of Sokal 1997). `power`: 1 for the mean of the values themselves.
    """
    starts = _starts(track)
    lengths, times = np.diff(starts), np.ones(len(starts) - 1)
    for length in np.unique(lengths[lengths > 1]).tolist():
        tracks = np.flatnonzero(lengths == length)
        series = values[starts[tracks, None] + np.arange(length)]
        size, pairs = 1 << (2 * length - 1).bit_length(), np.arange(length, 0, -1)
        spectrum = (np.abs(np.fft.rfft(series, size, axis=1)) ** 2).sum(axis=2)
        products = np.fft.irfft(spectrum, size, axis=1)[:, :length]
        with np.errstate(invalid="ignore", divide="ignore"):  # of tracks whose values are zero
            correlation = products[:, 1:] / products[:, :1] * (length / pairs[1:])
        time = 1.0 + 2.0 * np.cumsum(correlation**power * pairs[1:] / length, axis=1)
        enough = np.arange(1, length) >= WINDOW * time
        enough[:, -1] = True
        times[tracks] = np.fmax(time[np.arange(len(tracks)), enough.argmax(axis=1)], 1.0)
    return np.repeat(times, lengths)


def energy_scores(errors: Float[np.ndarray, "n d"], covs: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, " n"]:
    """E|X − y| − ½E|X − X′| (n,), m, of normal X and X′ and the truth y in two or three dimensions (Gneiting 2007)."""
    scores = np.empty(len(errors))
    for a in range(0, len(errors), CHUNK):
        e, P = errors[a : a + CHUNK], covs[a : a + CHUNK]
        trace, moved = np.einsum("nii->n", P), np.einsum("nij,nj->ni", P, e)
        minors = 0.5 * (trace**2 - (P * P).sum(axis=(1, 2)))
        # det(I + sP) and eᵀadj(I + sP)e as polynomials in s, by Cayley and Hamilton.
        volume = np.stack([trace, minors, np.linalg.det(P) if P.shape[1] == 3 else 0 * trace])
        square, along = (e * e).sum(axis=1), (e * moved).sum(axis=1)
        last = (moved * moved).sum(axis=1) - trace * along + minors * square
        size = np.stack([square, trace * square - along, last])
        twice = volume * np.array([[2.0], [4.0], [8.0]])
        scores[a : a + CHUNK] = _mean_norm(volume, size) - 0.5 * _mean_norm(twice, np.zeros_like(size))
    return scores


def _mean_norm(volume: Float[np.ndarray, "3 n"], size: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    """The mean length (n,) of normal vectors, m, by the coefficients of the polynomials of `energy_scores`.

    E√Q = π^(−½) ∫ (1 − E exp(−t²Q))/t² dt over t > 0, with t = tan θ over the root of EQ, by Gauss and Legendre.
    """
    scale, ((p, q, r), (a, b, c)) = np.sqrt(size[0] + volume[0])[:, None], (volume[..., None], size[..., None])
    with np.errstate(invalid="ignore", divide="ignore"):  # of vectors of length zero
        s = 2 * (TANGENTS / scale) ** 2
        spread = 1 + s * (p + s * (q + s * r))
        kept = np.exp(-0.5 * s * (a + s * (b + s * c)) / spread) / np.sqrt(spread)
        integral = (1 - kept) @ (WEIGHTS * (1 + 1 / TANGENTS**2))
    return np.where(scale[:, 0] > 0, scale[:, 0] * integral * np.sqrt(np.pi) / 4, 0.0)


def refuse_without_overlap(rows: pl.DataFrame, truths: Truths) -> None:
    """Raises UnusableInput, with a recording, its tags and times of both, where next to no row lies inside a truth."""
    known = rows.filter(pl.col("why").ne_missing("no estimate"))
    asked = known.filter(pl.col("why").is_null().any().over("track"))
    inside = int(asked["why"].ne_missing("no truth").sum())
    if truths and inside <= LEAST_INSIDE * len(asked):
        name = (asked if len(asked) else known if len(known) else rows)["recording"][0]
        found = f"the tracks are of recording {name}, the truth is of {listed(sorted(truths))}"
        if name in truths:
            found = f"only {inside} of {len(asked)} estimates lie" if inside else "no estimate lies"
            both = f"estimates {_about(known.filter(recording=name))}, truth of '{name}' {_about(truths[name])}"
            found = f"{found} inside a truth: {both}; expected the same recording, tag and time"
        raise UnusableInput(f"{found}; compare names, ids, clocks and units, or give the time by --from and --to")


def _about(table: pl.DataFrame) -> str:
    times, tags = float_column(table, "t_s"), listed(sorted(table["tag"].cast(pl.String).unique())) or "none"
    return f"of tag {tags}, " + (f"from {span(times.min(), times.max())}" if len(times) else "at no time")
