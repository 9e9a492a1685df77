"""A scheduler with a thousand workers and parts that compute nothing: `python -m experiments.bench.cluster_scale`.

The workers are Dask's own, many in a process (`dask spec`), beside a scheduler in a process of its own. Each part takes
the declaration of a study and returns as many bytes as its largest chunks, so that what is measured is the
rate at which caller and scheduler hand out and take in chunks: processor seconds of each, and bytes over their
connections, by the kernel's own count. Also measured: storing such a chunk, adding it to the results, and computing it.
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
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.bench.timing import clocked, write_json
from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.cli.subprocesses import REPOSITORY

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
ROUNDS = 5
IDLE_S = 10.0
BYTES_SENT = 120
"""Offset of bytes sent and acknowledged in the kernel's struct tcp_info; bytes received follow."""


def main(*, workers: int = 1000, parts: int = 2000, out: Path = Path("out/bench-cluster-scale.json")) -> int:
    """Measure, print a table and write the results as JSON.

    Args:
        workers: of the scheduler, with one thread each.
        parts: that are computed.
        out: the JSON file to write.
    """
    set_flags()
    from experiments.bench.__main__ import machine
    from experiments.bench.measure import packages
    from experiments.bench.waiting import commit

    began, host = datetime.now(UTC), machine()
    with tempfile.TemporaryDirectory() as folder:
        found = measured(Path(folder), workers, parts)
    command = ["python", "-m", "experiments.bench.cluster_scale", *sys.argv[1:]]
    about = {"date": began.isoformat(timespec="seconds"), "command": command, "commit": commit(REPOSITORY)}
    write_json(out, {**about, "machine": host, "packages": packages("distributed"), **found})
    for name, value in found.items():
        print(f"{name:32s} {value if isinstance(value, str) else format(value, '.6g')}")
    print(f"Written: {out}")
    return 0


def measured(folder: Path, workers: int, parts: int) -> dict[str, Any]:
    """Figures of a chunk: its cost in the caller, the scheduler and a worker, and its bytes."""
    import distributed
    import psutil

    # What workers import by name: this file may run as __main__.
    from experiments.bench.cluster_scale import chunk_like, tcp_bytes
    from experiments.executors import cluster_executor, finished
    from experiments.monte_carlo.chunk_store import ChunkStore
    from experiments.monte_carlo.portable import PortableStudy, packed_chunk
    from experiments.monte_carlo.sources import load_study

    file = folder / "scale.toml"
    file.write_text(DECLARATION, "utf-8")
    study = load_study(str(file))
    packed_chunk(study, study.conditions[0], 0)
    costs = []
    store = ChunkStore(folder / "study", study).open()
    for k in range(1, ROUNDS + 1):
        (_, compute), content = clocked(partial(packed_chunk, study, study.conditions[0], k))
        (_, write), _ = clocked(partial(store.write, 0, 0, content))
        (_, add), _ = clocked(partial(store.results, {0: study.chunk}))
        costs.append((compute, write, add))
    compute, write, add = np.median(costs, axis=0)
    portable = PortableStudy.of(study)
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
            deque(finished(lambda _: executor.submit(chunk_like, portable, len(content)), range(count)), maxlen=0)
            return time.perf_counter() - began

        first, before = run(workers), taken()
        time.sleep(IDLE_S)
        idle = (taken() - before) / IDLE_S
        before = taken()
        seconds = run(parts)
        used = taken() - before
    per_part = (used - idle * seconds) / parts
    return {
        "world": WORLD,
        "tracker": TRACKER,
        "workers": workers,
        "parts": parts,
        "trajectories": study.chunk,
        "first_parts_s": first,
        "parts_per_s": parts / seconds,
        "caller_ms": 1e3 * per_part[0],
        "scheduler_ms": 1e3 * per_part[3],
        "chunk_bytes": len(content),
        "caller_sent_bytes": per_part[1],
        "caller_received_bytes": per_part[2],
        "scheduler_sent_bytes": per_part[4],
        "scheduler_received_bytes": per_part[5],
        "idle_scheduler_share": idle[3],
        "idle_scheduler_bytes_per_s": idle[4] + idle[5],
        "compute_s": compute,
        "store_ms": 1e3 * write,
        "add_ms": 1e3 * add,
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

        def started(*words: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-m", *words]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=REPOSITORY)
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
            started("distributed.cli.dask_spec", address, "--spec-file", str(path))
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
    run_alone(main, "python -m experiments.bench.cluster_scale")
