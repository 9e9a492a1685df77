"""Rate of a study's chunk over that of the tracker alone, for every world: `python -m experiments.lab.bench.studies`.

A chunk is simulated, prepared (rows of the tracker, stacked), run and scored as in a study with one tracker. The
tracker alone is `tracker.run` on the same stacked rows, beside its compiled program on arrays that are in place.
Processor seconds of warm programs, medians over rounds in which the whole chunk and its parts have one turn each.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.__main__ import machine
from experiments.lab.bench.timing import write_json

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
    "tool": ("uwb-imu", "uwb", "multilateration"),
    "agv": ("fix-kf", "fix-singer", "imm", "fix-mirror", "median", "mhk"),
}
"""The trackers that read each world's tables."""


def main(
    *, world: tuple[str, ...] = (), tracker: tuple[str, ...] = (), out: Path = Path("out/bench-studies.json")
) -> int:
    """Measure chunks of studies, print the table and write it as JSON; 1 if a share is below a third.

    Args:
        world: worlds, all by default.
        tracker: trackers, all of each world by default.
        out: the JSON file to write.
    """
    set_flags()
    rows = []
    print(
        f"{'world':9s}{'tracker':17s}{'rows':>8s}  µs/row: simulate  prepare  program      run    score    whole"
        "   share of run   run/program"
    )
    for name, trackers in WORLDS.items():
        for one in trackers:
            if (world and name not in world) or (tracker and one not in tracker):
                continue
            found = measured(name, one)
            rows.append(found)
            each = "".join(f"{found[f'{part}_us_per_row']:9.3f}" for part in PARTS)
            shares = f"{found['share']:15.2f}{found['run_over_program']:14.2f}"
            print(f"{name:9s}{one:17s}{found['rows']:8d}         {each}{shares}", flush=True)
    command = ["python", "-m", "experiments.lab.bench.studies", *sys.argv[1:]]
    write_json(
        out,
        {
            "command": command,
            "machine": machine(),
            "packages": {"jax": version("jax"), "numpy": np.__version__},
            "studies": rows,
        },
    )
    print(f"Written: {out}")
    return int(any(found["share"] < LEAST_SHARE for found in rows))


PARTS = ("simulate", "prepare", "program", "run", "score", "whole")


def measured(world: str, tracker: str) -> dict[str, Any]:
    """Processor time per row of the parts and of the whole chunk, and the share of the rate of the tracker alone."""
    from experiments.monte_carlo.chunk import run_chunk
    from experiments.monte_carlo.declaration import Study, TrackerConfig, World
    from sim.worlds import WORLDS as MAKE
    from trackers.core.chunks import as_dtype, chunks
    from trackers.core.recording import Batch
    from trackers.core.tracker import AbstractTracker, filter_batch
    from trackers.recordings.folder import RecordingFolder
    from trackers.recordings.tracks import batches as row_batches

    count = FEWER.get(tracker, TRAJECTORIES)
    study = Study(
        "speed",
        "",
        {world: World(MAKE[world])},
        {tracker: TrackerConfig(tracker)},
        runs=count * (2 if count <= 128 else 512),
    )
    (condition,), config, ids = study.conditions, study.trackers[tracker], np.arange(count)
    chunk = study.chunk
    assert chunk == count
    program = eqx.filter_jit(filter_batch)
    seconds: dict[str, list[float]] = {part: [] for part in PARTS}
    for attempt in range(ROUNDS + 1):
        folder, simulate = _clocked(lambda: study.worlds[world].make(ids, study.seed))

        def prepared(folder: RecordingFolder = folder) -> list[tuple[AbstractTracker, Batch]]:
            groups = config.spec.batches([folder], tracker)
            return [(own.tracker, batch) for own in groups for _, batch in row_batches(own.trajectories, truth=False)]

        batches, prepare = _clocked(prepared)
        placed = [(as_dtype(own, batch.dt.dtype), part) for own, batch in batches for part in chunks(batch, chunk)]
        _, bare = _clocked(partial(_compiled, program, placed))
        _, run = _clocked(partial(_run, batches, chunk))
        _, whole = _clocked(lambda: run_chunk(study, condition, ids, False))
        if attempt:
            for part, value in zip(
                PARTS, (simulate, prepare, bare, run, whole - simulate - prepare - run, whole), strict=True
            ):
                seconds[part].append(value)
    rows = int(sum(np.asarray(batch.valid).sum() for _, batch in batches))
    medians = {f"{part}_us_per_row": 1e6 * float(np.median(seconds[part])) / rows for part in PARTS}
    share = float(np.median(np.array(seconds["run"]) / np.array(seconds["whole"])))
    over = float(np.median(np.array(seconds["run"]) / np.array(seconds["program"])))
    found = {"world": world, "tracker": tracker, "trajectories": count, "rows": rows, **medians}
    return {**found, "share": share, "run_over_program": over}


def _compiled(program: Callable[..., Any], placed: list[tuple[Any, Any]]) -> None:
    jax.block_until_ready([program(own, part) for own, part in placed])


def _run(batches: list[Any], chunk: int) -> None:
    for tracker, batch in batches:
        tracker.run(batch, chunk)


def _clocked(run: Callable[[], Any]) -> tuple[Any, float]:
    """The result, and processor seconds."""
    began = time.process_time()
    result = run()
    return result, time.process_time() - began


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.studies")
