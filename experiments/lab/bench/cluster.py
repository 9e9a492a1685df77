"""What workers cost: a study and a fit on worker processes beside threads, with a worker killed on the way."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import signal
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from trackwright.experiments.cli.console import FoldersInTurn
from trackwright.experiments.cli.options import ReadingOptions
from trackwright.experiments.cli.tuning_job import data_in_turn
from trackwright.experiments.jobs.executors import cluster_client, cluster_executor
from trackwright.experiments.jobs.held_parts import FitWorkers, HeldParts
from trackwright.experiments.jobs.run import finished
from trackwright.experiments.lab.bench.cluster_scale import declared, tcp_bytes
from trackwright.experiments.lab.bench.timing import clocked, last_line, timed_command
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, shown
from trackwright.experiments.lab.subprocesses import REPOSITORY
from trackwright.experiments.monte_carlo import Study, run_study
from trackwright.experiments.pages.reports.study_text import to_json
from trackwright.sim import worlds
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.recordings.folder import write_recording
from trackwright.tuning.parameters import flatten, select_parameters
from trackwright.tuning.problem import Problem

WORKERS, PARTS = 2, 200
PLACES = {
    "threads": ((), False),
    "`local:1`": (("local:1",), False),
    "`local:2`": (("local:2",), False),
    "`local:2`, one worker killed": (("local:2",), True),
}
"""The cluster of each run, and whether a worker is killed by SIGKILL on the way."""


def cluster(*, output: Output = DEFAULTS) -> int:
    """A study on threads, on one and two worker processes, and on two of which one is killed; 1 if the bits differ.

    Trajectories a second are counted from the moment when a quarter of the chunks is stored, since each worker begins
    by importing and compiling. The overhead of a chunk is that of a part which computes nothing and returns the content
    of a chunk: a worker's time per part while others wait, and the round trip of a single one.
    """
    with tempfile.TemporaryDirectory() as name:
        folder, study = Path(name), declared(Path(name), 20_000 if output.small else 100_000)
        rows = shown({"": where, **of_a_study(study, folder / where, *how)} for where, how in PLACES.items())
        content = max((folder / "threads" / "chunks").glob("*.npz"), key=lambda path: path.stat().st_size).read_bytes()
    with cluster_executor(f"local:{WORKERS}") as executor:
        trips = [clocked(lambda: executor.submit(returned, content).result())[0][0] for _ in range(PARTS)]
        parts = finished(lambda _: executor.submit(returned, content), range(PARTS))
        (wall, caller), _ = clocked(lambda: deque(parts, maxlen=0))
    chunk = {"chunk kB": len(content) / 1e3, "caller, processor ms": 1e3 * caller / PARTS,
             "a worker, ms": 1e3 * wall * WORKERS / PARTS, "round trip ms": 1e3 * float(np.median(trips))}  # fmt: skip
    studied = f"a study of {study.runs:,} trajectories in {study.chunks * len(study.conditions)} chunks"
    output.publish("bench cluster", Table(rows, studied), Table([chunk], "a chunk, beside computing"))
    return int(len({row["SHA-256"] for row in rows}) > 1)


def returned(content: bytes) -> bytes:
    """The content of a chunk: the part that computes nothing."""
    return content


def of_a_study(study: Study, out: Path, place: Sequence[str], kill: bool) -> Row:
    """Times and digest of one run of the study; `kill`: a worker is killed once a tenth of the chunks is done.

    Times are those until the last chunk is stored; processor time is that of this process and of the workers.
    """
    chunks = len(study.conditions) * study.chunks
    killed: list[int] = []
    stored: list[float] = []

    def advance(count: int, now: str = "") -> None:
        stored.extend([time.perf_counter()] * count)
        if kill and not killed and len(stored) >= chunks // 10:
            killed.append(workers_of(os.getpid())[0])
            os.kill(killed[0], signal.SIGKILL)

    before, began = os.times(), time.perf_counter()
    with cluster_executor(*place) if place else nullcontext() as executor:
        started = time.perf_counter()
        results = run_study(study, out, advance=advance, executor=executor)
    assert results is not None
    used = np.subtract(os.times()[:4], before[:4])
    return {
        "trajectories a second": study.runs * (1 - chunks // 4 / chunks) / (stored[-1] - stored[chunks // 4 - 1]),
        "start s": started - began,
        "run s": stored[-1] - started,
        "processor s": float(used.sum()),
        "SHA-256": json.loads(to_json(results, []))["sha256"][:12],
    }


def workers_of(pid: int) -> list[int]:
    """The process ids of a process's local workers."""
    try:
        children = psutil.Process(pid).children(recursive=True)
        return [child.pid for child in children if "spawn_main" in " ".join(child.cmdline())]
    except psutil.Error:
        return []


TUNE, STEPS = ("motion.sigma_a", "sensors.*.sigma*"), 8
FIT = ("--tracker", "fix-kf", "--optimiser", "adam", "--starts", "1", "--no-report", "--no-figures",
       "--tune", *TUNE, "--steps", str(STEPS))  # fmt: skip
"""Forced: so few steps may end before the optimum."""

EVALUATIONS = 10


def cluster_fit(*, output: Output = DEFAULTS) -> int:
    """A fit whose rows are held by worker processes, beside threads, with a worker killed in mid-fit.

    `trackwright tune` of simulated position fixes; tuned.toml and trace.csv are compared to the byte. Memory is what a
    process itself holds (RssAnon: without the files that it looks at), at its peak, of fits to a quarter of the
    recordings and to all; that of the caller also until the last step, after which it tracks some recordings for the
    table before and after. The bytes of an evaluation are those over the workers' connections, by the kernel's own
    count. 1 if the bits differ.
    """
    recordings, tags, rows = (4, 4, 50) if output.small else (32, 128, 500)
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        paths = [place / f"hall-{k}" for k in range(recordings)]
        for k, path in enumerate(paths):
            folder = worlds.agv(n=tags, seed=k, rows=rows).folder()
            rig = dataclasses.replace(folder.rig, name=path.name)
            write_recording(dataclasses.replace(folder, name=path.name, rig=rig), path)
        fits = shown({"": where, **of_a_fit(place, paths, *how)} for where, how in PLACES.items())
        travels = travelling(paths, place / "travel")
    count = recordings * tags
    size = f"a fit of {count:,} trajectories, {count * rows / 1e6:.2f} million rows, {STEPS} steps"
    evaluation = f"an evaluation at one vector (median of {EVALUATIONS}; Dask may move a chunk besides)"
    output.publish("bench cluster-fit", Table(fits, size), Table([travels], evaluation))
    return int(len({row["SHA-256"] for row in fits}) > 1)


def of_a_fit(place: Path, paths: Sequence[Path], on: Sequence[str], kill: bool) -> Row:
    """Seconds, processor seconds and digest of a fit to all recordings, and the memory of one to a quarter of them."""
    words = (*FIT, *(("--cluster", *on) if on else ()))
    quarter, whole = (
        tuned((*map(str, some), *words), place, kill and some is paths) for some in (paths[: len(paths) // 4], paths)
    )
    memory = {
        f"{title} MB, {part}": usage[of]
        for title, of in (("caller fitting", "fitting"), ("caller", "caller"), ("worker", "worker"))
        for part, usage in (("¼", quarter), ("all", whole))
    }
    return {"wall s": whole["wall_s"], "processor s": whole["cpu_s"], **memory, "SHA-256": whole["sha256"][:12]}


def tuned(words: Sequence[str], place: Path, kill: bool) -> Row:
    """Times and digest of one `tune`, and the most memory, MB, of the command and of one of its workers.

    `fitting`: until the last step. `kill`: a worker once there is the checkpoint, which every step writes.
    """
    with tempfile.TemporaryDirectory(dir=place) as out:
        checkpoint, log = Path(out) / "checkpoint.npz", Path(out) / "log.txt"
        peak = dict.fromkeys(("fitting", "caller", "worker"), 0.0)
        step, killed = 0, not kill

        def watch(pid: int) -> None:
            nonlocal step, killed
            workers = workers_of(pid)
            last, step = step, checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
            if step != last:
                peak["fitting"] = peak["caller"]
            peak["caller"] = max(peak["caller"], anonymous(pid))
            peak["worker"] = max([peak["worker"], *map(anonymous, workers)])
            if not killed and step and workers:
                os.kill(workers[0], signal.SIGKILL)
                killed = True

        run = timed_command(
            ["-m", "trackwright.experiments", "tune", *words, "--out", out], REPOSITORY, log, watch=watch
        )
        if run["code"]:
            raise UnusableInput(f"bench: tune: exit code {run['code']}: {last_line(log)}")
        if not killed:
            raise UnusableInput("bench: tune: the fit was over before a worker was killed; expected more steps")
        content = b"\0".join((Path(out) / name).read_bytes() for name in ("tuned.toml", "trace.csv"))
    return {**run, **peak, "sha256": hashlib.sha256(content).hexdigest()}


def anonymous(pid: int) -> float:
    """Megabytes of memory of a process that are no pages of files (RssAnon); 0 once it has ended."""
    try:
        used: Any = psutil.Process(pid).memory_info()
    except psutil.Error:
        return 0.0
    return (used.rss - used.shared) / 1e6


def travelling(paths: Sequence[Path], folder: Path) -> Row:
    """The bytes to and from all workers per evaluation, and those of the chunks, which stay there."""
    folder.mkdir()
    folders = FoldersInTurn(paths, ReadingOptions())
    named = build("fix-kf", folders[0])
    data = data_in_turn(named, folders, len(paths), folder, "state-nll", 8000, 2, "recordings")
    parameters = select_parameters(data.tracker, TUNE)
    with cluster_client(f"local:{WORKERS}") as (client, expected):
        held = FitWorkers(client, expected, folder)
        problem = Problem(
            data.tracker, data.batches(), data.objective, parameters,
            keep=lambda point, pieces: HeldParts(held, named, point, pieces),
        )  # fmt: skip
        vector = flatten(parameters)
        problem.evaluate(vector)
        counts = [client.run(tcp_bytes)]
        for _ in range(EVALUATIONS):
            problem.evaluate(vector)
            counts.append(client.run(tcp_bytes))
        totals = [[sum(of_worker[k] for of_worker in count.values()) for k in (1, 0)] for count in counts]
        # The median, since Dask moves a chunk between workers now and then.
        sent, received = (int(np.median(np.diff(running))) for running in zip(*totals, strict=True))
        stored = sum(path.stat().st_size for path in folder.glob("*.npz"))
        return {"workers": WORKERS, "chunks": len(problem.parts.rows), "chunks MB": stored / 1e6,
                "sent kB": sent / 1e3, "received kB": received / 1e3}  # fmt: skip
