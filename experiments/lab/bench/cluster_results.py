"""The JSON file and the table in a page of a benchmark of clusters."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from experiments.lab.bench.timing import replace_tables, write_json


def head(module: str, began: datetime) -> dict[str, Any]:
    """What results are beside their numbers: date, command, commit, machine and versions."""
    from experiments.lab.bench.__main__ import machine
    from experiments.lab.bench.measure import packages
    from experiments.lab.bench.waiting import commit
    from experiments.lab.subprocesses import REPOSITORY

    return {
        "date": began.isoformat(timespec="seconds"),
        "command": ["python", "-m", module, *sys.argv[1:]],
        "commit": commit(REPOSITORY),
        "machine": machine(),
        "packages": packages("distributed"),
    }


def publish(results: Mapping[str, Any], table: str, out: Path, page: Path | None) -> None:
    """Write the results to `out` and print their table, which replaces that of its command in the page."""
    write_json(out, results)
    host, command = results["machine"], results["command"]
    heading = f"{host['cpu']}, {host['cores']} cores, {results['date'][:10]}, `{' '.join(command)}`:"
    print(f"{heading}\n\n{table}\n\nWritten: {out}")
    if page is not None:
        replace_tables(page, command[2], f"{heading}\n\n{table}\n")


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, the first row of which is its head; all columns but the first are aligned right."""
    ruled = [rows[0], ["---", *["---:"] * (len(rows[0]) - 1)], *rows[1:]]
    return "\n".join(f"| {' | '.join(row)} |" for row in ruled)
