"""What commands share: notices on standard error, the recordings that are read, output folders."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trackwright.experiments.cli.options import ReadingOptions, require_output
from trackwright.experiments.text.terminal import notice
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.recordings.atomic import json_text
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording, read_recordings, refuse_repeated
from trackwright.trackers.recordings.kinds import KINDS

if TYPE_CHECKING:
    from trackwright.trackers.recordings.calibration import Calibration
    from trackwright.tuning.tuned_file import Tuned


@contextmanager
def json_alone(wanted: bool) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """With `wanted`, standard output is JSON alone: what the yielded function is given, at the end."""
    result: dict[str, Any] = {}
    with redirect_stdout(sys.stderr) if wanted else nullcontext():
        yield result.update
    if wanted:
        print(json_text(result), end="")


def usable_recordings(paths: Sequence[Path], force: bool, calibrated: bool) -> tuple[list[RecordingFolder], list[str]]:
    """The recordings that can be tracked, and a line for each other one; with `force` those with errors, too. Raises
    UnusableInput as `read_recordings`, and where no recording can be tracked."""
    refused: list[str] = []
    usable = list[RecordingFolder]()
    for recording in read_recordings(paths, refused):
        try:
            usable += checked([recording], force, calibrated)
        except UnusableInput as problem:
            refused.append(str(problem))
    if not usable:
        for line in refused[1:]:
            notice(f"not tracked: {line}")
        raise UnusableInput(refused[0])
    return usable, refused


def errors_of(recording: RecordingFolder, force: bool | None, calibrated: bool) -> list[str]:
    """A line for each mistake of `quick_check`; raises UnusableInput for errors without `force`, None for no option."""
    from trackwright.trackers.recordings.checks.all_checks import quick_check

    mistakes = quick_check(recording, calibrated)
    lines = [f"{recording.path}: {mistake.where}: {mistake.message}" for mistake in mistakes]
    errors = [line for line, mistake in zip(lines, mistakes, strict=True) if mistake.level == "error"]
    if errors and not force:
        more = f" (and {len(errors) - 1} more: `trackwright check {recording.path}`)" if len(errors) > 1 else ""
        raise UnusableInput(f"{errors[0]}{more}{'' if force is None else '; --force takes it as it is'}")
    return lines


def checked(recordings: list[RecordingFolder], force: bool | None, calibrated: bool) -> list[RecordingFolder]:
    """The recordings; prints what `errors_of` returns of them, and raises as it."""
    for recording in recordings:
        for line in errors_of(recording, force, calibrated):
            notice(f"notice: {line}")
    return recordings


def read_with_notices(paths: Sequence[Path], used: ReadingOptions | None = None) -> list[RecordingFolder]:
    """The recordings in several folders with these options; prints their notices."""
    return prepared(read_recordings(paths), used or ReadingOptions())


def prepared(recordings: Sequence[RecordingFolder], used: ReadingOptions) -> list[RecordingFolder]:
    """Recordings that were read, as `read_with_notices` returns them; prints their notices."""
    calibration = used.read_calibration()
    pairs = [ready(recording, used, calibration) for recording in recordings]
    for _, lines in pairs:
        for line in lines:
            notice(f"notice: {line}")
    return [recording for recording, _ in pairs]


def ready(
    recording: RecordingFolder, used: ReadingOptions, calibration: Calibration | None
) -> tuple[RecordingFolder, list[str]]:
    """A recording with these options and the calibration that they name, and its notices, with its path."""
    path = recording.path
    recording = used.part.of(recording)
    if used.average is not None:
        recording = recording.averaged(used.average)
    recording = recording.calibrated(calibration)
    # What is not calibrated is listed below.
    lines = [f"{path}: {text}" for text in recording.notices if not text.startswith("not calibrated")]
    if calibration is not None and recording.name in calibration.recordings:
        lines.append(f"{path}: is one of the recordings of {used.calibration}; errors of others are larger")
    if calibration is not None and (lacking := recording.uncalibrated()):
        lines.append(f"{path}: {listed(lacking)}: not in {used.calibration}, or moved since; used uncalibrated")
    return recording, lines


def notice_other_calibration(noise: Path | None, tuned: Tuned, given: Path | None) -> None:
    """A notice where the file `noise` was fitted with a calibration, or without, and another, or none, is `given`."""
    from trackwright.trackers.recordings.input_file import identity

    fitted, begin = tuned.calibration, f"notice: {noise}: fitted to recordings with"
    # A file that names no tracker is not of `tune`.
    if fitted is None and given is not None and tuned.tracker is not None:
        notice(f"{begin}out a calibration, and {given} is given; leave --calibration out, or tune again")
    elif fitted is not None and (given is None or identity(given)["fingerprint"] != fitted["fingerprint"]):
        name, now = fitted["name"], "none is given" if given is None else f"{given} is another"
        notice(f"{begin} the calibration {name} ({fitted['fingerprint']}), and {now}; give it, or tune again")


def notice_unused_calibration(folders: Sequence[RecordingFolder], tracker: str, table: str) -> None:
    """A notice where the recordings have a calibration, but the tracker reads nothing that one changes."""
    changed = [name for name, kind in KINDS.items() if kind.calibrated is not None]
    if folders[0].calibration is not None and not {*changed} & {*table.replace(",", " ").split()}:
        notice(f"notice: tracker '{tracker}' reads {table}; a calibration changes {listed(changed)} alone")


def output_folder(path: Path) -> Path:
    """The folder, created if missing; raises UnusableInput as `require_output`, and if that fails."""
    require_output(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableInput(f"--out {path}: cannot be created ({error.strerror}); choose another folder") from error
    return path


class FoldersInTurn(Sequence[RecordingFolder]):
    """Recordings that are read whenever they are asked for, and kept by nobody here; notices are printed once."""

    def __init__(self, paths: Sequence[Path], used: ReadingOptions) -> None:
        refuse_repeated(paths)
        self.paths, self.used, self.numbers = paths, used, dict[str, int]()
        self.calibration = used.read_calibration()

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, which: Any) -> Any:
        if isinstance(which, slice):
            return [self[k] for k in range(len(self))[which]]
        number = range(len(self))[which]
        known, read = number in self.numbers.values(), [read_recording(self.paths[number])]
        (recording,) = read if known else checked(read, None, self.calibration is not None)
        folder, lines = ready(recording, self.used, self.calibration)
        for line in () if known else lines:
            notice(f"notice: {line}")
        self.numbers[folder.name] = number
        return folder

    def named(self, names: Iterable[str]) -> list[RecordingFolder]:
        """The recordings of these names, which were read before."""
        return [self[self.numbers[name]] for name in names]
