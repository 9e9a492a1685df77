"""The cost of drifting biases in the tracker of bearings: `python -m experiments.lab.bench.bearings`.

Walks of a minute seen by four stations, 480 bearings each, as `experiments.lab.validation.track_loss` simulates them:
the filter with constant velocity alone, 4 states, beside that of `bearings`, 12 states with two biases per station.
Rows a second of processor time of the compiled program, the median of runs, and processor seconds of its first call,
which traces and compiles without a cache. Each point runs in a new process.
"""

from __future__ import annotations

import os
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.lab.bench.timing import clocked, turns, write_json
from experiments.lab.subprocesses import in_new_process_or_failed

SIZES = (1, 64, 512)
TRACKERS = ("constant velocity", "drifting biases")
ROUNDS = 15
LIMIT_S = 240.0


def main(*, out: Path = Path("out/bench-bearings.json")) -> int:
    """Print the table and write it as JSON.

    Args:
        out: the JSON file to write.
    """
    from experiments.lab.bench.__main__ import machine

    began = datetime.now(UTC)
    points: dict[str, Any] = {}
    print("| walks at once | tracker | rows/s | first call, s |\n| ---: | --- | ---: | ---: |")
    for size in SIZES:
        for name in TRACKERS:
            found = in_new_process_or_failed("experiments.lab.bench.bearings", "point", (name, str(size)), LIMIT_S)
            points[f"{name}, {size}"] = found
            rate, first = (found.get(key, np.nan) for key in ("rows_per_s", "first_s"))
            print(f"| {size} | {name} | {rate:,.0f} | {first:.2f} |", flush=True)
    command = ["python", "-m", "experiments.lab.bench.bearings", *sys.argv[1:]]
    date = began.isoformat(timespec="seconds")
    write_json(out, {"date": date, "command": command, "machine": machine(), "points": points})
    return 0


def point(name: str, walks: str) -> dict[str, float]:
    """Rows a second and processor seconds of the first call of a tracker on so many walks, in this process."""
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    set_flags()
    from experiments.lab.bench.growth_cases import filtering, finished
    from experiments.lab.validation.track_loss import kidnapped_walk
    from trackers.aoa.fusion import BEARINGS, BearingSensor, bearing_tracker
    from trackers.core.motion import ConstantVelocity
    from trackers.core.recording import stack
    from trackers.core.tracker import Tracker
    from trackers.core.tunable import Scale
    from trackers.parts.start_nearby import NearbyStart

    batch = stack([kidnapped_walk(seed, "bearings").recording for seed in range(int(walks))])
    tracker = bearing_tracker(4, planar=True)
    if name == "constant velocity":
        start = NearbyStart(Scale(1.5, "m"), Scale(1.0, "m/s"), planar=True, velocities=2)
        sensors = {BEARINGS: BearingSensor(0.1, 0.1, 4.0)}
        tracker = Tracker(ConstantVelocity(0.5, 2), sensors, start, track_loss=tracker.track_loss)
    run = finished(filtering(tracker, batch))
    (_, first), _ = clocked(run)
    seconds = np.median(turns([run], ROUNDS)[:, 0, 1])
    return {"first_s": first, "rows_per_s": float(batch.dt.size / seconds)}


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.bearings")
