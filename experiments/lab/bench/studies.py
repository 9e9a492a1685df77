"""A study's chunk and its parts beside the tracker alone, and a study on worker processes, in processor seconds."""

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np

from trackwright.experiments.jobs.executors import cluster_executor
from trackwright.experiments.lab.bench.timing import ROUNDS, clocked
from trackwright.experiments.lab.runner import Case, Figures, machine
from trackwright.experiments.monte_carlo import Study, load_study, run_study
from trackwright.experiments.monte_carlo.chunk import run_chunk
from trackwright.experiments.monte_carlo.declaration import TrackerConfig, World
from trackwright.experiments.pages.reports.study import to_json
from trackwright.sim.worlds import WORLDS as MAKE
from trackwright.trackers.recordings.tracks import batches

TRAJECTORIES = 256
FEWER = {"das": 8, "line-pf": 16, "line-grid": 8, "fix-mirror": 32, "mhk": 64, "uwb-imu": 64}
"""Trajectories of a chunk, and of one of the slowest trackers."""

WORLDS: dict[str, tuple[str, ...]] = {
    "station": ("direct", "cascade", "beam", "das"),
    "line": ("fix-kf", "imm", "line-grid", "line-pf", "mhk"),
    "ranges": ("uwb", "multilateration"),
    "tdoa": ("tdoa",),
    "fusion": ("fusion",),
    "tool": ("uwb-imu",),
    "agv": ("fix-kf", "fix-singer", "fix-mirror"),
}
"""The trackers that read each world's tables."""

PLACES = ("threads", "local:1", "local:2")
RUNS = 20_000
STUDY = f'runs = {RUNS}\nname = "speed"\nabout = "What do workers cost?"\n[worlds.line]\n[trackers.fix-kf]\n'
"""A study on worker processes, which load it from a file."""


def cases() -> Iterator[Case]:
    """The split of a chunk for every world and tracker, and a study on threads and on worker processes."""
    for world, trackers in WORLDS.items():
        yield from (Case(world, tracker, "a chunk", partial(split, world, tracker)) for tracker in trackers)
    yield from (Case("line", "fix-kf", f"on {place}", partial(on_workers, place)) for place in PLACES)


def split(world: str, tracker: str) -> Figures:
    """Processor time per row of the parts of a chunk: simulated, prepared, run and scored; medians of warm rounds."""
    count = FEWER.get(tracker, TRAJECTORIES)
    runs = count * (2 if count <= 128 else 512)
    study = Study("speed", "", {world: World(MAKE[world])}, {tracker: TrackerConfig(tracker)}, runs=runs)
    (condition,), config, ids = study.conditions, study.trackers[tracker], np.arange(count)
    assert study.chunk == count

    def one_round() -> tuple[float, ...]:
        simulate, folder = clocked(lambda: study.worlds[world].make(ids, study.seed))
        prepare, stacked = clocked(
            lambda: [
                (group.tracker, batch)
                for group in config.spec.batches([folder], tracker)
                for _, batch in batches(group.trajectories, truth=False)
            ]
        )
        run, _ = clocked(lambda: [model.run(batch, count) for model, batch in stacked])
        whole, _ = clocked(lambda: run_chunk(study, condition, ids, False))
        rows, parts = sum(np.asarray(batch.valid).sum() for _, batch in stacked), (simulate.cpu, prepare.cpu, run.cpu)
        return (rows, *parts, whole.cpu - sum(parts), whole.cpu)

    rows, *warm = np.median([one_round() for _ in range(ROUNDS + 1)][1:], axis=0)
    names = (f"{part}_us_per_row" for part in ("simulate", "prepare", "run", "score", "whole"))
    times = dict(zip(names, 1e6 / rows * np.array(warm), strict=True))
    return {"trajectories": count, "rows": int(rows), **times, **machine()}


def on_workers(place: str) -> Figures:
    """Wall and processor time of a whole study, workers included, and the digest of its results."""
    before = os.times()
    with tempfile.TemporaryDirectory() as name, cluster_executor(place) if place != "threads" else nullcontext() as on:
        file = Path(name) / "study.toml"
        file.write_text(STUDY, "utf-8")
        study = load_study(str(file))
        seconds, results = clocked(lambda: run_study(study, Path(name) / "out", executor=on))
    cpu = float(np.subtract(os.times()[:4], before[:4]).sum())
    digest = json.loads(to_json(results, []))["sha256"][:12]
    return {"trajectories": RUNS, "wall_s": seconds.wall, "cpu_s": cpu, "sha256": digest, **machine()}
