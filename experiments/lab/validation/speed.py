"""Speed: compiled programs by row, studies beside their trackers, whole commands; one timer for all."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple, cast

import jax
import numpy as np

import trackwright as tw
from trackwright.experiments.jobs.executors import cluster_executor
from trackwright.experiments.lab.runner import REPOSITORY, Case, Figures, machine
from trackwright.experiments.lab.validation.sites import paths
from trackwright.experiments.monte_carlo import Study, load_study, run_study
from trackwright.experiments.monte_carlo.chunk import run_chunk
from trackwright.experiments.monte_carlo.declaration import TrackerConfig, World
from trackwright.experiments.pages.study import to_json
from trackwright.sim import worlds
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.tracks import batches
from trackwright.tuning.objectives import NegativeLogLikelihood
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

ROUNDS = 5


class Seconds(NamedTuple):
    """Wall and processor time."""

    wall: float
    cpu: float


def clocked(run: Callable[[], Any]) -> tuple[Seconds, Any]:
    """The time of one run, and its result."""
    began, began_cpu = time.perf_counter(), time.process_time()
    result = run()
    return Seconds(time.perf_counter() - began, time.process_time() - began_cpu), result


def per_row(run: Callable[[], Any], rows: int) -> Figures:
    """The first call, which traces and compiles, and the medians per row of the runs after it."""
    first, _ = clocked(run)
    wall, cpu = np.median([clocked(run)[0] for _ in range(ROUNDS)], axis=0)
    times = {"first_call_cpu_s": first.cpu, "us_per_row": 1e6 * cpu / rows, "wall_us_per_row": 1e6 * wall / rows}
    return {"rows": rows, **times, "device": jax.devices()[0].device_kind, **machine()}


def command(words: Sequence[str | Path], log: Path, environment: Mapping[str, str]) -> tuple[Seconds, float, int]:
    """The time of `trackwright` with these words in a process, children included, its peak in MB, and its exit code."""
    began = time.perf_counter()
    with log.open("w", encoding="utf-8") as said:
        line = [sys.executable, "-m", "trackwright", *words]
        child = subprocess.Popen(line, cwd=REPOSITORY, env=environment, stdout=said, stderr=said)
        _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    seconds = Seconds(time.perf_counter() - began, used.ru_utime + used.ru_stime)
    return seconds, used.ru_maxrss * 1024 / 1e6, child.returncode


SIZES = (1, 64, 512)
LARGE = (512, 16_384)  # trajectories of a batch on a processor, and on a GPU

READS = {
    "beam": "station",
    "direct": "station",
    "line-grid": "line",
    "line-pf": "line",
    "uwb": "ranges",
    "uwb-imu": "tool",
    "tdoa": "tdoa",
    "fusion": "fusion",
    "fix-kf": "agv",
    "imm": "agv",
    "mhk": "agv",
}
"""The world whose recordings a tracker reads."""

LARGE_STATES = ("line-grid", "line-pf", "mhk")
"""Trackers that run forward alone; of these 64 trajectories are the most on a processor."""

ON_GPU = ("beam", "uwb", "line-pf")
ROWS = 40  # times of each recording, or readings; `line` lasts for two minutes


def program_cases() -> Iterator[Case]:
    """Processor time per row of compiled programs: filter, smoother and gradient by size of the batch."""
    for tracker in READS:
        for size in SIZES[: 2 if tracker in LARGE_STATES else None]:
            yield from of_size(tracker, size)


def gpu_cases() -> Iterator[Case]:
    """Some trackers in large batches on a GPU; raises UnusableInput without one."""
    if jax.default_backend() != "gpu":
        raise UnusableInput(
            f"gpu: jax finds no GPU, only {jax.devices()[0].device_kind}; expected a CUDA device; install the extra on "
            "its host: pip install trackwright[cuda], or trackwright[cuda13] for drivers of CUDA 13"
        )
    for tracker in ON_GPU:
        for size in LARGE:
            yield from of_size(tracker, size)


def of_size(tracker: str, size: int) -> Iterator[Case]:
    """Filter, smoother and gradient of a batch, as far as a tracker has them."""
    for what in ("filter",) if tracker in LARGE_STATES else ("filter", "smoother", "gradient"):
        measure = partial(program_figures, tracker, what, size)
        yield Case(READS[tracker], tracker, f"{what}, {size} trajectories", measure)


def program_figures(name: str, what: str, size: int) -> Figures:
    """The time per row; a gradient is the likelihood's by the first two tunables."""
    options = {} if READS[name] == "line" else {"rows": ROWS}
    folder = worlds.WORLDS[READS[name]](np.arange(size), 0, **options)
    batch = tw.TRACKERS[name].batches([folder], name)[0]
    recordings, tracker = [t.recording for t in batch.trajectories], cast(Any, batch.tracker)
    rows, stacked = sum(map(len, recordings)), tw.stack(recordings)
    if what == "gradient":
        parameters = select_parameters(tracker, list(tw.tunables(tracker))[:2])
        problem, vector = Problem(tracker, [stacked], NegativeLogLikelihood(), parameters), flatten(parameters)
        return per_row(lambda: jax.block_until_ready(problem.evaluate(vector)[:2]), rows)
    run = tw.Smoothed(tracker) if what == "smoother" else tracker
    return per_row(lambda: run.run(stacked, chunk=max(512, size)), rows)


TRAJECTORIES = 256
FEWER = {"das": 8, "line-pf": 16, "line-grid": 8, "fix-mirror": 32, "mhk": 64, "uwb-imu": 64}
"""Trajectories of a chunk, and of one of the slowest trackers."""

READ_BY: dict[str, tuple[str, ...]] = {
    "station": ("direct", "cascade", "beam", "das"),
    "line": ("fix-kf", "imm", "line-grid", "line-pf", "mhk"),
    "ranges": ("uwb", "multilateration"),
    "tdoa": ("tdoa",),
    "fusion": ("fusion", "bearings"),
    "tool": ("uwb-imu",),
    "agv": ("fix-kf", "fix-singer", "fix-mirror"),
}
"""The trackers that read each world's tables."""

PLACES = ("threads", "local:1", "local:2")
RUNS = 20_000
STUDY = f'runs = {RUNS}\nname = "speed"\nabout = "What do workers cost?"\n[worlds.line]\n[trackers.fix-kf]\n'
"""A study on worker processes, which load it from a file."""


def study_cases() -> Iterator[Case]:
    """A study's chunk and its parts beside the tracker alone, and a study on worker processes, in processor seconds."""
    for world, trackers in READ_BY.items():
        yield from (Case(world, tracker, "a chunk", partial(split, world, tracker)) for tracker in trackers)
    yield from (Case("line", "fix-kf", f"on {place}", partial(on_workers, place)) for place in PLACES)


def split(world: str, tracker: str) -> Figures:
    """Processor time per row of a chunk, of the tracker alone on its recordings, and their ratio; medians, warm."""
    count = FEWER.get(tracker, TRAJECTORIES)
    runs = count * (2 if count <= 128 else 512)
    study = Study("speed", "", {world: World(worlds.WORLDS[world])}, {tracker: TrackerConfig(tracker)}, runs=runs)
    (condition,), ids = study.conditions, np.arange(count)
    assert study.chunk == count
    groups = study.trackers[tracker].spec.batches([study.worlds[world].make(ids, 0)], tracker)
    stacked = [(g.tracker.for_positions(), batch) for g in groups for _, batch in batches(g.trajectories, truth=False)]

    def one_round() -> tuple[float, float]:
        run, _ = clocked(lambda: [model.run(batch, count) for model, batch in stacked])
        whole, _ = clocked(lambda: run_chunk(study, condition, ids, False))
        return run.cpu, whole.cpu

    rows = sum(np.asarray(batch.valid).sum() for _, batch in stacked)
    run, whole = 1e6 / rows * np.median([one_round() for _ in range(ROUNDS + 1)][1:], axis=0)
    times = {"run_us_per_row": run, "whole_us_per_row": whole, "ratio": whole / run}
    program = any(program is not None for program in study.programs.values())
    return {"trajectories": count, "rows": int(rows), "one_program": program, **times, **machine()}


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


WALKS = ("ble51-walk-u1-r1", "ble51-walk-u2-r1", "ble51-walk-u3-r1")
LEVELS = ("sensors.ranges.sigma_r", "motion.noise.sigma_a")
COMMANDS: dict[str, tuple[str, ...]] = {
    "help": ("--help",),
    "check": ("check", "starloc-fast-s1"),
    "refusal": ("track", "no-such-recording", "--out", "OUT"),
    "track-walk": ("track", WALKS[0], "--out", "OUT"),
    "track-labyrinth": ("track", "labyrinth", "--out", "OUT"),
    "track-lias": ("track", "lias-planar-fast", "--out", "OUT"),
    "track-starloc": ("track", "starloc-fast-s1", "--tracker", "uwb-imu", "--out", "OUT"),
    "track-drone": ("track", "iasl-drone-1", "--out", "OUT"),
    "tune-walks": ("tune", *WALKS, "--tune", "motion.sigma_a", "sensors.bearings.sigma_azimuth", "--out", "OUT"),
    "tune-starloc": ("tune", "starloc-fast-s1", "--tracker", "uwb-imu", "--tune", *LEVELS, "--out", "OUT"),
}
"""The arguments by name; recordings by their folder's name, `OUT` for the output folder."""

EXIT_CODES = {"check": (0, 1), "refusal": (2,), "tune-walks": (0, 1), "tune-starloc": (0, 1)}
"""Other than 0 alone: `check` finds errors, and `tune` may refuse its values at the end."""

WARM = 3
SETTINGS = ("JAX_", "XLA_", "TRACKWRIGHT_CACHE")
"""Environment variables that begin so are not handed on: they would move the cache or change the programs."""


def command_cases() -> Iterator[Case]:
    """Processor time that a user waits for whole commands, in fresh processes, with an empty and a filled cache."""
    for name, words in COMMANDS.items():
        yield Case("".join(words[1:2]), "", name, partial(command_figures, name))


def command_figures(name: str) -> Figures:
    """The first run, which fills the cache of compiled programs, and medians of the runs after it."""
    with tempfile.TemporaryDirectory() as scratch:
        log, out = Path(scratch) / "log.txt", Path(scratch) / "out"
        words = [paths().get(a, out if a == "OUT" else a) for a in COMMANDS[name]]
        environment = {key: value for key, value in os.environ.items() if not key.startswith(SETTINGS)}
        environment["TRACKWRIGHT_CACHE"] = str(Path(scratch) / "cache")
        runs = []
        for _ in range(1 + WARM):
            seconds, peak, code = command(words, log, environment)
            if code not in EXIT_CODES.get(name, (0,)):
                raise RuntimeError(f"exit code {code}: {(log.read_text('utf-8').splitlines() or ['no message'])[-1]}")
            runs.append((seconds, peak))
    (cold, peak), warm = runs[0], [seconds for seconds, _ in runs[1:]]
    times = {
        "cold_cpu_s": cold.cpu,
        "warm_cpu_s": median(x.cpu for x in warm),
        "warm_wall_s": median(x.wall for x in warm),
    }
    return {**times, "peak_mb": peak, **machine()}
