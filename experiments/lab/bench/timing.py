"""One timer, and one command in a process of its own: what every benchmark measures with."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from trackwright.experiments.lab.runner import Figures, machine
from trackwright.experiments.lab.subprocesses import REPOSITORY

ROUNDS = 5


class Seconds(NamedTuple):
    """Wall and processor time."""

    wall: float
    cpu: float


def clocked(run: Callable[[], Any]) -> tuple[Seconds, Any]:
    """The time of one run, and its result."""
    began, began_cpu = time.perf_counter(), time.process_time()
    result = run()
    return Seconds(time.perf_counter() - began, time.process_time() - began_cpu), result


def per_row(run: Callable[[], Any], rows: int) -> Figures:
    """The first call, which traces and compiles, and the medians per row of the runs after it."""
    first, _ = clocked(run)
    wall, cpu = np.median([clocked(run)[0] for _ in range(ROUNDS)], axis=0)
    times = {"first_call_cpu_s": first.cpu, "us_per_row": 1e6 * cpu / rows, "wall_us_per_row": 1e6 * wall / rows}
    return {"rows": rows, **times, "device": jax.devices()[0].device_kind, **machine()}


def command(words: Sequence[str | Path], log: Path, environment: Mapping[str, str]) -> tuple[Seconds, float, int]:
    """The time of `trackwright` with these words in a process, children included, its peak in MB, and its exit code."""
    began = time.perf_counter()
    with log.open("w", encoding="utf-8") as said:
        line = [sys.executable, "-m", "trackwright", *words]
        child = subprocess.Popen(line, cwd=REPOSITORY, env=environment, stdout=said, stderr=said)
        _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    seconds = Seconds(time.perf_counter() - began, used.ru_utime + used.ru_stime)
    return seconds, used.ru_maxrss * 1024 / 1e6, child.returncode
