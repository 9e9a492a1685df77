"""Time that a user waits for whole commands, in fresh processes."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

from trackwright.experiments.lab.bench.timing import last_line, timed_command
from trackwright.experiments.lab.cases import DEFAULTS, Output, Row, Table, chosen, commit
from trackwright.experiments.lab.subprocesses import REPOSITORY, required_recordings
from trackwright.trackers.core.errors import UnusableInput

WALKS = ("ble51-walk-u1-r1", "ble51-walk-u2-r1", "ble51-walk-u3-r1")
LEVELS = ("sensors.ranges.sigma_r", "motion.noise.sigma_a")
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
    "tune-starloc": ("tune", "starloc-fast-s1", "--tracker", "uwb-imu", "--tune", *LEVELS, "--out", "OUT"),
}
"""The arguments by name; recordings by their folder's name, `OUT` for the output folder."""

EXIT_CODES = {"check": (0, 1), "refusal": (2,), "tune-walks": (0, 1), "tune-starloc": (0, 1)}
"""Other than 0 alone: `check` finds errors, and `tune` may refuse its values at the end."""

WARM = 3
"""Runs of each command with a filled cache, whose median is taken."""

PHASES = ("imports", "reading", "tracing", "compiling", "running", "evaluation", "figures")
"""`running` is the rest: filtering, and everything that is not named."""

SETTINGS = ("JAX_", "XLA_", "TRACKWRIGHT_CACHE")
"""Environment variables that begin so are not handed on: they would move the cache or change the programs."""


def waiting(*names: str, against: Path | None = None, output: Output = DEFAULTS) -> int:
    """Time that a user waits for whole commands: in fresh processes, with an empty and a filled cache of programs.

    Another checkout, for instance of an earlier version, takes turns with this one. Processor time is the measure,
    since other load on the machine hardly changes it; a command that starts threads can have more of it than wall time.

    Args:
        names: of commands; default: all.
        against: the folder of another checkout, which takes turns with this one.
    """
    commands = chosen(names, COMMANDS, ("help", "refusal") if output.small else ())
    checkouts = [REPOSITORY] if against is None else [against.resolve(), REPOSITORY]
    rows = [row for name in commands for row in of_a_command(name, checkouts, output.rounds(WARM))]
    output.publish("bench waiting", Table(rows, note="Phases in processor seconds."))
    return 0


def of_a_command(name: str, checkouts: Sequence[Path], warm: int) -> Iterator[Row]:
    """The measurements of one command, cold and warm, for each checkout."""
    print(f"measuring: {name} …", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory() as scratch:
        places = [(checkout, Path(scratch) / str(k)) for k, checkout in enumerate(checkouts)]
        cold = [one_run(name, *place) for place in places]
        rounds = [[one_run(name, *place) for place in places] for _ in range(warm)]
    for k, checkout in enumerate(checkouts):
        medians = {key: median(turn[k][key] for turn in rounds) for key in cold[k]}
        for cache, run in (("cold", cold[k]), ("warm", medians)):
            yield {"command": name, "commit": commit(checkout), "cache": cache, **run}


def one_run(name: str, checkout: Path, scratch: Path) -> Row:
    """Seconds, processor seconds, peak memory (MB) and split of one run; `scratch` holds the cache and the output."""
    scratch.mkdir(exist_ok=True)
    recordings, split, log = required_recordings(), scratch / "split.json", scratch / "log.txt"
    there = {entry.name for entry in recordings.iterdir()}
    words = [str(recordings / a) if a in there else str(scratch / "out") if a == "OUT" else a for a in COMMANDS[name]]
    environment = {key: value for key, value in os.environ.items() if not key.startswith(SETTINGS)}
    environment["TRACKWRIGHT_CACHE"] = str(scratch / "cache")
    script = Path(__file__).with_name("waiting_split.py")
    run = timed_command([script, split, *words], checkout, log, environment)
    if run["code"] not in EXIT_CODES.get(name, (0,)):
        raise UnusableInput(f"{name} in {checkout}: ended with status {run['code']}: {last_line(log)}")
    parts: dict[str, float] = json.loads(split.read_text("utf-8"))
    phases = {phase: parts.get(phase, 0.0) for phase in PHASES}
    return {"processor s": run["cpu_s"], "wall s": run["wall_s"], "peak MB": run["peak_mb"], **phases}
