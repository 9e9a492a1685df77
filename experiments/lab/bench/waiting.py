"""Time that a user waits for whole commands: `python -m experiments.lab.bench.waiting [NAME …] [--against DIR]`.

Each command runs in fresh processes: first with an empty cache of compiled programs, then with the programs of that
run. Another checkout, for instance of an earlier version, takes turns with this one. Processor time is the measure,
since other load on the machine hardly changes it; a command that starts threads can have more of it than wall time.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

from experiments.cli.main import run_alone
from experiments.lab.bench.timing import write_json
from experiments.lab.subprocesses import REPOSITORY, recordings_folder
from experiments.text.tables import aligned
from trackers.core.errors import UnusableInput

WALKS = ("ble51-walk-u1-r1", "ble51-walk-u2-r1", "ble51-walk-u3-r1")
COMMANDS: dict[str, tuple[str, ...]] = {
    "help": ("--help",),
    "track-help": ("track", "--help"),
    "check": ("check", "starloc-fast-s1"),
    "refusal": ("track", "no-such-recording", "--out", "OUT"),
    "track-walk": ("track", WALKS[0], "--out", "OUT"),
    "track-labyrinth": ("track", "labyrinth", "--out", "OUT"),
    "track-lias": ("track", "lias-planar-fast", "--out", "OUT"),
    "track-starloc": ("track", "starloc-fast-s1", "--tracker", "uwb-imu", "--out", "OUT"),
    "track-drone": ("track", "iasl-drone-1", "--out", "OUT"),
    "tune-walks": ("tune", *WALKS, "--tune", "motion.sigma_a", "sensors.bearings.sigma_azimuth", "--out", "OUT"),
    "tune-starloc": (
        "tune",
        "starloc-fast-s1",
        "--tracker",
        "uwb-imu",
        "--tune",
        "sensors.ranges.sigma_r",
        "motion.noise.sigma_a",
        "--out",
        "OUT",
    ),
}
"""The arguments by name; recordings by their folder's name, `OUT` for the output folder."""

EXIT_CODES = {"check": (0, 1), "refusal": (2,), "tune-walks": (0, 1), "tune-starloc": (0, 1)}
"""Other than 0 alone: `check` finds errors, and `tune` may refuse its values at the end."""

PHASES = ("imports", "reading", "tracing", "compiling", "running", "evaluation", "figures")
"""`running` is the rest: filtering, and everything that is not named."""

SETTINGS = ("JAX_", "XLA_", "TRACKWRIGHT_CACHE")
"""Environment variables that begin so are not handed on: they would move the cache or change the programs."""


def main(
    names: tuple[str, ...] = (),
    *,
    against: Path | None = None,
    warm: int = 3,
    out: Path = Path("out/bench-waiting.json"),
) -> int:
    """Measure commands, print a table and write the results as JSON; 2 if a command fails.

    Args:
        names: of commands; default: all.
        against: the folder of another checkout, which takes turns with this one.
        warm: runs of each command with a filled cache, whose median is taken.
        out: the JSON file to write.
    """
    from experiments.lab.bench.__main__ import machine

    began, host = datetime.now(UTC), machine()
    try:
        unknown = [name for name in names if name not in COMMANDS]
        if unknown:
            raise UnusableInput(f"{', '.join(unknown)}: unknown; expected names among {', '.join(COMMANDS)}")
        checkouts = [REPOSITORY] if against is None else [against.resolve(), REPOSITORY]
        found = {name: waiting(name, checkouts, warm) for name in names or COMMANDS}
    except UnusableInput as problem:
        print(f"bench: {problem}", file=sys.stderr)
        return 2
    results = {
        "date": began.isoformat(timespec="seconds"),
        "command": ["python", "-m", "experiments.lab.bench.waiting", *sys.argv[1:]],
        "machine": host,
        "commits": [commit(folder) for folder in checkouts],
        "commands": found,
        "took_s": (datetime.now(UTC) - began).total_seconds(),
    }
    write_json(out, results)
    print(table(results))
    print(f"Written: {out}")
    return 0


def waiting(name: str, checkouts: Sequence[Path], warm: int) -> list[dict[str, Any]]:
    """The measurements of one command, cold and warm, for each checkout."""
    print(f"measuring: {name} …", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        folders = [Path(scratch) / str(k) for k in range(len(checkouts))]
        pairs = [*zip(checkouts, folders, strict=True)]
        cold = [one_run(name, *pair) for pair in pairs]
        rounds = [[one_run(name, *pair) for pair in pairs] for _ in range(warm)]
    return [{"cold": cold[k], "warm": medians([turn[k] for turn in rounds])} for k in range(len(checkouts))]


def one_run(name: str, checkout: Path, scratch: Path) -> dict[str, float]:
    """Seconds, processor seconds, peak memory (MB) and split of one run; `scratch` holds the cache and the output."""
    scratch.mkdir(exist_ok=True)
    recordings, split = recordings_folder(), scratch / "split.json"
    if recordings is None:
        raise UnusableInput("no real recordings found; TRACKWRIGHT_RECORDINGS names their folder")
    names = {entry.name for entry in recordings.iterdir()}
    arguments = [
        str(recordings / a) if a in names else str(scratch / "out") if a == "OUT" else a for a in COMMANDS[name]
    ]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(SETTINGS)}
    environment["TRACKWRIGHT_CACHE"] = str(scratch / "cache")
    script = Path(__file__).with_name("waiting_split.py")
    began = time.perf_counter()
    with (scratch / "log.txt").open("w+", encoding="utf-8") as log:
        child = subprocess.Popen(
            [sys.executable, script, split, *arguments], cwd=checkout, env=environment, stdout=log, stderr=log
        )
        _, status, used = os.wait4(child.pid, 0)
        seconds = time.perf_counter() - began
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode not in EXIT_CODES.get(name, (0,)):
            log.seek(0)
            last = (log.read().strip().splitlines() or ["no message"])[-1]
            raise UnusableInput(f"{name} in {checkout}: ended with status {child.returncode}: {last}")
    parts: dict[str, float] = json.loads(split.read_text("utf-8"))
    measured = {"cpu_s": used.ru_utime + used.ru_stime, "wall_s": seconds, "peak_mb": used.ru_maxrss * 1024 / 1e6}
    return measured | {phase: parts.get(phase, 0.0) for phase in PHASES}


def medians(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The median of each measurement."""
    return {key: median(run[key] for run in runs) for key in runs[0]}


def commit(folder: Path) -> str:
    """The commit that is checked out there, `unknown` without git."""
    done = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=folder, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() or "unknown"


def table(results: Mapping[str, Any]) -> str:
    """One line for each command, checkout and state of the cache."""
    head = ("command", "commit", "cache", "cpu s", "wall s", "peak MB", *PHASES)
    rows = [head]
    for name, checkouts in results["commands"].items():
        for which, found in zip(results["commits"], checkouts, strict=True):
            for cache, run in found.items():
                times = (f"{run[key]:.2f}" for key in ("cpu_s", "wall_s"))
                parts = (f"{run[phase]:.2f}" for phase in PHASES)
                rows.append((name, which, cache, *times, f"{run['peak_mb']:.0f}", *parts))
    host = results["machine"]
    first = f"{host['cpu']}, {host['cores']} cores, load {host['load_average'][0]:.1f}, {results['date']}"
    return f"{first}\nPhases in processor seconds.\n\n{aligned(rows, range(3, len(head)))}"


if __name__ == "__main__":
    run_alone(main, "python -m experiments.lab.bench.waiting")
