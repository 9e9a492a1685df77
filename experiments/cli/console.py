"""Output of commands on the console: progress bars, notices on standard error, tables as text."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from trackers.core.errors import UnusableInput, listed
from trackers.recordings.calibration_file import read_calibration
from trackers.recordings.folder import RecordingFolder, read_recordings

ERRORS = Console(stderr=True, highlight=False, soft_wrap=True)


class Advance(Protocol):
    """Advances a progress bar by `done`; `now` is appended to its label."""

    def __call__(self, done: int, now: str = "") -> None: ...


@contextmanager
def progress(what: str, total: int) -> Iterator[Advance]:
    """A progress bar on standard error, drawn only on a terminal; yields the function that advances it."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=ERRORS, disable=not sys.stderr.isatty(), transient=True) as bar:
        task = bar.add_task(what, total=total)

        def advance(done: int, now: str = "") -> None:
            bar.update(task, advance=done, description=f"{what} {now}" if now else what)

        yield advance


def notice(text: str) -> None:
    """Prints one line on standard error."""
    ERRORS.print(text, markup=False)


def read_with_notices(
    paths: Sequence[Path], calibration: Path | None = None, average: float | None = None
) -> list[RecordingFolder]:
    """The recordings in several folders, averaged over intervals of so many s, with the calibration in a file.

    Prints their notices. Raises UnusableInput as `read_recordings` and `read_calibration`, and for a wrong interval.
    """
    if average is not None and not 0 <= average < math.inf:
        raise UnusableInput(f"--average {average:g}: expected seconds above zero, or 0 for every reading")
    recordings = read_recordings(paths)
    if average is not None:
        recordings = [recording.averaged(average) for recording in recordings]
    read = None if calibration is None else read_calibration(calibration)
    recordings = [recording.calibrated(read) for recording in recordings]
    for path, recording in zip(paths, recordings, strict=True):
        for text in recording.notices:
            notice(f"notice: {path}: {text}")
        if read is not None and recording.name in read.recordings:
            notice(f"notice: {path}: is one of the recordings of {calibration}; errors of others are larger")
        if read is not None and (lacking := recording.uncalibrated()):
            notice(f"notice: {path}: {listed(lacking)}: not in {calibration}, or moved since; used uncalibrated")
    return recordings


def notice_unused_calibration(folders: Sequence[RecordingFolder], tracker: str, table: str) -> None:
    """A notice where the recordings have a calibration, but the tracker reads neither bearings nor ranges."""
    if folders[0].calibration is not None and not {"bearings", "ranges"} & set(table.replace(",", " ").split()):
        notice(f"notice: tracker '{tracker}' reads {table}; a calibration changes bearings and ranges alone")


def output_folder(path: Path) -> Path:
    """The folder, created if missing; raises UnusableInput if that fails, or for a recording folder."""
    if (path / "rig.toml").exists():
        raise UnusableInput(f"--out {path}: is a recording folder; expected a folder for results; choose another")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableInput(f"--out {path}: cannot be created ({error.strerror}); choose another folder") from error
    return path
