"""One timer and one fresh process: what every benchmark measures with."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.lab.cases import Row, function_of
from trackwright.experiments.lab.subprocesses import new_interpreter
from trackwright.trackers.recordings.atomic import json_text


def clocked(run: Callable[[], Any]) -> tuple[tuple[float, float], Any]:
    """Seconds and processor seconds of one run, and its result."""
    began, began_cpu = time.perf_counter(), time.process_time()
    result = run()
    return (time.perf_counter() - began, time.process_time() - began_cpu), result


def turns(runs: Iterable[Callable[[], Any]], rounds: int) -> np.ndarray:
    """Seconds and processor seconds (rounds, runs, 2) of runs that each have one turn per round."""
    every = list(runs)
    return np.array([[clocked(run)[0] for run in every] for _ in range(rounds)])


def cold_and_warm(run: Callable[[], Any], rows: int, rounds: int) -> Row:
    """The first call, which traces and compiles, and medians of the others; for a fresh process.

    Memory is the process's peak over that before the first call; `rows` are those of one call.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    (_, first), _ = clocked(run)
    wall, cpu = np.median(turns([run], rounds)[:, 0], axis=0).tolist()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "first call, processor s": first,
        "run ms": 1e3 * wall,
        "processor ms": 1e3 * cpu,
        "processor µs/row": 1e6 * cpu / rows,
        "M rows per processor s": rows / cpu / 1e6,
        "MiB": (peak - before) / 1024,
    }


class Version(NamedTuple):
    """A competitor: its trajectories and their rows, a run of it, and the error of its result, if that is compared."""

    trajectories: int
    rows: int
    run: Callable[[], Any]
    error: Callable[[Any], float] | None = None


def compared(versions: Mapping[str, Version], rounds: int) -> list[Row]:
    """First calls of all versions, then medians over rounds in which each has one turn.

    Ratios to the first version are taken within a round: other load slows all versions alike.
    """
    first, errors = {}, {}
    for name, version in versions.items():
        (first[name], _), result = clocked(version.run)
        errors[name] = None if version.error is None else version.error(result)
        del result
    seconds = turns((version.run for version in versions.values()), rounds)
    rates = np.array([version.trajectories * version.rows for version in versions.values()])[:, None] / seconds
    medians, faster = np.median(seconds, axis=0), np.median(rates[:, :1] / rates, axis=0)
    return [
        {
            "version": name, "trajectories": version.trajectories, "rows": version.rows, "first call s": first[name],
            "run ms": 1e3 * medians[k, 0], "processor ms": 1e3 * medians[k, 1],
            "M rows/s": np.median(rates[:, k, 0]) / 1e6, "ours × faster": faster[k, 0],
            "ours × faster, per processor s": faster[k, 1], "error": errors[name],
        }
        for k, (name, version) in enumerate(versions.items())
    ]  # fmt: skip


def apart(target: str, *arguments: Any, limit_s: float) -> Row:
    """What a function of the laboratory returns in a new interpreter, or why not under `failed`.

    `target`: as `bench.growth:point`. The peak of a process is at least that of the one which started it.
    """
    print(f"measuring: {target} {' '.join(map(str, arguments))} …", file=sys.stderr, flush=True)
    program = f"from {__name__} import answer; answer({target!r}, {arguments!r})"
    try:
        done = new_interpreter(["-c", program], limit_s)
    except subprocess.TimeoutExpired:
        return {"failed": f"took over {limit_s:.0f} s; run it again on an idle machine"}
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return {"failed": f"ended with status {done.returncode}: {reason}"}
    row: Row = json.loads(done.stdout)
    return row


def apart_each(target: str, names: Iterable[str], small: bool, limit_s: float) -> list[Row]:
    """The rows that a function of a competitor's name returns, each competitor beside ours in a process of its own."""
    rows = []
    for name in names:
        result = apart(target, name, small, limit_s=limit_s)
        rows += result.get("rows", [{"version": name, **result}])
    return rows


def answer(target: str, arguments: Sequence[Any]) -> None:
    """Print as JSON what the function returns, computed without a cache of compiled programs."""
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        os.environ.pop(name, None)
    print(json_text(function_of(target)(*arguments)))


def timed_command(
    words: Sequence[str | Path], folder: Path, log: Path, environment: Mapping[str, str] | None = None,
    watch: Callable[[int], None] | None = None,
) -> Row:  # fmt: skip
    """Processor seconds with those of children, seconds, peak (MB) and exit code of a Python command in a process.

    `log`: the file of what it prints. `watch(pid)` is called twenty times a second while it runs.
    """
    began = time.perf_counter()
    with log.open("w", encoding="utf-8") as said:
        child = subprocess.Popen([sys.executable, *words], cwd=folder, env=environment, stdout=said, stderr=said)
        while watch is not None and not os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
            watch(child.pid)
            time.sleep(0.05)
        _, status, used = os.wait4(child.pid, 0)
        seconds = time.perf_counter() - began
        child.returncode = os.waitstatus_to_exitcode(status)
    cpu, peak = used.ru_utime + used.ru_stime, used.ru_maxrss * 1024 / 1e6
    return {"cpu_s": cpu, "wall_s": seconds, "peak_mb": peak, "code": child.returncode}


def last_line(log: Path) -> str:
    """The last line of what a command printed."""
    return (log.read_text("utf-8", "replace").strip().splitlines() or ["no message"])[-1]
