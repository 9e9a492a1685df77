"""The two forms of covariances against the number of trajectories and states: `python -m experiments.bench.lanes`.

Ranges in the plane, 4, 8, 12 and 15 states, 1 to 512 trajectories at once, of 200 rows: processor time per row of a
compiled program with scalars and with matrices, and the processor time of its first call, which traces and compiles.
`FEW` in `trackers/core/covariance.py` chooses. Each point runs in a new process.
"""

from __future__ import annotations

import os
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from experiments.bench.timing import clocked, turns, write_json
from experiments.cli.main import run_alone
from experiments.cli.runtime import set_flags
from experiments.cli.subprocesses import in_new_process_or_failed

LANES = (1, 2, 4, 8, 64, 512)
STATES = (4, 8, 12, 15)
ROWS = 200
ROUNDS = 15
LIMIT_S = 240.0


def main(
    *, lanes: tuple[int, ...] = LANES, states: tuple[int, ...] = STATES, out: Path = Path("out/bench-lanes.json")
) -> int:
    """Print the table and write it as JSON.

    Args:
        lanes: numbers of trajectories.
        states: numbers of components of the state.
        out: the JSON file to write.
    """
    from experiments.bench.__main__ import machine

    began = datetime.now(UTC)
    results: dict[str, Any] = {}
    print("| states | trajectories | scalars µs/row | matrices µs/row | scalars first call s | matrices first call s |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: |")
    for n in states:
        for size in lanes:
            found = {
                form: in_new_process_or_failed("experiments.bench.lanes", "point", (form, str(n), str(size)), LIMIT_S)
                for form in ("scalars", "matrices")
            }
            results[f"{n} states, {size} trajectories"] = found
            columns = [found[form].get(key, np.nan) for key in ("us_per_row", "first_s") for form in found]
            print(f"| {n} | {size} | " + " | ".join(f"{x:.3g}" for x in columns) + " |", flush=True)
    command = ["python", "-m", "experiments.bench.lanes", *sys.argv[1:]]
    write_json(
        out,
        {"date": began.isoformat(timespec="seconds"), "command": command, "machine": machine(), "points": results},
    )
    return 0


def point(form: str, states: str, trajectories: str) -> dict[str, float]:
    """Processor seconds of the first call and microseconds per row and trajectory, in this process."""
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    set_flags()
    from experiments.bench.growth_cases import filtering, ranging
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
    run_alone(main, "python -m experiments.bench.lanes")
