"""Faults that are made on purpose, and what was seen: `python -m tests.faults table --page docs/faults.md`.

Each is tried so many times with real processes. A fault passes if no finished part was lost, no file is half-written, the
next command leaves no temporary file, its results have the bits of a run without the fault, and a refusal is one line.
Results are kept in `tests/faults/results.json`; `--only` tries some of them again.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.faults import callers, disks, networks, workers
from tests.faults.seen import Seen, UntriedError
from trackwright.experiments.lab.cases import commit, write_json
from trackwright.experiments.text.tables import replace_tables
from trackwright.trackers.programs.program_cache import cache_programs

RESULTS = Path(__file__).parent / "results.json"
LEAST, LARGE = 4_000, 200_000
"""Trajectories of the study with a worker that hangs, and of each whose workers are killed."""


class Fault(NamedTuple):
    """A fault, how it is made, how many times in the table, and the function that tries it so many times."""

    name: str
    how: str
    times: int
    tried: Callable[[int, np.random.Generator, Path], Seen]


def faults(trajectories: int = LARGE, deaths: int = 10) -> list[Fault]:
    """All of them; `deaths` of workers within each study of so many `trajectories`."""
    random = (
        "SIGKILL at random moments, half of them in the moment a file is written; up to 4 in a row, then to the end"
    )
    full = "a file system of a random size, too small; then 64 MB"
    ends = "a random file of the results loses its end; the same command again"
    two = "two processes on one folder at once, of every other pair one killed; then a third"
    all_commands = {
        "study": "`study`",
        "track": "`track`",
        "archive": "`track` of an archive",
        "tune": "`tune --resume`",
    }
    # Of an archive, a second command is refused, and of its files the tables alone are compared with their sizes.
    commands = {name: words for name, words in all_commands.items() if name != "archive"}
    return [
        *(Fault(f"{c} killed", random, 34 - (n != "study"), _of(callers.killed, n)) for n, c in all_commands.items()),
        *(Fault(f"{c}, Ctrl-C", "SIGINT at random moments", 10, _of(callers.interrupted, n))
          for n, c in all_commands.items()),
        Fault("workers killed", "SIGKILL of a worker of `local:2` at random", 100,
              lambda times, draw, place: workers.killed(times, draw, place, trajectories, deaths)),
        Fault("workers of a fit killed", "SIGKILL of a worker of `local:2` at random, of `tune --cluster`", 10,
              workers.fit_killed),
        Fault("a worker hangs", f"SIGSTOP of a worker of `local:2`, silent for over {workers.executors.SILENT_S} s", 1,
              lambda times, draw, place: workers.hangs(times, draw, place, LEAST)),
        Fault("scheduler killed", "SIGKILL of `dask scheduler` with two workers; then another one", 3,
              workers.scheduler_killed),
        Fault("caller of workers killed", "SIGKILL of `study --cluster local:2`; then on threads", 5, callers.orphaned),
        *(Fault(f"network down, `{n} --cluster`", "the workers on another host (a network namespace), 1 to 20 s", 10,
                _of(networks.cut, n)) for n in ("study", "tune")),
        *(Fault(f"full disk, {c}", full, 20, _of(disks.full, n)) for n, c in all_commands.items()),
        *(Fault(f"read-only folder, {c}", "a file system mounted read-only, empty or with results", 4,
                _of(disks.read_only, n)) for n, c in all_commands.items()),
        *(Fault(f"truncated file, {c}", ends, 20, _of(disks.cut, n)) for n, c in commands.items()),
        *(Fault(f"two of {c}", two, 6, _of(callers.both, n)) for n, c in commands.items()),
    ]  # fmt: skip


def _of(function: Callable[..., Seen], name: str) -> Callable[[int, np.random.Generator, Path], Seen]:
    return partial(function, name)


def tried(fault: Fault, seed: int, times: int) -> Seen:
    """What is seen of the fault in a folder of its own; raises UntriedError where it cannot be made."""
    place = Path(tempfile.mkdtemp(prefix="faults-"))
    try:
        return fault.tried(times, np.random.default_rng([seed, *fault.name.encode()]), place)
    finally:
        shutil.rmtree(place, ignore_errors=True)


def main() -> int:
    """Tries the faults, keeps what was seen and writes the page; exit code 1 if one does not pass."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults table", description=__doc__)
    parser.add_argument("--only", default="", help="those whose name contains this text")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--share", type=float, default=1.0, help="of the number of times that each is tried")
    parser.add_argument("--trajectories", type=int, default=LARGE, help="of each study whose workers die")
    parser.add_argument("--deaths", type=int, default=10, help="of workers in each")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--page", type=Path, help="the page whose table is replaced, as docs/faults.md")
    asked = parser.parse_args()
    cache_programs()
    kept: dict[str, Any] = json.loads(asked.results.read_text("utf-8")) if asked.results.exists() else {}
    every, failed = faults(asked.trajectories, asked.deaths), False
    for fault in every:
        if asked.only not in fault.name:
            continue
        began, started = time.monotonic(), datetime.now(UTC)
        try:
            seen, untried = tried(fault, asked.seed, max(1, round(asked.share * fault.times))), ""
        except UntriedError as reason:
            seen, untried = Seen(), str(reason)
        wrong = [] if untried else seen.faults
        failed |= bool(wrong)
        kept[fault.name] = {
            "how": fault.how, "date": started.date().isoformat(), "seed": asked.seed, "untried": untried,
            "seconds": round(time.monotonic() - began), "load": round(os.getloadavg()[0], 1),
            "commit": commit(RESULTS.parents[2]), "python": platform.python_version(),
            **{name: version(name) for name in ("jax", "distributed")},
            **vars(seen), "said": sorted(seen.said), "wrong": wrong,
        }  # fmt: skip
        write_json(asked.results, {f.name: kept[f.name] for f in every if f.name in kept})
        print(f"{fault.name}: {untried or '; '.join(wrong) or 'passed'}; {seen}", flush=True)
    if asked.page is not None:
        replace_tables(asked.page, "tests.faults.table", markdown(kept))
    return int(failed)


def markdown(kept: Mapping[str, Mapping[str, Any]]) -> str:
    """The table, the refusals, and with what it was tried."""
    lines = [
        "| fault | how | times | lost | half-written | left | results | other bits | s |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    said: dict[str, list[str]] = {}
    for name, found in kept.items():
        if found["untried"]:
            lines.append(f"| {name} | not tried: {found['untried']} | | | | | | | |")
            continue
        counts = (found[key] for key in ("times", "lost", "half", "left", "compared", "differ"))
        how = "; ".join([found["how"], *found["notes"]])
        lines.append(f"| {name} | {how} | {' | '.join(f'{int(n):,}' for n in counts)} | {found['seconds']:,} |")
        for line in found["said"]:
            said.setdefault(line, []).append(name)
        lines += [f"| | **fails**: {line} | | | | | | | |" for line in found["wrong"]]
    dates = sorted({found["date"] for found in kept.values()})
    last = next(reversed(kept.values()))
    with_ = ", ".join(f"{key} {last[key]}" for key in ("python", "jax", "distributed"))
    seeds = ", ".join(sorted({str(found["seed"]) for found in kept.values()}))
    lines += ["", "What was said, each time one line (paths shortened):", ""]
    lines += [f"- {', '.join(names)}: `{line.replace('`', '')}`" for line, names in said.items()]
    missing = [fault.name for fault in faults() if fault.name not in kept]
    lines += ["", f"Not tried yet with these versions: {', '.join(missing)}."] if missing else []
    return "\n".join([*lines, "", f"{' to '.join({dates[0]: 0, dates[-1]: 0})}, {with_}, seed {seeds}.", ""])
