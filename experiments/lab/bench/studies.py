"""A study's chunk and its parts beside the tracker alone, in processor seconds of warm programs."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

import jax
import numpy as np

from trackwright.experiments.lab.bench.timing import clocked
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen, shown
from trackwright.experiments.monte_carlo.chunk import run_chunk
from trackwright.experiments.monte_carlo.declaration import Study, TrackerConfig, World
from trackwright.sim.worlds import WORLDS as MAKE
from trackwright.trackers.core.data.recording import Batch
from trackwright.trackers.core.run.chunks import as_dtype, called, chunks
from trackwright.trackers.core.run.tracker import AbstractTracker, filter_batch
from trackwright.trackers.recordings.tracker_spec import TrackerBatch
from trackwright.trackers.recordings.tracks import batches

TRAJECTORIES = 256
"""Trajectories of a chunk."""

FEWER = {"das": 8, "line-pf": 16, "line-grid": 8, "fix-mirror": 32, "mhk": 64, "uwb-imu": 64}
"""Trajectories of a chunk of the slowest trackers."""

ROUNDS = 3
LEAST_SHARE = 1 / 3
"""Least rate of a whole chunk, as a share of the rate of the tracker alone."""

WORLDS: dict[str, tuple[str, ...]] = {
    "station": ("direct", "cascade", "beam", "das"),
    "line": ("fix-kf", "imm", "moving-average", "line-grid", "line-pf", "mhk"),
    "ranges": ("uwb", "multilateration"),
    "tdoa": ("tdoa",),
    "fusion": ("fusion", "uwb"),
    "tool": ("uwb-imu", "uwb", "multilateration"),
    "agv": ("fix-kf", "fix-singer", "imm", "fix-mirror", "median", "mhk"),
}
"""The trackers that read each world's tables."""


def studies(*, world: tuple[str, ...] = (), tracker: tuple[str, ...] = (), output: Output = DEFAULTS) -> int:
    """A study's chunk beside the tracker alone, for every world: simulated, prepared, run and scored.

    The tracker alone is `tracker.run` on the same stacked rows, beside its compiled program on arrays that are in
    place; medians over rounds in which the whole and its parts have one turn each. 1 if the rate of a chunk is below a
    third of the tracker's.

    Args:
        world: worlds, all by default.
        tracker: trackers, all of each world by default.
    """
    trackers = chosen(tracker, dict.fromkeys(t for every in WORLDS.values() for t in every))
    pairs = [(w, t) for w in chosen(world, WORLDS) for t in WORLDS[w] if t in trackers]
    rows = shown(of_a_chunk(*pair, output) for pair in pairs)
    output.publish("bench studies", Table(rows))
    return int(any(row["run/whole"] < LEAST_SHARE for row in rows))


def of_a_chunk(world: str, tracker: str, output: Output) -> Row:
    """Processor time per row of the parts and of the whole chunk, and the share of the rate of the tracker alone."""
    count = 4 if output.small else FEWER.get(tracker, TRAJECTORIES)
    study = Study(
        "speed",
        "",
        {world: World(MAKE[world])},
        {tracker: TrackerConfig(tracker)},
        runs=count * (2 if count <= 128 else 512),
    )
    (condition,), config, ids = study.conditions, study.trackers[tracker], np.arange(count)
    assert study.chunk == count
    program: Any = partial(called, filter_batch)
    rows = 0

    def one_round() -> tuple[float, ...]:
        nonlocal rows
        (_, simulate), folder = clocked(lambda: study.worlds[world].make(ids, study.seed))
        (_, prepare), stacked = clocked(lambda: rows_of(config.spec.batches([folder], tracker)))
        placed = [(as_dtype(model, batch.dt.dtype), part) for model, batch in stacked for part in chunks(batch, count)]
        (_, bare), _ = clocked(lambda: jax.block_until_ready([program(*arguments) for arguments in placed]))
        (_, run), _ = clocked(lambda: [model.run(batch, count) for model, batch in stacked])
        (_, whole), _ = clocked(lambda: run_chunk(study, condition, ids, False))
        rows = int(sum(np.asarray(batch.valid).sum() for _, batch in stacked))
        return simulate, prepare, bare, run, whole - simulate - prepare - run, whole

    warm = np.array([one_round() for _ in range(output.rounds(ROUNDS) + 1)])[1:]
    parts = (f"{part} µs/row" for part in ("simulate", "prepare", "program", "run", "score", "whole"))
    return {
        "world": world,
        "tracker": tracker,
        "trajectories": count,
        "rows": rows,
        **dict(zip(parts, (1e6 * np.median(warm, axis=0) / rows).tolist(), strict=True)),
        "run/whole": float(np.median(warm[:, 3] / warm[:, 5])),
        "run/program": float(np.median(warm[:, 3] / warm[:, 2])),
    }


def rows_of(groups: Iterable[TrackerBatch]) -> list[tuple[AbstractTracker, Batch]]:
    """The stacked rows of all trajectories, with their trackers."""
    return [(group.tracker, batch) for group in groups for _, batch in batches(group.trajectories, truth=False)]
