"""Estimates of three tags with errors that are known, without a tracker."""

from __future__ import annotations

import numpy as np
import polars as pl

from trackwright.experiments.pages.scored_tracks import ScoredTracks
from trackwright.trackers.core.model.rig import Rig, Station
from trackwright.trackers.evaluation.rows import scored_rows
from trackwright.trackers.recordings.folder import RecordingFolder

NASTY = "<script>document.title = 'stolen'</script>"
TAGS = ("A", "B", NASTY)
ANCHORS = {"1": (0.0, 0.0, 2.0), "2": (10.0, 0.0, 2.0), "10": (10.0, 8.0, 2.0), "11": (10.05, 8.0, 1.0)}
BIAS = 0.25  # bias of the ranges to anchor 2, m


def small_tracks(rows: int = 80, tags: tuple[str, ...] = TAGS, seed: int = 1) -> ScoredTracks:
    """Tracks whose errors are normal with the reported covariance, twice as large for each further tag."""
    rng = np.random.default_rng(seed)
    times = 3.0 + 0.1 * np.arange(rows)
    estimates, truths, ranges = [], [], []
    for k, tag in enumerate(tags):
        true = np.stack([5 + 3 * np.cos(times / 2 + k), 4 + 2 * np.sin(times / 2 + k), 0 * times + 1], axis=1)
        sigma = 0.05 * 2.0 ** (k % 5)
        error = rng.multivariate_normal([0, 0], sigma**2 * np.array([[1, 0.3], [0.3, 0.5]]), rows)
        at = true + np.pad(error, ((0, 0), (0, 1)))
        key = {"recording": "hall", "tag": tag, "t_s": times}
        position = {f"{a}_m": at[:, i] for i, a in enumerate("xyz")}
        spread = {"std_x_m": sigma, "std_y_m": sigma * np.sqrt(0.5), "std_z_m": 0.0, "cov_xy_m2": 0.3 * sigma**2}
        filtered = {"nis": rng.chisquare(2, rows), "nis_dof": 2.0, "status": ["waiting"] + ["ok"] * (rows - 1)}
        estimates.append(pl.DataFrame(key | position | spread | filtered))
        truths.append(pl.DataFrame({"t_s": times, "tag": tag} | {f"{a}_m": true[:, i] for i, a in enumerate("xyz")}))
        for number, (name, place) in enumerate(ANCHORS.items()):
            own = slice(number, None, len(ANCHORS))
            distance = np.linalg.norm(true[own] - place, axis=1) + 0.02 * rng.normal(size=len(true[own]))
            shifted = distance + (BIAS if name == "2" else 0.0)
            ranges.append(pl.DataFrame({"t_s": times[own], "tag": tag, "anchor": name, "range_m": shifted}))
    tables = {"truth": pl.concat(truths), "ranges": pl.concat(ranges).sort("t_s")}
    rig = Rig("hall", anchors={name: np.array(place) for name, place in ANCHORS.items()})
    folder = RecordingFolder("hall", None, rig, tables)
    return ScoredTracks(scored_rows(pl.concat(estimates), {"hall": tables["truth"]}), [folder], [])


def small_bearings(in_plane: bool, rows: int = 60) -> tuple[ScoredTracks, np.ndarray, np.ndarray]:
    """Directions of a tag around a station, with estimated and true angles (rows, 2), rad; in plane the second is zero.

    The angle of the first column turns once, across ±180°, from the boresight or from the array's x axis.
    """
    rng = np.random.default_rng(4)
    times, angle = 2.0 + 0.1 * np.arange(rows), np.linspace(-3.5, 2.7, rows)
    sigma = np.array([0.03, np.nan if in_plane else 0.05])
    rise = np.zeros(rows) if in_plane else 0.3 * np.sin(times)
    true = np.stack([angle, rise], axis=1)
    estimate = true + np.nan_to_num(sigma) * rng.normal(size=true.shape)
    if in_plane:
        place = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
        x, y = np.cos(estimate[:, 0]), np.sin(estimate[:, 0])
        azimuth, elevation, sigmas = np.where(x < 0, -np.pi / 2, np.pi / 2), np.arcsin(y), (None, sigma[0])
    else:
        place = np.stack([np.sin(angle) * np.cos(rise), np.sin(rise), np.cos(angle) * np.cos(rise)], axis=1)
        azimuth, elevation, sigmas = np.angle(np.exp(1j * estimate[:, 0])), estimate[:, 1], tuple(sigma)
    table = pl.DataFrame(
        {"recording": "yard", "tag": "A", "station": "S", "t_s": times}
        | {"azimuth_rad": azimuth, "elevation_rad": elevation}
        | {"std_azimuth_rad": sigmas[0], "std_elevation_rad": sigmas[1], "status": "ok"}
        | {"nis": rng.chisquare(2, rows), "nis_dof": 2.0},
        schema_overrides={"std_azimuth_rad": pl.Float64},
    )
    truth = pl.DataFrame({"t_s": times, "tag": "A"} | {f"{a}_m": 5 * place[:, i] for i, a in enumerate("xyz")})
    rig = Rig("yard", stations={"S": Station(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))})
    folder = RecordingFolder("yard", None, rig, {"truth": truth})
    return (
        ScoredTracks(scored_rows(table, {"yard": truth}, {"yard": rig.stations}), [folder], []),
        np.degrees(estimate),
        np.degrees(true),
    )


def small_run(shifts: dict[str, float]) -> pl.DataFrame:
    """The scored rows of a run whose error in x, m, is that of each recording."""
    times = 0.1 * np.arange(30)
    at = {"tag": "1", "t_s": times, "x_m": times, "y_m": times**2, "z_m": 1.0}
    spread = {"std_x_m": 0.1, "std_y_m": 0.1, "std_z_m": 0.0, "cov_xy_m2": 0.0, "nis": 1.0, "nis_dof": 1.0}
    tables = (pl.DataFrame({"recording": k} | at | spread).with_columns(pl.col("x_m") + s) for k, s in shifts.items())
    return scored_rows(pl.concat(tables), dict.fromkeys(shifts, pl.DataFrame(at)))
