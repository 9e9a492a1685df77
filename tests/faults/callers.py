"""Commands that are killed or interrupted at random moments, and two of them at once on one folder."""

from __future__ import annotations

import signal
import time
from pathlib import Path

import numpy as np

from tests.faults.jobs import Ended, Job, Moment, after, begun, hurt, reference, run, running, temporary, writing
from tests.faults.seen import Seen

Draw = np.random.Generator

MOST = 4
"""Kills in a row before a command is left to end, its results are compared, and another begins from nothing."""

GONE_S = 20.0
"""Seconds in which the workers of a killed caller end."""


def _reference(place: Path, name: str) -> tuple[Job, str, float]:
    """The job, the digest of its results without a fault, and its duration, s, with compiled programs."""
    job, digest = reference(place, name)
    began = time.monotonic()
    ended = run(job.line(place / "again"))
    seconds = time.monotonic() - began
    assert ended.code == 0, ended.err
    assert job.digest(place / "again") == digest
    return job, digest, seconds


def _moment(draw: Draw, out: Path, seconds: float) -> Moment:
    """Any moment of a run, or the next file that is written after it."""
    when = draw.uniform(0.0, seconds)
    return writing(out, when) if draw.random() < 0.5 else after(when)


def killed(name: str, times: int, draw: Draw, place: Path) -> Seen:
    """A command killed by SIGKILL, again and again, then left to end."""
    job, digest, seconds = _reference(place, name)
    seen, mid_write, ends = Seen(), 0, 0
    while seen.times < times:
        out, before = place / f"killed-{ends}", set()
        for _ in range(min(int(draw.integers(1, MOST + 1)), times - seen.times)):
            there = temporary(out)
            ended = hurt(job.line(out), _moment(draw, out, seconds))
            seen.times += ended.code == -signal.SIGKILL
            mid_write += bool(temporary(out) - there)
            before = seen.look(job, out, before)
        ended = run(job.line(out))
        seen.look(job, out, before)
        seen.compare(job, out, digest, ended)
        ends += 1
    seen.notes.append(f"{mid_write} times in mid-write")
    return seen


def interrupted(name: str, times: int, draw: Draw, place: Path) -> Seen:
    """A command that gets Ctrl-C (SIGINT) at a random moment, then the same one again."""
    job, digest, seconds = _reference(place, name)
    seen, k = Seen(), 0
    while seen.times < times:
        out, k = place / f"interrupted-{k}", k + 1
        ended = hurt(job.line(out), _moment(draw, out, seconds), signal.SIGINT)
        if ended.code == 0:
            continue
        seen.times += 1
        _judge_interrupted(seen, ended)
        seen.left += len(temporary(out))
        before = seen.look(job, out, set())
        ended = run(job.line(out))
        seen.look(job, out, before)
        seen.compare(job, out, digest, ended)
    return seen


def _judge_interrupted(seen: Seen, ended: Ended) -> None:
    """Exit code 130 and a last line that says so, and no traceback."""
    said = (ended.err.splitlines() or [""])[-1]
    if ended.code != 130 or "Traceback" in ended.err or not said.startswith(("trackwright: interrupted", "stopped: ")):
        seen.wrong.append(f"Ctrl-C: ended with {ended.code}: {ended.err[-300:]}")
        return
    seen.said.add(said.removeprefix("trackwright: "))


def orphaned(times: int, draw: Draw, place: Path) -> Seen:
    """The caller of workers on this machine is killed: they end, and the study continues on threads."""
    import psutil

    job, digest = reference(place, "study")
    seen = Seen()
    for k in range(times):
        out = place / f"orphaned-{k}"
        with running(job.line(out, "--cluster", "local:2")) as (process, ended):
            # By parts, not by seconds: workers take longer to begin on a busy machine.
            begun(job, out, int(draw.integers(1, 8)))(process)
            family = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else []
            process.kill()
            seen.times += ended().code == -signal.SIGKILL
        alive = psutil.wait_procs(family, GONE_S)[1]
        seen.wrong += [f"still there after {GONE_S:g} s: {' '.join(worker.cmdline()[:4])}" for worker in alive]
        before = seen.look(job, out, set())
        ended_later = run(job.line(out))
        seen.look(job, out, before)
        seen.compare(job, out, digest, ended_later)
    return seen


def both(name: str, times: int, draw: Draw, place: Path) -> Seen:
    """Two of the same command at once on one folder, one of which is killed every other time; then a third."""
    job, digest, seconds = _reference(place, name)
    seen = Seen()
    for k in range(times):
        out = place / f"both-{k}"
        with running(job.line(out)) as (first, end_of_first), running(job.line(out)) as (_, end_of_other):
            if k % 2:
                _moment(draw, out, 2 * seconds)(first)
                first.kill()
            ends = [end_of_first(), end_of_other()]
        for ended in (one for one in ends if one.code != -signal.SIGKILL):
            seen.compare(job, out, digest, ended, alone=False)
        seen.times += 1
        seen.compare(job, out, digest, run(job.line(out)))
    return seen
