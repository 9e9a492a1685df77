"""What commands share: notices on standard error, the recordings that are read, output folders."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from typing import Any

from rich.console import Console

from trackers.core.errors import UnusableInput, has_control, listed, printable
from trackers.recordings.atomic import json_text
from trackers.recordings.calibration_file import read_calibration
from trackers.recordings.folder import RecordingFolder, read_recordings
from trackers.recordings.selection import Selection

ERRORS = Console(stderr=True, highlight=False, soft_wrap=True)


@contextmanager
def json_alone(wanted: bool) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """With `wanted`, the result on standard output is JSON alone, and what a command prints goes to standard error.

    Yields a function that adds to the result.
    """
    result: dict[str, Any] = {}
    with redirect_stdout(sys.stderr) if wanted else nullcontext():
        yield result.update
    if wanted:
        print(json_text(result), end="")


def notice(text: str) -> None:
    """Prints one line on standard error."""
    ERRORS.print(" ".join(printable(text).split()), markup=False)


def selection(tag: Sequence[str], start: float | None, stop: float | None, every: float | None) -> Selection:
    """The part of recordings that `--tag`, `--from`, `--to` and `--every` name; raises UnusableInput."""
    for option, value in (("--from", start), ("--to", stop)):
        if value is not None and not math.isfinite(value):
            raise UnusableInput(f"{option} {value:g}: expected seconds, a time of the recording")
    if start is not None and stop is not None and start >= stop:
        raise UnusableInput(f"--from {start:g} --to {stop:g}: expected the first below the second")
    if every is not None and not 0 < every < math.inf:
        raise UnusableInput(f"--every {every:g}: expected seconds above zero")
    return Selection(tuple(tag), start, stop, every)


def read_with_notices(
    paths: Sequence[Path],
    calibration: Path | None = None,
    average: float | None = None,
    part: Selection | None = None,
) -> list[RecordingFolder]:
    """The recordings in several folders, averaged over intervals of so many s, with the calibration in a file.

    `part`: of each recording, all by default. Prints their notices. Raises UnusableInput as `read_recordings` and
    `read_calibration`, and for a wrong interval.
    """
    return prepared(read_recordings(paths), calibration, average, part)


def prepared(
    recordings: Sequence[RecordingFolder], calibration: Path | None, average: float | None, part: Selection | None
) -> list[RecordingFolder]:
    """Recordings that were read, as `read_with_notices` returns them; prints their notices."""
    paths = [recording.path for recording in recordings]
    if average is not None and not 0 <= average < math.inf:
        raise UnusableInput(f"--average {average:g}: expected seconds above zero, or 0 for every reading")
    recordings = [(part or Selection()).of(recording) for recording in recordings]
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
    """The folder, created if missing; raises UnusableInput as `require_output`, and if that fails."""
    require_output(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableInput(f"--out {path}: cannot be created ({error.strerror}); choose another folder") from error
    return path


def require_output(path: Path) -> None:
    """Raises UnusableInput for a folder that takes no results: a recording, a file, or the root of the file system."""
    if (path / "rig.toml").exists():
        raise UnusableInput(f"--out {path}: is a recording folder; expected a folder for results; choose another")
    if path.resolve() == Path(path.resolve().anchor):
        raise UnusableInput(f"--out {path}: is the root of the file system; choose another folder")
    if has_control(str(path)):
        raise UnusableInput(f"--out {path}: has a control character or bytes that are no UTF-8; choose another folder")
    if path.is_file():
        raise UnusableInput(f"--out {path}: is a file; expected a folder for results; choose another folder")
