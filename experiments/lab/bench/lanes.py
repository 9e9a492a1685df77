"""Time per row against the number of trajectories: `python -m experiments.lab.bench.lanes`.

Ranges in the plane, 4, 8, 12 and 15 states, 1 to 512 trajectories at once, of 200 rows: processor time per row of a
compiled program with scalars and with matrices, and the processor time of its first call, which traces and compiles.
`FEW` in `trackers/core/covariance.py` chooses. With `--smoothed` instead trackers of simulated recordings, filtered and
smoothed, 1 to 2,000 trajectories at once. Each point runs in a new process.
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

LANES = (1, 2, 4, 8, 64, 512)
STATES = (4, 8, 12, 15)
ROWS = 200
ROUNDS = 15
SMOOTHED = ("uwb", "fix-kf", "fix-singer", "imm", "uwb-imu")
TRAJECTORIES = (1, 4, 8, 9, 16, 32, 64, 128, 512, 2000)
SMOOTHED_ROWS, SMOOTHED_ROUNDS = 50, 5
LIMIT_S = 240.0


def main(
    *,
    lanes: tuple[int, ...] = (),
    states: tuple[int, ...] = STATES,
    smoothed: bool = False,
    trackers: tuple[str, ...] = SMOOTHED,
    out: Path = Path("out/bench-lanes.json"),
) -> int:
    """Print the table and write it as JSON.

    Args:
        lanes: numbers of trajectories.
        states: numbers of components of the state.
        smoothed: trackers, filtered and smoothed, instead of the two forms of covariances.
        trackers: the trackers of `--smoothed`.
        out: the JSON file to write.
    """
    from experiments.lab.bench.__main__ import machine

    began = datetime.now(UTC)
    results = smoothing(trackers, lanes or TRAJECTORIES) if smoothed else forms(states, lanes or LANES)
    command = ["python", "-m", "experiments.lab.bench.lanes", *sys.argv[1:]]
    write_json(
        out,
        {"date": began.isoformat(timespec="seconds"), "command": command, "machine": machine(), "points": results},
    )
    return 0


def smoothing(trackers: tuple[str, ...], lanes: tuple[int, ...]) -> dict[str, Any]:
    """The table of trackers, filtered and smoothed."""
    results: dict[str, Any] = {}
    print("| tracker | trajectories | filtered µs/row | smoothed µs/row | ratio | first calls s |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for name in trackers:
        for size in lanes:
            found = in_new_process_or_failed("experiments.lab.bench.lanes", "tracker_point", (name, str(size)), LIMIT_S)
            results[f"{name}, {size} trajectories"] = found
            filtered, smoothed = (found.get(f"{k}_us_per_row", np.nan) for k in ("filtered", "smoothed"))
            firsts = " and ".join(f"{found.get(f'{k}_first_s', np.nan):.3g}" for k in ("filtered", "smoothed"))
            cells = f"{filtered:.3g} | {smoothed:.3g} | {smoothed / filtered:.2g} | {firsts}"
            print(f"| {name} | {size} | {cells} |", flush=True)
    return results


def forms(states: tuple[int, ...], lanes: tuple[int, ...]) -> dict[str, Any]:
    """The table of the two forms of covariances."""
    results: dict[str, Any] = {}
    print("| states | trajectories | scalars µs/row | matrices µs/row | scalars first call s | matrices first call s |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: |")
    for n in states:
        for size in lanes:
            found = {
                form: in_new_process_or_failed(
                    "experiments.lab.bench.lanes", "point", (form, str(n), str(size)), LIMIT_S
                )
                for form in ("scalars", "matrices")
            }
            results[f"{n} states, {size} trajectories"] = found
            columns = [found[form].get(key, np.nan) for key in ("us_per_row", "first_s") for form in found]
            print(f"| {n} | {size} | " + " | ".join(f"{x:.3g}" for x in columns) + " |", flush=True)
    return results


def tracker_point(name: str, trajectories: str) -> dict[str, float]:
    """As `point`, of a tracker of simulated recordings, filtered and smoothed, calls of `run` included."""
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    set_flags()
    from sim import worlds
    from trackers.catalogue import TRACKERS
    from trackers.core.smoother import Smoothed

    simulate: Any = {"uwb": worlds.ranges, "uwb-imu": worlds.tool}.get(name, worlds.agv)
    folder = simulate(n=int(trajectories), rows=SMOOTHED_ROWS).folder()
    (batch,) = TRACKERS[name].batches([folder], name)
    recordings = [t.recording for t in batch.trajectories]
    filtered: Any = batch.tracker
    rows, found = sum(map(len, recordings)), {}
    for form, tracker in (("filtered", filtered), ("smoothed", Smoothed(filtered))):

        def run(tracker: Any = tracker) -> Any:
            return tracker.run(recordings)

        (_, found[f"{form}_first_s"]), _ = clocked(run)
        found[f"{form}_us_per_row"] = float(1e6 * np.median(turns([run], SMOOTHED_ROUNDS)[:, 0, 1]) / rows)
    return found


def point(form: str, states: str, trajectories: str) -> dict[str, float]:
    """Processor seconds of the first call and microseconds per row and trajectory, in this process."""
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    set_flags()
    from experiments.lab.bench.growth_cases import filtering, ranging
    from trackers.core import covariance
    from trackers.core.recording import stack

    size = int(trajectories)
    covariance.FEW = size if form == "matrices" else 0
    tracker, recordings = ranging(max(int(states) - 4, 4), 1, int(states) - 4, size)
    run = filtering(tracker, stack(recordings))
    (_, first), _ = clocked(run)
    seconds = np.median(turns([run], ROUNDS)[:, 0, 1])
    return {"first_s": first, "us_per_row": float(1e6 * seconds / (size * ROWS))}


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.lanes")
