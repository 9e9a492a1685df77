"""Processor time that a user waits for whole commands, in fresh processes, with an empty and a filled cache."""

import os
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from statistics import median

from trackwright.experiments.lab.bench.timing import command
from trackwright.experiments.lab.runner import Case, Figures, machine
from trackwright.experiments.lab.validation.sites import paths

WALKS = ("ble51-walk-u1-r1", "ble51-walk-u2-r1", "ble51-walk-u3-r1")
LEVELS = ("sensors.ranges.sigma_r", "motion.noise.sigma_a")
COMMANDS: dict[str, tuple[str, ...]] = {
    "help": ("--help",),
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
SETTINGS = ("JAX_", "XLA_", "TRACKWRIGHT_CACHE")
"""Environment variables that begin so are not handed on: they would move the cache or change the programs."""


def cases() -> Iterator[Case]:
    """Every command."""
    return (
        Case(words[1] if len(words) > 1 else "", "", name, partial(figures, name)) for name, words in COMMANDS.items()
    )


def figures(name: str) -> Figures:
    """The first run, which fills the cache of compiled programs, and medians of the runs after it."""
    with tempfile.TemporaryDirectory() as scratch:
        log, out = Path(scratch) / "log.txt", Path(scratch) / "out"
        words = [paths().get(a, out if a == "OUT" else a) for a in COMMANDS[name]]
        environment = {key: value for key, value in os.environ.items() if not key.startswith(SETTINGS)}
        environment["TRACKWRIGHT_CACHE"] = str(Path(scratch) / "cache")
        runs = []
        for _ in range(1 + WARM):
            seconds, peak, code = command(words, log, environment)
            if code not in EXIT_CODES.get(name, (0,)):
                raise RuntimeError(f"exit code {code}: {(log.read_text('utf-8').splitlines() or ['no message'])[-1]}")
            runs.append((seconds, peak))
    (cold, peak), warm = runs[0], [seconds for seconds, _ in runs[1:]]
    times = {
        "cold_cpu_s": cold.cpu,
        "warm_cpu_s": median(x.cpu for x in warm),
        "warm_wall_s": median(x.wall for x in warm),
    }
    return {**times, "peak_mb": peak, **machine()}
