"""Archives of thousands of recordings, tracked and evaluated: `python -m experiments.lab.bench.archives [SIZE …]`.

Each recording is a simulated vehicle for four seconds, fixes with truth: so short that what a recording costs beside
its rows shows. Three in a hundred are broken instead, at random and in many ways, by the generator of the tests
(`tests/faults/recordings.py`). Each command runs in a process of its own: processor time, and memory at its peak. The
percentiles of all rows, which come from histograms, are compared with exact ones.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from experiments.cli.main import run_alone
from experiments.lab.bench.timing import replace_tables, write_json
from experiments.lab.subprocesses import REPOSITORY, in_new_process
from experiments.monte_carlo.accumulators import BIN_WIDTH

SIZES = (100, 1000, 10_000)
ROWS, TOGETHER, TRACKER = 40, 100, "fix-kf"
"""Rows of a recording, recordings of one simulation, and the tracker."""

BROKEN_EVERY, SEED = 33, 29
"""One in so many recordings is broken; the seed of its faults."""

LIMIT_S = 3600.0
COMMANDS: dict[str, tuple[str, ...]] = {
    "track": ("track", "ARCHIVE", "--tracker", TRACKER, "--no-figures", "--no-report", "--out", "OUT"),
    "track again": ("track", "ARCHIVE", "--tracker", TRACKER, "--no-figures", "--no-report", "--out", "OUT"),
    "evaluate": ("evaluate", "OUT"),
}
"""The commands in their order; the second `track` finds everything finished but the broken ones."""


def main(sizes: tuple[str, ...] = (), *, page: Path | None = None, out: Path = Path("out/bench-archives.json")) -> int:
    """Measure the sizes, print a table and write it as JSON.

    Exit code 1 if a command fails, or a percentile deviates by more than a bin.

    Args:
        sizes: numbers of recordings; by default 100, 1000 and 10000.
        page: the page whose table is replaced, as docs/performance.md.
        out: the JSON file to write.
    """
    from experiments.lab.bench.__main__ import machine
    from experiments.lab.bench.waiting import commit

    began, host, before = datetime.now(UTC), machine(), commit(REPOSITORY)
    found = {size: measured(int(size)) for size in sizes or map(str, SIZES)}
    command = ["python", "-m", "experiments.lab.bench.archives", *sys.argv[1:]]
    heading = f"{host['cpu']}, {host['cores']} cores, {began:%Y-%m-%d}, `{' '.join(command)}`."
    text = f"{heading}\n\n{table(found)}"
    print(text)
    if page is not None:
        replace_tables(page, "experiments.lab.bench.archives", text)
    about = {"date": began.isoformat(timespec="seconds"), "command": command, "commit": before}
    write_json(out, {**about, "machine": host, "rows": ROWS, "archives": found})
    print(f"Written: {out}")
    wrong = any(run["code"] > 1 for one in found.values() for run in one["runs"].values())
    return int(wrong or any(one["deviations"]["percentiles"][0] > BIN_WIDTH for one in found.values()))


def measured(size: int) -> dict[str, Any]:
    """The runs of each command on an archive of so many recordings, and what `deviations` returns."""
    with tempfile.TemporaryDirectory(prefix="archives-") as folder:
        # In other processes: the peak of a child that is forked is at least that of this one.
        made = in_new_process("experiments.lab.bench.archives", "write_archive", (str(size), folder), LIMIT_S)
        runs = {name: one_run(words, Path(folder)) for name, words in COMMANDS.items()}
        return (
            made | {"runs": runs} | in_new_process("experiments.lab.bench.archives", "deviations", (folder,), LIMIT_S)
        )


def one_run(words: Sequence[str], folder: Path) -> dict[str, float]:
    """Processor seconds, seconds, peak memory (MB), exit code and printed lines of one command."""
    places = {"ARCHIVE": str(folder / "archive"), "OUT": str(folder / "out")}
    began = time.perf_counter()
    with (folder / "log.txt").open("w+", encoding="utf-8") as log:
        line = [sys.executable, "-m", "experiments", *(places.get(word, word) for word in words)]
        child = subprocess.Popen(line, cwd=REPOSITORY, stdout=log, stderr=log)
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        log.seek(0)
        lines = sum(1 for _ in log)
    return {
        "cpu_s": used.ru_utime + used.ru_stime,
        "wall_s": time.perf_counter() - began,
        "peak_mb": used.ru_maxrss * 1024 / 1e6,
        "code": child.returncode,
        "lines": lines,
    }


def write_archive(size: str, folder: str) -> dict[str, Any]:
    """Writes so many recordings in folders of `TOGETHER` each; how many of them are broken."""
    import polars as pl

    from sim import worlds
    from trackers.core.rig import Rig
    from trackers.recordings.folder import RecordingFolder, write_recording

    # Of the repository, not of the package.
    broken_recording = import_module("tests.faults.recordings").broken_recording
    broken = 0
    for first in range(0, int(size), TOGETHER):
        day = Path(folder) / "archive" / f"day-{first // TOGETHER:03d}"
        tables = worlds.agv(n=TOGETHER, seed=first, rows=ROWS).folder().tables
        by_tag = {name: frame.partition_by("tag", as_dict=True) for name, frame in tables.items()}
        for k in range(first, min(first + TOGETHER, int(size))):
            name = f"run-{k:05d}"
            if k % BROKEN_EVERY == BROKEN_EVERY - 1:
                (day / name).mkdir(parents=True)
                rig = broken_recording(SEED, k, day / name)[0] / "rig.toml"
                if rig.is_file() and not rig.is_symlink():
                    rig.write_bytes(rig.read_bytes().replace(b'"good"', f'"{name}"'.encode()))
                broken += 1
                continue
            day.mkdir(parents=True, exist_ok=True)
            tag = (str(k - first),)
            own = {table: frames[tag].with_columns(tag=pl.lit("agv")) for table, frames in by_tag.items()}
            write_recording(RecordingFolder(name, None, Rig(name), own), day / name)
    return {"recordings": int(size), "broken": broken}


PERCENTILES = ("median", "p90", "p95", "p99", "sigma_factor")
"""Beginnings of the names of the metrics from histograms."""


def deviations(folder: str) -> dict[str, Any]:
    """The largest relative deviations of the metrics of all rows from those of all rows at once, with their names.

    `percentiles`: of those from histograms; `others`.
    """
    from experiments.cli.archives.tables import read_results
    from trackers.evaluation import evaluate
    from trackers.recordings.folder import read_truth
    from trackers.recordings.tracks_table import EVALUATION, read_tracks

    out = Path(folder) / "out"
    recordings = [read_truth(path) for path, refused in read_results(out).items() if not refused]
    exact = evaluate(read_tracks(out), recordings).overall
    found = json.loads((out / EVALUATION).read_bytes())["overall"]
    relative = {name: abs(found[name] / value - 1) for name, value in exact.items() if value}
    largest: dict[str, Any] = {"percentiles": (0.0, ""), "others": (0.0, "")}
    for name, value in relative.items():
        kind = "percentiles" if name.startswith(PERCENTILES) else "others"
        largest[kind] = max(largest[kind], (value, name))
    return {"deviations": largest}


def table(found: Mapping[str, Mapping[str, Any]]) -> str:
    """The Markdown table of all runs, and the largest deviation of each size."""
    lines = [
        "| recordings | broken | command | processor s | ms a recording | peak MB | lines printed |",
        "| ---: | ---: | --- | ---: | ---: | ---: | ---: |",
    ]
    for size, one in found.items():
        for name, run in one["runs"].items():
            each = 1e3 * run["cpu_s"] / int(size)
            figures = f"{run['cpu_s']:.1f} | {each:.1f} | {run['peak_mb']:.0f} | {run['lines']}"
            lines.append(f"| {size} | {one['broken']} | `{name}` | {figures} |")
    largest = [f"{100 * one['deviations']['percentiles'][0]:.2f} % of {size}" for size, one in found.items()]
    return "\n".join([*lines, "", f"Percentiles from histograms deviate by at most {', '.join(largest)}.", ""])


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.archives")
