"""A scheduler with a thousand workers and parts that compute nothing, and what a large study takes by its rates."""

from __future__ import annotations

import json
import math
import os
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import distributed
import numpy as np
import psutil

from trackwright.experiments.jobs.executors import cluster_executor
from trackwright.experiments.jobs.run import finished
from trackwright.experiments.lab.bench.timing import clocked
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table
from trackwright.experiments.lab.subprocesses import REPOSITORY
from trackwright.experiments.monte_carlo import Study, load_study
from trackwright.experiments.monte_carlo.chunk_store import ChunkStore
from trackwright.experiments.monte_carlo.runner import packed_chunk
from trackwright.experiments.monte_carlo.sources import PortableStudy


def declared(folder: Path, runs: int) -> Study:
    """A study of position fixes with so many trajectories."""
    file = folder / "cluster.toml"
    file.write_text(
        f'runs = {runs}\nname = "cluster"\nabout = "What do worker processes cost?"\n'
        'metrics = ["rmse_m", "nees_mean"]\n[worlds.line]\nsituation = "constant"\n[trackers.fix-kf]\n',
        "utf-8",
    )
    return load_study(str(file))


PROCESSES, ROUNDS, IDLE_S = 4, 5, 10.0
QUIET = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "1h",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1h",
    "DASK_DISTRIBUTED__ADMIN__TICK__CYCLE": "1h",
}
"""Settings of the workers.

A thousand on a few cores would spend these on looking after themselves, which workers with cores of their own do beside
their work: the profile of each one's thread and its event loop, the record of its memory and processor, and the check
that its loop is alive.
"""

COSTS = {
    "parts_per_s": ("chunks a second", 1),
    "scheduler_ms": ("scheduler, processor ms a chunk", 1),
    "caller_ms": ("caller, processor ms a chunk", 1),
    "caller_sent_bytes": ("caller sends, kB a chunk", 1e-3),
    "caller_received_bytes": ("caller receives, kB a chunk", 1e-3),
    "idle_scheduler_share": ("idle scheduler, % of a core", 100),
    "idle_scheduler_bytes_per_s": ("idle scheduler, kB/s", 1e-3),
    "compute_s": ("computing a chunk and packing it, processor ms", 1e3),
    "store_ms": ("storing a chunk, processor ms", 1),
    "add_ms": ("adding a chunk to the results, processor ms", 1),
}
"""The words and the factor of each number of the table, by its key in the result file, from which plans are made."""

BYTES_SENT = 120
"""Offset of bytes sent and acknowledged in the kernel's struct tcp_info; bytes received follow."""


def cluster_scale(*, output: Output = DEFAULTS) -> int:
    """A scheduler with a thousand workers of Dask's, many in a process, and parts that compute nothing.

    Each part takes the declaration of a study and returns as many bytes as its largest chunks: processor seconds of
    caller and scheduler, and bytes over their connections, by the kernel's own count, with what an idle scheduler
    takes, which is measured, too. Also measured: storing such a chunk, adding it to the results, and computing it.
    """
    workers, parts = ((PROCESSES,), 20) if output.small else ((100, 1000), 2000)
    with tempfile.TemporaryDirectory() as folder:
        study = declared(Path(folder), 1_000_000_000)
        chunk = of_a_chunk(study, Path(folder) / "study")
        portable = PortableStudy.of(study)
        clusters = [of_a_cluster(portable, chunk["chunk_bytes"], n, parts, output.small) for n in workers]
    columns = {f"{cluster['workers']:,} workers": chunk | cluster for cluster in clusters}
    rows = [
        {"": title, **{name: scale * column[key] for name, column in columns.items()}}
        for key, (title, scale) in COSTS.items()
    ]
    output.publish("bench cluster-scale", Table(rows), chunk=chunk, clusters=clusters)
    return 0


def of_a_chunk(study: Study, place: Path) -> Row:
    """Bytes of a chunk, and seconds or ms of processor time to compute and pack it, to store it, and to add it up."""
    # The first one compiles.
    contents = [packed_chunk(study, (0, 0))]
    store, computed, written = ChunkStore(place, study).open(), [], []
    for k in range(ROUNDS):
        (_, write), _ = clocked(partial(store.keep, (0, k), contents[-1]))
        (_, compute), content = clocked(partial(packed_chunk, study, (0, k + 1)))
        computed.append(compute)
        written.append(write)
        contents.append(content)
    of_one, of_all = (
        np.median([clocked(partial(store.results, {0: count * study.chunk}))[0][1] for _ in range(ROUNDS)])
        for count in (1, ROUNDS)
    )
    return {
        "world": "line", "tracker": "fix-kf", "trajectories": study.chunk, "chunk_bytes": max(map(len, contents)),
        "compute_s": float(np.median(computed)), "store_ms": 1e3 * float(np.median(written)),
        "add_ms": 1e3 * float(of_all - of_one) / (ROUNDS - 1),
    }  # fmt: skip


def of_a_cluster(portable: Any, size: int, workers: int, parts: int, small: bool) -> Row:
    """The rate, processor time and bytes of parts of this size on so many workers."""
    with (
        simulated(workers) as (address, scheduler),
        cluster_executor(address) as executor,
        distributed.Client(address, set_as_default=False) as watching,
    ):
        process = psutil.Process(scheduler)

        def taken() -> np.ndarray:
            """Processor seconds and bytes so far: of this process, and of the scheduler."""
            used, there = process.cpu_times(), watching.run_on_scheduler(tcp_bytes)
            return np.array([time.process_time(), *tcp_bytes(), used.user + used.system, *there])

        def run(count: int) -> float:
            began = time.perf_counter()
            each = finished(lambda _: executor.submit(chunk_like, portable, size), range(count), executor.at_once)
            deque(each, maxlen=0)
            return time.perf_counter() - began

        first, before, pause = run(workers), taken(), 1.0 if small else IDLE_S
        time.sleep(pause)
        idle = (taken() - before) / pause
        before = taken()
        seconds = run(parts)
        per_part = (taken() - before) / parts
    return {
        "workers": workers, "parts": parts, "first_parts_s": first, "parts_per_s": parts / seconds,
        "caller_ms": 1e3 * per_part[0], "caller_sent_bytes": per_part[1], "caller_received_bytes": per_part[2],
        "scheduler_ms": 1e3 * per_part[3], "scheduler_sent_bytes": per_part[4], "scheduler_received_bytes": per_part[5],
        "idle_scheduler_share": idle[3], "idle_scheduler_bytes_per_s": idle[4] + idle[5],
    }  # fmt: skip


def chunk_like(portable: Any, size: int) -> bytes:
    """So many bytes: the part that computes nothing."""
    return bytes(size)


@contextmanager
def simulated(workers: int) -> Iterator[tuple[str, int]]:
    """A scheduler with so many workers in a few processes; its address and its process id."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))

        def started(*words: str, **settings: str) -> subprocess.Popen[bytes]:
            command, none = [sys.executable, "-m", *words], subprocess.DEVNULL
            process = subprocess.Popen(command, stdout=none, stderr=none, cwd=REPOSITORY, env=os.environ | settings)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process

        place = folder / "scheduler.json"
        options = ("--no-dashboard", "--port", "0", "--host", "127.0.0.1", "--scheduler-file", str(place))
        scheduler = started("distributed.cli.dask_scheduler", *options)
        while not place.exists():
            time.sleep(0.1)
        address = json.loads(place.read_text("utf-8"))["address"]
        each = {"nthreads": 1, "memory_limit": 0, "dashboard": False, "local_directory": str(folder)}
        for k in range(PROCESSES):
            spec = {
                f"{k}-{n}": {"cls": "distributed.Worker", "opts": each | {"name": f"{k}-{n}"}}
                for n in range(workers // PROCESSES)
            }
            path = folder / f"{k}.json"
            path.write_text(json.dumps(spec), "utf-8")
            started("distributed.cli.dask_spec", address, "--spec-file", str(path), **QUIET)
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(workers // PROCESSES * PROCESSES, timeout=1200)
        yield address, scheduler.pid


def tcp_bytes() -> tuple[int, int]:
    """The bytes sent and received over the open TCP connections of this process."""
    sent = received = 0
    for name in os.listdir("/proc/self/fd"):
        try:
            if not os.readlink(f"/proc/self/fd/{name}").startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(name))) as connection:
                if connection.type != socket.SOCK_STREAM or connection.family not in (socket.AF_INET, socket.AF_INET6):
                    continue
                info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
        except OSError:
            continue
        if len(info) >= BYTES_SENT + 16:
            out, into = struct.unpack_from("QQ", info, BYTES_SENT)
            sent, received = sent + out, received + into
    return sent, received


MEASURED = Path(__file__).parent / "results" / "bench-cluster-scale-2-cores.json"


def plan(rates: Mapping[str, Any], runs: float, workers: int) -> dict[str, float]:
    """What a study takes, in words and numbers; `rates`: of `cluster_scale`.

    Computing, handing out and storing go on at the same time; the results are added up afterwards, by the caller.
    """
    chunks = math.ceil(runs / rates["trajectories"])
    hours = chunks / 3600
    compute, caller = hours * rates["compute_s"], hours * (rates["caller_ms"] + rates["store_ms"]) / 1e3
    scheduler, results = hours * rates["scheduler_ms"] / 1e3, hours * rates["add_ms"] / 1e3
    elapsed = max(compute / workers, caller, scheduler)
    traffic = chunks * (rates["caller_sent_bytes"] + rates["caller_received_bytes"])
    return {
        f"chunks of {rates['trajectories']:,} trajectories": chunks,
        "computing, core-hours": compute,
        "computing on all workers, h": compute / workers,
        "caller: hand out, take in and store, h": caller,
        "scheduler, h": scheduler,
        "workers that these two keep busy": compute / max(caller, scheduler),
        "caller: add up the results, h": results,
        "from start to end, h": elapsed + results,
        "chunk files, GB": chunks * rates["chunk_bytes"] / 1e9,
        "over the caller's network, GB": traffic / 1e9,
        "the same, MB/s": traffic / 1e6 / (3600 * elapsed),
        # The workers may end before the results are added up.
        "paid for, core-hours": elapsed * workers,
    }


def rates_of(measured: Mapping[str, Any], workers: int) -> dict[str, Any]:
    """The rates of a chunk, with those of the measured cluster whose number of workers is nearest in proportion."""
    nearest = min(measured["clusters"], key=lambda cluster: abs(math.log(cluster["workers"] / workers)))
    return {**measured["chunk"], **nearest}


def cluster_plan(
    *,
    runs: float = 1e9,
    workers: tuple[int, ...] = (64, 1000),
    price: float | None = None,
    measured: Path = MEASURED,
    output: Output = DEFAULTS,
) -> int:
    """What a large study takes on a cluster: chunks, hours, bytes, and with a price the cost. Nothing is run.

    All rates are those of a result file of cluster-scale, with the scheduler of the nearest number of workers.

    Args:
        runs: trajectories, of all worlds and points of the grid together.
        workers: of one core each.
        price: of a core-hour, in any currency.
        measured: the result file of cluster-scale.
    """
    results = json.loads(measured.read_text("utf-8"))
    plans = {n: plan(rates_of(results, n), runs, n) for n in workers}
    if price is not None:
        for row in plans.values():
            row[f"cost at {price:g} a core-hour"] = price * row["paid for, core-hours"]
    first, chunk = f"{runs:,.0f} trajectories", results["chunk"]
    rows = [{first: title, **{f"{n:,} workers": row[title] for n, row in plans.items()}} for title in plans[workers[0]]]
    note = f"Rates of {measured.name}: world {chunk['world']}, tracker {chunk['tracker']}."
    output.publish("bench cluster-plan", Table(rows, note=note))
    return 0
