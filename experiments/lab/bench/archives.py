"""Archives of thousands of recordings, some of them broken, tracked and evaluated by commands in fresh processes."""

from __future__ import annotations

import tempfile
from importlib import import_module
from pathlib import Path

from trackwright.experiments.lab.bench.timing import apart, timed_command
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table
from trackwright.experiments.lab.subprocesses import REPOSITORY
from trackwright.trackers.core.errors import UnusableInput

ROWS, TOGETHER, TRACKER = 40, 100, "fix-kf"
"""Rows of a recording, recordings of one simulation, and the tracker."""

BROKEN_EVERY, SEED = 33, 29
"""One in so many recordings is broken; the seed of its faults."""

LIMIT_S = 3600.0
TRACK = ("track", "ARCHIVE", "--tracker", TRACKER, "--no-figures", "--no-report", "--out", "OUT")
COMMANDS = {"track": TRACK, "track again": TRACK, "evaluate": ("evaluate", "OUT")}
"""The commands in their order; the second `track` finds everything finished but the broken ones."""


def archives(*, output: Output = DEFAULTS) -> int:
    """Archives of thousands of recordings, tracked and evaluated: processor time, and memory at its peak.

    Each recording is a simulated vehicle for four seconds, fixes with truth: so short that what a recording costs
    beside its rows shows. Three in a hundred are broken instead, at random and in many ways, by the generator of the
    tests (`tests/faults/recordings.py`). 1 if a command fails.
    """
    rows = []
    for size in (35,) if output.small else (100, 1000, 10_000):
        with tempfile.TemporaryDirectory(prefix="archives-") as name:
            folder = Path(name)
            # In other processes: the peak of a child is at least that of this one.
            made = apart("bench.archives:write_archive", size, name, limit_s=LIMIT_S)
            if "failed" in made:
                raise UnusableInput(f"bench: archives: {made['failed']}")
            for command, words in COMMANDS.items():
                run = of_a_command(words, folder)
                rows.append({
                    "recordings": size, "broken": made["broken"], "command": command, "processor s": run["cpu_s"],
                    "ms a recording": 1e3 * run["cpu_s"] / size, "wall s": run["wall_s"], "peak MB": run["peak_mb"],
                    "lines printed": run["lines"], "exit code": run["code"],
                })  # fmt: skip
    output.publish("bench archives", Table(rows))
    return int(any(row["exit code"] > 1 for row in rows))


def of_a_command(words: tuple[str, ...], folder: Path) -> Row:
    """Times, peak memory, exit code and printed lines of one command."""
    places, log = {"ARCHIVE": str(folder / "archive"), "OUT": str(folder / "out")}, folder / "log.txt"
    run = timed_command(["-m", "trackwright.experiments", *(places.get(word, word) for word in words)], REPOSITORY, log)
    return run | {"lines": len(log.read_text("utf-8").splitlines())}


def write_archive(size: int, folder: str) -> Row:
    """Writes so many recordings in folders of `TOGETHER` each; how many of them are broken."""
    import polars as pl

    from trackwright.sim import worlds
    from trackwright.trackers.core.model.rig import Rig
    from trackwright.trackers.recordings.folder import RecordingFolder, write_recording

    # Of the repository, not of the package.
    broken_recording = import_module("tests.faults.recordings").broken_recording
    broken = 0
    for first in range(0, size, TOGETHER):
        day = Path(folder) / "archive" / f"day-{first // TOGETHER:03d}"
        tables = worlds.agv(n=TOGETHER, seed=first, rows=ROWS).folder().tables
        by_tag = {name: frame.partition_by("tag", as_dict=True) for name, frame in tables.items()}
        for k in range(first, min(first + TOGETHER, size)):
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
            of_tag = {table: frames[tag].with_columns(tag=pl.lit("agv")) for table, frames in by_tag.items()}
            write_recording(RecordingFolder(name, None, Rig(name), of_tag), day / name)
    return {"broken": broken}
