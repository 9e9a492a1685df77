"""A fit whose rows are held by worker processes, beside threads: `python -m experiments.lab.bench.cluster_fit`.

`trackwright tune` of position fixes runs on threads, on `local:1`, on `local:2`, and on `local:2` with a worker killed
by SIGKILL in mid-fit; tuned.toml and trace.csv are compared to the byte. Memory is what a process itself holds
(RssAnon: without the files that it looks at), at its peak, of fits to a quarter of the recordings and to all; that of
the caller also until the last step, after which it tracks some recordings for the table before and after. The bytes of
an evaluation are those over the workers' connections, by the kernel's own count.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.cluster_results import head, markdown, publish

TUNE = ("motion.sigma_a", "sensors.*.sigma*")
SHORT = ("--starts", "1", "--force", "--no-report", "--no-figures")
"""Forced: so few steps may end before the optimum."""
FIT = ("--tracker", "fix-kf", "--optimiser", "adam", *SHORT, "--tune", *TUNE)
EVALUATIONS = 10
KINDS: dict[str, tuple[tuple[str, ...], bool]] = {
    "threads": ((), False),
    "`local:1`": (("--cluster", "local:1"), False),
    "`local:2`": (("--cluster", "local:2"), False),
    "`local:2`, one worker killed": (("--cluster", "local:2"), True),
}
"""Words of each fit, and whether a worker is killed."""


def main(
    *,
    recordings: int = 32,
    tags: int = 128,
    rows: int = 500,
    steps: int = 8,
    out: Path = Path("out/bench-cluster-fit.json"),
    page: Path | None = None,
) -> int:
    """Fit simulated recordings, print a table and write the results as JSON; 1 if the bits differ.

    Args:
        recordings: their number; memory is measured with a quarter of them, too.
        tags: of each recording.
        rows: of each tag.
        steps: of the optimiser.
        out: the JSON file to write.
        page: the page whose table is replaced, as docs/cluster.md.
    """
    set_flags()
    results = head("experiments.lab.bench.cluster_fit", datetime.now(UTC))
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        paths = written(place, recordings, tags, rows)
        few = paths[: len(paths) // 4]
        fits = {kind: fitted(place, paths, few, steps, *how) for kind, how in KINDS.items()}
        travels = travelling(paths, place / "travel")
    size = {"recordings": recordings, "trajectories": recordings * tags, "rows": recordings * tags * rows}
    text = (
        f"A fit of {size['trajectories']:,} trajectories, {size['rows'] / 1e6:.2f} million rows, which take "
        f"{travels['chunk_bytes'] / 1e6:.0f} MB on the workers.\n\n{markdown(table(fits))}\n\nAn evaluation at one "
        f"vector sends {travels['sent'] / 1e3:.0f} kB to the {travels['workers']} workers, and "
        f"{travels['received'] / 1e3:.0f} kB back, for {travels['chunks']} chunks (median of "
        f"{EVALUATIONS}; Dask may move a chunk to another worker besides)."
    )
    publish({**results, **size, "steps": steps, "fits": fits, "evaluation": travels}, text, out, page)
    return int(len({one["sha256"] for one in fits.values()}) > 1)


def table(fits: Mapping[str, Mapping[str, Any]]) -> list[list[str]]:
    """The rows of a table of all fits."""
    first = fits["threads"]["sha256"]
    memory = [f"{of} MB, {part}" for of in ("caller fitting", "caller", "worker") for part in ("¼", "all")]
    return [
        ["", "wall s", "processor s", *memory, "SHA-256"],
        *(
            [
                kind,
                f"{one['wall_s']:.1f}",
                f"{one['cpu_s']:.1f}",
                *(
                    f"{one[where][f'{of}_mb']:.0f}"
                    for of in ("fitting", "caller", "worker")
                    for where in ("quarter", "memory")
                ),
                f"{one['sha256'][:12]}…" if kind == "threads" else "the same" if one["sha256"] == first else "differs",
            ]
            for kind, one in fits.items()
        ),
    ]


def written(place: Path, count: int, tags: int, rows: int) -> list[Path]:
    """The folders of so many simulated recordings."""
    from sim import worlds
    from trackers.recordings.folder import write_recording

    paths = [place / f"hall-{k}" for k in range(count)]
    for k, path in enumerate(paths):
        folder = worlds.agv(n=tags, seed=k, rows=rows).folder()
        rig = dataclasses.replace(folder.rig, name=path.name)
        write_recording(dataclasses.replace(folder, name=path.name, rig=rig), path)
    return paths


def fitted(
    place: Path, paths: Sequence[Path], few: Sequence[Path], steps: int, on: Sequence[str], kill: bool
) -> dict[str, Any]:
    """Seconds, processor seconds, memory and digest of a fit to all recordings, and the memory of one to a few."""
    words = (*FIT, "--steps", str(steps), *on)
    quarter = tuned((*map(str, few), *words), place, False)
    return tuned((*map(str, paths), *words), place, kill) | {"quarter": quarter["memory"]}


def tuned(words: Sequence[str], place: Path, kill: bool) -> dict[str, Any]:
    """The same of one `tune`, without the memory of another."""
    with tempfile.TemporaryDirectory(dir=place) as out:
        command = [sys.executable, "-m", "experiments", "tune", *words, "--out", out]
        before, began = os.times(), time.perf_counter()
        with tempfile.TemporaryFile() as said:
            running = subprocess.Popen(command, stdout=said, stderr=said)
            memory = peaks(running, Path(out) / "checkpoint.npz", kill)
            said.seek(0)
            if running.returncode:
                raise RuntimeError(f"tune: exit code {running.returncode}: {said.read().decode()}")
        after = os.times()
        content = b"\0".join((Path(out) / name).read_bytes() for name in ("tuned.toml", "trace.csv"))
    return {
        "wall_s": time.perf_counter() - began,
        "cpu_s": after.children_user + after.children_system - before.children_user - before.children_system,
        "memory": memory,
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def peaks(running: subprocess.Popen[bytes], checkpoint: Path, kill: bool) -> dict[str, float]:
    """The most memory, MB, that a command holds until the last step and until it ends, and one of its workers.

    `kill`: a worker once there is the checkpoint, which every step writes.
    """
    whole = fitting = worker = step = 0
    while running.poll() is None:
        workers = workers_of(running.pid)
        last, step = step, checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
        if step != last:
            fitting = whole
        whole, worker = max(whole, anonymous(running.pid)), max([worker, *map(anonymous, workers)])
        if kill and step:
            os.kill(workers[0], signal.SIGKILL)
            kill = False
        time.sleep(0.05)
    if kill:
        raise RuntimeError("tune: the fit was over before a worker was killed; expected more steps")
    return {"fitting_mb": fitting / 1e6, "caller_mb": whole / 1e6, "worker_mb": worker / 1e6}


def anonymous(pid: int) -> int:
    """Bytes of memory of a process that are no pages of files; 0 once it has ended."""
    try:
        found = re.search(r"RssAnon:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text("utf-8"))
    except OSError:
        return 0
    return 0 if found is None else 1024 * int(found[1])


def workers_of(pid: int) -> list[int]:
    """The process ids of a command's local workers."""
    import psutil

    try:
        children = psutil.Process(pid).children(recursive=True)
        return [child.pid for child in children if "spawn_main" in " ".join(child.cmdline())]
    except psutil.Error:
        return []


def travelling(paths: Sequence[Path], folder: Path, workers: int = 2) -> dict[str, int]:
    """The bytes to and from all workers per evaluation, and those of the chunks, which stay there."""
    from experiments.cli.console import ReadingOptions
    from experiments.cli.folders_in_turn import FoldersInTurn
    from experiments.cli.tuning_cluster import data_in_turn
    from experiments.jobs.executors import cluster_client
    from experiments.jobs.held_parts import FitWorkers, HeldParts
    from experiments.lab.bench.cluster_scale import tcp_bytes
    from trackers.catalogue import build
    from tuning.parameters import flatten, select_parameters
    from tuning.problem import Problem

    folder.mkdir()
    folders = FoldersInTurn(paths, ReadingOptions())
    named = build("fix-kf", folders[0])
    data = data_in_turn(named, folders, len(paths), folder, "state-nll", 8000, 2, "recordings")
    parameters = select_parameters(data.tracker, TUNE)
    with cluster_client(f"local:{workers}") as (client, expected):
        held = FitWorkers(client, expected, folder)
        problem = Problem(
            data.tracker, data.batches(), data.objective, parameters,
            place=lambda point, pieces: HeldParts(held, named, point, pieces),
        )  # fmt: skip
        vector = flatten(parameters)
        problem.evaluate(vector)
        counts = [client.run(tcp_bytes)]
        for _ in range(EVALUATIONS):
            problem.evaluate(vector)
            counts.append(client.run(tcp_bytes))
        totals = [[sum(one[k] for one in count.values()) for k in (1, 0)] for count in counts]
        # The median, since Dask moves a chunk between workers now and then.
        sent, received = (int(np.median(np.diff(own))) for own in zip(*totals, strict=True))
        return {
            "workers": workers,
            "chunks": len(problem.parts.rows),
            "chunk_bytes": sum(path.stat().st_size for path in folder.glob("*.npz")),
            "sent": sent,
            "received": received,
        }


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.cluster_fit")
