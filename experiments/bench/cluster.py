"""A study on worker processes beside threads, one worker killed: `python -m experiments.bench.cluster`.

The chunks of a study of position fixes run on threads of this process, on `local:2`, and on `local:2` with a worker
killed by SIGKILL on the way; the three results are compared to the bit. The overhead of a chunk is that of a part which
computes nothing and returns the arrays of a chunk: a worker's time per part while others wait, and the round trip of a
single one.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import time
from collections import deque
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from experiments.bench.timing import clocked, write_json
from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags

DECLARATION = """
name = "cluster"
about = "What do worker processes cost?"
metrics = ["rmse_m", "nees_mean"]
[worlds.line]
situation = "constant"
[trackers.fix-kf]
"""
WORKERS = 2
PARTS = 200


def main(*, runs: int = 20_000, out: Path = Path("out/bench-cluster.json")) -> int:
    """Run the study three times, print a table and write the results as JSON; 1 if the bits differ.

    Args:
        runs: trajectories of the study.
        out: the JSON file to write.
    """
    set_flags()
    from experiments.bench.__main__ import machine
    from experiments.bench.measure import packages
    from experiments.bench.waiting import commit
    from experiments.cli.subprocesses import REPOSITORY

    began, host = datetime.now(UTC), machine()
    with tempfile.TemporaryDirectory() as folder:
        found = measured(Path(folder), runs)
    write_json(
        out,
        {
            "date": began.isoformat(timespec="seconds"),
            "command": ["python", "-m", "experiments.bench.cluster", *sys.argv[1:]],
            "commit": commit(REPOSITORY),
            "machine": host,
            "packages": packages("distributed"),
            "runs": runs,
            **found,
        },
    )
    for name, one in found["studies"].items():
        print(
            f"{name:20s} {one['chunks']} chunks  start {one['start_s']:4.1f} s  run {one['run_s']:6.1f} s  processor "
            f"{one['cpu_s']:6.1f} s  sha256 {one['sha256'][:12]}"
        )
    print(
        f"overhead of a chunk of {found['chunk_bytes']} bytes: {found['overhead_ms']:.1f} ms of a worker, "
        f"{found['overhead_cpu_ms']:.1f} ms of processor time in the caller; round trip {found['round_trip_ms']:.1f} ms"
    )
    print(f"Written: {out}")
    return int(len({one["sha256"] for one in found["studies"].values()}) > 1)


def measured(folder: Path, runs: int) -> dict[str, Any]:
    """Times and digest of the study on threads, on workers, and with one of these killed; and the overhead."""
    from experiments.executors import cluster_executor, finished

    file = folder / "cluster.toml"
    file.write_text(f"runs = {runs}\n{DECLARATION}", "utf-8")
    studies = {"threads": one_study(file, folder / "threads", None)}
    for name, kill in (("local:2", False), ("local:2, one killed", True)):
        studies[name] = one_study(file, folder / name, f"local:{WORKERS}", kill)
    stored = max((folder / "threads" / "chunks").glob("*.npz"), key=lambda path: path.stat().st_size)
    with np.load(stored) as arrays:
        chunk = {name: arrays[name] for name in arrays.files}
    with cluster_executor(f"local:{WORKERS}") as executor:
        trips = [clocked(lambda: executor.submit(returned, chunk).result())[0][0] for _ in range(PARTS)]
        parts = finished(lambda _: executor.submit(returned, chunk), range(PARTS))
        (wall, caller), _ = clocked(lambda: deque(parts, maxlen=0))
    return {
        "studies": studies,
        "chunk_bytes": sum(x.nbytes for x in chunk.values()),
        "overhead_ms": 1e3 * wall * WORKERS / PARTS,
        "overhead_cpu_ms": 1e3 * caller / PARTS,
        "round_trip_ms": 1e3 * float(np.median(trips)),
    }


def returned(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays: the part that computes nothing."""
    return arrays


def one_study(file: Path, out: Path, cluster: str | None, kill: bool = False) -> dict[str, Any]:
    """Times and digest of one run of the study; `kill`: a worker is killed once a tenth of the chunks is done.

    Times are those until the last chunk is stored; processor time is that of this process and of the workers.
    """
    from experiments.executors import cluster_executor
    from experiments.monte_carlo import load_study, run_study
    from experiments.reports.study_text import to_json

    study = load_study(str(file))
    chunks, done, stored = len(study.conditions) * study.chunks, 0, 0.0
    killed: list[int] = []

    def advance(count: int, now: str = "") -> None:
        nonlocal done, stored
        done, stored = done + count, time.perf_counter()
        if kill and not killed and done >= chunks // 10:
            killed.append(_worker_of_this_process())
            os.kill(killed[0], signal.SIGKILL)

    own, began = os.times(), time.perf_counter()
    with cluster_executor(cluster) if cluster else nullcontext() as executor:
        started = time.perf_counter()
        results = run_study(study, out, advance=advance, executor=executor)
    assert results is not None
    used = np.subtract(os.times()[:4], own[:4])
    return {
        "chunks": chunks,
        "start_s": started - began,
        "run_s": stored - started,
        "cpu_s": float(used.sum()),
        "killed": len(killed),
        "sha256": json.loads(to_json(results, []))["sha256"],
    }


def _worker_of_this_process() -> int:
    """The process id of a local worker."""
    import psutil

    children = psutil.Process().children(recursive=True)
    return next(child.pid for child in children if "spawn_main" in " ".join(child.cmdline()))


if __name__ == "__main__":
    run_alone(main, "python -m experiments.bench.cluster")
