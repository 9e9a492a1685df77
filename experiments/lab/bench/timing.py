"""Times of runs that take turns, and the JSON file and tables of a benchmark's results."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from trackers.recordings.atomic import atomic_write, json_text


def clocked(run: Callable[[], Any]) -> tuple[tuple[float, float], Any]:
    """Seconds and processor seconds of one run, and its result."""
    began, began_cpu = time.perf_counter(), time.process_time()
    result = run()
    return (time.perf_counter() - began, time.process_time() - began_cpu), result


def turns(runs: Sequence[Callable[[], Any]], rounds: int) -> np.ndarray:
    """Seconds and processor seconds (rounds, runs, 2) of runs that each have one turn per round."""
    return np.array([[clocked(run)[0] for run in runs] for _ in range(rounds)])


def write_json(out: Path, results: Mapping[str, Any]) -> None:
    """Write the results, creating the folder if missing."""
    out.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(out, lambda path: path.write_text(json_text(results), "utf-8"))


def replace_tables(page: Path, module: str, text: str) -> None:
    """Replace what a page has between the marks of a module's tables."""
    begin, end = f"<!-- tables of {module} -->", "<!-- end of the tables -->"
    before, _, rest = page.read_text("utf-8").partition(begin)
    page.write_text(f"{before}{begin}\n\n{text}\n{end}{rest.partition(end)[2]}", "utf-8")
