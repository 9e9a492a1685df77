"""The estimates of whole recordings as one table, one row per trajectory and time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.data.estimates import AXES, STATUS_WORDS, STEP_COLUMNS, Estimates, Status
from trackwright.trackers.core.data.frames import frame_html, to_pandas
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.model.state import Heading
from trackwright.trackers.core.run.chunks import CHUNK
from trackwright.trackers.core.run.tracker import AbstractTracker
from trackwright.trackers.recordings.tracks_table import HEADING
from trackwright.trackers.recordings.trajectories import Trajectories, Trajectory

MAX_BATCH = 8 * CHUNK  # trajectories in memory at once, on every machine


@dataclass(frozen=True)
class TrackerBatch:
    """Trajectories that one tracker runs as a batch; `planar`: the state lies in a plane, as of the floor."""

    tracker: AbstractTracker
    trajectories: Sequence[Trajectory]
    planar: bool
    notices: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False)
class Tracks:
    """The estimates of recordings: a row per time of a trajectory, how many ended how, and the batches that ran."""

    table: pl.DataFrame
    summaries: dict[str, int]
    batches: list[TrackerBatch]

    @property
    def notices(self) -> tuple[str, ...]:
        """One line for readings used once, and for what a recording has that its tracker leaves out of account."""
        return tuple(line for batch in self.batches for line in batch.notices)

    def to_polars(self) -> pl.DataFrame:
        """The table of estimates."""
        return self.table

    def to_pandas(self) -> Any:
        """The table of estimates as a pandas frame; raises UnusableInput where pandas is not installed."""
        return to_pandas(self.table)

    def _repr_html_(self) -> str:
        return frame_html(repr(self), self.table)

    def __repr__(self) -> str:
        ended = ", ".join(f"{n} {words}" for words, n in self.summaries.items())
        return f"<Tracks: {len(self.table)} estimates; trajectories: {ended}>"


def batches(trajectories: Iterable[Trajectory], seed: int = 0, truth: bool = True) -> list[tuple[Trajectories, Batch]]:
    """The trajectories in batches of at most `MAX_BATCH`, similar lengths together; `seed`: of filters that draw."""
    joined = Trajectories.of(trajectories)
    lengths = np.diff(joined.columns.starts)
    ordered = np.argsort(lengths, kind="stable")
    parts = [ordered[k : k + MAX_BATCH] for k in range(0, len(ordered), MAX_BATCH)]
    groups = [(joined.chosen(part), rounded(int(lengths[part].max()))) for part in parts]
    return [(group, group.columns.batch(steps, None, seed, truth)) for group, steps in groups]


def rounded(rows: int) -> int:
    """At least `rows`, with three significant bits: recordings of all lengths then share few compiled programs."""
    step = 1 << max(rows.bit_length() - 3, 0)
    return -(-rows // step) * step


def track(groups: Sequence[TrackerBatch], advance: Callable[[int], None] = lambda done: None, seed: int = 0) -> Tracks:
    """The estimates of all batches; `advance` gets the number of trajectories done; `seed`: of filters that draw."""
    tables, endings = list[pl.DataFrame](), Counter[str]()
    for group in groups:
        # Covariances of large states have hundreds of entries.
        tracker = group.tracker.for_positions()
        for trajectories, batch in batches(group.trajectories, seed, truth=False):
            estimates = tracker.run(batch)
            rows = trajectories.columns.padded(trajectories.columns.times, estimates.status.shape[1])
            last, merged = estimates.per_time(rows)
            number = np.nonzero(last)[0]
            endings += _endings(number, merged.status, len(trajectories))
            tables.append(_table(trajectories, number, estimates.valid_times(rows)[last], merged))
            advance(len(trajectories))
    table = pl.concat(tables, how="diagonal").sort("recording", "tag", "t_s", maintain_order=True)
    return Tracks(table, dict(endings), list(groups))


def _endings(number: np.ndarray, status: np.ndarray, count: int) -> Counter[str]:
    """How many of `count` trajectories ended how; `number` (N,): of the one of each estimate, with its `status`."""
    has = {s: np.bincount(number[status == s], minlength=count) for s in Status}
    endings = {
        "too little data": has[Status.WAITING] == np.bincount(number, minlength=count),
        "non-finite": has[Status.NON_FINITE] > 0,
        "lost and re-started": has[Status.RESTARTED] > 0,
        "lost and never re-started": has[Status.LOST] > 0,
    }
    return Counter(np.select(list(endings.values()), list(endings), "ok").tolist())


def _table(trajectories: Trajectories, number: np.ndarray, times: np.ndarray, estimates: Estimates) -> pl.DataFrame:
    """The estimates (N,), one per time; `number`: of the trajectory of each; `times`: for which they are valid, s."""
    bearing = bool(trajectories.stations[0])
    origins = np.array([folder.origin for folder in trajectories.folders])[number]
    columns = angles(estimates) if bearing else _positions(estimates, trajectories.heights[number], origins)
    ids: dict[str, Sequence[str]] = {"recording": [f.name for f in trajectories.folders], "tag": trajectories.tags}
    if bearing:
        ids["station"] = trajectories.stations
    known = {name: np.where(estimates.usable, np.asarray(x, float), np.nan) for name, x in columns.items()}
    words = pl.Series([STATUS_WORDS.get(s) for s in Status])
    return pl.DataFrame(
        {name: pl.Series(texts).gather(number) for name, texts in ids.items()}
        | {"t_s": times}
        | {name: pl.Series(x, nan_to_null=True) for name, x in known.items()}
        | {name: getattr(estimates, name) for name in STEP_COLUMNS}
        | {"wrapped": estimates.wrapped > 0, "status": words.gather(estimates.status)}
    )


def _positions(estimates: Estimates, height: np.ndarray, origins: np.ndarray) -> dict[str, np.ndarray]:
    """Positions about `origins` (N, 2), m, of `height` (N,) without one, spreads, velocities and heading."""
    mean, every_sigma = [np.asarray(x) for x in estimates.mean.position], estimates.sigmas
    mean[:2] = [np.asarray(x, float) + origin for x, origin in zip(mean, origins.T, strict=False)]
    sigmas = [every_sigma[f"position.{k}"] for k in range(len(mean))]
    cov, n = estimates.entries("position"), len(mean)
    if n == 2:
        mean, sigmas = [*mean, height], [*sigmas, 0.0 * height]
    columns = {f"{a}_m": x for a, x in zip(AXES, mean, strict=True)}
    columns |= {f"std_{a}_m": s for a, s in zip(AXES, sigmas, strict=True)}
    columns |= {f"cov_{AXES[i]}{AXES[j]}_m2": cov[i][j] for i in range(n) for j in range(i + 1, n)}
    # A moving window has no velocity.
    velocity = [np.asarray(x) for x in getattr(estimates.mean, "velocity", ())]
    columns |= {f"v{a}_mps": v for a, v in zip(AXES, velocity, strict=False)}
    attitude = getattr(estimates.mean, "attitude", None)
    if attitude is None:
        return columns
    if isinstance(attitude, Heading):
        angle = np.asarray(attitude.angle)
    else:
        w, x, y, z = (np.asarray(q) for q in (attitude.w, attitude.x, attitude.y, attitude.z))
        angle = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    columns[HEADING] = np.pi - (np.pi - angle) % (2 * np.pi)
    if isinstance(attitude, Heading) and "attitude.0" in every_sigma:
        columns[f"std_{HEADING}"] = every_sigma["attitude.0"]
    return columns


def angles(estimates: Estimates) -> dict[str, np.ndarray]:
    """Azimuth and elevation; a direction in the array's plane has azimuth ±90° and its spread in the elevation."""
    mean, sigmas = estimates.mean, estimates.sigmas
    if hasattr(mean, "heading"):
        angle, sigma = np.asarray(mean.heading.angle), sigmas["heading.0"]
        azimuth = np.where(np.cos(angle) >= 0, np.pi / 2, -np.pi / 2)
        elevation = np.arcsin(np.clip(np.sin(angle), -1, 1))
        spreads = np.full_like(sigma, np.nan), sigma
    else:
        azimuth, elevation, spreads = mean.azimuth, mean.elevation, (sigmas["azimuth"], sigmas["elevation"])
    both = {"azimuth_rad": azimuth, "elevation_rad": elevation}
    return both | {"std_azimuth_rad": spreads[0], "std_elevation_rad": spreads[1]}
