"""The estimates of whole recordings as one table, one row per trajectory and time."""

from __future__ import annotations

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
from trackwright.trackers.recordings.columns import stable_order
from trackwright.trackers.recordings.tracker_spec import TrackerBatch
from trackwright.trackers.recordings.tracks_table import HEADING
from trackwright.trackers.recordings.trajectories import Trajectories, Trajectory

MAX_BATCH = 8 * CHUNK
"""Trajectories in memory at once: as many on every machine, since a batch's last chunk has a shape of its own."""


@dataclass(frozen=True, repr=False)
class Tracks:
    """The estimates of all trajectories of one or more recordings.

    `table`: one row per time of a trajectory, the columns of tracks.parquet (docs/formats.md). `summaries`: how many
    trajectories ended how, as `ok` or `lost and re-started`. `batches`: the trajectories, with the trackers that ran
    them.
    """

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
        count = sum(self.summaries.values())
        ended = ", ".join(f"{n} {words}" for words, n in self.summaries.items())
        noun = "trajectory" if count == 1 else "trajectories"
        return f"<Tracks: {len(self.table)} estimates of {count} {noun}: {ended}>"


def batches(trajectories: Iterable[Trajectory], seed: int = 0, truth: bool = True) -> list[tuple[Trajectories, Batch]]:
    """The trajectories in batches of at most `MAX_BATCH`, with similar lengths together, padded to few lengths.

    `seed`: of the random numbers of filters that draw any. `truth`: whether the batches have it.
    """
    joined = Trajectories.of(trajectories)
    groups = [(joined.chosen(numbers), steps) for numbers, steps in by_length(np.diff(joined.columns.starts))]
    return [(group, group.columns.batch(steps, None, seed, truth)) for group, steps in groups]


def by_length(lengths: np.ndarray) -> list[tuple[np.ndarray, int]]:
    """The numbers of the trajectories of each batch, of these lengths (n,), and the steps that it is padded to."""
    ordered = np.argsort(lengths, kind="stable")
    parts = [ordered[k : k + MAX_BATCH] for k in range(0, len(ordered), MAX_BATCH)]
    return [(part, rounded(int(lengths[part].max()))) for part in parts]


def rounded(rows: int) -> int:
    """At least `rows`, with three significant bits: recordings of all lengths then share few compiled programs."""
    step = 1 << max(rows.bit_length() - 3, 0)
    return -(-rows // step) * step


def track(groups: Sequence[TrackerBatch], advance: Callable[[int], None] = lambda done: None, seed: int = 0) -> Tracks:
    """The estimates of all batches of trajectories; `advance` is called with the number of trajectories done.

    `seed`: of the random numbers of filters that draw any.
    """
    tables: list[pl.DataFrame] = []
    keys: list[tuple[list[tuple[str, str]], np.ndarray]] = []
    summaries: dict[str, int] = {}
    for group in groups:
        # Covariances of large states have hundreds of entries.
        tracker = group.tracker.for_positions()
        for trajectories, batch in batches(group.trajectories, seed, truth=False):
            estimates = tracker.run(batch)
            rows = trajectories.columns.padded(trajectories.columns.times, estimates.status.shape[1])
            last, merged = estimates.per_time(rows)
            number = np.nonzero(last)[0]
            for words, count in _summaries(number, merged.status, len(trajectories)).items():
                summaries[words] = summaries.get(words, 0) + count
            names = [(folder.name, tag) for folder, tag in zip(trajectories.folders, trajectories.tags, strict=True)]
            keys.append((names, number))
            tables.append(_table(trajectories, number, estimates.valid_times(rows)[last], merged))
            advance(len(trajectories))
    table = pl.concat(tables, how="diagonal")
    place = {key: k for k, key in enumerate(sorted({key for names, _ in keys for key in names}))}
    of_rows = np.concatenate([np.array([place[key] for key in names])[number] for names, number in keys])
    return Tracks(table[_order(of_rows, table["t_s"].to_numpy())], summaries, list(groups))


def _order(track: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The order (N,) of rows by the number of their track, then time; rows of equal times keep theirs."""
    order = stable_order(track)
    sorted_times = (np.diff(times[order]) >= 0) | (np.diff(track[order]) > 0)
    return order if sorted_times.all() else np.lexsort((times, track))


def _summaries(number: np.ndarray, status: np.ndarray, count: int) -> dict[str, int]:
    """How many of `count` trajectories ended how, in the words of `Estimates.summary`.

    `number` (N,): of the trajectory of each estimate, whose `status` (N,) this is.
    """
    has = {s: np.bincount(number[status == s], minlength=count) for s in Status}
    rows = np.bincount(number, minlength=count)
    endings = {
        "too little data": has[Status.WAITING] == rows,
        "non-finite": has[Status.NON_FINITE] > 0,
        "lost and re-started": has[Status.RESTARTED] > 0,
        "lost and never re-started": has[Status.LOST] > 0,
        "ok": np.ones(count, bool),
    }
    counts, left = {}, np.ones(count, bool)
    for words, ended in endings.items():
        counts[words] = int((left & ended).sum())
        left &= ~ended
    return {words: n for words, n in counts.items() if n}


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
    """Positions with their standard deviations and covariances, m and m², and velocities, m/s, if the state has any.

    `height` (N,), m, for states without one; `origins` (N, 2): x and y, m, from which the states have theirs.
    """
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
    return columns | _heading(estimates)


def _heading(estimates: Estimates) -> dict[str, np.ndarray]:
    """The heading of a state with an attitude, rad in (−π, π], and its standard deviation where it is kept."""
    attitude = getattr(estimates.mean, "attitude", None)
    if attitude is None:
        return {}
    if isinstance(attitude, Heading):
        angle = np.asarray(attitude.angle)
    else:
        w, x, y, z = (np.asarray(q) for q in (attitude.w, attitude.x, attitude.y, attitude.z))
        angle = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    columns = {HEADING: np.pi - (np.pi - angle) % (2 * np.pi)}
    sigma = estimates.sigmas.get("attitude.0") if isinstance(attitude, Heading) else None
    return columns if sigma is None else columns | {f"std_{HEADING}": sigma}


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
