"""Run trackers over trajectories and write what they estimate as a table."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import polars as pl

from trackers.core.chunks import CHUNK
from trackers.core.estimates import Estimates, Status
from trackers.core.recording import Batch, stack
from trackers.core.tracker import AbstractTracker
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.trajectories import Trajectory, known_heights

TRACKS = "tracks.parquet"
WORDS = {
    Status.OK: "ok",
    Status.WAITING: "waiting",
    Status.RESTARTED: "restarted",
    Status.LOST: "lost",
    Status.NON_FINITE: "non-finite",
}
AXES = "xyz"

MAX_BATCH = 8 * CHUNK
"""Trajectories in memory at once: as many on every machine, since a batch's last chunk has a shape of its own."""


def batches(trajectories: Sequence[Trajectory]) -> list[tuple[list[Trajectory], Batch]]:
    """The trajectories in batches of at most `MAX_BATCH`, those of like length together, padded to few lengths."""
    ordered = sorted(trajectories, key=lambda trajectory: len(trajectory.recording))
    parts = [ordered[k : k + MAX_BATCH] for k in range(0, len(ordered), MAX_BATCH)]
    return [(part, stack([x.recording for x in part], rows=rounded(len(part[-1].recording)))) for part in parts]


def rounded(rows: int) -> int:
    """At least `rows`, with three significant bits: recordings of all lengths then share few compiled programs."""
    step = 1 << max(rows.bit_length() - 3, 0)
    return -(-rows // step) * step


def track(groups: Sequence[TrackerBatch], advance: Callable[[int], None]) -> tuple[pl.DataFrame, dict[str, int]]:
    """The estimates of all groups as one table, and how often each verdict was given; `advance` counts trajectories done."""
    tables: list[pl.DataFrame] = []
    verdicts: dict[str, int] = {}
    for group in groups:
        for trajectories, batch in batches(group.trajectories):
            estimates = group.tracker.run(batch)
            for k, trajectory in enumerate(trajectories):
                one = estimates[k]
                verdict = re.split(r":| \d+ times| at row \d+", one.verdict())[0]
                verdicts[verdict] = verdicts.get(verdict, 0) + 1
                tables.append(_table(trajectory, group.tracker, one))
            advance(len(trajectories))
    return pl.concat(tables, how="diagonal").sort(["recording", "tag", "t_s"], maintain_order=True), verdicts


def _table(trajectory: Trajectory, tracker: AbstractTracker, estimates: Estimates) -> pl.DataFrame:
    """One trajectory's estimates, the last of each time, at the times for which they are valid."""
    recording = trajectory.recording
    rows = len(recording)
    times, estimates = tracker.at_valid_time(recording.times, estimates[:rows])
    last = np.append(np.diff(recording.times) > 0, True)
    status = estimates.status[:rows]
    usable = estimates.usable[:rows]
    columns = angles(estimates) if trajectory.station else _positions(estimates, known_heights(trajectory), rows)
    ids: dict[str, Any] = {"recording": trajectory.folder.name, "tag": trajectory.tag}
    if trajectory.station:
        ids["station"] = trajectory.station
    known = {name: np.where(usable, np.asarray(x)[:rows].astype(float), np.nan)[last] for name, x in columns.items()}
    said = {"nis": estimates.nis, "nis_dof": estimates.nis_dof, "log_likelihood": estimates.log_likelihood}
    return pl.DataFrame(
        {name: pl.repeat(text, int(last.sum()), eager=True) for name, text in ids.items()}
        | {"t_s": times[last]}
        | {name: pl.Series(x, nan_to_null=True) for name, x in known.items()}
        | {name: x[:rows][last].astype(float) for name, x in said.items()}
        | {"wrapped": estimates.wrapped[:rows][last] > 0, "status": [WORDS[Status(s)] for s in status[last]]}
    )


def _positions(estimates: Estimates, height: np.ndarray, rows: int) -> dict[str, np.ndarray]:
    mean = [np.asarray(x)[:rows] for x in estimates.mean.position]
    sigmas = [estimates.sigmas[f"position.{k}"][:rows] for k in range(len(mean))]
    if len(mean) == 2:
        mean, sigmas = [*mean, height], [*sigmas, 0.0 * height]
    columns = {f"{a}_m": x for a, x in zip(AXES, mean, strict=True)}
    columns |= {f"std_{a}_m": s for a, s in zip(AXES, sigmas, strict=True)}
    cov = estimates.covariance[:rows]
    n = len(estimates.mean.position)
    columns |= {f"cov_{AXES[i]}{AXES[j]}_m2": cov[:, i, j] for i in range(n) for j in range(i + 1, n)}
    # A moving window has no velocity.
    velocity = [np.asarray(x)[:rows] for x in getattr(estimates.mean, "velocity", ())]
    return columns | {f"v{a}_mps": v for a, v in zip(AXES, velocity, strict=False)}


def angles(estimates: Estimates) -> dict[str, np.ndarray]:
    """Azimuth and elevation; a direction in the array's plane has azimuth ±90° and its spread in the elevation."""
    if hasattr(estimates.mean, "heading"):
        angle = np.asarray(estimates.mean.heading.angle)
        azimuth = np.where(np.cos(angle) >= 0, np.pi / 2, -np.pi / 2)
        sigma = estimates.sigmas["heading.0"]
        return {
            "azimuth_rad": azimuth,
            "elevation_rad": np.arcsin(np.clip(np.sin(angle), -1, 1)),
            "std_azimuth_rad": np.full_like(sigma, np.nan),
            "std_elevation_rad": sigma,
        }
    sigmas = estimates.sigmas
    return {
        "azimuth_rad": estimates.mean.azimuth,
        "elevation_rad": estimates.mean.elevation,
        "std_azimuth_rad": sigmas["azimuth"],
        "std_elevation_rad": sigmas["elevation"],
    }
