"""Workers of a cluster that die or hang while a command runs, and a scheduler that dies."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from tests.faults.jobs import Job, begun, hurt, long_fit, long_study, reference, reference_of, run, running
from tests.faults.seen import Seen
from trackwright.experiments.jobs import executors

Draw = np.random.Generator

IMPATIENT = """
import runpy
from trackwright.experiments.jobs import executors
executors.SILENT_S = {}
runpy.run_module("{}", run_name="__main__")
"""
"""A command that takes a worker for hanging after other seconds."""


def workers(caller: int | None = None) -> list[int]:
    """The process ids of the local workers of a process, by default this one."""
    import psutil

    found = []
    for child in psutil.Process(caller).children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # one that has just been killed
            found += [child.pid] * ("spawn_main" in " ".join(child.cmdline()))
    return found


def _sent(draw: Draw, number: int, caller: int) -> bool:
    """Sends a signal to any worker of a process; whether one got it."""
    with suppress(Exception):  # of psutil: the caller has ended
        found = workers(caller)
        os.kill(found[draw.integers(len(found))], number)
        return True
    return False


def killed(times: int, draw: Draw, place: Path, trajectories: int, deaths: int) -> Seen:
    """Studies on `local:2`, in each of which so many workers are killed by SIGKILL."""
    job, digest, chunks = reference_of(long_study(place, trajectories), place)
    seen, studies = Seen(), range(0, times, deaths)
    for first in studies:
        out = place / f"workers-{first}"
        seen += _killed(job, digest, chunks, min(deaths, times - first), draw, out)
    seen.notes.append(f"{len(studies)} × {trajectories:,} trajectories in {chunks} chunks, {deaths} kills each")
    return seen


def fit_killed(times: int, draw: Draw, place: Path) -> Seen:
    """A fit on `local:2` whose workers are killed by SIGKILL while they evaluate."""
    job, digest, steps = reference_of(long_fit(place), place)
    seen = _killed(job, digest, steps, times, draw, place / "workers")
    seen.notes.append(f"1,200 vehicles, {steps} steps")
    return seen


def _killed(job: Job, digest: str, parts: int, times: int, draw: Draw, out: Path) -> Seen:
    """A command on `local:2`, so many workers of which are killed while it computes its parts."""
    seen, before = Seen(), set[Any]()
    with running(job.line(out, "--cluster", "local:2")) as (caller, end):
        for part in np.sort(draw.choice(np.arange(1, parts - 1), times, replace=False)):
            begun(job, out, part)(caller)
            while caller.poll() is None and not _sent(draw, signal.SIGKILL, caller.pid):
                time.sleep(0.02)
            seen.times += caller.poll() is None
            before = seen.look(job, out, before)
        ended = end()
    seen.compare(job, out, digest, ended)
    if seen.times < times:
        seen.wrong.append(f"only {seen.times} kills: give it more parts")
    return seen


def hangs(times: int, draw: Draw, place: Path, trajectories: int, silent_s: float = executors.SILENT_S) -> Seen:
    """A worker of `local:2` that hangs (SIGSTOP) for ever is ended, and its part runs elsewhere."""
    job, digest, _ = reference_of(long_study(place, trajectories), place)
    seen = Seen()
    for k in range(times):
        out, began = place / f"workers-{k}", time.monotonic()
        _, _, module, *words = job.line(out, "--cluster", "local:2")
        with running([sys.executable, "-c", IMPATIENT.format(silent_s, module), *words]) as (caller, end):
            begun(job, out, 2)(caller)
            seen.times += _sent(draw, signal.SIGSTOP, caller.pid)
            seen.compare(job, out, digest, end())
        seen.notes.append(f"the study took {time.monotonic() - began:.0f} s")
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
