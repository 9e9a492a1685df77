"""What commands share: notices on standard error, the recordings that are read, output folders."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from experiments.cli.arguments import File
from experiments.text.terminal import notice
from trackers.core.errors import UnusableInput, has_control, listed
from trackers.recordings.atomic import json_text
from trackers.recordings.calibration import Calibration
from trackers.recordings.calibration_file import identity, read_calibration
from trackers.recordings.folder import RecordingFolder, read_recordings
from trackers.recordings.selection import Selection


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


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """The options of `track`, `tune` and `sweep` on the readings that are used, and on their calibration.

    Raises UnusableInput for times that name no part of a recording.

    Args:
        calibration: a calibration.toml of `trackwright calibrate`, of other recordings of these stations or anchors.
        tag: these tags alone.
        from_: readings from this time on.
        to: readings up to this time.
        every: only the last reading of each tag and anchor or station in every so many seconds.
        average: mean of the ranges, fixes or bearings of each tag and anchor or station over so many seconds; 0:
            every reading; default: 0.5 for bearings that repeat.
    """

    calibration: File | None = None
    tag: Annotated[tuple[str, ...], "TAG"] = ()
    from_: Annotated[float | None, "S"] = None
    to: Annotated[float | None, "S"] = None
    every: Annotated[float | None, "S"] = None
    average: Annotated[float | None, "S"] = None

    def __post_init__(self) -> None:
        _ = self.part
        if self.average is not None and not 0 <= self.average < math.inf:
            raise UnusableInput(f"--average {self.average:g}: expected seconds above zero, or 0 for every reading")

    @property
    def part(self) -> Selection:
        """The part of each recording."""
        return selection(self.tag, self.from_, self.to, self.every)

    def read_calibration(self) -> Calibration | None:
        """The calibration, None without; raises UnusableInput as `read_calibration`."""
        return None if self.calibration is None else read_calibration(self.calibration)


def selection(tag: Sequence[str], start: float | None, stop: float | None, every: float | None) -> Selection:
    """The part of recordings that `--tag`, `--from`, `--to` and `--every` name; raises UnusableInput."""
    for option, value in (("--from", start), ("--to", stop)):
        if value is not None and not math.isfinite(value):
            raise UnusableInput(f"{option} {value:.12g}: expected seconds, a time of the recording")
    if start is not None and stop is not None and start >= stop:
        raise UnusableInput(f"--from {start:.12g} --to {stop:.12g}: expected the first below the second")
    if every is not None and not 0 < every < math.inf:
        raise UnusableInput(f"--every {every:g}: expected seconds above zero")
    return Selection(tuple(tag), start, stop, every)


def read_with_notices(paths: Sequence[Path], used: ReadingOptions | None = None) -> list[RecordingFolder]:
    """The recordings in several folders with these options; prints their notices.

    Raises UnusableInput as `read_recordings` and `read_calibration`.
    """
    return prepared(read_recordings(paths), used or ReadingOptions())


def prepared(recordings: Sequence[RecordingFolder], used: ReadingOptions) -> list[RecordingFolder]:
    """Recordings that were read, as `read_with_notices` returns them; prints their notices."""
    calibration = used.read_calibration()
    found = [ready(recording, used, calibration) for recording in recordings]
    for _, lines in found:
        for line in lines:
            notice(f"notice: {line}")
    return [recording for recording, _ in found]


def ready(
    recording: RecordingFolder, used: ReadingOptions, calibration: Calibration | None
) -> tuple[RecordingFolder, list[str]]:
    """A recording with these options and the calibration that they name, and its notices, with its path."""
    path = recording.path
    recording = used.part.of(recording)
    if used.average is not None:
        recording = recording.averaged(used.average)
    lines = [f"{path}: {text}" for text in recording.notices]
    recording = recording.calibrated(calibration)
    if calibration is not None and recording.name in calibration.recordings:
        lines.append(f"{path}: is one of the recordings of {used.calibration}; errors of others are larger")
    if calibration is not None and (lacking := recording.uncalibrated()):
        lines.append(f"{path}: {listed(lacking)}: not in {used.calibration}, or moved since; used uncalibrated")
    return recording, lines


def notice_other_calibration(noise: Path | None, fitted: Mapping[str, str] | None, given: Path | None) -> None:
    """A notice where the file `noise` was fitted with a calibration, `fitted`, and another or none is `given`."""
    if fitted is None or (given is not None and identity(given)["fingerprint"] == fitted["fingerprint"]):
        return
    now = "none is given" if given is None else f"{given} is another"
    notice(
        f"notice: {noise}: fitted to recordings with the calibration {fitted['name']} ({fitted['fingerprint']}), and "
        f"{now}; give --calibration {fitted['name']}, or tune again"
    )


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
