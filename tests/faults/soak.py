"""Long runs: a study, a fit, a track and an archive, over and over: `python -m tests.faults soak --hours 2`.

In one process, and every `FRESH` rounds as processes of their own, on one cache of compiled programs. After each round
the memory, open files, threads, memory maps and Python objects of the process are written down, the most memory of the
fresh processes, and the files that stay in the cache and in the temporary folder. A quantity is not flat where the
Theil–Sen slope of its second half is above zero with 95 % confidence and grows it by more than `MOST` in a thousand rounds.
"""

from __future__ import annotations

import argparse
import gc
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import theilslopes

from tests.faults.jobs import LIMIT_S, Job, jobs
from tests.in_process import trackwright
from trackwright.experiments.cli.runtime import keep_programs
from trackwright.experiments.lab.cases import write_json
from trackwright.experiments.text.tables import replace_tables

FRESH = 10
"""Rounds in the one process for a round of fresh processes, which takes as long as some tens of these."""

MOST = 0.1
"""The share by which a quantity may grow in a thousand rounds."""

LEAST = 12
"""Values that a slope needs; a shorter series is not judged flat."""

Round = dict[str, float]

OWN = {
    "resident memory": "MB", "open files": "", "threads": "", "memory maps": "", "objects": "", "seconds": "s",
}  # fmt: skip
SHARED = {"cache": "MB", "files in the cache": "", "temporary files": ""}
OTHERS = {"memory of fresh processes": "MB", "seconds of fresh processes": "s"}
UNITS = OWN | SHARED | OTHERS


def held(cache: Path, scratch: Path) -> Round:
    """What this process holds now, and what lies in the folders of the cache and of temporary files."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    files = [path for path in cache.rglob("*") if path.is_file()]
    return {
        "resident memory": pages * os.sysconf("SC_PAGE_SIZE") / 2**20,
        "open files": len(os.listdir("/proc/self/fd")),
        "threads": len(os.listdir("/proc/self/task")),
        "memory maps": Path("/proc/self/maps").read_bytes().count(b"\n"),
        "objects": len(gc.get_objects()),
        "cache": sum(path.stat().st_size for path in files) / 2**20,
        "files in the cache": len(files),
        "temporary files": len([*scratch.iterdir()]),
    }


def here(job: Job, out: Path) -> None:
    """The command in this process."""
    done = trackwright(*job.words, "--out", out)
    assert done.code == 0, done


def afresh(job: Job, out: Path) -> float:
    """The command in a process of its own; the most memory that it held, MB."""
    began = time.monotonic()
    process = os.posix_spawn(
        sys.executable, job.line(out), os.environ,
        file_actions=[(os.POSIX_SPAWN_OPEN, fd, os.devnull, os.O_WRONLY, 0) for fd in (1, 2)],
    )  # fmt: skip
    _, status, used = os.wait4(process, 0)
    assert status == 0, f"{job.words}: {os.waitstatus_to_exitcode(status)}"
    assert time.monotonic() - began < LIMIT_S
    return used.ru_maxrss / 1024


def rounds(hours: float, place: Path, extra: Callable[[], object] = lambda: None) -> list[Round]:
    """What was held after each round of so many hours; `extra` is called in each, as by a program that leaks."""
    cache, scratch = place / "cache", place / "temporary"
    scratch.mkdir()
    os.environ |= {"TRACKWRIGHT_CACHE": str(cache), "TMPDIR": str(scratch)}
    tempfile.tempdir = None
    keep_programs()
    every, found, began = [*jobs(place).values()], list[Round](), time.monotonic()
    while time.monotonic() - began < 3600 * hours:
        out, started = place / "out", time.monotonic()
        for job in every:
            here(job, out / job.name)
        extra()
        taken, others = time.monotonic() - started, Round()
        if len(found) % FRESH == 0:
            started = time.monotonic()
            most = max(afresh(job, out / f"{job.name}-afresh") for job in every)
            others = {"memory of fresh processes": most, "seconds of fresh processes": time.monotonic() - started}
        shutil.rmtree(out)
        found.append({"hours": (time.monotonic() - began) / 3600, "seconds": taken, **held(cache, scratch), **others})
    return found


def growth(numbers: Sequence[int], values: Sequence[float]) -> tuple[float, float, float]:
    """The share by which a quantity grows in a thousand rounds, with its 95 % interval, by the second half of them."""
    half = len(values) // 2
    x, y = np.array(numbers[half:], float), np.array(values[half:], float)
    slope, _, low, high = theilslopes(y, x, 0.95)
    scale = 1000 / max(float(np.median(y)), 1.0)
    return slope * scale, low * scale, high * scale


def judged(found: Sequence[Round]) -> dict[str, dict[str, Any]]:
    """Each quantity: its first and last value, its growth and whether it is flat."""
    series: dict[str, dict[str, Any]] = {}
    for name in UNITS:
        known = [(k, one[name]) for k, one in enumerate(found) if name in one]
        if not known:
            continue
        numbers, values = zip(*known, strict=True)
        one: dict[str, Any] = {"first": values[0], "middle": values[len(values) // 2], "last": values[-1]}
        if len(values) >= LEAST:
            share, low, high = growth(numbers, values)
            # Seconds are those of a machine on which other programs run: shown, not judged.
            one |= {"growth": share, "low": low, "high": high}
            one |= {} if UNITS[name] == "s" else {"flat": not (low > 0 and share > MOST)}
        series[name] = one
    return series


def markdown(found: Sequence[Round], series: Mapping[str, Mapping[str, Any]]) -> str:
    """The table of a page."""
    lines = [
        "| after a round | first | middle | last | growth in 1,000 rounds (95 %) | flat |",
        "| --- | ---: | ---: | ---: | ---: | --- |",
    ]
    for name, one in series.items():
        unit = f", {UNITS[name]}" if UNITS[name] else ""
        span = f"{one['growth']:+.1%} ({one['low']:+.1%} to {one['high']:+.1%})" if "growth" in one else "too few"
        verdict = {True: "yes", False: "**no**", None: ""}[one.get("flat")]
        values = " | ".join(
            f"{one[key]:,.4g}" if one[key] < 1e4 else f"{one[key]:,.0f}" for key in ("first", "middle", "last")
        )
        lines.append(f"| {name}{unit} | {values} | {span} | {verdict} |")
    fresh = sum("memory of fresh processes" in one for one in found)
    lines += ["", f"{found[-1]['hours']:.2f} hours, {len(found)} rounds in one process, {fresh} of fresh processes."]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Soaks, and writes what was held after each round; exit code 1 where something is not flat."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults soak", description=__doc__)
    parser.add_argument("--hours", type=float, default=2.0)
    parser.add_argument("--out", type=Path, default=Path("out/soak"))
    parser.add_argument("--page", type=Path, help="the page whose table is replaced, as docs/faults.md")
    asked = parser.parse_args()
    place = Path(tempfile.mkdtemp(prefix="soak-"))
    try:
        found = rounds(asked.hours, place)
    finally:
        shutil.rmtree(place, ignore_errors=True)
    series = judged(found)
    text = markdown(found, series)
    write_json(
        asked.out / "soak.json", {"date": datetime.now(UTC).date().isoformat(), "judged": series, "rounds": found}
    )
    print(f"{text}Written: {asked.out / 'soak.json'}")
    if asked.page is not None:
        date = f"{datetime.now(UTC).date()}, `python -m tests.faults soak --hours {asked.hours:g}`."
        replace_tables(asked.page, "tests.faults.soak", f"{text}\n{date}\n")
    # Too few rounds to judge are no pass; of fresh processes a short soak has few.
    return int(not all(one.get("flat", name in OTHERS) for name, one in series.items() if UNITS[name] != "s"))
