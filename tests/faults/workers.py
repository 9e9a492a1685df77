"""Workers of a cluster that die or hang while a study runs, and a scheduler that dies."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from threading import Timer
from typing import Any
from unittest import mock

import numpy as np

from tests.faults.jobs import begun, half_written, hurt, long_fit, reference, run, running, temporary
from tests.faults.seen import Seen
from trackwright.experiments.jobs import executors
from trackwright.experiments.monte_carlo import load_study, run_study
from trackwright.experiments.monte_carlo.chunk_store import ChunkStore
from trackwright.experiments.monte_carlo.declaration import Study
from trackwright.experiments.pages.reports.study_text import to_json

Draw = np.random.Generator

DECLARATION = """
name = "faults"
about = "What does a dead worker cost?"
metrics = ["rmse_m", "nees_mean"]
[worlds.line]
situation = "constant"
rate_hz = 1.0
[trackers.fix-kf]
"""
APART = 4
"""Chunks between two kills, at least: a part whose worker dies four times ends the command, by design."""


def _declared(place: Path, trajectories: int) -> Study:
    file = place / "faults.toml"
    file.write_text(f"runs = {trajectories}\n{DECLARATION}", "utf-8")
    return load_study(str(file))


def _digest(study: Study, folder: Path, cluster: str | None = None) -> str:
    """Of the results of the study, on threads or a cluster."""
    if cluster is None:
        results = run_study(study, folder)
    else:
        with executors.cluster_executor(cluster) as executor:
            results = run_study(study, folder, executor=executor)
    assert results is not None
    return str(json.loads(to_json(results, []))["sha256"])


def workers(caller: int | None = None) -> list[int]:
    """The process ids of the local workers of a process, by default this one."""
    import psutil

    found = []
    for child in psutil.Process(caller).children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # one that has just been killed
            found += [child.pid] * ("spawn_main" in " ".join(child.cmdline()))
    return found


def _sent(draw: Draw, number: int, caller: int | None = None) -> int:
    """Sends a signal to any worker of a process, by default this one; how many got it."""
    found = workers(caller)
    if not found:
        return 0
    try:
        os.kill(found[draw.integers(len(found))], number)
    except ProcessLookupError:
        return 0
    return 1


@contextmanager
def _hurting(draw: Draw, times: int, chunks: int, number: int = signal.SIGKILL) -> Iterator[list[int]]:
    """Workers get a signal while chunks are computed, and every other time in the moment a result is stored.

    `times`: spread over the number of `chunks`. Yields a list of the times that they got it.
    """
    plain, done, sent, timers = ChunkStore.write, 0, list[int](), list[Timer]()
    apart = max(APART, 4 * chunks // (5 * times))

    def send() -> None:
        sent.append(_sent(draw, number))

    def write(store: ChunkStore, index: int, chunk: int, arrays: Sequence[Mapping[str, Any]]) -> None:
        nonlocal done
        done += 1
        if done % apart == 0 and sum(sent) < times:
            if done // apart % 2:
                send()
            else:
                timers.append(Timer(draw.uniform(0.0, 0.3), send))
                timers[-1].start()
        plain(store, index, chunk, arrays)

    with mock.patch.object(ChunkStore, "write", write):
        yield sent
    for timer in timers:
        timer.cancel()


def killed(times: int, draw: Draw, place: Path, trajectories: int, deaths: int) -> Seen:
    """Studies on `local:2` in each of which so many workers are killed by SIGKILL, with the bits of threads."""
    study, seen, studies = _declared(place, trajectories), Seen(), range(0, times, deaths)
    digest = _digest(study, place / "threads")
    for first in studies:
        out = place / f"workers-{first}"
        with _hurting(draw, min(deaths, times - first), study.chunks) as sent:
            found = _digest(study, out, "local:2")
        half, left = len(half_written(out)), len(temporary(out))
        seen += Seen(sum(sent), half=half, left=left, compared=1, differ=found != digest)
    if seen.times < times:
        seen.wrong.append(f"only {seen.times} kills: give it more trajectories")
    seen.notes.append(f"{len(studies)} × {study.runs:,} trajectories in {study.chunks} chunks, {deaths} kills each")
    return seen


def fit_killed(times: int, draw: Draw, place: Path) -> Seen:
    """A fit on `local:2` whose workers are killed by SIGKILL while they evaluate, with the bits of threads."""
    job = long_fit(place)
    ended = run(job.line(place / "threads"))
    assert ended.code == 0, ended.err
    seen, out, before = Seen(), place / "workers", set[Any]()
    steps = len(job.finished(place / "threads"))
    with running(job.line(out, "--cluster", "local:2")) as (caller, end):
        for step in np.sort(draw.choice(np.arange(1, steps - 1), times, replace=False)):
            while caller.poll() is None and (
                len(job.finished(out)) < step or not _sent(draw, signal.SIGKILL, caller.pid)
            ):
                time.sleep(0.02)
            seen.times += caller.poll() is None
            before = seen.look(job, out, before)
        ended = end()
    seen.compare(job, out, job.digest(place / "threads"), ended)
    if seen.times < times:
        seen.wrong.append(f"only {seen.times} kills: give it more steps")
    seen.notes.append(f"1,200 vehicles, {steps} steps")
    return seen


def hangs(times: int, draw: Draw, place: Path, trajectories: int, silent_s: float = executors.SILENT_S) -> Seen:
    """A worker of `local:2` that hangs (SIGSTOP) for ever is ended, and its part runs elsewhere."""
    study, seen = _declared(place, trajectories), Seen()
    digest = _digest(study, place / "threads")
    for k in range(times):
        with (
            mock.patch.object(executors, "SILENT_S", silent_s),
            _hurting(draw, 1, study.chunks, signal.SIGSTOP) as sent,
        ):
            began = time.monotonic()
            found = _digest(study, place / f"workers-{k}", "local:2")
        seen += Seen(sum(sent), compared=1, differ=found != digest)
        seen.notes.append(f"the study took {time.monotonic() - began:.0f} s")
    seen.wrong += [f"worker {pid} is left" for pid in workers()]
    return seen


@contextmanager
def _dask(*words: str, before: Sequence[str] = ()) -> Iterator[subprocess.Popen[bytes]]:
    """A process of Dask, which is killed with the block, its workers too; `before`: words before its command."""
    import psutil

    line = [*before, sys.executable, "-m", "dask", *words]
    process = subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        yield process
    finally:
        family = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
        for one in (process, *family):
            one.kill()
        process.wait()


@contextmanager
def dask_scheduler(place: Path, host: str = "127.0.0.1") -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A scheduler: its address and its process."""
    file = place / "scheduler.json"
    file.unlink(missing_ok=True)
    words = ("--host", host, "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    with _dask("scheduler", *words) as scheduler:
        while not file.exists():
            assert scheduler.poll() is None
            time.sleep(0.05)
        yield json.loads(file.read_text("utf-8"))["address"], scheduler


def dask_workers(address: str, count: int, *before: str) -> AbstractContextManager[subprocess.Popen[bytes]]:
    """The process of so many workers of a scheduler; `before`: words before its command."""
    return _dask("worker", address, "--nthreads", "1", "--nworkers", str(count), "--no-dashboard", before=before)


@contextmanager
def dask_cluster(place: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """A scheduler with two workers: its address and its process."""
    with dask_scheduler(place) as (address, scheduler), dask_workers(address, 2):
        yield address, scheduler


def scheduler_killed(times: int, draw: Draw, place: Path) -> Seen:
    """The scheduler is killed while a study runs on it: a refusal, and the same command goes on with another one."""
    (job, digest), seen = reference(place, "study"), Seen()
    for k in range(times):
        out = place / f"scheduler-{k}"
        with dask_cluster(place) as (address, scheduler):

            def moment(process: subprocess.Popen[bytes], out: Path = out, scheduler: Any = scheduler) -> None:
                begun(job, out, int(draw.integers(1, 8)))(process)
                scheduler.kill()
                process.wait(120)

            ended = hurt(job.line(out, "--cluster", address), moment)
            seen.times += 1
            seen.refused(ended, place, 2, "the scheduler was lost")
        before = seen.look(job, out, set())
        with dask_cluster(place) as (address, _):
            ended = run(job.line(out, "--cluster", address))
        seen.look(job, out, before)
        seen.compare(job, out, digest, ended)
    return seen
