"""What commands share: their stages and results, the recordings that they read, compiled programs, manifests."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trackwright.experiments.cli.options import Readings
from trackwright.experiments.text.terminal import Begin, notice, stages
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.recordings.atomic import config_hash, json_text, write_whole
from trackwright.trackers.recordings.folder import RecordingFolder, read_recordings
from trackwright.trackers.recordings.kinds import KINDS
from trackwright.trackers.recordings.tracks_table import require_output

if TYPE_CHECKING:
    from trackwright.trackers.recordings.calibration import Calibration

LEFT_OUT = 3
"""The exit code where recordings were left out, and the others done."""


@dataclass(frozen=True)
class Run:
    """A command that runs: `begin` begins a stage, `put` takes what `--json` prints at the end."""

    begin: Begin
    put: Callable[[Mapping[str, Any]], None]
    started: datetime = field(default_factory=lambda: datetime.now(UTC))

    @property
    def seconds(self) -> float:
        """Seconds since the beginning."""
        return (datetime.now(UTC) - self.started).total_seconds()


@contextmanager
def running(what: str, json: bool) -> Iterator[Run]:
    """Runs the command `what`; with `json`, standard output is what was put as JSON, and the rest goes to errors."""
    result: dict[str, Any] = {}
    with redirect_stdout(sys.stderr) if json else nullcontext(), stages(what) as begin:
        yield Run(begin, result.update)
    if json:
        print(json_text(result), end="")


def write_manifest(out: Path, config: Mapping[str, Any], started: datetime, **more: Any) -> None:
    """Writes `manifest.json`: the command, its options, versions, the device, and `more`."""
    import jax

    from trackwright import __version__

    versions = {"trackwright": __version__, **{name: version(name) for name in ("jax", "jaxlib", "numpy")}}
    manifest = {
        "command": sys.argv,
        "config": config,
        "config_sha256": config_hash(config),
        "seeds": [],
        "chunk": None,
        "versions": versions | {"python": platform.python_version()},
        "device": jax.devices()[0].device_kind,
        "platform": jax.default_backend(),
        "n_devices": jax.device_count(),
        "started": started.astimezone(UTC).isoformat(timespec="milliseconds"),
        "ended": datetime.now(UTC).isoformat(timespec="milliseconds"),
        **more,
    }
    write_whole(out / "manifest.json", json_text(manifest))


def keep_programs() -> None:
    """Keeps compiled programs for later commands; a notice where that is impossible."""
    from trackwright.trackers.programs.traced_programs import keep_programs

    keep_programs(lambda line: notices([line]))


def output_folder(path: Path) -> Path:
    """The folder, created if missing; raises UnusableInput as `require_output`, and where it cannot be."""
    require_output(path)
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
    recording: RecordingFolder, used: Readings, calibration: Calibration | None
) -> tuple[RecordingFolder, list[str]]:
    """A recording with the options and the calibration that they name, and its notices, with its path."""
    path, recording = recording.path, used.part.of(recording)
    if used.average is not None:
        recording = recording.averaged(used.average)
    recording = recording.calibrated(calibration)
    lines = [f"{path}: {text}" for text in recording.notices if not text.startswith("not calibrated")]
    if calibration is not None and recording.name in calibration.recordings:
        lines.append(f"{path}: is one of the recordings of {used.calibration}; its errors are smaller than others'")
    if calibration is not None and (lacking := recording.uncalibrated()):
        lines.append(f"{path}: {listed(lacking)}: not in {used.calibration}, or moved since; used uncalibrated")
    return recording, lines


def prepared(
    paths: Sequence[Path], used: Readings, force: bool | None = None, check: bool = True, calibrated: bool = False,
    refused: list[str] | None = None,
) -> list[RecordingFolder]:  # fmt: skip
    """The recordings in several folders as options ask for them; prints their notices. Raises UnusableInput for errors
    as `require_sound`; with `refused`, which gets a line for each unusable recording, only where none is left."""
    from trackwright.trackers.recordings.checks.all_checks import require_sound

    calibration, folders = used.read_calibration(), list[RecordingFolder]()
    for recording in read_recordings(paths, refused):
        try:
            notices(require_sound(recording, force, calibrated or calibration is not None) if check else ())
            folder, lines = ready(recording, used, calibration)
        except UnusableInput as problem:
            if refused is None:
                raise
            refused.append(str(problem))
            continue
        notices(lines)
        folders.append(folder)
    if refused and not folders:
        for line in refused[1:]:
            notice(f"not tracked: {line}")
        raise UnusableInput(refused[0])
    return folders


def notice_unused_calibration(folders: Sequence[RecordingFolder], tracker: str, table: str) -> None:
    """A notice where the recordings have a calibration, but the tracker reads nothing that one changes."""
    changed = [name for name, kind in KINDS.items() if kind.calibrated is not None]
    if folders[0].calibration is not None and not {*changed} & {*table.replace(",", " ").split()}:
        notice(f"notice: tracker '{tracker}' reads {table}; a calibration changes {listed(changed)} alone")
