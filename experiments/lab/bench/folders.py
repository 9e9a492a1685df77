"""Time to track a folder of a thousand tags over that of the tracker alone: `python -m experiments.lab.bench.folders`.

The folder is the demo's: 200 rows of phases at three stations for each tag, as Parquet. Reading it, tracking it (rows
of all tags, run, table of estimates) and writing `tracks.parquet` are timed beside `tracker.run` on the stacked rows.
Processor seconds of warm programs, medians over rounds in which the whole and its parts have one turn each.
"""

from __future__ import annotations

import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.__main__ import machine
from experiments.lab.bench.timing import clocked, write_json

TAGS, ROUNDS = 1000, 5
SIGMA_P = 0.2
"""Phase noise of the demo, rad."""

MOST = 3.0
"""Greatest time of reading, tracking and writing, as a multiple of that of the tracker alone."""

PARTS = ("read", "rows", "run", "track", "write")


def main(*, tracker: tuple[str, ...] = ("direct", "cascade"), out: Path = Path("out/bench-folders.json")) -> int:
    """Measure the tracking of a folder, print the table and write it as JSON; 1 where it takes too long.

    Args:
        tracker: trackers of phases.
        out: the JSON file to write.
    """
    set_flags()
    found = [measured(name) for name in tracker]
    print(f"{'tracker':10s}" + "".join(f"{part + ', s':>10s}" for part in PARTS) + "   whole/run")
    for one in found:
        each = "".join(f"{one[f'{part}_s']:10.3f}" for part in PARTS)
        print(f"{one['tracker']:10s}{each}{one['times_the_run']:12.2f}")
    command = ["python", "-m", "experiments.lab.bench.folders", *sys.argv[1:]]
    write_json(out, {"command": command, "machine": machine(), "folders": found})
    print(f"Written: {out}")
    return int(any(one["times_the_run"] > MOST for one in found))


def measured(tracker: str) -> dict[str, Any]:
    """Processor seconds of the parts, and of reading, tracking and writing as a multiple of the run."""
    from sim.worlds import station
    from trackers.catalogue import build
    from trackers.core.recording import Batch
    from trackers.core.tracker import AbstractTracker
    from trackers.recordings.folder import RecordingFolder, read_recording, write_recording
    from trackers.recordings.tracks import Tracks, batches
    from trackers.recordings.tracks_table import write_tracks

    def tracked(recording: RecordingFolder) -> Tracks:
        return build(tracker, recording).run(recording)

    def stacked_rows(recording: RecordingFolder) -> list[tuple[AbstractTracker, Batch]]:
        groups = build(tracker, recording).batches(recording)
        return [(group.tracker, batch) for group in groups for _, batch in batches(group.trajectories)]

    def alone(stacked: list[tuple[AbstractTracker, Batch]]) -> None:
        for own, batch in stacked:
            own.run(batch)

    with tempfile.TemporaryDirectory() as folder:
        path, table = Path(folder) / "world", Path(folder) / "tracks.parquet"
        write_recording(station(TAGS, path="hand", sigma_p=SIGMA_P).folder(), path)
        seconds = []
        for _ in range(ROUNDS + 1):
            (_, read), recording = clocked(partial(read_recording, path))
            (_, whole), tracks = clocked(partial(tracked, recording))
            (_, rows), stacked = clocked(partial(stacked_rows, read_recording(path)))
            (_, run), _ = clocked(partial(alone, stacked))
            (_, write), _ = clocked(partial(write_tracks, tracks.table, table))
            seconds.append((read, rows, run, whole, write))
    warm = np.array(seconds[1:])
    medians = {f"{part}_s": float(value) for part, value in zip(PARTS, np.median(warm, axis=0), strict=True)}
    times = np.median((warm[:, 0] + warm[:, 3] + warm[:, 4]) / warm[:, 2])
    return {"tracker": tracker, "tags": TAGS, **medians, "times_the_run": float(times)}


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.folders")
