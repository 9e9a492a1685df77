"""A command on broken input, judged: its exit code, what it printed, how long it took and what it left behind."""

from __future__ import annotations

import os
import re
import signal
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.in_process import trackwright

REFUSAL_S, LIMIT_S = 10.0, 120.0
"""Seconds of processor time of a refusal, and of any command."""


class TooLong(BaseException):
    """A command that does not end."""


def faults_of(words: Sequence[str | Path | float], kept: Path, out: Path | None = None) -> tuple[str, int]:
    """What is wrong with a run of `trackwright WORDS` on the files in `kept`, empty for nothing; and its exit code.

    `out`: where it may write; a refused command leaves nothing there.
    """
    before, began = listing(kept), time.process_time()
    try:
        with native_errors() as native, limited(LIMIT_S):
            result = trackwright(*words)
    except TooLong:
        return f"has not ended after {LIMIT_S:g} s", -1
    except BaseException as error:  # everything that leaves `main` is a fault
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {str(error)[:200]} ({where.filename}:{where.lineno})", -1
    seconds = time.process_time() - began
    lines = result.err.splitlines()
    refusals = [line for line in lines if line.startswith("trackwright: ")]
    wrong = []
    if result.code not in (0, 1, 2):
        wrong.append(f"exit code {result.code}")
    if result.code == 2 and refusals != lines[-1:]:
        wrong.append(f"not refused in one line: {lines[-3:]}")
    if result.code == 2 and len(result.err) > 6000:
        wrong.append(f"refused in {len(result.err)} characters")
    if result.code == 2 and seconds > REFUSAL_S:
        wrong.append(f"refused after {seconds:.1f} s")
    if "Traceback" in result.err + native[0] or re.search(r"panicked|Warning:", native[0] + result.err):
        wrong.append(f"printed {(native[0] + result.err)[:300]!r}")
    if re.search(r"[\x00-\x08\x0b-\x1f\x7f]", (result.err + result.out).replace("\r\n", "\n")):
        wrong.append("printed control characters")
    if listing(kept) != before:
        wrong.append(f"changed {sorted(set(listing(kept).items()) ^ set(before.items()))[:3]}")
    if out is not None and result.code == 2 and out.exists() and any(out.iterdir()):
        wrong.append(f"left {sorted(x.name for x in out.iterdir())}")
    if out is not None and out.exists() and (half := [x.name for x in out.rglob(".*")]):
        wrong.append(f"left {half}")
    return "; ".join(wrong), result.code


def listing(folder: Path) -> dict[str, tuple]:
    """Every entry of a folder with what tells whether it was changed."""
    return {str(p): (s.st_mode, s.st_size, s.st_mtime_ns) for p in [folder, *folder.rglob("*")] for s in [p.lstat()]}


@contextmanager
def native_errors() -> Iterator[list[str]]:
    """What native code prints on the error stream of the process, once the block is left."""
    said = [""]
    with tempfile.TemporaryFile() as sink:
        kept = os.dup(2)
        os.dup2(sink.fileno(), 2)
        try:
            yield said
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            sink.seek(0)
            said[0] = sink.read().decode(errors="replace")


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """Raises TooLong within the block after so many seconds."""

    def stop(*_: object) -> None:
        raise TooLong

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
