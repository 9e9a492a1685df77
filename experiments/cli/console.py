"""What commands share: the recordings that they read, compiled programs, manifests."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trackwright.experiments.cli.options import Numbers, Readings
from trackwright.experiments.text.terminal import Begin, notice
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.recordings.checks.all_checks import require_sound
from trackwright.trackers.recordings.files import json_text, write_whole
from trackwright.trackers.recordings.folder import RecordingFolder, read_recordings

if TYPE_CHECKING:
    from trackwright.trackers.recordings.calibration import Calibration

LEFT_OUT = 3  # the exit code where recordings were left out, and the others done


def write_manifest(out: Path, **about: Any) -> None:
    """Writes `manifest.json`: the command, versions, and what is given `about` it."""
    versions = {name: version(name) for name in ("trackwright", "jax", "jaxlib", "numpy", "polars")}
    manifest = {"command": sys.argv, "versions": versions | {"python": platform.python_version()}, **about}
    write_whole(out / "manifest.json", json_text(manifest))


def keep_programs() -> None:
    """Keeps compiled programs for later commands; a notice where that is impossible."""
    from trackwright.trackers.core.programs import keep_programs

    keep_programs(lambda line: notices([line]))


def output_folder(path: Path) -> Path:
    """The folder, created if missing; raises UnusableInput where it cannot be."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UnusableInput(f"--out {path}: cannot be created ({error.strerror}); choose another folder") from error
    return path


def notices(lines: Iterable[str]) -> None:
    """Prints the lines as notices."""
    for line in lines:
        notice(f"notice: {line}")


def ready(
    recording: RecordingFolder, used: Readings, force: bool | None, calibration: Calibration | None
) -> tuple[RecordingFolder, list[str]]:
    """A recording as options ask for it, and its notices; raises UnusableInput for errors as `require_sound`."""
    lines = require_sound(recording, force, calibration is not None)
    path, recording = recording.path, used.part.of(recording)
    if used.average is not None:
        recording = recording.averaged(used.average)
    recording = recording.calibrated(calibration)
    lines += [f"{path}: {text}" for text in recording.notices if not text.startswith("not calibrated")]
    if calibration is not None and recording.name in calibration.recordings:
        lines.append(f"{path}: is one of the recordings of {used.calibration}; its errors are smaller than others'")
    if calibration is not None and (lacking := recording.uncalibrated()):
        lines.append(f"{path}: {listed(lacking)}: not in {used.calibration}, or moved since; used uncalibrated")
    return recording, lines


def prepared(
    paths: Sequence[Path], used: Readings, begin: Begin, force: bool | None = None, refused: list[str] | None = None
) -> list[RecordingFolder]:
    """The recordings in several folders as `ready`; prints their notices, and begins to prepare programs for them. With
    `refused`, which gets a line for each unusable recording, UnusableInput is raised only where none is left."""
    begin("reading")
    calibration, folders = used.read_calibration(), list[RecordingFolder]()
    for recording in read_recordings(paths, refused):
        try:
            folder, lines = ready(recording, used, force, calibration)
        except UnusableInput as problem:
            if refused is None:
                raise
            refused.append(str(problem))
            continue
        notices(lines)
        folders.append(folder)
    if refused and not folders:
        raise UnusableInput(f"{refused[0]} ({len(refused)} of {len(paths)} recordings are refused)")
    begin("preparing")
    keep_programs()
    return folders


def chosen_tracker(folders: Sequence[RecordingFolder], numbers: Numbers) -> str:
    """The tracker that options name, or that fits the first recording, with a notice of what it leaves unread."""
    from trackwright.trackers.catalogue import fitting, spec_of

    name = numbers.named or fitting(folders[0])
    if numbers.tracker is None:
        spec = spec_of(name)
        unread = {table for folder in folders for table in folder.tables} - spec.reads - {"imu", "truth"}
        without = f"; without {listed(sorted(unread))}" if unread else ""
        notice(f"tracker: {name} ({spec.about}{without}); choose another with --tracker")
    return name
