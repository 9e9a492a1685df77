"""Archives of thousands of recordings, some of them broken, tracked and evaluated by commands in fresh processes."""

from __future__ import annotations

import json
import tempfile
from importlib import import_module
from pathlib import Path

from trackwright.experiments.lab.bench.timing import DEFAULTS, Bench, Row, Table, apart, timed_command
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

PERCENTILES = ("median", "p90", "p95", "p99", "sigma_factor")
"""Beginnings of the names of the metrics from histograms."""


def archives(*sizes: int, bench: Bench = DEFAULTS) -> int:
    """Archives of thousands of recordings, tracked and evaluated: processor time, and memory at its peak.

    Each recording is a simulated vehicle for four seconds, fixes with truth: so short that what a recording costs
    beside its rows shows. Three in a hundred are broken instead, at random and in many ways, by the generator of the
    tests (`tests/faults/recordings.py`). The percentiles of all rows, which come from histograms, are compared with
    exact ones. 1 if a command fails, or a percentile deviates by more than a bin.

    Args:
        sizes: numbers of recordings; by default 100, 1000 and 10000.
    """
    rows, percentiles, wrong = [], [], False
    for size in sizes or ((35,) if bench.small else (100, 1000, 10_000)):
        with tempfile.TemporaryDirectory(prefix="archives-") as name:
            folder = Path(name)
            # In other processes: the peak of a child is at least that of this one.
            made = _checked(apart("archives:write_archive", size, name, limit_s=LIMIT_S))
            for command, words in COMMANDS.items():
                run = of_a_command(words, folder)
                wrong |= run["code"] > 1
                rows.append({
                    "recordings": size, "broken": made["broken"], "command": command, "processor s": run["cpu_s"],
                    "ms a recording": 1e3 * run["cpu_s"] / size, "wall s": run["wall_s"], "peak MB": run["peak_mb"],
                    "lines printed": run["lines"],
                })  # fmt: skip
            found = _checked(apart("archives:deviations", name, limit_s=LIMIT_S))
        wrong |= found["percentiles, %"] > found["a bin, %"]
        percentiles.append({"recordings": size, **found})
    title = "largest deviations of the metrics of all rows, whose percentiles come from histograms"
    bench.publish("archives", Table(rows, "commands"), Table(percentiles, title))
    return int(wrong)


def _checked(found: Row) -> Row:
    """The result of a process; raises UnusableInput where it failed."""
    if "failed" in found:
        raise UnusableInput(f"bench: archives: {found['failed']}")
    return found


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
            own = {table: frames[tag].with_columns(tag=pl.lit("agv")) for table, frames in by_tag.items()}
            write_recording(RecordingFolder(name, None, Rig(name), own), day / name)
    return {"broken": broken}


def deviations(folder: str) -> Row:
    """The largest relative deviations of the metrics of all rows from those of all rows at once, with their names."""
    from trackwright.experiments.cli.archives.tables import read_results
    from trackwright.trackers.evaluation.evaluate import evaluate
    from trackwright.trackers.evaluation.scores import BIN_WIDTH
    from trackwright.trackers.recordings.folder import read_truth
    from trackwright.trackers.recordings.tracks_table import EVALUATION, read_tracks

    out = Path(folder) / "out"
    recordings = [read_truth(path) for path, refused in read_results(out).items() if not refused]
    exact = evaluate(read_tracks(out), recordings).overall
    found = json.loads((out / EVALUATION).read_bytes())["overall"]
    relative = {name: abs(found[name] / value - 1) for name, value in exact.items() if value}
    of_bins = [name for name in relative if name.startswith(PERCENTILES)]
    others = [name for name in relative if name not in of_bins]
    worst = {
        kind: max(names, key=relative.__getitem__) for kind, names in (("percentiles", of_bins), ("others", others))
    }
    largest = {f"{kind}, %": 100 * relative[name] for kind, name in worst.items()}
    return {**largest, "a bin, %": 100 * BIN_WIDTH, **{f"{kind}, worst": name for kind, name in worst.items()}}
