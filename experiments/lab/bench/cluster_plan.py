"""What a study takes on a cluster: `python -m experiments.lab.bench.cluster_plan --runs 1e9 --workers 64 1000`.

Nothing is run: all rates are those of a result file of `experiments.lab.bench.cluster_scale`, by default the committed
one, with the scheduler of the number of workers that is nearest.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.cli.main import run_alone
from experiments.lab.bench.cluster_results import markdown
from experiments.lab.bench.timing import replace_tables
from experiments.text.tables import aligned

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


def rates_of(measured: Mapping[str, Any], workers: int) -> dict[str, Any]:
    """The rates of a chunk, with those of the measured cluster whose number of workers is nearest in proportion."""
    nearest = min(measured["clusters"], key=lambda one: abs(math.log(one["workers"] / workers)))
    return {**measured["chunk"], **nearest}


def main(
    *,
    runs: float = 1e9,
    workers: tuple[int, ...] = (64, 1000),
    price: float | None = None,
    conditions: int = 1,
    measured: Path = MEASURED,
    page: Path | None = None,
) -> int:
    """Print what a study takes: chunks, hours, bytes, and with a price the cost.

    Args:
        runs: trajectories of each condition.
        workers: of one core each.
        price: of a core-hour, in any currency.
        conditions: worlds times points of the grid.
        measured: the result file of cluster_scale.
        page: the page whose table is replaced, as docs/cluster.md.
    """
    found = json.loads(measured.read_text("utf-8"))
    plans = [plan(rates_of(found, count), runs, count, conditions) for count in workers]
    rows = table(plans, found["chunk"]["trajectories"], runs, workers, price)
    print(aligned(rows, range(1, len(rows[0]))))
    print(f"Rates of {measured.name}: world {found['chunk']['world']}, tracker {found['chunk']['tracker']}.")
    if page is not None:
        replace_tables(page, "experiments.lab.bench.cluster_plan", markdown(rows) + "\n")
    return 0


def table(
    plans: Sequence[Plan], trajectories: int, runs: float, workers: Sequence[int], price: float | None
) -> list[list[str]]:
    """The rows of the plans, beside each other."""
    every: list[tuple[str, Any, str]] = [
        (f"chunks of {trajectories:,} trajectories", lambda p: p.chunks, ",.0f"),
        ("computing, core-hours", lambda p: p.core_hours, ",.1f"),
        ("computing on all workers, h", lambda p: p.compute_h, ",.2f"),
        ("caller: hand out, take in and store, h", lambda p: p.caller_h, ",.2f"),
        ("scheduler, h", lambda p: p.scheduler_h, ",.2f"),
        ("workers that these two keep busy", lambda p: p.busy, ",.0f"),
        ("caller: add up the results, h", lambda p: p.results_h, ",.2f"),
        ("from start to end, h", lambda p: p.elapsed_h, ",.2f"),
        ("chunk files, GB", lambda p: p.stored_bytes / 1e9, ",.0f"),
        ("over the caller's network, GB", lambda p: p.caller_bytes / 1e9, ",.0f"),
        ("the same, MB/s", lambda p: p.caller_bytes_per_s / 1e6, ",.0f"),
        ("paid for, core-hours", lambda p: p.paid_core_hours, ",.0f"),
    ]
    if price is not None:
        every.append((f"cost at {price:g} a core-hour", lambda p: price * p.paid_core_hours, ",.2f"))
    head = [f"{runs:,.0f} trajectories", *(f"{count:,} workers" for count in workers)]
    return [head, *([name, *(format(value(one), how) for one in plans)] for name, value, how in every)]


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.cluster_plan")
