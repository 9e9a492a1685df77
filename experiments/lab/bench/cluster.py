"""A study on worker processes beside threads, one worker killed: `python -m experiments.lab.bench.cluster`.

The chunks of a study of position fixes run on threads of this process, on `local:1`, on `local:2`, and on `local:2`
with a worker killed by SIGKILL on the way; the results are compared to the bit. Trajectories a second are counted from
the moment when a quarter of the chunks is stored, since each worker begins by importing and compiling. The overhead of
a chunk is that of a part which computes nothing and returns the content of a chunk: a worker's time per part while
others wait, and the round trip of a single one.
"""

from __future__ import annotations

import json
import os
import signal
import tempfile
import time
from collections import deque
from collections.abc import Mapping
from contextlib import nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.cluster_results import head, markdown, publish
from experiments.lab.bench.timing import clocked

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


def main(*, runs: int = 100_000, out: Path = Path("out/bench-cluster.json"), page: Path | None = None) -> int:
    """Run the study in each place, print a table and write the results as JSON; 1 if the bits differ.

    Args:
        runs: trajectories of the study.
        out: the JSON file to write.
        page: the page whose table is replaced, as docs/cluster.md.
    """
    set_flags()
    results = head("experiments.lab.bench.cluster", datetime.now(UTC))
    with tempfile.TemporaryDirectory() as folder:
        found = measured(Path(folder), runs)
    publish({**results, "runs": runs, **found}, text(runs, found), out, page)
    return int(len({one["sha256"] for one in found["studies"].values()}) > 1)


def text(runs: int, found: Mapping[str, Any]) -> str:
    """The table of all studies, and the overhead of a chunk in words."""
    return (
        f"A study of {runs:,} trajectories in {found['studies']['threads']['chunks']} chunks.\n\n"
        f"{markdown(table(found['studies']))}\n\nBeside computing, a chunk of {found['chunk_bytes'] / 1e3:.0f} kB "
        f"costs {found['overhead_cpu_ms']:.1f} ms of processor time in the caller, and "
        f"{found['overhead_ms']:.1f} ms of a worker; the round trip of a single one takes "
        f"{found['round_trip_ms']:.1f} ms."
    )


def table(studies: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """The rows of a table of all studies."""
    first = studies["threads"]["sha256"]
    return [
        ["", "trajectories a second", "start s", "run s", "processor s", "SHA-256 of the results"],
        *(
            [
                name,
                f"{one['per_s']:,.0f}",
                f"{one['start_s']:.1f}",
                f"{one['run_s']:.1f}",
                f"{one['cpu_s']:.1f}",
                f"{first[:12]}…" if name == "threads" else "the same" if one["sha256"] == first else "differs",
            ]
            for name, one in studies.items()
        ),
    ]


def measured(folder: Path, runs: int) -> dict[str, Any]:
    """Times and digest of the study on threads, on workers, and with one of these killed; and the overhead."""
    from experiments.jobs.executors import cluster_executor, finished

    file = folder / "cluster.toml"
    file.write_text(f"runs = {runs}\n{DECLARATION}", "utf-8")
    studies = {"threads": one_study(file, folder / "threads", None)}
    for workers, kill in ((1, False), (WORKERS, False), (WORKERS, True)):
        name = f"`local:{workers}`{', one worker killed' * kill}"
        studies[name] = one_study(file, folder / name, f"local:{workers}", kill)
    content = max((folder / "threads" / "chunks").glob("*.npz"), key=lambda path: path.stat().st_size).read_bytes()
    with cluster_executor(f"local:{WORKERS}") as executor:
        trips = [clocked(lambda: executor.submit(returned, content).result())[0][0] for _ in range(PARTS)]
        parts = finished(lambda _: executor.submit(returned, content), range(PARTS))
        (wall, caller), _ = clocked(lambda: deque(parts, maxlen=0))
    return {
        "studies": studies,
        "chunk_bytes": len(content),
        "overhead_ms": 1e3 * wall * WORKERS / PARTS,
        "overhead_cpu_ms": 1e3 * caller / PARTS,
        "round_trip_ms": 1e3 * float(np.median(trips)),
    }


def returned(content: bytes) -> bytes:
    """The content of a chunk: the part that computes nothing."""
    return content


def one_study(file: Path, out: Path, cluster: str | None, kill: bool = False) -> dict[str, Any]:
    """Times and digest of one run of the study; `kill`: a worker is killed once a tenth of the chunks is done.

    Times are those until the last chunk is stored; processor time is that of this process and of the workers.
    """
    from experiments.jobs.executors import cluster_executor
    from experiments.monte_carlo import load_study, run_study
    from experiments.pages.reports.study_text import to_json

    study = load_study(str(file))
    chunks, done = len(study.conditions) * study.chunks, 0
    killed: list[int] = []
    stored: list[float] = []

    def advance(count: int, now: str = "") -> None:
        nonlocal done
        done += count
        stored.extend([time.perf_counter()] * count)
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
        "per_s": study.runs * (1 - chunks // 4 / chunks) / (stored[-1] - stored[chunks // 4 - 1]),
        "start_s": started - began,
        "run_s": stored[-1] - started,
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
    run_alone(main, "python -m experiments.lab.bench.cluster")
