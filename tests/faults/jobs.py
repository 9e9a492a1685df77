"""Commands whose results are compared to the bit, as processes that can be hurt, and what these leave behind."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import polars as pl

from tests.experiments.cli.small_archive import write_archive
from tests.in_process import trackwright
from trackwright.trackers.recordings.atomic import PREFIX

LIMIT_S = 600
"""Seconds after which a command counts as one that does not end."""

STUDY = """
runs = 1000
metrics = ["rmse_m"]
[worlds.line]
rate_hz = 1.0
[trackers.fix-kf]
[trackers.moving-average]
[grid]
'world.speed' = [0.2, 0.3, 0.4]
"""


LONG_STUDY = """
metrics = ["rmse_m", "nees_mean"]
[worlds.line]
situation = "constant"
rate_hz = 1.0
[trackers.fix-kf]
"""

PARTS = {"study": "chunks/[0-9]*.npz", "archive": "recordings/*/tracked.json"}
"""The last files of finished parts, which are written once."""


class Job(NamedTuple):
    """A command without its --out, and the files that have the same bytes whatever happened on the way."""

    name: str
    words: tuple[str, ...]
    same: tuple[str, ...]

    def line(self, out: Path, *more: str) -> list[str]:
        """The command as a process gets it."""
        return [sys.executable, "-m", "trackwright.experiments", *self.words, *more, "--out", str(out)]

    def digest(self, out: Path) -> str:
        """Of the bits of the results."""
        if self.name == "study":
            return str(json.loads((out / "results.json").read_text("utf-8"))["sha256"])
        return hashlib.sha256(b"\0".join((out / name).read_bytes() for name in self.same)).hexdigest()

    def finished(self, out: Path) -> set[Any]:
        """The parts that no later command may lose or compute again: chunks, recordings, steps of a fit."""
        if self.name in PARTS:
            return {(str(path), path.stat().st_ino) for path in out.glob(PARTS[self.name])}
        if self.name == "tune" and (out / "checkpoint.npz").exists():
            with np.load(out / "checkpoint.npz") as arrays:
                return {*range(int(arrays["array_0"]))}
        return set()


def jobs(place: Path) -> dict[str, Job]:
    """A study, a track, an archive and a fit of some seconds, by name; their inputs are written to `place`."""
    (place / "small.toml").write_text(STUDY, "utf-8")
    done = trackwright("simulate", "agv", "--n", 3, "--rows", 200, "--out", place / "world")
    assert done.code == 0, done.err
    write_archive(place / "walks", 30)
    world, tables = str(place / "world"), ("tracks.parquet", "events.parquet")
    track = ("--tracker", "fix-kf", "--no-figures")
    all_jobs = (
        Job("study", ("study", str(place / "small.toml"), "--no-figures"), ("results.json",)),
        Job("track", ("track", world, *track), tables),
        Job("archive", ("track", str(place / "walks"), *track), (*tables, "evaluation.json", "results.csv")),
        _fit(world, 40),
    )
    return {job.name: job for job in all_jobs}


def long_study(place: Path, trajectories: int) -> Job:
    """A study of so many trajectories in a condition, up to 513 chunks."""
    (place / "long.toml").write_text(f"runs = {trajectories}\n{LONG_STUDY}", "utf-8")
    return Job("study", ("study", str(place / "long.toml"), "--no-figures"), ("results.json",))


def long_fit(place: Path) -> Job:
    """A fit to 1,200 vehicles, three chunks of a cluster, whose steps take a second each."""
    done = trackwright("simulate", "agv", "--n", 1200, "--rows", 400, "--out", place / "fleet")
    assert done.code == 0, done.err
    return _fit(str(place / "fleet"), 80)


def _fit(world: str, steps: int) -> Job:
    # Adam takes all its steps, so that a fit is not over before it is hurt.
    few = ("--optimiser", "adam", "--steps", str(steps), "--starts", "2", "--no-figures", "--no-report", "--resume")
    words = ("tune", world, "--tracker", "fix-kf", "--tune", "motion.sigma_a", "sensors.*.sigma*", *few)
    return Job("tune", words, ("tuned.toml", "trace.csv"))


class Ended(NamedTuple):
    """How a process ended; `code` is negative for a signal."""

    code: int
    out: str
    err: str


Moment = Callable[[subprocess.Popen[bytes]], None]
"""Returns when a process is to be hurt, or has ended."""


@contextmanager
def running(line: Sequence[str]) -> Iterator[tuple[subprocess.Popen[bytes], Callable[[], Ended]]]:
    """A process in a session of its own, and a function that waits for its end; it is killed with the block."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        # Files, not pipes: workers that outlive their caller would keep these open.
        process = subprocess.Popen(line, stdout=out, stderr=err, start_new_session=True)
        try:
            yield process, lambda: Ended(process.wait(LIMIT_S), _said(out), _said(err))
        finally:
            process.kill()
            process.wait()


def _said(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read().decode(errors="replace")


def run(line: Sequence[str]) -> Ended:
    """The whole process."""
    with running(line) as (_, ended):
        return ended()


def alone(job: Job, out: Path) -> Ended:
    """The job as a process of its own."""
    return run(job.line(out))


def reference_of(job: Job, place: Path, ran: Callable[[Job, Path], Ended] = alone) -> tuple[Job, str, int]:
    """The job, and of its results on threads, without a fault, in the folder `whole`: the digest, the finished parts."""
    ended = ran(job, place / "whole")
    assert ended.code == 0, ended.err
    return job, job.digest(place / "whole"), len(job.finished(place / "whole"))


def reference(place: Path, name: str, ran: Callable[[Job, Path], Ended] = alone) -> tuple[Job, str]:
    """A job by its name, and the digest of its results as of `reference_of`."""
    return reference_of(jobs(place)[name], place, ran)[:2]


def hurt(line: Sequence[str], moment: Moment, number: int = signal.SIGKILL) -> Ended:
    """The process, which gets a signal at a moment unless it has ended."""
    with running(line) as (process, ended):
        moment(process)
        process.send_signal(number)
        return ended()


def after(seconds: float) -> Moment:
    """So many seconds after its start."""

    def wait(process: subprocess.Popen[bytes]) -> None:
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            return

    return wait


def writing(out: Path, seconds: float) -> Moment:
    """When it writes its next file, so many seconds after its start."""
    before = temporary(out)

    def wait(process: subprocess.Popen[bytes]) -> None:
        after(seconds)(process)
        while process.poll() is None and not temporary(out) - before:
            time.sleep(2e-4)

    return wait


def begun(job: Job, out: Path, parts: int) -> Moment:
    """When so many parts are finished: chunks of a study, steps of a fit."""

    def wait(process: subprocess.Popen[bytes]) -> None:
        while process.poll() is None and len(job.finished(out)) < parts:
            time.sleep(0.01)

    return wait


def temporary(out: Path) -> set[str]:
    """The temporary files of commands in a folder and in those inside it."""
    return {name for _, *names in os.walk(out) for name in (*names[0], *names[1]) if name.startswith(PREFIX)}


def half_written(out: Path) -> list[str]:
    """The files, but for temporary ones, that their kind's own reader does not take for whole."""
    files = {path.relative_to(out): path for path in out.rglob("*") if path.is_file()}
    hidden = {name for name in files if any(part.startswith(".") for part in name.parts)}
    return [str(name) for name, path in files.items() if name not in hidden and not _whole(path)]


def _whole(path: Path) -> bool:
    try:
        return bool(READERS[path.suffix](path))
    except (ValueError, OSError, pl.exceptions.PolarsError, zipfile.BadZipFile):
        return False


READERS: dict[str, Callable[[Path], object]] = {
    ".npz": lambda path: zipfile.ZipFile(path).testzip() is None,
    ".json": lambda path: json.loads(path.read_text("utf-8")),
    ".toml": lambda path: tomllib.loads(text := path.read_text("utf-8")) and text.endswith("\n"),
    ".parquet": lambda path: pl.read_parquet(path).width,
    ".html": lambda path: path.read_text("utf-8").rstrip().endswith("</html>"),
    ".csv": lambda path: path.read_text("utf-8").endswith("\n"),
    ".txt": lambda path: path.read_text("utf-8").endswith("\n"),
}
