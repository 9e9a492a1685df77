"""A scheduler with a thousand workers and parts that compute nothing: `python -m experiments.lab.bench.cluster_scale`.

The workers are Dask's own, many in a process (`dask spec`), beside a scheduler in a process of its own. Each part takes
the declaration of a study and returns as many bytes as its largest chunks, so that what is measured is the
rate at which caller and scheduler hand out and take in chunks: processor seconds of each, and bytes over their
connections, by the kernel's own count. All of these include what an idle scheduler takes, which is measured, too.
Also measured: storing such a chunk, adding it to the results, and computing it.

A thousand workers on a few cores would spend these on looking after themselves, which workers with cores of their own
do beside their work: the profile of each one's thread and its event loop, the record of its memory and processor, and
the check that its loop is alive are switched off. The scheduler has Dask's settings, and all workers report to it.
"""

from __future__ import annotations

import json
import os
import re
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.cluster_results import head, markdown, publish
from experiments.lab.bench.timing import clocked
from experiments.lab.subprocesses import REPOSITORY

DECLARATION = """
name = "scale"
about = "What does a chunk cost beside its computation?"
runs = 1_000_000_000
metrics = ["rmse_m", "nees_mean"]
[worlds.line]
situation = "constant"
[trackers.fix-kf]
"""
WORLD, TRACKER = "line", "fix-kf"
PROCESSES = 4
QUIET = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__SYSTEM_MONITOR__INTERVAL": "1h",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1h",
    "DASK_DISTRIBUTED__ADMIN__TICK__CYCLE": "1h",
}
"""Settings of the workers."""

ROUNDS = 5
IDLE_S = 10.0
BYTES_SENT = 120
"""Offset of bytes sent and acknowledged in the kernel's struct tcp_info; bytes received follow."""


def main(
    *,
    workers: tuple[int, ...] = (100, 1000),
    parts: int = 2000,
    out: Path = Path("out/bench-cluster-scale.json"),
    page: Path | None = None,
) -> int:
    """Measure, print a table and write the results as JSON.

    Args:
        workers: of a scheduler, with one thread each.
        parts: that are computed by so many workers.
        out: the JSON file to write.
        page: the page whose table is replaced, as docs/cluster.md.
    """
    set_flags()
    from experiments.monte_carlo.portable import PortableStudy
    from experiments.monte_carlo.sources import load_study

    results = head("experiments.lab.bench.cluster_scale", datetime.now(UTC))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scale.toml"
        file.write_text(DECLARATION, "utf-8")
        study = load_study(str(file))
        chunk = of_a_chunk(study, Path(folder) / "study")
        portable = PortableStudy.of(study)
        clusters = [of_a_cluster(portable, chunk["chunk_bytes"], count, parts) for count in workers]
    publish({**results, "chunk": chunk, "clusters": clusters}, markdown(rows(chunk, clusters)), out, page)
    return 0


def rows(chunk: Mapping[str, Any], clusters: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """The table of all clusters, and of what a chunk costs beside."""
    every = [
        ("chunks a second", "parts_per_s", 1, ".0f"),
        ("scheduler, processor ms a chunk", "scheduler_ms", 1, ".2f"),
        ("caller, processor ms a chunk", "caller_ms", 1, ".2f"),
        ("caller sends, kB a chunk", "caller_sent_bytes", 1e-3, ".1f"),
        ("caller receives, kB a chunk", "caller_received_bytes", 1e-3, ".1f"),
        ("idle scheduler, % of a core", "idle_scheduler_share", 100, ".1f"),
        ("idle scheduler, kB/s", "idle_scheduler_bytes_per_s", 1e-3, ".0f"),
    ]
    beside = [
        (f"computing {chunk['trajectories']:,} trajectories and packing them, processor ms", "compute_s", 1e3, ".0f"),
        ("storing a chunk, processor ms", "store_ms", 1, ".2f"),
        ("adding a chunk to the results, processor ms", "add_ms", 1, ".2f"),
    ]
    return [
        ["", *(f"{one['workers']:,} workers" for one in clusters)],
        *([name, *(format(scale * one[key], how) for one in clusters)] for name, key, scale, how in every),
        *([name, *[format(scale * chunk[key], how)] * len(clusters)] for name, key, scale, how in beside),
    ]


def of_a_chunk(study: Any, place: Path) -> dict[str, Any]:
    """Bytes of a chunk, and seconds or ms of processor time to compute and pack it, to store it, and to add it up."""
    from experiments.monte_carlo.chunk_store import ChunkStore
    from experiments.monte_carlo.portable import packed_chunk

    # The first one compiles.
    contents = [packed_chunk(study, study.conditions[0], 0)]
    store, computed, written = ChunkStore(place, study).open(), [], []
    for k in range(ROUNDS):
        (_, write), _ = clocked(partial(store.write, 0, k, contents[-1]))
        (_, compute), content = clocked(partial(packed_chunk, study, study.conditions[0], k + 1))
        computed.append(compute)
        written.append(write)
        contents.append(content)
    one, every = (
        np.median([clocked(partial(store.results, {0: count * study.chunk}))[0][1] for _ in range(ROUNDS)])
        for count in (1, ROUNDS)
    )
    return {
        "world": WORLD,
        "tracker": TRACKER,
        "trajectories": study.chunk,
        "chunk_bytes": max(map(len, contents)),
        "compute_s": float(np.median(computed)),
        "store_ms": 1e3 * float(np.median(written)),
        "add_ms": 1e3 * float(every - one) / (ROUNDS - 1),
    }


def of_a_cluster(portable: Any, size: int, workers: int, parts: int) -> dict[str, Any]:
    """The rate, processor time and bytes of parts of this size on so many workers."""
    import distributed
    import psutil

    from experiments.jobs.executors import cluster_executor, finished

    # What workers import by name: this file may run as __main__.
    from experiments.lab.bench.cluster_scale import chunk_like, tcp_bytes

    with (
        simulated(workers) as (address, scheduler),
        cluster_executor(address) as executor,
        distributed.Client(address, set_as_default=False) as watching,
    ):
        process = psutil.Process(scheduler)

        def taken() -> np.ndarray:
            """Processor seconds and bytes so far: of this process, and of the scheduler."""
            used = process.cpu_times()
            there = watching.run_on_scheduler(tcp_bytes)
            return np.array([time.process_time(), *tcp_bytes(), used.user + used.system, *there])

        def run(count: int) -> float:
            began = time.perf_counter()
            parts = finished(lambda _: executor.submit(chunk_like, portable, size), range(count), executor.at_once)
            deque(parts, maxlen=0)
            return time.perf_counter() - began

        first, before = run(workers), taken()
        time.sleep(IDLE_S)
        idle = (taken() - before) / IDLE_S
        before = taken()
        seconds = run(parts)
        per_part = (taken() - before) / parts
    return {
        "workers": workers,
        "parts": parts,
        "first_parts_s": first,
        "parts_per_s": parts / seconds,
        "caller_ms": 1e3 * per_part[0],
        "scheduler_ms": 1e3 * per_part[3],
        "caller_sent_bytes": per_part[1],
        "caller_received_bytes": per_part[2],
        "scheduler_sent_bytes": per_part[4],
        "scheduler_received_bytes": per_part[5],
        "idle_scheduler_share": idle[3],
        "idle_scheduler_bytes_per_s": idle[4] + idle[5],
    }


def chunk_like(portable: Any, size: int) -> bytes:
    """So many bytes: the part that computes nothing."""
    return bytes(size)


@contextmanager
def simulated(workers: int) -> Iterator[tuple[str, int]]:
    """A scheduler with so many workers in a few processes; its address and its process id."""
    import distributed

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
            kind = os.readlink(f"/proc/self/fd/{name}")
            if not re.match("socket:", kind):
                continue
            with socket.socket(fileno=os.dup(int(name))) as own:
                if own.type != socket.SOCK_STREAM or own.family not in (socket.AF_INET, socket.AF_INET6):
                    continue
                info = own.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256)
        except OSError:
            continue
        if len(info) >= BYTES_SENT + 16:
            out, into = struct.unpack_from("QQ", info, BYTES_SENT)
            sent, received = sent + out, received + into
    return sent, received


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.cluster_scale")
