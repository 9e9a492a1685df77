"""What a study of any size takes on a cluster: `python -m experiments.bench.cluster_plan --runs 1e9 --workers 1000`.

Nothing is run: all rates are those of a result file of `experiments.bench.cluster_scale`, by default the committed one.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from experiments.cli.main import run_alone
from experiments.reports.tables import aligned

MEASURED = Path(__file__).parent / "results" / "bench-cluster-scale-2-cores.json"


class Plan(NamedTuple):
    """What a study takes: hours, bytes and core-hours; `busy`: workers that caller and scheduler can keep busy."""

    chunks: int
    core_hours: float
    compute_h: float
    caller_h: float
    scheduler_h: float
    results_h: float
    elapsed_h: float
    paid_core_hours: float
    busy: float
    stored_bytes: float
    caller_bytes: float
    caller_bytes_per_s: float


def plan(rates: Mapping[str, Any], runs: float, workers: int, conditions: int = 1) -> Plan:
    """The plan of a study; `rates`: of `cluster_scale`. `conditions`: worlds × points of the grid.

    Computing, handing out and storing go on at the same time; the results are added up afterwards, by the caller.
    """
    chunks = math.ceil(runs / rates["trajectories"]) * conditions
    hours = chunks / 3600
    compute, caller = hours * rates["compute_s"], hours * (rates["caller_ms"] + rates["store_ms"]) / 1e3
    scheduler, results = hours * rates["scheduler_ms"] / 1e3, hours * rates["add_ms"] / 1e3
    elapsed = max(compute / workers, caller, scheduler)
    traffic = chunks * (rates["caller_sent_bytes"] + rates["caller_received_bytes"])
    return Plan(
        chunks=chunks,
        core_hours=compute,
        compute_h=compute / workers,
        caller_h=caller,
        scheduler_h=scheduler,
        results_h=results,
        elapsed_h=elapsed + results,
        # The workers may end before the results are added up.
        paid_core_hours=elapsed * workers,
        busy=compute / max(caller, scheduler),
        stored_bytes=chunks * rates["chunk_bytes"],
        caller_bytes=traffic,
        caller_bytes_per_s=traffic / (3600 * elapsed),
    )


def main(
    *,
    runs: float = 1e9,
    workers: int = 1000,
    price: float | None = None,
    conditions: int = 1,
    measured: Path = MEASURED,
) -> int:
    """Print what a study takes: chunks, hours, bytes, and with a price the cost.

    Args:
        runs: trajectories of each condition.
        workers: of one core each.
        price: of a core-hour, in any currency.
        conditions: worlds times points of the grid.
        measured: the result file of cluster_scale.
    """
    rates = json.loads(measured.read_text("utf-8"))
    found = plan(rates, runs, workers, conditions)
    rows = [
        ("chunks of " + format(rates["trajectories"], ",") + " trajectories", f"{found.chunks:,}"),
        ("computing, core-hours", f"{found.core_hours:,.1f}"),
        (f"computing on {workers:,} workers, h", f"{found.compute_h:,.2f}"),
        ("caller: hand out, take in and store, h", f"{found.caller_h:,.2f}"),
        ("scheduler, h", f"{found.scheduler_h:,.2f}"),
        ("workers that these two keep busy", f"{found.busy:,.0f}"),
        ("caller: add up the results, h", f"{found.results_h:,.2f}"),
        ("from start to end, h", f"{found.elapsed_h:,.2f}"),
        ("chunk files, GB", f"{found.stored_bytes / 1e9:,.0f}"),
        ("over the caller's network, GB", f"{found.caller_bytes / 1e9:,.0f}"),
        ("the same, MB/s", f"{found.caller_bytes_per_s / 1e6:,.0f}"),
        ("paid for, core-hours", f"{found.paid_core_hours:,.0f}"),
    ]
    if price is not None:
        rows.append((f"cost at {price:g} a core-hour", f"{price * found.paid_core_hours:,.2f}"))
    print(aligned(rows, [1]))
    print(f"Rates of {measured.name}: world {rates['world']}, tracker {rates['tracker']}, {rates['workers']} workers.")
    return 0


if __name__ == "__main__":
    run_alone(main, "python -m experiments.bench.cluster_plan")
