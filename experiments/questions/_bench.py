"""The bench of the study `worksteps`: a tool on its round of nine points, and how its trackers are judged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl

from experiments.monte_carlo.errors import TrackedRuns
from sim.corruptions import white_noise
from sim.imu import simulate_uwb_imu
from sim.paths import point_to_point
from sim.ranging import CHAMBER, antenna_biases, chamber, round_robin
from sim.stations import simulate_phases, work_station
from trackers.recordings.folder import RecordingFolder
from trackers.worksteps.decisions import NO_POINT, Decisions, FasteningPoints, decide, nearest_point

SIGMA_P, SIGMA_R, BIAS = 0.25, 0.03, 0.05
SECONDS, WARM_UP_S, REST_M = 10.0, 2.0, 1e-3
"""Length of a round, what of it nobody is judged on, and how near to a point the tip is at rest on it."""

MIDDLE = np.array([0.0, 0.0, 0.15])
"""Of the points, in the frame of the work stand, whose floor is 1.05 m above the room's."""

ROOM = CHAMBER - [2.5, 2.5, 1.05]


def points_of(spacing: float) -> np.ndarray:
    """Nine points (9, 3), m, on a level square grid."""
    steps = (np.arange(3) - 1) * spacing
    x, y = np.meshgrid(steps, steps, indexing="ij")
    return MIDDLE + np.stack([x.ravel(), y.ravel(), np.zeros(9)], axis=1)


def bench(ids: np.ndarray, seed: int, spacing: float) -> RecordingFolder:
    """Rounds of the tool with phases, ranges and IMU, and the points in the table `points`."""
    points = points_of(spacing)
    path, n = partial(point_to_point, points=points), len(ids)
    phases = simulate_phases(
        work_station(), path, n, seed, sigma_p=SIGMA_P, rate_hz=10.0, n_points=int(10 * SECONDS), ids=ids
    )
    errors = {"biases": antenna_biases(BIAS), "white": white_noise(SIGMA_R), "turn": round_robin()}
    ranges = simulate_uwb_imu(
        chamber(ROOM), path, n, seed, rate_hz=40.0, n_points=int(40 * SECONDS), corruptions=errors, ids=ids
    )
    heard, felt = phases.folder("bench"), ranges.folder("bench")
    named = pl.DataFrame({"name": [str(k) for k in range(9)]} | dict(zip(("x_m", "y_m", "z_m"), points.T, strict=True)))
    tables = {**felt.tables, "phases": heard.tables["phases"], "points": named}
    return replace(felt, rig=replace(felt.rig, stations=heard.rig.stations), tables=tables)


def decided(tracked: TrackedRuns) -> tuple[Decisions, np.ndarray]:
    """The decisions on all rows, trajectory after trajectory, and the point at which the tool rests (n, T)."""
    table = tracked.folder.tables["points"]
    points = FasteningPoints(tuple(table["name"]), table.select("x_m", "y_m").to_numpy())
    rows = tracked.known & (tracked.times >= WARM_UP_S)
    at = nearest_point(np.where(rows[..., None], tracked.truth, np.nan)[..., :2].reshape(-1, 2), points, REST_M)
    means, spread = tracked.estimates[..., :2].reshape(-1, 2), tracked.covariance[..., :2, :2].reshape(-1, 2, 2)
    return decide(means, spread, points, points.tolerance(), 0.0), at.reshape(tracked.known.shape)


def _share(hit: Callable[[Decisions, np.ndarray], np.ndarray]) -> Callable[[TrackedRuns], np.ndarray]:
    """The mean of what `hit` says of a row over the rows at rest of each trajectory, NaN where it has none."""

    def measure(tracked: TrackedRuns) -> np.ndarray:
        decisions, at = decided(tracked)
        rest = at != NO_POINT
        hits = np.where(rest, hit(decisions, at.ravel()).reshape(at.shape), 0.0).sum(axis=1)
        return np.where(rest.any(axis=1), hits / np.maximum(rest.sum(axis=1), 1), np.nan)

    return measure


MEASURES = {
    "named_right": _share(lambda d, at: d.point == at),
    "claimed": _share(lambda d, at: np.nan_to_num(d.probability)),
    "released_right": _share(lambda d, at: d.unlocked & (d.point == at)),
    "released_wrong": _share(lambda d, at: d.unlocked & (d.point != at)),
    "missed": _share(lambda d, at: ~d.unlocked),
}
