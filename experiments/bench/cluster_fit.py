"""A fit whose rows are held by worker processes, beside threads: `python -m experiments.bench.cluster_fit`.

`trackwright tune` of position fixes runs on threads, on `local:1`, on `local:2`, and on `local:2` with a worker killed
by SIGKILL at the first step; the four tuned.toml are compared to the byte. Memory is what the calling process itself
holds (RssAnon: without the files that it looks at), at its peak, for two sizes of the recordings. The bytes of an
evaluation are those of the pickled calls and results, and of chunks that moved from worker to worker meanwhile.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import pickle
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from experiments.bench.timing import write_json
from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags

TAGS, ROWS = 64, 250
FIT = ("--tracker", "fix-kf", "--tune", "motion.sigma_a", "sensors.*.sigma*", "--no-report", "--no-figures")
EVALUATIONS = 10


def main(*, recordings: int = 32, steps: int = 8, out: Path = Path("out/bench-cluster-fit.json")) -> int:
    """Fit recordings of 64 tags and 250 rows each, print a table and write it as JSON; 1 if the bits differ.

    Args:
        recordings: their number; memory is measured at a quarter of it, too.
        steps: of the optimiser.
        out: the JSON file to write.
    """
    set_flags()
    from experiments.bench.__main__ import machine
    from experiments.bench.measure import packages
    from experiments.bench.waiting import commit
    from experiments.cli.subprocesses import REPOSITORY

    began, host = datetime.now(UTC), machine()
    with tempfile.TemporaryDirectory() as place:
        paths = written(Path(place), recordings)
        fits = fitted(Path(place), paths, steps)
        travels = travelling(paths, Path(place) / "travel")
    results = {
        "date": began.isoformat(timespec="seconds"),
        "command": ["python", "-m", "experiments.bench.cluster_fit", *sys.argv[1:]],
        "commit": commit(REPOSITORY),
        "machine": host,
        "packages": packages("distributed"),
        "recordings": recordings,
        "rows": recordings * TAGS * ROWS,
        "fits": fits,
        "evaluation": travels,
    }
    write_json(out, results)
    for name, one in fits.items():
        print(
            f"{name:28s} {one['wall_s']:6.1f} s  processor {one['cpu_s']:6.1f} s  caller's own memory "
            f"{one['quarter_mb']:.0f} MB at a quarter, {one['memory_mb']:.0f} MB  sha256 {one['sha256'][:12]}"
        )
    print(
        f"an evaluation of {travels['chunks']} chunks ({travels['chunk_bytes']} bytes in all): {travels['sent']} bytes "
        f"out, {travels['received']} back, {travels['moved']} between workers"
    )
    print(f"Written: {out}")
    return int(len({one["sha256"] for one in fits.values()}) > 1)


def written(place: Path, count: int) -> list[Path]:
    """The folders of so many simulated recordings."""
    from sim import worlds
    from trackers.recordings.folder import write_recording

    paths = []
    for k in range(count):
        path = place / f"hall-{k}"
        folder = worlds.agv(n=TAGS, seed=k, rows=ROWS).folder()
        rig = dataclasses.replace(folder.rig, name=path.name)
        write_recording(dataclasses.replace(folder, name=path.name, rig=rig), path)
        paths.append(path)
    return paths


def fitted(place: Path, paths: Sequence[Path], steps: int) -> dict[str, dict[str, Any]]:
    """Times, memory and digest of the fit in each place; memory of a short fit to a quarter of the recordings, too."""
    found = {}
    kinds: dict[str, tuple[tuple[str, ...], bool]] = {
        "threads": ((), False),
        "local:1": (("--cluster", "local:1"), False),
        "local:2": (("--cluster", "local:2"), False),
        "local:2, one worker killed": (("--cluster", "local:2"), True),
    }
    for name, (on, kill) in kinds.items():
        fit = (*FIT, "--optimiser", "adam", "--starts", 1, "--steps")
        quarter = one_fit(place / f"{name} quarter", (*paths[: len(paths) // 4], *fit, 1, *on))
        whole = one_fit(place / name, (*paths, *fit, steps, *on), kill)
        found[name] = {**whole, "quarter_mb": quarter["memory_mb"]}
    return found


def one_fit(out: Path, words: Sequence[Any], kill: bool = False) -> dict[str, Any]:
    """Seconds, processor seconds, peak memory of the caller and digest of one `tune`."""
    command = [sys.executable, "-m", "experiments", "tune", *map(str, words), "--out", str(out)]
    before, began, peak = os.times(), time.perf_counter(), 0
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while running.poll() is None:
        peak = max(peak, _anonymous(running.pid))
        if kill and (out / "checkpoint.npz").exists():
            os.kill(_worker(running.pid), signal.SIGKILL)
            kill = False
        time.sleep(0.02)
    if running.returncode or kill:
        raise RuntimeError(f"{' '.join(command)}: exit code {running.returncode}, or no worker was killed in time")
    after = os.times()
    return {
        "wall_s": time.perf_counter() - began,
        "cpu_s": after.children_user + after.children_system - before.children_user - before.children_system,
        "memory_mb": peak / 1e6,
        "sha256": hashlib.sha256((out / "tuned.toml").read_bytes()).hexdigest(),
    }


def _anonymous(pid: int) -> int:
    """Bytes of memory of a process that are no pages of files; 0 once it has ended."""
    try:
        found = re.search(r"RssAnon:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text("utf-8"))
    except OSError:
        return 0
    return 0 if found is None else 1024 * int(found[1])


def _worker(pid: int) -> int:
    """The process id of one of a command's local workers."""
    import psutil

    children = psutil.Process(pid).children(recursive=True)
    return next(child.pid for child in children if "spawn_main" in " ".join(child.cmdline()))


class Counting:
    """Dask's client, with the bytes of what it sends and gets back."""

    def __init__(self, client: Any) -> None:
        self.client, self.sent, self.received = client, 0, 0

    def submit(self, function: Any, expected: Any, call: bytes, *held: Any, **how: Any) -> Any:
        """As Dask's."""
        self.sent += len(pickle.dumps((expected, call)))
        return self.client.submit(function, expected, call, *held, **how)

    def gather(self, futures: list[Any]) -> list[Any]:
        """As Dask's."""
        found: list[Any] = self.client.gather(futures)
        self.received += len(pickle.dumps(found))
        return found


def travelling(paths: Sequence[Path], folder: Path) -> dict[str, int]:
    """The bytes that travel per evaluation on two workers, and those of the chunks, which do not."""
    from experiments.executors import cluster_client
    from experiments.held_parts import FitWorkers, HeldParts
    from trackers.catalogue import build
    from trackers.recordings.folder import read_recordings
    from tuning.data import fit_data
    from tuning.parameters import flatten, select_parameters
    from tuning.problem import Problem

    folder.mkdir()
    folders = read_recordings(paths)
    named = build("fix-kf", folders)
    data = fit_data(named.only_batch(folders), "state-nll")
    parameters = select_parameters(data.tracker, [word for word in FIT if "sigma" in word])
    with cluster_client("local:2") as (client, expected):
        counting = Counting(client)
        workers = FitWorkers(counting, expected, folder)
        problem = Problem(
            data.tracker, data.batches(), data.objective, parameters,
            place=lambda point, pieces: HeldParts(workers, named, point, pieces),
        )  # fmt: skip
        problem.evaluate(flatten(parameters))
        moved, counting.sent, counting.received = _moved(client), 0, 0
        for _ in range(EVALUATIONS):
            problem.evaluate(flatten(parameters))
        return {
            "chunks": len(problem.parts.rows),
            "chunk_bytes": sum(path.stat().st_size for path in folder.glob("*.npz")),
            "sent": counting.sent // EVALUATIONS,
            "received": counting.received // EVALUATIONS,
            "moved": (_moved(client) - moved) // EVALUATIONS,
        }


def _moved(client: Any) -> int:
    """Bytes that the workers have had from each other."""
    return sum(client.run(lambda dask_worker: sum(one["total"] for one in dask_worker.transfer_incoming_log)).values())


if __name__ == "__main__":
    run_alone(main, "python -m experiments.bench.cluster_fit")
